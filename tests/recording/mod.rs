//! Recordings: made by the real binary, replayed, damaged and saved.

mod identify;
mod recording;
mod replay;
mod session;
