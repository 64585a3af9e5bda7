//! The real binary on a real pty: the daemon, its outputs and its tools.

mod arm;
mod calibrate;
mod commands;
mod demo;
mod doors;
mod faults;
mod http;
mod lines;
mod model;
mod motion;
mod port;
mod publish;
mod running;
mod sensors;
mod service;
mod shipped;
mod shortage;
mod stdout;
mod subscribe;
#[cfg(feature = "watch")]
mod watch;
mod properties;
