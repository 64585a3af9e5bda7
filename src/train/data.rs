//! Where frames come from: data set files, the simulator, recordings; and how a frame is varied.

pub mod dataset;
pub mod courses;
pub mod simulated;
pub mod collect;
pub mod disturb;
pub mod augment;
