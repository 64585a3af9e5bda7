//! A press becomes a verdict: loads a model from ONNX bytes and judges presses with it.
//!
//! In: the bytes of a model file as `hrn-train export` writes them, then frames in newtons
//! (format 1) or the course of a press (format 3). Out: [`Verdict`]s. This module refuses a file
//! unless all of it follows the format and it reproduces the probabilities that its trainer wrote
//! into it. So a loaded [`Model`] computes what was evaluated. This module never reads a file itself,
//! never prints and never trains.

mod card;
mod course;
mod error;
pub mod features;
mod file;
mod forest;
mod grid;
mod guard;
mod inputs;
pub mod parts;
mod probabilities;
mod references;
mod settings;
mod shore;
mod tried;

use sha2::{Digest, Sha256};
use tract_onnx::prelude::*;

pub use self::card::{
    Card, Check, CheckedCourse, Checks, Conformal, CourseCheck, Format, Limits, Range, TAIL,
};
pub use self::course::{COURSE_FRAMES, Moment, TimeSeries};
pub use self::error::{CHECK_TOLERANCE, MAX_FILE_BYTES, MIN_OPSET, ModelError, SHORE_TOLERANCE};
use self::error::{JUDGING, RUNNING};
use self::file::File;
pub use self::file::check_line;
pub use self::grid::{COLS, ModelFrame, ROWS, Resampling, TAXELS};
use self::inputs::{Input, Query};
pub use self::probabilities::argmax;
use self::probabilities::largest_difference;
pub(crate) use self::probabilities::softmax;
pub(crate) use self::references::Reference;
pub use self::references::{Knowledge, MOST_REFERENCES, PIECE, Piece, ReferencePress, References};
pub use self::settings::{BuiltIn, Settings};
pub use self::shore::{Borders, Distribution, Level, LevelTable, MOST_LEVELS, Shore, are_levels};
pub use self::tried::Tried;
pub(crate) use self::tried::are_unlike;

/// No number that a model keeps of a press is so large.
const MOST_FEATURE: f32 = 1e6;

/// The default model, built into the binary; `models/course.md` is its card.
pub const BUILT_IN: &[u8] = include_bytes!("../../../models/course.onnx");

/// The model of single frames, also built into the binary; `models/README.md` is its card.
pub const BUILT_IN_HRN: &[u8] = include_bytes!("../../../models/hrn.onnx");

/// The verdict of a model on a press.
///
/// # Example
///
/// The card of a model has the labels of its levels.
///
/// ```
/// use hardnessd_core::verdict::{BUILT_IN_HRN, Model, TAXELS};
///
/// let hrn = Model::load(BUILT_IN_HRN)?;
/// let mut newtons = [0.0; TAXELS];
/// newtons[400..404].fill(2.0);
/// let verdict = hrn.judge_taxels(&newtons)?;
/// let level = &hrn.card().levels[usize::from(verdict.level) - 1];
/// println!("{} ({:.0} %)", level.label, 100.0 * verdict.confidence);
/// assert_eq!(level.level, verdict.level);
/// # Ok::<(), hardnessd_core::verdict::ModelError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Verdict {
    /// The 1-based argmax of the probabilities (Eq. 10). Of equal probabilities, the lower level
    /// wins.
    pub level: u8,
    /// `[L]`: the logits, after temperature.
    pub logits: Vec<f32>,
    /// `[L]`: the softmax of the logits.
    pub probabilities: Vec<f32>,
    /// The largest probability.
    pub confidence: f32,
    /// The Shore hardness. A model of courses always has it; a model of format 1 may.
    pub shore: Option<Shore>,
    /// The conformal set, if the file has a threshold.
    pub levels: Option<Vec<u8>>,
}

/// A model, ready to judge.
///
/// # Example
///
/// The built-in model judges one of the frames that it carries as a check.
///
/// ```
/// use hardnessd_core::verdict::{BUILT_IN, Model};
///
/// let hrn = Model::load(BUILT_IN)?;
/// let verdict = hrn.judge_check(0)?;
/// assert_eq!(verdict.probabilities.len(), hrn.card().levels.len());
/// assert_eq!(verdict.confidence, verdict.probabilities[usize::from(verdict.level) - 1]);
/// # Ok::<(), hardnessd_core::verdict::ModelError>(())
/// ```
#[derive(Debug, Clone)]
pub struct Model {
    plan: Arc<TypedRunnableModel>,
    file: File,
    sha256: String,
    /// The references of the sensor whose presses are judged.
    references: References,
}

