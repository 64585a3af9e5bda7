//! The real binary on a real pty: the daemon, its outputs and its tools.

mod calibrate;
mod commands;
mod demo;
mod doors;
mod faults;
mod flood;
mod http;
mod lines;
mod model;
mod motion;
mod port;
mod publish;
mod running;
mod sensors;
mod shipped;
mod soak;
mod stdout;
mod subscribe;
mod watch;
mod properties;
