//! The method of the paper, storey by storey: data, networks, losses, loop, file.
//!
//! In: labelled and unlabelled frames. Out: a run's directory with the model that the daemon loads
//! and its evaluation. The modules below are in reading order, and each uses only those above
//! it: [`settings`] holds the settings of a run, [`data`] makes data sets and batches,
//! [`net`] holds the networks and their losses, [`judge`] measures, [`run`] keeps a run's files,
//! [`learn`] takes the steps, [`model`] writes the ONNX file, [`stages`] and [`methods`] build the
//! paper's method from these parts, and [`compare`] runs all methods for tables and reports.
//! Nothing here draws from a global random state.
//!
//! What to expect: `--method frame --profile quick`, trained on 58,000 simulated presses, judges
//! 78 % of the presses of other random materials correctly with `matched` shapes and 65 % with
//! `wide` ones, and takes 3 minutes of one thread. `--method course`, trained on 122,312 presses,
//! judges 92 and 89 % correctly and takes 55 minutes of one busy core (`models/`).

pub mod settings;
pub mod data;
pub mod net;
pub mod judge;
pub mod run;
pub mod learn;
pub mod model;
pub mod stages;
pub mod methods;
pub mod compare;
