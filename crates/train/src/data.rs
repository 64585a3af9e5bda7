//! Sources of frames (data set files, the simulator, recordings), and the variation of a frame.

pub mod dataset;
pub mod courses;
pub mod simulated;
pub mod collect;
pub mod augment;
