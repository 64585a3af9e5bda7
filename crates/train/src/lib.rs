//! The trainer, storey by storey: presses, networks and their losses, one loop, a file.
//!
//! In: labelled and unlabelled presses. Out: a run's directory with the model that the daemon loads
//! and its evaluation. The modules below are in reading order, and each uses only those above
//! it: [`exit`] gives errors their exit codes, `progress` shows how far work is, [`settings`] holds the
//! settings of a run, [`data`] reads and splits presses, [`net`] holds the networks and their losses,
//! [`judge`] measures, [`run`] keeps a run's files, [`learn`] takes the steps, [`model`] writes the ONNX
//! file, [`recipe`] names the methods, [`methods`] builds their stages from these parts, [`train`] is one
//! training, [`compare`] runs all methods, and [`fit`] makes the best model of a user's own presses.
//! Nothing here draws from a global random state.

pub mod exit;
mod progress;
pub mod settings;
pub mod data;
pub mod net;
pub mod judge;
pub mod run;
pub mod learn;
pub mod model;
pub mod recipe;
pub mod methods;
pub mod train;
pub mod compare;
pub mod fit;
