//! Bytes become frames, frames become presses, presses become verdicts, verdicts reach
//! subscribers, and only the two ends touch the world.
//!
//! The modules below stand in reading order. Each from [`frame`] to [`random`] uses only those
//! above it and opens nothing, waits for nothing and asks no clock: it is given bytes and the
//! moment they came; [`recording`] also what to read from and write to. `daemon`, `tools` and
//! `train` are the ends.

pub mod frame;
pub mod wording;
pub mod wire;
pub mod tare;
pub mod press;
pub mod sensor;
pub mod verdict;
pub mod event;
mod ros;
pub mod pipeline;
pub mod recording;

pub mod random;
pub mod simulator;

pub mod daemon;
pub mod tools;
#[cfg(feature = "train")]
pub mod train;