impl Model {
    /// Loads a model file and reproduces its check frames.
    ///
    /// # Errors
    ///
    /// Returns a [`ModelError`] with all that breaks the format, or an
    /// error as [`Model::judge_taxels`] if a check frame cannot be judged.
    pub fn load(bytes: &[u8]) -> Result<Self, ModelError> {
        let hrn = Self::read(bytes)?;
        hrn.reproduce_check()?;
        Ok(hrn)
    }

    /// Loads a model file without reproducing its check frames. The trainer uses it to compute
    /// them.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Model::load`], except those of the check frames.
    pub fn read(bytes: &[u8]) -> Result<Self, ModelError> {
        if bytes.len() > MAX_FILE_BYTES {
            return Err(ModelError::too_large(bytes.len()));
        }
        // The file's types and shapes of values inside the graph are not needed, and are unchecked.
        let onnx = tract_onnx::onnx().with_ignore_value_info(true);
        let proto = onnx.proto_model_for_read(&mut &*bytes);
        let mut proto = proto.map_err(ModelError::of("not an ONNX model"))?;
        let file = File::read(&proto)?;
        proto.graph.iter().try_for_each(guard::check_operators)?;
        // The inference library would keep a copy of the metadata.
        proto.metadata_props.clear();
        let inference = onnx.model_for_proto_model(&proto);
        let mut inference = inference.map_err(ModelError::of(RUNNING))?;
        // The protobuf is as large as the weights. Only the plan is needed from here on.
        drop(proto);
        for (at, input) in file.inputs.iter().enumerate() {
            let shape = input.shape(file.lengths);
            let fixed = inference.with_input_fact(at, f32::fact(&shape).into());
            inference = fixed.map_err(ModelError::of(RUNNING))?;
        }
        let typed = inference.into_typed();
        let typed = typed.and_then(TypedModel::into_decluttered);
        let mut optimized = typed.map_err(ModelError::of(RUNNING))?;
        guard::check_values(&optimized)?;
        optimized.optimize().map_err(ModelError::of(RUNNING))?;
        forest::quicken(&mut optimized);
        for (place, output) in file.outputs.iter().enumerate() {
            let Some(lengths) = file.lengths_of(output) else {
                continue;
            };
            let fact = optimized
                .output_fact(place)
                .map_err(ModelError::of(RUNNING))?;
            let is_float = fact.datum_type == f32::datum_type();
            let shape = fact.shape.as_concrete();
            if !(is_float && matches!(shape, Some([1, length]) if lengths.contains(length))) {
                let expected = format!("f32 [1, {} to {}]", lengths.start(), lengths.end());
                let problem =
                    format!("model output `{output}`: found {fact:?}, expected {expected}");
                return Err(ModelError::new(problem));
            }
        }
        let plan = optimized.into_runnable();
        Ok(Self {
            plan: plan.map_err(ModelError::of(RUNNING))?,
            file,
            sha256: sha256_hex(bytes),
            references: References::NONE,
        })
    }

    /// SHA-256 of the whole file, 64 hexadecimal digits.
    pub fn sha256(&self) -> &str {
        &self.sha256
    }

    /// The description of the model in its file.
    pub fn card(&self) -> &Card {
        &self.file.card
    }

    /// The same model with other levels: other parts of the scale of its Shore hardness. The promise of
    /// its sets of levels is of its own levels.
    ///
    /// # Errors
    ///
    /// Returns an error if the model gives no distribution over the scale, or the levels are no parts
    /// of it.
    pub fn with_levels(mut self, levels: Vec<Level>) -> Result<Self, ModelError> {
        if self.file.place_of("bins").is_none() {
            return Err(ModelError::new(
                "found levels, expected none: the model has levels of its own, and only a model of format 3 \
                 takes others",
            ));
        }
        Borders::of(&levels)?;
        self.file.card.levels = levels;
        Ok(self)
    }

    /// The input that the model judges.
    pub fn format(&self) -> Format {
        match self.file.inputs[0] {
            Input::Frame => Format::Frame,
            Input::Parts => Format::Parts,
            _ => Format::Course {
                most_frames: self.file.lengths.frames,
            },
        }
    }

    /// The checks in the file.
    pub fn checks(&self) -> &Checks {
        &self.file.checks
    }

    /// Judges what a model of format 1 takes: the taxels of a frame, or of the parts of a press, in the
    /// array of its card.
    ///
    /// # Errors
    ///
    /// Returns an error if an output is NaN or infinite, the inference library fails, or the model takes
    /// another number of taxels.
    pub fn judge_taxels(&self, newtons: &[f32]) -> Result<Verdict, ModelError> {
        let input = self.file.inputs[0];
        // No frame is below 0, as [`ModelFrame::pressed`].
        let least = if input == Input::Frame { 0.0 } else { f32::MIN };
        let newtons: Vec<f32> = newtons.iter().map(|newtons| newtons.max(least)).collect();
        let tensor = Tensor::from_shape(&input.shape(self.file.lengths), &newtons);
        let tensor = tensor.map_err(ModelError::of(JUDGING))?;
        self.verdict(&self.run(tvec!(tensor.into()))?, Knowledge::None)
    }

