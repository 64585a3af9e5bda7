//! Tare: the unloaded baseline, and its subtraction.
//!
//! In: [`RawFrame`]s in counts. Out: [`Frame`]s in newtons, with dead taxels replaced, and the
//! outcome of a tare. A tare under load would zero a press away, so no baseline is taken while
//! something touches the sensor. The first tare is tried again. A tare on request is given up.

mod settings;

use serde::{Deserialize, Serialize};

use self::settings::MOST_TARE_FRAMES;
pub use self::settings::{EXPONENTS, GAINS, Gains, NEWTONS_PER_COUNT, Settings, SettingsError};
use crate::frame::{Array, Frame, RawFrame};

/// The thresholds at which frames of a tare count as touched.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Contact {
    /// A taxel is touched if it varies by this much.
    pub threshold_n: f32,
    /// The sensor is touched if this many taxels are.
    pub area_taxels: u32,
}

/// The largest force by which [`Tare::follow`] moves a taxel's baseline in one step. One step a
/// second is 1 N in an hour. Film arrays drift by half as much. A touch that is too light for a
/// press, below 0.07 N on a taxel, takes four minutes to disappear.
pub const MOST_STEP_N: f32 = 1.0 / 3600.0;

/// A summary of a baseline over the array's live taxels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Offsets {
    /// The mean over the taxels.
    pub mean_counts: f32,
    /// The smallest value of a taxel.
    pub least_counts: f32,
    /// The largest value of a taxel.
    pub most_counts: f32,
}

/// The reason why a requested tare is not taken. The offsets stay unchanged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum RetareError {
    /// A press is under way, and the tare would zero it away.
    #[error("a press is under way: release the sensor and ask again")]
    Pressed,
    /// Something rests on the sensor, and the tare would zero it away.
    #[error("something touches the sensor: free it and ask again")]
    Touched,
    /// The sensor sends no frames to average.
    #[error("the sensor is not live: it sends no frames to average")]
    NotLive,
    /// Another tare is under way, and has to end first.
    #[error("another tare is under way: wait for its answer")]
    UnderWay,
    /// `tare_frames` is 0.
    #[error("no tare is configured: set calibration.tare_frames to 1 or more")]
    NoFrames,
}

/// The offsets before and after a requested tare.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Retaken {
    /// The offsets up to now.
    pub old: Offsets,
    /// The offsets from the next frame on.
    pub new: Offsets,
}

/// The purpose of a tare under way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Aim {
    /// The first baseline. It is tried again until nothing touches the sensor.
    First {
        /// Whether something touched the sensor during an earlier try.
        met_contact: bool,
    },
    /// Another baseline, on request. The old baseline stays in force until the new one is taken.
    /// The tare is given up when something touches the sensor.
    Request,
}

/// The baseline of one sensor, and the tare under way, if there is one.
///
/// # Example
///
/// ```
/// use hardnessd_core::frame::{Array, RawFrame};
/// use hardnessd_core::tare::{Contact, Settings, Tare};
///
/// let contact = Contact { threshold_n: 0.07, area_taxels: 3 };
/// let settings = Settings { tare_frames: 1, ..Settings::default() };
/// let mut tare = Tare::new(&settings, Array::JX255N, contact);
/// let mut raw = RawFrame::zero(Array::JX255N);
/// raw.counts.fill(2);
/// tare.observe(&raw);
/// assert_eq!(tare.aim(), None, "the tare is taken");
///
/// raw.counts[0] = 27;
/// let frame = tare.apply(&raw);
/// assert_eq!(frame.newtons[0], 25.0 * 0.04);
/// assert_eq!(frame.newtons[1], 0.0);
/// ```
#[derive(Debug, Clone)]
pub struct Tare {
    scale: ForceCurve,
    /// The number of frames of a tare.
    frames: u32,
    /// The counts of each unloaded taxel. All zeros until a tare is taken.
    baseline: Vec<f32>,
    stage: Stage,
    contact: Contact,
    max_n: f32,
    /// Whether the baseline follows drift.
    follows: bool,
    array: Array,
    /// The place of each dead taxel, and the places of its live neighbours.
    dead: Vec<(usize, Vec<usize>)>,
}

/// The conversion from counts to newtons.
#[derive(Debug, Clone)]
struct ForceCurve {
    newtons_per_count: f32,
    exponent: f32,
    /// The gain of each taxel.
    gains: Vec<f32>,
}

