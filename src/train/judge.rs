//! How good a recogniser or a generated frame is, beside what trivial methods reach; and pictures.

pub mod features;
pub mod baseline;
pub mod press_features;
pub mod likeness;
pub mod paper;
pub mod metrics;
mod canvas;
pub mod sheet;
