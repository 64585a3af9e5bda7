//! Bytes become frames, frames become presses, presses become verdicts and events.
//!
//! The modules are in reading order: each uses only the modules above it. They wait for nothing and ask
//! no clock: callers pass in the bytes and the time at which they arrived. [`recording`] is given a
//! reader or a writer. Only two do I/O: [`part`] writes files, and [`trial`] starts a child process that tries
//! a model.

pub mod frame;
pub mod colour;
pub mod wording;
pub mod exit;
pub mod range;
pub mod allowance;
pub mod line;
pub mod part;
pub mod npy;
pub mod npz;
pub mod wire;
pub mod tare;
pub mod press;
pub mod motion;
pub mod verdict;
pub mod port;
pub mod sensor;
pub mod references;
pub mod event;
pub mod ros;
pub mod judge;
pub mod pipeline;
pub mod recording;
pub mod trial;
#[cfg(any(test, feature = "test-support"))]
pub mod tests;
