//! The pages say what the programs do.

mod commands;
mod docs;
mod guides;
mod links;
