//! Frames that are packed, so that the end of each is a byte of its own.
//!
//! In: packed bytes. Out: the layout of what is in them. A mark is put before each unpacked frame, so that
//! the search for frames of one length finds them, and is taken out of the proposal again.

use hardnessd_core::wire::{Framing, HexBytes, Settings};

use crate::found::{Failure, Found, Known, Ranked};
use crate::layout::Proposal;
use crate::text::most_frequent;
use crate::{Capture, in_periods};

/// What no sensor sends.
pub(crate) const MARK: [u8; 8] = [0xA5, 0xC3, 0x96, 0x3C, 0xD2, 0xE1, 0x69, 0xB4];

/// The layout of packed frames.
pub(crate) fn find(framing: Framing, bytes: &[u8], known: Known) -> Result<Found, Failure> {
    let frames: Vec<Vec<u8>> = bytes
        .split_inclusive(|&byte| byte == framing.end())
        .filter_map(|packed| framing.unpacked(packed))
        .filter(|frame| !frame.is_empty())
        .collect();
    let usual = most_frequent(frames.iter().map(Vec::len));
    let (usual, _) = usual.ok_or(Failure::NotPeriodic(bytes.len()))?;
    let mut capture = Capture::default();
    let usual_frames = frames.iter().filter(|frame| frame.len() == usual);
    for (index, frame) in usual_frames.enumerate() {
        capture.take(&[&MARK[..], frame].concat(), index as f64);
    }
    let Found { best, next, .. } = in_periods(&capture, known)?;
    let packed = |ranked: Ranked| {
        let proposal = without_mark(ranked.proposal, framing, bytes)?;
        Some(Ranked { proposal, ..ranked })
    };
    let ranked = [Some(best), next].into_iter().flatten().filter_map(packed);
    Found::among(ranked.collect(), known.is_complete()).ok_or(Failure::NoArray(usual))
}

/// The proposal for the packed bytes.
fn without_mark(proposal: Proposal, framing: Framing, bytes: &[u8]) -> Option<Proposal> {
    let Proposal {
        settings, remarks, ..
    } = proposal;
    let of = |part: &Option<HexBytes>| part.clone().unwrap_or_default().0;
    let around = [of(&settings.tail), of(&settings.sync)].concat();
    let at = around.windows(MARK.len()).position(|part| part == MARK)?;
    let part = |bytes: &[u8]| (!bytes.is_empty()).then(|| HexBytes(bytes.to_vec()));
    let settings = Settings {
        framing: Some(framing),
        tail: part(&around[..at]),
        sync: part(&around[at + MARK.len()..]),
        ..settings
    };
    let decoded = Proposal::decoded(settings, false, bytes)?;
    Some(Proposal { remarks, ..decoded })
}
