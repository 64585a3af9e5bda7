//! From a trained recogniser to the ONNX file that the daemon loads.

pub mod file;
pub mod export;
pub mod course;
pub mod adopt;
pub mod review;
