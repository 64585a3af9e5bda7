//! The settings of verdicts.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::{BUILT_IN, BUILT_IN_HRN};
use crate::range::from_to;

crate::settings! {
    /// The `[model]` table.
    pub struct Settings {
        /// The model in the binary that judges, unless a path names another.
        pub built_in: BuiltIn = BuiltIn::Course;
        /// The path of the ONNX file. The default is the built-in model.
        pub path: Option<PathBuf>;
        /// The SHA-256 hash that the model must have, in hex.
        pub sha256: Option<String>;
        /// A verdict below this confidence is rejected.
        pub min_confidence: f32 = 0.0, in from_to((0.0, 1.0), "");
        /// A verdict on a frame with less total force, in newtons, is rejected.
        pub min_force_n: f64 = 0.0, in from_to((0.0, 1e6), "newtons");
        /// A model of the course gives an early verdict when its confidence reaches this value.
        pub early_confidence: f32 = 0.95, in from_to((0.0, 1.0), "");
    }
}

/// The models in the binary.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BuiltIn {
    /// The model of courses and references.
    #[default]
    Course,
    /// The model that judges one frame, that of the largest contact area, as the paper does.
    Hrn,
}

impl BuiltIn {
    /// The bytes of the model.
    pub fn bytes(self) -> &'static [u8] {
        match self {
            Self::Course => BUILT_IN,
            Self::Hrn => BUILT_IN_HRN,
        }
    }
}
