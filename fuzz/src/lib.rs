//! The properties of `tests/doors`, for the fuzz targets.

#[path = "../../tests/doors/properties.rs"]
mod properties;
#[cfg(feature = "train")]
#[path = "../../crates/train/tests/doors/property.rs"]
mod trainer;

pub use properties::*;
#[cfg(feature = "train")]
pub use trainer::npz;
