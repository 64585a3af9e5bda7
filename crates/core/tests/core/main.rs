//! The formats: bytes of a sensor, and published events.
#![allow(
    clippy::unwrap_used,
    reason = "clippy knows no helper of a test as a test"
)]

mod event_format;
mod wire_props;
