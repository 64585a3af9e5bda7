//! Tare: the unloaded baseline, and its subtraction.
//!
//! In: [`RawFrame`]s in counts. Out: [`Frame`]s in newtons, with dead taxels replaced, and the
//! outcome of a tare. A tare under load would zero a press away, so no baseline is taken while
//! something touches the sensor. The first tare is tried again. A tare on request is given up.

mod settings;

use serde::{Deserialize, Serialize};

pub use self::settings::{EXPONENTS, GAINS, Gains, NEWTONS_PER_COUNT, Settings};
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
/// press, below 0.07 N on a taxel, takes four minutes to disappear, also where newtons are a power of the counts.
pub const MOST_STEP_N: f32 = 1.0 / 3600.0;

/// The largest force of a taxel: more than any sensor feels.
const MOST_N: f32 = 1e20;

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
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
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
    #[error("another tare is under way: wait until it ends")]
    UnderWay,
    /// Something keeps the sensor from its first tare.
    #[error("the first tare is under way: {0}")]
    First(Touch),
    /// `tare_frames` is 0.
    #[error("no tare is configured: set calibration.tare_frames to 1 or more")]
    NoFrames,
}

/// Why frames of a tare count as touched.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Touch {
    /// How the taxels show the touch.
    pub kind: TouchKind,
    /// The number of such taxels.
    pub taxels: usize,
    /// The row and the column of the taxel that shows it most, and its newtons.
    pub most: ([usize; 2], f32),
    /// The newtons that it may show at most.
    pub limit_n: f32,
}

/// How taxels show a touch during a tare.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum TouchKind {
    /// They vary from frame to frame.
    Varies,
    /// They read more than the array's median.
    High,
}

/// What was found, and what to do if nothing touches the sensor.
impl std::fmt::Display for Touch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let ([row, col], most_n) = self.most;
        let rounded = |n: f32| (1e3 * f64::from(n)).round() / 1e3;
        let [most_n, limit_n] = [most_n, self.limit_n].map(rounded);
        let taxels = match self.taxels {
            1 => "1 taxel".to_owned(),
            taxels => format!("{taxels} taxels"),
        };
        let (found, key) = match self.kind {
            TouchKind::Varies => (
                format!("{taxels} varied by {limit_n} N or more, [{row}, {col}] by {most_n} N"),
                "contact_threshold_n",
            ),
            TouchKind::High => (
                format!(
                    "{taxels} read more than {limit_n} N above the array's median, [{row}, {col}] \
                     {most_n} N"
                ),
                "tare_max_n",
            ),
        };
        write!(
            f,
            "{found}: free the sensor; if nothing touches it, set a smaller newtons_per_count or a \
             {key} above {most_n}, or list broken taxels in dead_taxels"
        )
    }
}

/// The purpose of a tare under way.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum Aim {
    /// The first baseline. It is tried again until nothing touches the sensor.
    First {
        /// What touched the sensor during the last try.
        touch: Option<Touch>,
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
/// raw.counts.fill(2.0);
/// tare.observe(&raw);
/// assert_eq!(tare.aim(), None, "the tare is taken");
///
/// raw.counts[0] = 27.0;
/// let frame = tare.apply(&raw);
/// assert_eq!(frame.newtons[0], 25.0 * 0.04);
/// assert_eq!(frame.newtons[1], 0.0);
/// ```
#[derive(Debug, Clone)]
pub struct Tare {
    settings: Settings,
    /// The gain of each taxel.
    gains: Vec<f32>,
    /// The counts of each unloaded taxel. All zeros until a tare is taken.
    baseline: Vec<f32>,
    taking: Option<Taking>,
    /// The outcome of the requested tare, until it is fetched.
    outcome: Option<Result<[Offsets; 2], RetareError>>,
    contact: Contact,
    array: Array,
    /// The places of live taxels.
    live: Vec<usize>,
    /// The place of each dead taxel, and the places of its live neighbours.
    dead: Vec<(usize, Vec<usize>)>,
}

/// A tare under way: its purpose, and of each taxel the sum, the least and the greatest of its counts.
#[derive(Debug, Clone)]
struct Taking {
    aim: Aim,
    seen: u32,
    sum: Vec<f64>,
    least: Vec<f32>,
    most: Vec<f32>,
}

impl Taking {
    fn add(&mut self, counts: &[f32]) {
        self.seen += 1;
        for (place, &count) in counts.iter().enumerate() {
            self.sum[place] += f64::from(count);
            self.least[place] = self.least[place].min(count);
            self.most[place] = self.most[place].max(count);
        }
    }
}

/// The state of a [`Tare`] that has taken in one frame at most, or has ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AtRest {
    baseline: Vec<f32>,
    /// The purpose of the tare under way.
    aim: Option<Aim>,
    /// The counts of its first frame, if that has come.
    first: Option<Vec<f32>>,
}

