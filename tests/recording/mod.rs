//! Recordings: made by the real binary, replayed, damaged and saved.

mod identify;
mod record;
mod replay;
mod session;