    /// The most references that the model takes. Some models take none.
    pub fn most_references(&self) -> usize {
        self.file.lengths.references
    }

    /// What the model takes of these presses. A model that takes no references returns
    /// [`References::NONE`].
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Self::judge_taxels`], and one if there are more presses than the model takes.
    ///
    /// # Panics
    ///
    /// Panics if a press has no frame.
    pub fn references(&self, presses: &[ReferencePress]) -> Result<References, ModelError> {
        if self.most_references() == 0 {
            return Ok(References::NONE);
        }
        at_most(presses.len(), self.most_references(), "references")?;
        let presses = presses
            .iter()
            .map(|press| self.reference(&press.course, press.piece));
        Ok(References::of(presses.collect::<Result<_, _>>()?))
    }

    /// What the model takes of a press on `piece`.
    pub(crate) fn reference(
        &self,
        course: &TimeSeries,
        piece: Piece,
    ) -> Result<Reference, ModelError> {
        let outputs = self.run_course(&Query {
            course,
            piece: Some(piece),
            references: &References::NONE,
        })?;
        let features = self.numbers(&outputs, "reference")?;
        Ok(Reference::new(piece, features.unwrap_or_default()))
    }

    /// The same model, which knows a sensor by its references.
    ///
    /// # Errors
    ///
    /// Returns an error if another model computed the references.
    pub fn identified(&self, references: References) -> Result<Self, ModelError> {
        at_most(
            references.presses.len(),
            self.most_references(),
            "references",
        )?;
        if !references.presses.iter().all(|press| self.takes(press)) {
            return Err(ModelError::new(format!(
                "references: found those of another model, expected {} numbers of each",
                self.file.lengths.features
            )));
        }
        Ok(Self {
            references,
            ..self.clone()
        })
    }

    /// Whether the model may have computed this reference.
    fn takes(&self, reference: &Reference) -> bool {
        reference.features.len() == self.file.lengths.features
            && reference.knowledge != Knowledge::None
    }

    /// Whether the model may have computed this reference of a sensor's own press.
    pub(crate) fn takes_own(&self, reference: &Reference) -> bool {
        let are_likely = reference.features.iter().all(|x| x.abs() < MOST_FEATURE);
        self.takes(reference) && reference.knowledge == Knowledge::Own && are_likely
    }

    /// The references of the sensor whose presses this model judges.
    pub fn known_references(&self) -> &References {
        &self.references
    }

    /// Judges the course of a press.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Self::judge_taxels`], and one if there are more frames than the model takes, or
    /// it takes no courses.
    ///
    /// # Panics
    ///
    /// Panics if the course has no frame.
    pub fn judge_course(&self, course: &TimeSeries) -> Result<Verdict, ModelError> {
        self.judge_beside(course, &self.references)
    }

    /// The known references, and the last of the sensor's `own` presses that the model takes beside them.
    pub fn references_with(&self, own: &References) -> References {
        self.references.and(own, self.most_references())
    }

    /// Judges the course of a press with these references of its sensor.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Self::judge_taxels`].
    ///
    /// # Panics
    ///
    /// Panics as [`Self::judge_course`] does.
    pub fn judge_beside(
        &self,
        course: &TimeSeries,
        references: &References,
    ) -> Result<Verdict, ModelError> {
        let outputs = self.run_course(&Query {
            course,
            piece: None,
            references,
        })?;
        self.verdict(&outputs, references.knowledge())
    }

    /// Judges one of [`Self::checks`].
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Self::judge_taxels`].
    pub fn judge_check(&self, index: usize) -> Result<Verdict, ModelError> {
        match &*self.file.checks {
            Checks::Frames(check) => self.judge_taxels(&check.frames[index]),
            Checks::Courses(check) => {
                let press = &check.presses[index];
                let references = match press.identified {
                    true => self.references(&check.references)?,
                    false => References::NONE,
                };
                self.judge_beside(&press.course, &references)
            }
        }
    }

    fn run_course(&self, query: &Query) -> Result<TVec<TValue>, ModelError> {
        at_most(
            query.course.moments.len(),
            self.file.lengths.frames,
            "frames of a press",
        )?;
        let mut inputs = TVec::new();
        for input in &self.file.inputs {
            let tensor = input.tensor(query, self.file.lengths);
            inputs.push(tensor.map_err(ModelError::of(JUDGING))?.into());
        }
        self.run(inputs)
    }

    fn run(&self, inputs: TVec<TValue>) -> Result<TVec<TValue>, ModelError> {
        self.plan.run(inputs).map_err(ModelError::of(JUDGING))
    }

    /// The numbers of an output, if the model has it.
    fn numbers(&self, outputs: &[TValue], output: &str) -> Result<Option<Vec<f32>>, ModelError> {
        let Some(place) = self.file.place_of(output) else {
            return Ok(None);
        };
        let view = outputs[place].try_as_plain_ram();
        let view = view.map_err(ModelError::of(JUDGING))?;
        let values = view.as_slice::<f32>().map_err(ModelError::of(JUDGING))?;
        match values.iter().all(|value| value.is_finite()) {
            true => Ok(Some(values.to_vec())),
            false => Err(ModelError::new(format!(
                "model gave a number that is not finite in `{output}`"
            ))),
        }
    }

    /// What the outputs say.
    fn verdict(&self, outputs: &[TValue], knowledge: Knowledge) -> Result<Verdict, ModelError> {
        let card = &self.file.card;
        let promised = card.conformal.as_ref();
        let limits = promised.map(|promised| promised.limits(knowledge));
        let given = |output| self.numbers(outputs, output);
        let (logits, probabilities, shore) = if let Some(bins) = given("bins")? {
            let distribution = Distribution::of(&bins);
            let borders = Borders::of(&card.levels);
            let borders = &borders.expect("the levels were checked when they came");
            let probabilities = distribution.levels(borders);
            let logits = probabilities.iter();
            let logits = logits.map(|p| p.max(f32::MIN_POSITIVE).ln()).collect();
            let tail = limits.map_or(TAIL, |limits| limits.tail);
            let shore = distribution.shore(borders, tail);
            (logits, probabilities, Some(shore))
        } else {
            // An interval has to contain its value, so widen it if it does not.
            let shore = given("shore")?.map(|found| Shore {
                value: found[0],
                low: found[1].min(found[0]),
                high: found[2].max(found[0]),
            });
            let logits = given("logits")?.unwrap_or_default();
            (logits, given("probabilities")?.unwrap_or_default(), shore)
        };
        let (best, confidence) = argmax(&probabilities);
        Ok(Verdict {
            level: card.levels[best].level,
            logits,
            shore,
            levels: promised
                .zip(limits)
                .map(|(promised, limits)| limits.set(&probabilities, promised.alpha)),
            probabilities,
            confidence,
        })
    }

    /// The Shore hardness within the part of the scale that the level covers, if the levels are parts of
    /// the scale.
    pub fn within(&self, shore: Shore, level: u8) -> Shore {
        let levels = &self.card().levels;
        let place = levels.iter().position(|known| known.level == level);
        match (place, Borders::of(levels)) {
            (Some(place), Ok(borders)) => shore.within(borders.part(place)),
            _ => shore,
        }
    }

    /// Judges every check frame or press. The first judgement also warms up the plan.
    fn reproduce_check(&self) -> Result<(), ModelError> {
        let checks = self.checks();
        for (check, (probabilities, shore)) in checks.expected().into_iter().enumerate() {
            let verdict = self.judge_check(check)?;
            let same = |found: &[f32], expected: &[f32], most: f32, what: &str| {
                let difference = largest_difference(found, expected);
                match difference > most {
                    true => Err(ModelError::new(format!(
                        "check {check}: {what} by up to {difference:.6}: expected at most {most}"
                    ))),
                    false => Ok(()),
                }
            };
            let found = &verdict.probabilities;
            let what = "probabilities differ from the trainer's";
            same(found, probabilities, CHECK_TOLERANCE, what)?;
            let what = "`probabilities` differs from softmax(`logits`)";
            same(found, &softmax(&verdict.logits), CHECK_TOLERANCE, what)?;
            if let (Some(found), Some(expected)) = (verdict.shore, shore) {
                let [found, expected] = [found, expected].map(<[f32; 3]>::from);
                let what = "`shore` differs from the trainer's";
                same(&found, &expected, SHORE_TOLERANCE, what)?;
            }
        }
        Ok(())
    }
}

/// Refuses more than the model takes.
fn at_most(found: usize, most: usize, what: &str) -> Result<(), ModelError> {
    match found <= most {
        true => Ok(()),
        false => Err(ModelError::new(format!(
            "found {found} {what}, expected at most {most}"
        ))),
    }
}

/// The SHA-256 of `bytes` as 64 hexadecimal digits.
pub fn sha256_hex(bytes: &[u8]) -> String {
    hex::encode(Sha256::digest(bytes))
}

#[cfg(test)]
mod tests;