impl AtRest {
    /// Whether a tare of `array` can continue from it. A recording may hold anything.
    pub(crate) fn is_usable(&self, array: Array) -> bool {
        let is_usable = |counts: &Vec<f32>| {
            counts.len() == array.taxels() && counts.iter().all(|count| count.is_finite())
        };
        is_usable(&self.baseline) && self.first.iter().all(is_usable)
    }
}

impl Tare {
    /// A tare that is about to be taken. With `tare_frames` 0, the baseline stays zero.
    ///
    /// `settings` have passed [`Settings::check`] for `array`.
    pub fn new(settings: &Settings, array: Array, contact: Contact) -> Self {
        let is_live = |&place: &usize| {
            let (row, col) = array.position(place);
            !settings.dead_taxels.contains(&[row, col])
        };
        let (live, dead): (Vec<usize>, Vec<usize>) = (0..array.taxels()).partition(is_live);
        let neighbours = |dead: usize| {
            let (row, col) = array.position(dead);
            let is_near = |&&place: &&usize| {
                let (r, c) = array.position(place);
                r.abs_diff(row).max(c.abs_diff(col)) == 1
            };
            (dead, live.iter().filter(is_near).copied().collect())
        };
        let mut tare = Self {
            gains: match &settings.gains {
                Some(Gains::Taxels(rows)) => rows.concat(),
                Some(Gains::File(_)) | None => vec![1.0; array.taxels()],
            },
            settings: settings.clone(),
            baseline: vec![0.0; array.taxels()],
            taking: None,
            outcome: None,
            contact,
            array,
            dead: dead.into_iter().map(neighbours).collect(),
            live,
        };
        tare.begin(Aim::First { touch: None });
        tare
    }

    /// Begins a tare, unless `tare_frames` is 0.
    fn begin(&mut self, aim: Aim) {
        let taxels = self.array.taxels();
        self.taking = (self.settings.tare_frames > 0).then(|| Taking {
            aim,
            seen: 0,
            sum: vec![0.0; taxels],
            least: vec![f32::MAX; taxels],
            most: vec![f32::MIN; taxels],
        });
    }

    /// Whether no tare is under way, or the one under way has taken in one frame at most: a first tare of a sensor that
    /// never holds still has always one.
    pub fn is_at_rest(&self) -> bool {
        self.taking.as_ref().is_none_or(|taking| taking.seen <= 1)
    }

    /// The state of the tare at rest.
    pub fn at_rest(&self) -> AtRest {
        let begun = self.taking.as_ref().filter(|taking| taking.seen > 0);
        AtRest {
            baseline: self.baseline.clone(),
            aim: self.aim(),
            first: begun.map(|taking| taking.least.clone()),
        }
    }

    /// Continues from the state of another tare.
    pub fn resume(&mut self, state: AtRest) {
        self.taking = None;
        if let Some(aim) = state.aim {
            self.begin(aim);
        }
        if let (Some(taking), Some(first)) = (&mut self.taking, state.first) {
            taking.add(&first);
        }
        self.baseline = state.baseline;
    }

    /// The purpose of the tare under way, if there is one.
    pub fn aim(&self) -> Option<Aim> {
        self.taking.as_ref().map(|taking| taking.aim)
    }

    /// Begins another tare. The baseline in force stays until the new one is taken.
    ///
    /// # Errors
    ///
    /// Returns an error if a tare is under way, or if the settings allow none. Nothing has changed
    /// then.
    pub fn retake(&mut self) -> Result<(), RetareError> {
        match self.aim() {
            None => {}
            Some(Aim::First { touch: Some(touch) }) => return Err(RetareError::First(touch)),
            Some(_) => return Err(RetareError::UnderWay),
        }
        if self.settings.tare_frames == 0 {
            return Err(RetareError::NoFrames);
        }
        self.outcome = None;
        self.begin(Aim::Request);
        Ok(())
    }

    /// Ends a requested tare. The baseline in force stays. A first tare continues.
    pub fn give_up(&mut self, reason: RetareError) {
        if self.aim() == Some(Aim::Request) {
            self.taking = None;
            self.outcome = Some(Err(reason));
        }
    }

    /// The outcome of the requested tare: the offsets before it and after it. The next call returns `None`.
    pub fn outcome(&mut self) -> Option<Result<[Offsets; 2], RetareError>> {
        self.outcome.take()
    }

    /// The baseline in force.
    pub fn offsets(&self) -> Offsets {
        let counts = || self.live.iter().map(|&place| self.baseline[place]);
        Offsets {
            mean_counts: counts().sum::<f32>() / self.live.len().max(1) as f32,
            least_counts: counts().reduce(f32::min).unwrap_or(0.0),
            most_counts: counts().reduce(f32::max).unwrap_or(0.0),
        }
    }

    /// The newtons of this many counts above the baseline, at a taxel. Counts below the baseline give
    /// negative newtons: without them, noise would add up to a force.
    fn newtons(&self, counts: f32, place: usize) -> f32 {
        let Settings {
            newtons_per_count,
            exponent,
            ..
        } = self.settings;
        // An exponent of 1 skips `powf`, which costs more and rounds.
        let raised = if exponent == 1.0 {
            counts
        } else {
            counts.abs().powf(exponent).copysign(counts)
        };
        // Counts may be as large as a float allows. Newtons are finite.
        let newtons = raised.clamp(-MOST_N, MOST_N) * newtons_per_count * self.gains[place];
        newtons.clamp(-MOST_N, MOST_N)
    }

