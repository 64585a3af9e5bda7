//! The quality of recognisers, and what the paper reports.

pub mod paper;
pub mod metrics;
pub mod interval;
pub mod evaluated;
