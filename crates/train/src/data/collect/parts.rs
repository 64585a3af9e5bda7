//! The presses of each capture in a file of its own, so that they are found only once.
//!
//! In: captures. Out: small `.npz` files in a directory. A file's name is a hash of the capture's
//! bytes and of everything else that decides what is found in them. A file appears as a whole, so
//! a killed process leaves no half one.

use std::fs;
use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context as _;

use super::CollectError;
use super::capture::{Head, Presses};
use super::selection::Judged;
use crate::data::courses::{Courses, Press};
use crate::data::dataset::file::{self, Element, File};
use crate::data::dataset::stream::Stream;
use hardnessd_core::frame::{COLS, ROWS, TAXELS};
use hardnessd_core::recording::FileKind;
use hardnessd_core::sensor::Sensor;
use hardnessd_core::verdict::{Hrn, sha256_hex};
use hardnessd_simulator::Split;

/// Names the program that makes parts, because another one may find other presses. A commit says what the program
/// was built from. If there is none, or the sources were changed after it, only the program's own bytes do.
fn maker(commit: &str, program: &Path) -> anyhow::Result<String> {
    let version = env!("CARGO_PKG_VERSION");
    // These words are of `build.rs`.
    if commit != "no checkout" && !commit.ends_with("-dirty") {
        return Ok(format!("{version} {commit}"));
    }
    let bytes = fs::read(program).with_context(|| program.display().to_string())?;
    Ok(format!("{version} {commit} {}", sha256_hex(&bytes)))
}

/// A directory of parts.
#[derive(Debug, Clone)]
pub struct Parts {
    directory: PathBuf,
    sensor: Sensor,
    hrn: Arc<Hrn>,
    sequences: bool,
    maker: String,
}

impl Parts {
    /// Parts in `directory`, which must exist. `sensor` is the sensor of captures that do not
    /// describe their own, `hrn` judges the presses, and `sequences` says whether all frames of a
    /// press are wanted.
    ///
    /// # Errors
    ///
    /// Fails if this program cannot be read. A build of a commit does not read it.
    pub fn new(
        directory: PathBuf,
        sensor: Sensor,
        hrn: Arc<Hrn>,
        sequences: bool,
    ) -> anyhow::Result<Self> {
        // The program that runs, even if another one was built in its place.
        let program = Path::new("/proc/self/exe");
        Ok(Self {
            directory,
            sensor,
            hrn,
            sequences,
            maker: maker(env!("HARDNESSD_REVISION"), program)?,
        })
    }

    pub(super) fn are_sequences(&self) -> bool {
        self.sequences
    }

    /// Makes the part of a capture, if it is not there, and gives it with its head. No two calls
    /// at a time may have the same `number`.
    ///
    /// # Errors
    ///
    /// Returns a [`CollectError`] if the capture gives no samples, and another error if the part
    /// cannot be written.
    pub(super) fn of(&self, path: &Path, number: usize) -> anyhow::Result<(PathBuf, Head)> {
        let bytes = file::whole(path).map_err(|source| CollectError::Unreadable {
            path: path.to_owned(),
            source,
        })?;
        let sha256 = sha256_hex(&bytes);
        let part = self.directory.join(self.name(&bytes, &sha256));
        if let Some(head) = head(&part, path) {
            return Ok((part, head));
        }
        let Presses {
            labels,
            pitch_mm,
            judged,
        } = Presses::of(&bytes, path, &self.sensor, &self.hrn)?;
        let mut head = Head {
            path: path.to_owned(),
            sha256,
            labels,
            pitch_mm,
            judged: judged.len(),
            presses: 0,
            known: 0,
            frames: 0,
        };
        let bytes = match self.sequences {
            true => of_courses(&judged, &mut head),
            false => of_frames(&judged, &mut head),
        };
        let half = self.directory.join(format!("{number}.half"));
        fs::write(&half, bytes?)
            .and_then(|()| fs::rename(&half, &part))
            .with_context(|| half.display().to_string())?;
        Ok((part, head))
    }

    fn name(&self, bytes: &[u8], sha256: &str) -> String {
        // A recording describes its own sensor.
        let sensor = match FileKind::of(bytes) {
            FileKind::Recording => String::new(),
            FileKind::Raw => format!("{:?}", self.sensor),
        };
        let (maker, model, sequences) = (&self.maker, self.hrn.sha256(), self.sequences);
        let decides = format!("{maker} {model} {sequences} {sha256} {sensor}");
        format!("{}.npz", sha256_hex(decides.as_bytes()))
    }
}

