//! What augmentation can be told.

use serde::{Deserialize, Serialize};

/// What is done to a training frame before each use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[derive(Default)]
pub struct AugmentationSettings {
    /// Turn and mirror.
    pub symmetries: bool,
    /// Shift by up to this many taxels along each axis; what comes in is background.
    pub shift_taxels: u8,
    /// Half of the frames as another sensor of the kind would have given them.
    pub other_sensors: bool,
}
