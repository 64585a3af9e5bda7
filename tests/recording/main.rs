//! Recordings: made by the real binary, replayed, damaged and saved.
#![allow(
    clippy::unwrap_used,
    reason = "clippy knows no helper of a test as a test"
)]

#[path = "../bench/mod.rs"]
mod bench;

mod identify;
mod recording;
mod replay;
mod session;
