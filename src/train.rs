//! The method of the paper, storey by storey: data, networks, losses, loop, file.
//!
//! In: labelled and unlabelled frames. Out: a run's directory with the model that the daemon loads
//! and what it is worth. The modules below stand in the order of the storeys. Each uses only those
//! above it: [`settings`] says what a run can be told, [`data`] makes data sets and batches,
//! [`net`] holds the networks and their losses, [`judge`] measures, [`run`] keeps a run's files,
//! [`learn`] takes the steps, [`model`] writes the ONNX file, [`stages`] and [`methods`] are the
//! paper's method over these parts, and [`compare`] runs all methods for tables and reports.
//! Nothing here draws from a global random state.
//!
//! What to expect: `--method frame --profile quick` on 58,000 simulated presses is right on 78 % of presses of
//! random other materials with `matched` shapes and on 65 % with `wide` ones; 3 minutes of one thread.
//! `--method course` on 60,000 presses is right on 90 and 89 %; 20 minutes of one thread (`models/`).

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
