//! The networks: layers, weights, what they compute, and their losses.

pub mod graph;
pub mod image;
pub mod layers;
pub mod network;
mod builder;
pub mod frames;
pub mod standard;
pub mod shore;
pub mod bins;
pub mod sensed;
pub mod hrn;
pub mod frame;
pub mod course;
pub mod generator;
pub mod losses;
