//! Recordings: made by the real binary, replayed, damaged and saved.

mod bombs;
mod identify;
mod own;
mod record;
mod replay;
mod session;
