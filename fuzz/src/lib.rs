//! The properties of `tests/daemon` and of the trainer's tests, for the fuzz targets.

#[path = "../../tests/daemon/properties.rs"]
mod properties;
#[cfg(feature = "train")]
#[path = "../../crates/train/tests/trainer/property.rs"]
mod trainer;

pub use properties::*;
#[cfg(feature = "train")]
pub use trainer::npz;