impl ForceCurve {
    fn new(settings: &Settings, array: Array) -> Self {
        let gains = match &settings.gains {
            Some(Gains::Taxels(rows)) => rows.concat(),
            Some(Gains::File(_)) | None => vec![1.0; array.taxels()],
        };
        Self {
            newtons_per_count: settings.newtons_per_count,
            exponent: settings.exponent,
            gains,
        }
    }

    /// The newtons of this many counts above the baseline, at a taxel.
    fn newtons(&self, counts: f32, place: usize) -> f32 {
        let counts = counts.max(0.0);
        // An exponent of 1 skips `powf`, so the result has the same bits as before exponents
        // existed.
        let raised = if self.exponent == 1.0 {
            counts
        } else {
            counts.powf(self.exponent)
        };
        raised * self.newtons_per_count * self.gains[place]
    }

    /// The counts above the baseline that give `newtons`, without the exponent.
    fn counts(&self, newtons: f32, place: usize) -> f32 {
        newtons / (self.newtons_per_count * self.gains[place])
    }
}

/// The stage of a tare.
#[derive(Debug, Clone)]
enum Stage {
    /// No tare is under way.
    Idle,
    Taking {
        aim: Aim,
        sums: Sums,
    },
    /// A requested tare has ended, and its outcome has not been fetched.
    Ended(Result<Retaken, RetareError>),
}

impl Stage {
    /// Begins a tare over `frames` frames. With 0 frames, no tare begins.
    fn begin(aim: Aim, frames: u32, array: Array) -> Self {
        if frames == 0 {
            return Self::Idle;
        }
        let sums = Sums::new(frames, array);
        Self::Taking { aim, sums }
    }

    /// Begins the first tare again, after a touch. `first` is the first of its frames, if that is known.
    fn again(frames: u32, array: Array, first: Option<&RawFrame>) -> Self {
        let mut sums = Sums::new(frames, array);
        if let Some(raw) = first {
            sums.add(raw);
        }
        let aim = Aim::First { met_contact: true };
        Self::Taking { aim, sums }
    }
}

/// The state of a [`Tare`], without its settings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Memory {
    baseline: Vec<f32>,
    taking: Option<(Aim, Sums)>,
}

impl Memory {
    /// Whether a tare of `array` can have this state. A recording may hold anything.
    pub(crate) fn is_possible(&self, array: Array) -> bool {
        // The mean of counts, with room for rounding.
        let is_count = |mean: &f32| (0.0..=65_536.0).contains(mean);
        let are_sums = |(_, sums): &(Aim, Sums)| {
            let most = u64::from(sums.seen) * u64::from(u16::MAX);
            sums.seen < sums.wanted
                && sums.sum.len() == array.taxels()
                && sums.least.len() == array.taxels()
                && sums.most.len() == array.taxels()
                && sums.wanted <= MOST_TARE_FRAMES
                && sums.sum.iter().all(|&sum| u64::from(sum) <= most)
        };
        self.baseline.len() == array.taxels()
            && self.baseline.iter().all(is_count)
            && self.taking.as_ref().is_none_or(are_sums)
    }
}

/// The sums over the frames of a tare.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Sums {
    wanted: u32,
    seen: u32,
    sum: Vec<u32>,
    least: Vec<u16>,
    most: Vec<u16>,
}

impl Sums {
    fn new(wanted: u32, array: Array) -> Self {
        Self {
            wanted,
            seen: 0,
            sum: vec![0; array.taxels()],
            least: vec![u16::MAX; array.taxels()],
            most: vec![0; array.taxels()],
        }
    }

    fn add(&mut self, raw: &RawFrame) {
        self.seen += 1;
        for (place, &count) in raw.counts.iter().enumerate() {
            self.sum[place] += u32::from(count);
            self.least[place] = self.least[place].min(count);
            self.most[place] = self.most[place].max(count);
        }
    }
}

impl Tare {
    /// A tare that is about to be taken. With `tare_frames` 0, the baseline stays zero.
    ///
    /// `settings` have passed [`Settings::check`] for `array`.
    pub fn new(settings: &Settings, array: Array, contact: Contact) -> Self {
        let first = Aim::First { met_contact: false };
        Self {
            scale: ForceCurve::new(settings, array),
            frames: settings.tare_frames,
            baseline: vec![0.0; array.taxels()],
            stage: Stage::begin(first, settings.tare_frames, array),
            contact,
            max_n: settings.tare_max_n,
            follows: settings.auto_tare,
            array,
            dead: dead(settings, array),
        }
    }

