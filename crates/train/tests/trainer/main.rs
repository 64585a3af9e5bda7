//! The real trainer on small data.
#![allow(
    clippy::unwrap_used,
    reason = "clippy knows no helper of a test as a test"
)]

mod adopt;
mod collect;
mod compare;
mod course;
mod doors;
mod strangers;
mod train;
mod property;
