//! The properties of `tests/doors`, for the targets beside this file.

#[path = "../../tests/doors/properties.rs"]
mod properties;

pub use properties::*;
