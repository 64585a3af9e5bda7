//! Bytes become frames, frames become presses, presses become verdicts, verdicts reach
//! subscribers, and only the two ends touch the world.
//!
//! The modules are in reading order. Each module from [`frame`] to [`random`] uses only the modules
//! above it. These modules do no I/O, wait for nothing and ask no clock: callers pass in the bytes
//! and the time at which they arrived. [`recording`] is also given a reader or a writer. `daemon`,
//! `tools` and `train` are the two ends that touch the world.

pub mod frame;
pub mod colour;
pub mod wording;
pub mod npy;
pub mod wire;
pub mod tare;
pub mod press;
pub mod motion;
pub mod sensor;
pub mod verdict;
pub mod event;
mod ros;
pub mod pipeline;
pub mod recording;

pub mod random;
pub mod simulator;

pub mod trial;

pub mod daemon;
pub mod tools;
#[cfg(feature = "train")]
pub mod train;