/// The head of a part. `None` if the part is missing or damaged.
pub(super) fn head(part: &Path, path: &Path) -> Option<Head> {
    let bytes = fs::read(part).ok()?;
    let meta = File::open(&bytes, part).ok()?.meta().ok()?;
    let head: Head = serde_json::from_value(meta).ok()?;
    Some(Head {
        path: path.to_owned(),
        ..head
    })
}

/// An array of a part with `n` rows of shape `inner`.
pub(super) fn array<T: Element>(
    part: &Path,
    name: &'static str,
    inner: &[usize],
    n: usize,
) -> anyhow::Result<Vec<T>> {
    let read = || File::open(&file::read(part)?, part)?.required(name, inner, Some(n));
    read().context("a damaged part: remove it and collect again")
}

/// An array that is in memory, as the only block.
fn block<T>(values: Vec<T>) -> [anyhow::Result<Vec<T>>; 1] {
    [Ok(values)]
}

fn of_frames(judged: &[Judged], head: &mut Head) -> anyhow::Result<Vec<u8>> {
    let n = judged.len();
    (head.presses, head.frames) = (n, n);
    let mut part = Stream::new(Cursor::new(Vec::new()));
    let frames = judged.iter().map(|press| Ok(press.frame.newtons.to_vec()));
    part.add("frames", &[n, ROWS, COLS], frames)?;
    let forces = judged.iter().map(|press| press.force_n).collect();
    part.add::<f32>("force", &[n], block(forces))?;
    add_head(part, head)
}

fn of_courses(judged: &[Judged], head: &mut Head) -> anyhow::Result<Vec<u8>> {
    let mut courses = Courses::default();
    for judged in judged.iter().filter(|press| press.is_whole()) {
        head.known += usize::from(judged.is_known());
        // The data set has the labels. The part has what was measured.
        let press = Press {
            level: 0,
            object: 0,
            material: 0,
            split: Split::Train,
            shore: f32::NAN,
            force_n: judged.force_n,
            arm_n_per_mm: judged.arm_n_per_mm,
            best: judged.best as u32,
        };
        let moments = judged.moments.iter();
        courses.push(
            press,
            moments.map(|moment| (moment.time_s, moment.approach_mm, &moment.frame)),
        );
    }
    let (n, rows) = (courses.presses.len(), courses.press.len());
    (head.presses, head.frames) = (n, rows);
    debug_assert_eq!(courses.frames_mn.len(), rows * TAXELS);
    let presses = &courses.presses;
    let mut part = Stream::new(Cursor::new(Vec::new()));
    part.add("frames_mn", &[rows, ROWS, COLS], block(courses.frames_mn))?;
    part.add("press", &[rows], block(courses.press))?;
    part.add("time_s", &[rows], block(courses.time_s))?;
    part.add("approach_mm", &[rows], block(courses.approach_mm))?;
    part.add("known", &[rows], block(courses.known))?;
    let best = presses.iter().map(|press| press.best).collect();
    part.add::<u32>("best", &[n], block(best))?;
    let forces = presses.iter().map(|press| press.force_n).collect();
    part.add::<f32>("force", &[n], block(forces))?;
    let arms = presses.iter().map(|press| press.arm_n_per_mm).collect();
    part.add::<f32>("arm_n_per_mm", &[n], block(arms))?;
    add_head(part, head)
}

fn add_head(mut part: Stream<Cursor<Vec<u8>>>, head: &Head) -> anyhow::Result<Vec<u8>> {
    let text = serde_json::to_vec(head)?;
    part.add("meta", &[text.len()], block(text))?;
    Ok(part.finish()?.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_programs_of_one_commit_are_told_apart_unless_the_commit_says_all() {
        let directory = tempfile::tempdir().unwrap();
        let [one, other] = ["one", "other"].map(|name| {
            let path = directory.path().join(name);
            fs::write(&path, name).unwrap();
            path
        });
        for (commit, are_same) in [
            ("0123456789ab", true),
            ("v0.2.0-3-g0123456789ab", true),
            ("0123456789ab-dirty", false),
            ("no checkout", false),
        ] {
            let first = maker(commit, &one).unwrap();
            assert_eq!(first, maker(commit, &one).unwrap(), "{commit}");
            assert_eq!(
                first == maker(commit, &other).unwrap(),
                are_same,
                "{commit}"
            );
            let missing = maker(commit, &directory.path().join("none"));
            assert_eq!(missing.is_ok(), are_same, "{commit}");
        }
    }
}
