//! The method of the paper, stage by stage: data, networks, losses, loop, file.
//!
//! What to expect: `config/default-model.toml` on 10,000 simulated samples reaches 86.4 % on fresh
//! objects of the test materials with `paper` shapes and 81.2 % with `matched` ones; 612 s on one
//! thread of a busy machine (2026-11-21; `models/README.md`).
//!
//! In: labelled and unlabelled frames. Out: a run's directory with the model that the daemon loads
//! and what it is worth. In reading order: [`simulated`] and [`collect`] make
//! data sets, [`dataset`] and [`augment`] batches, [`generator`]
//! makes frames, [`network`] and [`hrn`] judge them, [`losses`] and [`gan`] set one against the
//! other, [`optimiser`] and [`fit`] learn, [`features`] is the trivial baseline, [`methods`] are
//! the table's rows over the parts of [`stages`], [`onnx`] and [`export`] write the file,
//! [`metrics`] and [`likeness`] say how good it is, and [`compare`] runs them all for the
//! [`tables`] and the [`report`]. Nothing here draws from a global random state.

pub mod settings;
pub mod dataset;
pub mod simulated;
pub mod collect;
pub mod augment;
pub mod layers;
pub mod network;
pub mod hrn;
pub mod generator;
pub mod losses;
pub mod optimiser;
pub mod learner;
pub mod checkpoint;
pub mod features;
pub mod baseline;
pub mod likeness;
pub mod history;
pub mod disk;
pub mod run;
mod progress;
pub mod fit;
pub mod gan;
pub mod stages;
pub mod methods;
pub mod onnx;
pub mod metrics;
pub mod paper;
pub mod compare;
pub mod tables;
pub mod report;
pub mod export;
pub mod sheet;
