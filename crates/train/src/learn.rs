//! Training: the optimiser, and the training loops of recognisers and GANs.

pub mod optimiser;
pub mod learner;
pub mod temperature;
pub mod epochs;
pub mod fit;
pub mod conformal;
pub mod frame;
pub mod course;
pub mod gan;
