//! The networks: layers, weights, what they compute, and their losses.

pub mod layers;
pub mod network;
pub mod graph;
pub mod image;
pub mod standard;
pub mod bins;
pub mod sensed;
pub mod hrn;
pub mod course;
pub mod generator;
pub mod losses;
