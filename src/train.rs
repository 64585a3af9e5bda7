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
//! What to expect: `config/default-model.toml` on 10,000 simulated samples reaches 86.4 % on fresh
//! objects of the test materials with `paper` shapes and 81.2 % with `matched` ones; 612 s on one
//! thread of a busy machine (2026-11-21; `models/README.md`).

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
