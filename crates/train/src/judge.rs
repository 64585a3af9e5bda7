//! The quality of recognisers and generated frames, compared with trivial methods; and pictures.

pub mod features;
pub mod baseline;
pub mod likeness;
pub mod paper;
pub mod metrics;
mod canvas;
pub mod sheet;
