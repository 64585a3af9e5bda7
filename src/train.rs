//! The method of the paper, stage by stage: data, networks, losses, loop, file.
//!
//! In: labelled and unlabelled frames. Out: a run's directory with the model that the daemon loads
//! and what it is worth. In reading order: [`dataset`] and [`augment`] make batches, [`network`]
//! and [`hrn`] judge them, [`optimiser`] and [`fit`] learn from them, [`features`] is the trivial
//! baseline, [`methods`] are the table's rows, [`onnx`] and [`export`] write the file, [`metrics`]
//! say how good it is. Nothing here draws from a global random state.

pub mod settings;
pub mod dataset;
pub mod augment;
pub mod network;
pub mod hrn;
pub mod optimiser;
pub mod checkpoint;
pub mod run;
pub mod fit;
pub mod features;
pub mod methods;
pub mod onnx;
pub mod metrics;
pub mod export;
pub mod sheet;
