//! The exit codes of both programs, which an operator's scripts may rely on.

/// The command failed, or its data is bad.
pub const FAILED: u8 = 1;
/// Wrong usage.
pub const USAGE: u8 = 2;
/// A file named on the command line is missing or unreadable.
pub const NO_INPUT: u8 = 66;
/// A device or the daemon is unavailable.
pub const UNAVAILABLE: u8 = 69;
/// I/O error.
pub const IO: u8 = 74;
/// Bad configuration or model, or a file that the configuration names.
pub const CONFIG: u8 = 78;
