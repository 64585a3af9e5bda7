//! The real binary on a real pty: the daemon, its outputs and its tools.
#![allow(
    clippy::unwrap_used,
    reason = "clippy knows no helper of a test as a test"
)]

#[path = "../bench/mod.rs"]
mod bench;

mod arm;
mod calibrate;
mod commands;
mod daemon;
mod demo;
mod doors;
mod faults;
mod http;
mod lines;
mod model;
mod motion;
mod port;
mod publish;
mod sensors;
mod service;
mod shipped;
mod shortage;
mod stdout;
mod subscribe;
#[cfg(feature = "watch")]
mod watch;
mod properties;