    /// Converts counts to newtons: `newtons_per_count x (counts - baseline)^exponent x gain`. Below the
    /// baseline, the power is that of the difference without its sign, and the newtons are negative.
    /// A dead taxel is replaced by the mean of its live neighbours.
    pub fn apply(&self, raw: &RawFrame) -> Frame {
        let mut frame = Frame::zero(self.array);
        for (place, newtons) in frame.newtons.iter_mut().enumerate() {
            let counts = raw.counts[place] - self.baseline[place];
            *newtons = self.newtons(counts, place);
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
        let is_touched = |&place: &usize| {
            let above = raw.counts[place] - self.baseline[place];
            self.newtons(above, place) >= self.contact.threshold_n
        };
        if !self.settings.auto_tare || self.live.iter().any(is_touched) {
            return;
        }
        let threshold_n = self.contact.threshold_n;
        for (place, baseline) in self.baseline.iter_mut().enumerate() {
            let above = raw.counts[place] - *baseline;
            let scale = self.settings.newtons_per_count * self.gains[place];
            let threshold = (threshold_n / scale).powf(self.settings.exponent.recip());
            let most = threshold * MOST_STEP_N / threshold_n;
            *baseline += above.clamp(-most, most);
        }
    }

    /// Whether a live taxel reads `full_scale` counts.
    pub fn is_saturated(&self, raw: &RawFrame, full_scale: f32) -> bool {
        let mut live = self.live.iter();
        live.any(|&place| raw.counts[place] >= full_scale)
    }

    /// Takes in a frame for the tare under way, if there is one. A new baseline holds from the next
    /// frame on. If something touches the sensor, the frames so far are discarded: a first tare begins
    /// again, with this frame if it differs from those before it, and a tare on request ends.
    pub fn observe(&mut self, raw: &RawFrame) {
        let Some(mut taking) = self.taking.take() else {
            return;
        };
        taking.add(&raw.counts);
        let seen = taking.seen as f32;
        let mean: Vec<f32> = taking.sum.iter().map(|&sum| sum as f32 / seen).collect();
        let is_whole = taking.seen == self.settings.tare_frames;
        let moving = self.moving(&taking);
        let loaded = || is_whole.then(|| self.loaded(&mean)).flatten();
        let touch = moving.or_else(loaded);
        match (taking.aim, touch) {
            (_, None) if !is_whole => self.taking = Some(taking),
            (Aim::First { .. }, Some(_)) => {
                self.begin(Aim::First { touch });
                // A frame unlike those before it may be the first one without a touch.
                if let (Some(_), Some(again)) = (moving, &mut self.taking) {
                    again.add(&raw.counts);
                }
            }
            (Aim::Request, Some(_)) => self.outcome = Some(Err(RetareError::Touched)),
            (Aim::First { .. }, None) => self.baseline = mean,
            (Aim::Request, None) => {
                let old = self.offsets();
                self.baseline = mean;
                self.outcome = Some(Ok([old, self.offsets()]));
            }
        }
    }

    /// The touch, if the frames of a tare differ as under a touch that moves.
    fn moving(&self, taking: &Taking) -> Option<Touch> {
        let limit_n = self.contact.threshold_n;
        let spread = |place: usize| taking.most[place] - taking.least[place];
        self.touch(TouchKind::Varies, limit_n, spread, |n| n >= limit_n)
    }

    /// The touch, if the mean of the frames is that of a sensor on which something rests.
    fn loaded(&self, mean: &[f32]) -> Option<Touch> {
        let mut sorted: Vec<f32> = self.live.iter().map(|&place| mean[place]).collect();
        sorted.sort_by(f32::total_cmp);
        let median = sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
        let above = |place: usize| mean[place] - median;
        let max_n = self.settings.tare_max_n;
        self.touch(TouchKind::High, max_n, above, |n| n > max_n)
    }

    /// The touch, if enough live taxels show one by the newtons of these counts.
    fn touch(
        &self,
        kind: TouchKind,
        limit_n: f32,
        counts: impl Fn(usize) -> f32,
        shows: impl Fn(f32) -> bool,
    ) -> Option<Touch> {
        let newtons = |&place: &usize| (place, self.newtons(counts(place), place));
        let found = self.live.iter().map(newtons);
        let found: Vec<(usize, f32)> = found.filter(|&(_, n)| shows(n)).collect();
        let &(place, newtons) = found
            .iter()
            .max_by(|one, other| one.1.total_cmp(&other.1))?;
        (found.len() >= self.contact.area_taxels as usize).then_some(Touch {
            kind,
            taxels: found.len(),
            most: (self.array.position(place).into(), newtons),
            limit_n,
        })
    }
}

#[cfg(test)]
mod tests;
