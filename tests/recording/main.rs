//! Recordings: made by the real binary, replayed, damaged and saved.
#![allow(
    clippy::unwrap_used,
    reason = "clippy knows no helper of a test as a test"
)]

#[path = "../bench/mod.rs"]
mod bench;
#[path = "../../src/tools/pty/pair.rs"]
#[allow(dead_code, reason = "nobody here asks where the device is")]
mod pair;

mod identify;
mod recording;
mod replay;
mod session;
