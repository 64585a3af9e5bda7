//! The pages say what the programs do.
#![allow(
    clippy::unwrap_used,
    reason = "clippy knows no helper of a test as a test"
)]

#[path = "../bench/mod.rs"]
mod bench;
mod commands;
mod docs;
mod guides;
mod pages;
