//! The bounds of a model, and the error of one that is refused.

use std::fmt::Display;

use tract_onnx::prelude::TractError;

/// The largest accepted model file, in bytes: 64 MB.
pub const MAX_FILE_BYTES: usize = 64_000_000;
/// The oldest accepted ONNX operator set.
pub const MIN_OPSET: i64 = 17;
/// The largest accepted difference from the check frames' probabilities.
pub const CHECK_TOLERANCE: f32 = 1e-4;
/// What failed inside the inference library.
pub(super) const RUNNING: &str = "model graph cannot be run";
pub(super) const JUDGING: &str = "model could not judge a frame";
/// The largest accepted difference from the check presses' Shore hardness.
pub const SHORE_TOLERANCE: f32 = 1e-2;

/// The reason why a model is refused, takes no such levels or references, or could not judge.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct ModelError(String);

impl ModelError {
    pub(crate) fn new(problem: impl Into<String>) -> Self {
        Self(problem.into())
    }

    /// The error of a file of `found` bytes.
    pub(crate) fn too_large(found: usize) -> Self {
        Self(format!(
            "model file of {found} bytes: at most {MAX_FILE_BYTES} are accepted"
        ))
    }

    /// The error of a key of the metadata.
    pub(super) fn of_key(key: &str, found: impl Display, expected: impl Display) -> Self {
        Self(format!(
            "model metadata `{key}`: found {found}, expected {expected}"
        ))
    }

    /// The error of what failed inside the inference library. Of the library's messages, the outer ones
    /// name only its own stages.
    pub(super) fn of(what: &str) -> impl Fn(TractError) -> Self {
        move |error| Self(format!("{what}: {}", error.root_cause()))
    }
}
