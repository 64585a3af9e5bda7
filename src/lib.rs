//! `hardnessd`: the daemon and the tools around it, the two ends of the core that touch the world.

pub mod thread;
mod maybe;
mod holders;
mod score;
pub mod daemon;
pub mod tools;
