//! Model files: how they are written, how they judge presses, and how good their verdicts are.

pub mod file;
pub mod verdicts;
pub mod evaluated;
pub mod export;
