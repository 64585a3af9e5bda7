//! The errors of commands, and the exit code of each.

use std::path::PathBuf;

use hardnessd_core::exit;
use hrn_train::data::collect::{CollectError, Problem};
use hrn_train::data::presses::DatasetError;
use hrn_train::settings::SettingsError;
use hrn_train::train::LabelsError;

use super::configuration::ConfigurationError;
use hardnessd_core::verdict::ModelError;

/// A file named on the command line that cannot be read.
#[derive(Debug, thiserror::Error)]
#[error("{}: {source}", path.display())]
pub(super) struct Unreadable {
    pub(super) path: PathBuf,
    pub(super) source: std::io::Error,
}

/// A directory named on the command line that has no model to take.
#[derive(Debug, thiserror::Error)]
#[error("{}: no finished run: {}", .0.display(), .1)]
pub(super) struct NoRun(pub(super) PathBuf, pub(super) &'static str);

/// The command line asks for a CUDA device, and there is none.
#[derive(Debug, thiserror::Error)]
#[cfg_attr(
    feature = "cuda",
    error(
        "--device cuda: no CUDA device found: check the device and its driver with nvidia-smi, or use \
         --device cpu"
    )
)]
#[cfg_attr(
    not(feature = "cuda"),
    error(
        "--device cuda: this build has no CUDA: build with --features cuda, or use --device cpu"
    )
)]
pub(super) struct NoCuda;

/// Options that do not go together.
#[derive(Debug, thiserror::Error)]
pub(super) enum WrongUsage {
    #[error("--objects and --test-objects: found 0 and 0, expected one or more of either")]
    NoObjects,
    #[error("{0}: works with `--materials {1}` only")]
    OtherMaterials(&'static str, &'static str),
    #[error("{}: {} is another file of this command: name a new one", .0, .1.display())]
    Overwritten(&'static str, PathBuf),
}

/// One of several files cannot be collected.
#[derive(Debug, thiserror::Error)]
#[error("{0} (to leave out such recordings: --skip-unusable)")]
pub(super) struct NotCollected(#[source] pub(super) CollectError);

fn problem<'e>(error: &'e (dyn std::error::Error + 'static)) -> Option<&'e Problem> {
    match error.downcast_ref()? {
        CollectError::File { problem, .. } => Some(problem),
        CollectError::Dataset(_) => None,
    }
}

/// The exit code: 2 wrong usage, 66 unreadable input, 69 no such device, 78 bad configuration or
/// model, 74 other I/O error, 1 any other error.
pub(super) fn exit_code(error: &anyhow::Error) -> u8 {
    let has = |test: fn(&(dyn std::error::Error + 'static)) -> bool| error.chain().any(test);
    if has(|e| {
        e.is::<WrongUsage>()
            || e.is::<LabelsError>()
            || matches!(problem(e), Some(Problem::NoLevel))
    }) {
        exit::USAGE
    } else if has(|e| {
        e.is::<Unreadable>()
            || e.is::<NoRun>()
            || matches!(e.downcast_ref(), Some(DatasetError::Unreadable { .. }))
            || matches!(problem(e), Some(Problem::Unreadable(_)))
    }) {
        exit::NO_INPUT
    } else if has(<dyn std::error::Error>::is::<NoCuda>) {
        exit::UNAVAILABLE
    } else if has(|e| {
        e.is::<ModelError>() || e.is::<SettingsError>() || e.is::<ConfigurationError>()
    }) {
        exit::CONFIG
    } else if has(<dyn std::error::Error>::is::<std::io::Error>) {
        exit::IO
    } else {
        exit::FAILED
    }
}
