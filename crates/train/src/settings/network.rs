//! Settings of the networks.

use serde::{Deserialize, Serialize};

/// The pooling of each channel for the recogniser's last layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Pooling {
    /// The greatest value, as in the paper.
    Max,
    /// The greatest value and the mean. A mean can add up an area or a force.
    MaxMean,
}

/// Settings of the networks' image and pooling. The defaults are the paper's.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NetworkSettings {
    /// `max` or `max-mean`. It applies to a recogniser with a last layer of its own, so not to SGAN
    /// and IGAN, whose discriminator is the recogniser.
    pub pooling: Pooling,
    /// Above 0, the image is linear in log(1 + newtons / this value). With 0, it is linear in
    /// newtons.
    pub log_above_n: f64,
}

impl Default for NetworkSettings {
    fn default() -> Self {
        Self {
            pooling: Pooling::Max,
            log_above_n: 0.0,
        }
    }
}
