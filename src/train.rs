//! The method.

pub mod augment;
pub mod dataset;
pub mod hrn;
pub mod metrics;
pub mod network;
pub mod onnx;
pub mod optimiser;