    /// Takes over changed settings. The baseline in force stays. If the number of frames of a tare
    /// changes, a tare under way begins again. If the number becomes 0, a tare under way ends.
    pub fn reload(&mut self, settings: &Settings, contact: Contact) {
        let frames = settings.tare_frames;
        self.stage = match std::mem::replace(&mut self.stage, Stage::Idle) {
            Stage::Taking {
                aim: Aim::Request, ..
            } if frames == 0 => Stage::Ended(Err(RetareError::NoFrames)),
            Stage::Taking { aim, .. } if frames != self.frames => {
                Stage::begin(aim, frames, self.array)
            }
            stage => stage,
        };
        self.scale = ForceCurve::new(settings, self.array);
        self.frames = frames;
        self.max_n = settings.tare_max_n;
        self.follows = settings.auto_tare;
        self.contact = contact;
        self.dead = dead(settings, self.array);
    }

    /// The state of the tare.
    pub fn memory(&self) -> Memory {
        Memory {
            baseline: self.baseline.clone(),
            taking: match &self.stage {
                Stage::Taking { aim, sums } => Some((*aim, sums.clone())),
                Stage::Idle | Stage::Ended(_) => None,
            },
        }
    }

    /// Continues from the state of another tare.
    pub fn recall(&mut self, memory: Memory) {
        self.baseline = memory.baseline;
        let taking = memory.taking;
        let taking = taking.map(|(aim, sums)| Stage::Taking { aim, sums });
        self.stage = taking.unwrap_or(Stage::Idle);
    }

    /// The purpose of the tare under way, if there is one.
    pub fn aim(&self) -> Option<Aim> {
        match &self.stage {
            Stage::Taking { aim, .. } => Some(*aim),
            Stage::Idle | Stage::Ended(_) => None,
        }
    }

    /// Begins another tare. The baseline in force stays until the new one is taken.
    ///
    /// # Errors
    ///
    /// Returns an error if a tare is under way, or if the settings allow none. Nothing has changed
    /// then.
    pub fn retake(&mut self) -> Result<(), RetareError> {
        if self.aim().is_some() {
            return Err(RetareError::UnderWay);
        }
        if self.frames == 0 {
            return Err(RetareError::NoFrames);
        }
        self.stage = Stage::begin(Aim::Request, self.frames, self.array);
        Ok(())
    }

    /// Ends a requested tare. The baseline in force stays. A first tare continues.
    pub fn give_up(&mut self, reason: RetareError) {
        if self.aim() == Some(Aim::Request) {
            self.stage = Stage::Ended(Err(reason));
        }
    }

    /// The outcome of the requested tare. The next call returns `None`.
    pub fn ended(&mut self) -> Option<Result<Retaken, RetareError>> {
        match self.stage {
            Stage::Ended(outcome) => {
                self.stage = Stage::Idle;
                Some(outcome)
            }
            Stage::Idle | Stage::Taking { .. } => None,
        }
    }

    /// The baseline in force.
    pub fn offsets(&self) -> Offsets {
        let live = self.live();
        let counts = || live.iter().map(|&place| self.baseline[place]);
        Offsets {
            mean_counts: counts().sum::<f32>() / live.len().max(1) as f32,
            least_counts: counts().reduce(f32::min).unwrap_or(0.0),
            most_counts: counts().reduce(f32::max).unwrap_or(0.0),
        }
    }

    /// Converts counts to newtons: `newtons_per_count x max(0, counts - baseline)^exponent x gain`.
    /// A dead taxel is replaced by the mean of its live neighbours.
    pub fn apply(&self, raw: &RawFrame) -> Frame {
        let mut frame = Frame::zero(self.array);
        for (place, newtons) in frame.newtons.iter_mut().enumerate() {
            let counts = f32::from(raw.counts[place]) - self.baseline[place];
            *newtons = self.scale.newtons(counts, place);
        }
        for (place, neighbours) in &self.dead {
            let sum: f32 = neighbours
                .iter()
                .map(|&neighbour| frame.newtons[neighbour])
                .sum();
            frame.newtons[*place] = sum / neighbours.len().max(1) as f32;
        }
        frame
    }

