//! The properties of `tests/doors`, for the fuzz targets.

#[path = "../../tests/doors/properties.rs"]
mod properties;

pub use properties::*;
