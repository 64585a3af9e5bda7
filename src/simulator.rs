//! The press simulator.
