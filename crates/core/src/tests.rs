//! What the tests of several modules need.

pub(crate) mod course_model;
pub(crate) mod graph;
