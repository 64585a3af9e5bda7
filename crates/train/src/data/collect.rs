//! Recordings of known objects as samples of a data set.
//!
//! In: captures, `.mcap` or `.bin`. Out: the chosen frame of every press that was judged, or all
//! its frames with the arm's approach. The daemon's own pipeline decodes, tares and selects, so a
//! model learns from the same frames that it will judge.
//!
//! The presses of each capture are a file of their own first ([`Parts`]), found in parallel. The
//! data set is put together from these files, so that the frames of only a few captures are in
//! memory.

mod capture;
mod collection;
mod error;
mod file;
mod parts;
mod selection;
mod walk;

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread;

use anyhow::Context as _;
use indicatif::{ProgressBar, ProgressStyle};

pub use self::collection::{Collection, Earlier};
pub use self::error::CollectError;
pub use self::parts::Parts;
pub use self::walk::captures;
use hardnessd_simulator::Split;

use self::collection::Shape;

/// The labels of the samples. A field that is `None` is taken from the capture's labels.
#[derive(Debug, Clone, Copy)]
pub struct Labelling {
    /// The hardness level 1..=4, or 0 for unlabelled.
    pub level: Option<u8>,
    /// The number of the pressed object. The same number in another data set is another object. If
    /// neither this field nor a label gives a number, all captures of one call are one new object.
    pub object: Option<u32>,
    /// The split: training or test.
    pub split: Split,
}

/// What to do with captures that cannot be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unusable {
    /// The first one ends the collection.
    Ends,
    /// They are left out and listed.
    LeftOut,
}

/// A capture whose part is there.
#[derive(Debug)]
struct Ready {
    part: PathBuf,
    shape: Shape,
    /// The number of its label `object`.
    object: Option<u32>,
}

/// Collects `captures`, after the samples of `earlier` if there are any, `jobs` at a time. The
/// samples are in the order of the captures. The data set has the array `material`, and the array
/// `shore`, if the captures have that label.
///
/// Presses over time whose begin is not in the recording are left out. They may lack a material or
/// a measured hardness.
///
/// # Errors
///
/// Returns the [`CollectError`] of the first capture that cannot be used, unless such captures are
/// left out. Returns another error if a part cannot be written or read, or no number is left for a
/// new object.
pub fn collect(
    captures: &[PathBuf],
    parts: &Parts,
    labelling: Labelling,
    earlier: Option<Earlier>,
    jobs: NonZeroUsize,
    unusable: Unusable,
) -> anyhow::Result<Collection> {
    let ready = all_ready(captures, parts, labelling, jobs, unusable)?;
    let first = first_of_most(&ready);
    let begin = match first.and_then(|first| Some((first, ready[first].as_ref().ok()?))) {
        Some((first, ready)) => (captures[first].as_path(), ready.shape),
        // Nothing is added then.
        None => (Path::new(""), Shape::default()),
    };
    let sequences = parts.are_sequences();
    let mut collection = Collection::begun(earlier, begin, labelling.split, sequences);
    let labelled = ready.iter().flatten().filter_map(|ready| ready.object);
    collection.keep_free(labelled.max());
    for (path, ready) in captures.iter().zip(ready) {
        let added = ready.map_err(anyhow::Error::from).and_then(|ready| {
            let head = parts::head(&ready.part, path);
            let head = head.with_context(|| format!("{}: is gone", ready.part.display()))?;
            collection.add(&head, ready.part, labelling)
        });
        match added.map_err(anyhow::Error::downcast::<CollectError>) {
            Ok(()) => {}
            Err(Ok(error)) if unusable == Unusable::LeftOut => {
                let reason = error.reason(path);
                collection.left_out.push((path.clone(), reason));
            }
            Err(Ok(error)) => return Err(error.into()),
            Err(Err(error)) => return Err(error),
        }
    }
    Ok(collection)
}

/// Makes the parts of all captures that are not there yet, and checks the labels of each capture.
/// The result is in the order of the captures.
fn all_ready(
    captures: &[PathBuf],
    parts: &Parts,
    labelling: Labelling,
    jobs: NonZeroUsize,
    unusable: Unusable,
) -> anyhow::Result<Vec<Result<Ready, CollectError>>> {
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} recordings, {eta} left");
    let bar = ProgressBar::new(captures.len() as u64);
    let bar = bar.with_style(style.expect("the template is right"));
    let (next, stops) = (AtomicUsize::new(0), AtomicBool::new(false));
    // Captures are taken in order. So when one fails, all before it were taken too, and the error
    // of the first one is known however many threads there are.
    let work = || {
        let mut done = Vec::new();
        while !stops.load(Ordering::Relaxed) {
            let number = next.fetch_add(1, Ordering::Relaxed);
            let Some(path) = captures.get(number) else {
                break;
            };
            let ready = ready(path, parts, labelling, number).map_err(anyhow::Error::downcast);
            let ready = match ready {
                Ok(ready) => Ok(Ok(ready)),
                Err(Ok(unusable)) => Ok(Err(unusable)),
                Err(Err(error)) => Err(error),
            };
            let ends = match &ready {
                Ok(ready) => ready.is_err() && unusable == Unusable::Ends,
                Err(_) => true,
            };
            stops.fetch_or(ends, Ordering::Relaxed);
            done.push((number, ready));
            bar.inc(1);
        }
        done
    };
    let mut done: Vec<_> = thread::scope(|scope| {
        let threads = jobs.get().min(captures.len());
        let threads: Vec<_> = (0..threads).map(|_| scope.spawn(work)).collect();
        let joined = threads.into_iter().map(thread::ScopedJoinHandle::join);
        let joined =
            joined.map(|done| done.unwrap_or_else(|panic| std::panic::resume_unwind(panic)));
        joined.flatten().collect()
    });
    bar.finish_and_clear();
    done.sort_by_key(|(number, _)| *number);
    done.into_iter().map(|(_, ready)| ready).collect()
}

fn ready(path: &Path, parts: &Parts, labelling: Labelling, number: usize) -> anyhow::Result<Ready> {
    let (part, head) = parts.of(path, number)?;
    // Wrong labels are found here and not after hours of work on the others.
    head.level(labelling.level)?;
    head.shore()?;
    let object = match labelling.object {
        Some(_) => None,
        None => head.number("object", "a number")?,
    };
    let shape = Shape::of(&head, parts.are_sequences());
    Ok(Ready {
        part,
        shape,
        object,
    })
}

/// The first capture of the most frequent shape, so that a stray capture does not decide what the
/// data set has.
fn first_of_most(ready: &[Result<Ready, CollectError>]) -> Option<usize> {
    let mut shapes: Vec<(Shape, usize, usize)> = Vec::new();
    for (number, ready) in ready.iter().enumerate() {
        let Ok(Ready { shape, .. }) = ready else {
            continue;
        };
        match shapes.iter_mut().find(|(known, ..)| known == shape) {
            Some((_, _, count)) => *count += 1,
            None => shapes.push((*shape, number, 1)),
        }
    }
    let most = shapes.iter().map(|(.., count)| *count).max()?;
    let first = shapes.iter().find(|(.., count)| *count == most);
    first.map(|(_, first, _)| *first)
}
