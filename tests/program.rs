//! The programs from outside: the daemon, its recordings and its pages. One binary, so it links once,
//! and tests that wait run beside tests that work.
#![allow(
    clippy::unwrap_used,
    reason = "clippy knows no helper of a test as a test"
)]

mod bench;
mod daemon;
mod pages;
mod recording;
