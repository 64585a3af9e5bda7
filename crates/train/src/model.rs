//! Exports trained recognisers to the ONNX file that the daemon loads, and adapts other ONNX files
//! to the format.

pub mod file;
pub mod evaluated;
pub mod export;
pub mod course;
pub mod learners;
pub mod foreign;
pub mod adopt;
pub mod review;
