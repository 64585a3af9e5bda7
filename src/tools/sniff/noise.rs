//! The noise of an array at rest.
//!
//! In: a layout and all the bytes. Out: by how many counts several taxels of a quiet frame exceed their
//! rest.

use hardnessd_core::frame::RawFrame;
use hardnessd_core::wire::{Decoder, Layout, Settings};

/// One in so many frames is quiet, that with the smallest sum.
const QUIET: usize = 4;
/// As many taxels in contact begin a press.
const TAXELS: usize = 3;

/// The greatest number of counts that as many taxels as begin a press exceed their rest by, in a quiet
/// frame.
pub(super) fn noise_counts(settings: &Settings, bytes: &[u8]) -> u16 {
    let Ok(layout) = Layout::new(settings) else {
        return 0;
    };
    let mut decoder = Decoder::new(layout);
    decoder.push(bytes);
    decoder.settle();
    let mut frames: Vec<RawFrame> = std::iter::from_fn(|| decoder.next_frame())
        .filter_map(|found| found.ok().map(|decoded| decoded.frame))
        .collect();
    frames.sort_by_cached_key(|frame| {
        let counts = frame.counts.iter().copied();
        counts.map(u64::from).sum::<u64>()
    });
    frames.truncate(frames.len().div_ceil(QUIET));
    let taxels = frames.first().map_or(0, |frame| frame.counts.len());
    let rest: Vec<u16> = (0..taxels)
        .map(|taxel| {
            let mut counts: Vec<u16> = frames.iter().map(|frame| frame.counts[taxel]).collect();
            counts.sort_unstable();
            counts[counts.len() / 2]
        })
        .collect();
    let of_frame = |frame: &RawFrame| {
        let taxels = frame.counts.iter().zip(&rest);
        let mut above: Vec<u16> = taxels
            .map(|(count, rest)| count.saturating_sub(*rest))
            .collect();
        above.sort_unstable();
        above.iter().rev().nth(TAXELS - 1).copied().unwrap_or(0)
    };
    frames.iter().map(of_frame).max().unwrap_or(0)
}
