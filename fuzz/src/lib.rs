//! The properties of `tests/doors`, for the fuzz targets.

#[path = "../../tests/daemon/properties.rs"]
mod properties;
#[cfg(feature = "train")]
#[path = "../../crates/train/tests/trainer/property.rs"]
mod trainer;

pub use properties::*;
#[cfg(feature = "train")]
pub use trainer::npz;
