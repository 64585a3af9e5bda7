//! The method.

pub mod augment;
pub mod checkpoint;
pub mod dataset;
pub mod fit;
pub mod hrn;
pub mod metrics;
pub mod network;
pub mod onnx;
pub mod optimiser;
pub mod run;
pub mod settings;
