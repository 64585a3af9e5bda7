//! Presses, as the simulator and recordings give them, and as files keep them.

pub mod source;
pub mod presses;
pub mod findings;
pub mod split;
pub mod augment;
pub mod simulated;
pub mod collect;