    /// Moves the baseline towards `raw`, by [`MOST_STEP_N`] at most, if the settings allow it. While
    /// a live taxel reads the contact threshold or more, something touches the sensor, and no
    /// baseline moves: the taxels around the touch read a part of it.
    ///
    /// Call this function once a second at most, and never during a press.
    pub fn follow(&mut self, raw: &RawFrame) {
        let above = |place: usize| f32::from(raw.counts[place]) - self.baseline[place];
        let is_touched =
            |place: &usize| self.scale.newtons(above(*place), *place) >= self.contact.threshold_n;
        if !self.follows || self.live().iter().any(is_touched) {
            return;
        }
        for (place, baseline) in self.baseline.iter_mut().enumerate() {
            let above = f32::from(raw.counts[place]) - *baseline;
            let most = self.scale.counts(MOST_STEP_N, place);
            *baseline += above.clamp(-most, most);
        }
    }

    /// Whether a live taxel reads `full_scale` counts.
    pub fn is_saturated(&self, raw: &RawFrame, full_scale: u16) -> bool {
        raw.counts.iter().enumerate().any(|(place, &count)| {
            count >= full_scale && !self.dead.iter().any(|(dead, _)| *dead == place)
        })
    }

    /// Takes in a frame for the tare under way, if there is one. A new baseline holds from the next
    /// frame on. If something touches the sensor, the frames so far are discarded: a first tare begins
    /// again, with this frame if it differs from those before it, and a tare on request ends.
    pub fn observe(&mut self, raw: &RawFrame) {
        let Stage::Taking { aim, sums } = &mut self.stage else {
            return;
        };
        sums.add(raw);
        let (aim, sums) = (*aim, sums.clone());
        let means = sums.sum.iter().map(|&sum| sum as f32 / sums.seen as f32);
        let mean: Vec<f32> = means.collect();
        let moves = self.is_moving(&sums);
        let is_whole = sums.seen == sums.wanted;
        if moves || (is_whole && self.is_loaded(&mean)) {
            self.stage = match aim {
                // A frame unlike those before it may be the first one without a touch.
                Aim::First { .. } => Stage::again(sums.wanted, self.array, moves.then_some(raw)),
                Aim::Request => Stage::Ended(Err(RetareError::Touched)),
            };
            return;
        }
        if !is_whole {
            return;
        }
        let old = self.offsets();
        self.baseline = mean;
        self.stage = match aim {
            Aim::First { .. } => Stage::Idle,
            Aim::Request => Stage::Ended(Ok(Retaken {
                old,
                new: self.offsets(),
            })),
        };
    }

    /// Whether the frames of a tare differ as under a touch that moves.
    fn is_moving(&self, sums: &Sums) -> bool {
        let live = self.live();
        let varying = live.iter().filter(|&&place| {
            let spread = f32::from(sums.most[place] - sums.least[place]);
            self.scale.newtons(spread, place) >= self.contact.threshold_n
        });
        varying.count() >= self.contact.area_taxels as usize
    }

    /// Whether the mean of the frames is that of a sensor on which something rests.
    fn is_loaded(&self, mean: &[f32]) -> bool {
        let live = self.live();
        let mut sorted: Vec<f32> = live.iter().map(|&place| mean[place]).collect();
        sorted.sort_by(f32::total_cmp);
        let median = sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
        let high = live
            .iter()
            .filter(|&&place| self.scale.newtons(mean[place] - median, place) > self.max_n);
        high.count() >= self.contact.area_taxels as usize
    }

    /// The places of the array's live taxels.
    fn live(&self) -> Vec<usize> {
        (0..self.array.taxels())
            .filter(|place| !self.dead.iter().any(|(dead, _)| dead == place))
            .collect()
    }
}

fn dead(settings: &Settings, array: Array) -> Vec<(usize, Vec<usize>)> {
    let mut is_dead = vec![false; array.taxels()];
    for &[row, col] in &settings.dead_taxels {
        is_dead[array.place(row, col)] = true;
    }
    let live_neighbours = |place: usize| {
        let (row, col) = array.position(place);
        let rows = row.saturating_sub(1)..=(row + 1).min(array.rows - 1);
        rows.flat_map(|r| {
            (col.saturating_sub(1)..=(col + 1).min(array.cols - 1)).map(move |c| array.place(r, c))
        })
        .filter(|&at| at != place && !is_dead[at])
        .collect()
    };
    (0..array.taxels())
        .filter(|&place| is_dead[place])
        .map(|place| (place, live_neighbours(place)))
        .collect()
}

#[cfg(test)]
mod tests;
