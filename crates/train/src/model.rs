//! Model files: how they judge presses, and how they are written.

pub mod file;
pub mod verdicts;
pub mod export;
