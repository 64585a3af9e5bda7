//! The method.

pub mod augment;
pub mod hrn;
pub mod metrics;
pub mod network;
pub mod onnx;
pub mod optimiser;
