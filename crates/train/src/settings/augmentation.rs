//! Settings of augmentation.

use serde::{Deserialize, Serialize};

/// The changes made to a training frame before each use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[derive(Default)]
pub struct AugmentationSettings {
    /// Whether frames are turned and mirrored.
    pub symmetries: bool,
    /// The largest shift along each axis, in taxels. The taxels that come in are background.
    pub shift_taxels: u8,
}
