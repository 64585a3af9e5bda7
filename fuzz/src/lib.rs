//! The properties of `tests/daemon` and of the trainer's tests, for the fuzz targets.

#[path = "../../tests/daemon/properties.rs"]
mod properties;
#[path = "../../crates/train/tests/trainer/property.rs"]
mod trainer;

pub use properties::*;
pub use trainer::npz;
