//! What the tests of several modules need, also those of the other crates.

#[cfg(test)]
pub(crate) mod course_model;
pub mod graph;
pub mod support;
