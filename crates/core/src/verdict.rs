//! A press becomes a verdict: loads an HRN from ONNX bytes and judges presses with it.
//!
//! In: the bytes of a model file as `hrn-train export` writes them, then frames in newtons
//! (format 1) or the course of a press (format 3). Out: [`Verdict`]s. This module refuses a file
//! unless all of it follows the format and it reproduces the probabilities that its trainer wrote
//! into it. So a loaded [`Hrn`] computes what was evaluated. This module never reads a file itself,
//! never prints and never trains.

mod card;
mod course;
mod error;
pub mod features;
mod file;
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
use tract_onnx::pb;
use tract_onnx::prelude::*;

pub use self::card::{
    Card, Check, CheckedCourse, Checks, Conformal, CourseCheck, Format, Limits, Range, TAIL,
};
pub use self::course::{COURSE_FRAMES, Course, Extents, Sample, extents};
pub use self::error::{
    CHECK_TOLERANCE, LevelsError, MAX_FILE_BYTES, MIN_OPSET, ModelError, NodeProblem,
    ReferencesError, SHORE_TOLERANCE,
};
use self::file::Outputs;
pub use self::file::{check_levels, check_line};
pub use self::grid::{COLS, ModelFrame, ROWS, Resampling, TAXELS};
use self::inputs::{Input, Lengths, Query};
pub use self::probabilities::argmax;
use self::probabilities::{largest_difference, softmax};
pub use self::references::{
    Knowledge, MOST_REFERENCES, PIECE, Piece, ReferenceKinds, ReferencePress, References,
};
pub use self::settings::{BuiltIn, Settings};
pub use self::shore::{Borders, BordersError, Distribution, Level, Shore};
pub use self::tried::Tried;
use crate::frame::Array;

/// The default model, built into the binary; `models/course.md` is its card.
pub const BUILT_IN: &[u8] = include_bytes!("../../../models/course.onnx");

/// The model of single frames, also built into the binary; `models/README.md` is its card.
pub const BUILT_IN_HRN: &[u8] = include_bytes!("../../../models/hrn.onnx");

/// The verdict of an HRN on a press.
///
/// # Example
///
/// The card of a model has the labels of its levels.
///
/// ```
/// use hardnessd_core::verdict::{BUILT_IN, Hrn, ModelFrame};
///
/// let hrn = Hrn::load(BUILT_IN)?;
/// let mut frame = ModelFrame::default();
/// frame.newtons[400..404].fill(2.0);
/// let verdict = hrn.judge(&frame)?;
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

/// A hardness recognition network, ready to judge.
///
/// # Example
///
/// The built-in model judges one of the frames that it carries as a check.
///
/// ```
/// use hardnessd_core::verdict::{BUILT_IN, Hrn};
///
/// let hrn = Hrn::load(BUILT_IN)?;
/// let verdict = hrn.judge_check(0)?;
/// assert_eq!(verdict.probabilities.len(), hrn.card().levels.len());
/// assert_eq!(verdict.confidence, verdict.probabilities[usize::from(verdict.level) - 1]);
/// # Ok::<(), hardnessd_core::verdict::ModelError>(())
/// ```
#[derive(Debug, Clone)]
pub struct Hrn {
    plan: Arc<TypedRunnableModel>,
    format: Format,
    /// The inputs of a model of courses, in the order of the file, and their lengths.
    inputs: Vec<Input>,
    lengths: Lengths,
    outputs: Outputs,
    card: Card,
    checks: Arc<Checks>,
    sha256: String,
    /// The references of the sensor whose presses are judged.
    references: References,
}

impl Hrn {
    /// Loads a model file and reproduces its check frames.
    ///
    /// # Errors
    ///
    /// Returns the [`ModelError`] for the first part of the file that breaks the format, or an
    /// error as [`Hrn::judge`] if a check frame cannot be judged.
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
    /// Returns the errors of [`Hrn::load`], except those of the check frames.
    pub fn read(bytes: &[u8]) -> Result<Self, ModelError> {
        // The file's types and shapes of values inside the graph are not needed, and are unchecked.
        let onnx = tract_onnx::onnx().with_ignore_value_info(true);
        let mut problems = Vec::new();
        let examined = examine(bytes, &mut problems);
        if let Some(first) = problems.into_iter().next() {
            return Err(first);
        }
        let Examined {
            mut proto,
            card,
            checks,
            signature,
        } = examined.expect("what is not read has a problem");

        let graph_error = |error: TractError| ModelError::Graph(root_cause(&error));
        // The inference library would keep a copy of the metadata.
        proto.metadata_props.clear();
        let inference = onnx.model_for_proto_model(&proto).map_err(graph_error)?;
        // The protobuf is as large as the weights. Only the plan is needed from here on.
        drop(proto);
        let shapes = match signature.format {
            Format::Frame | Format::Parts => vec![signature.format.shape(card.grid)],
            Format::Course { .. } => {
                let inputs = signature.inputs.iter();
                inputs.map(|input| input.shape(signature.lengths)).collect()
            }
        };
        let inference = shapes
            .iter()
            .enumerate()
            .try_fold(inference, |model, (at, shape)| {
                model.with_input_fact(at, f32::fact(shape).into())
            });
        let typed = inference.and_then(InferenceModelExt::into_typed);
        let typed = typed.and_then(TypedModel::into_decluttered);
        let mut optimized = typed.map_err(graph_error)?;
        guard::check_values(&optimized)?;
        optimized.optimize().map_err(graph_error)?;
        // The inference library does not compare a graph with the shapes that it declares.
        for (name, output, length) in signature.shapes(card.levels.len()) {
            let agreed = f32::fact([1, length]);
            let computed = optimized.output_fact(output).map_err(graph_error)?;
            if computed.without_value() != agreed {
                return Err(ModelError::Signature {
                    what: "outputs",
                    found: format!("{name} computed as {computed:?}"),
                    expected: format!("{agreed:?}"),
                });
            }
        }
        let plan = optimized.into_runnable().map_err(graph_error)?;

        Ok(Self {
            plan,
            format: signature.format,
            inputs: signature.inputs,
            lengths: signature.lengths,
            outputs: signature.outputs,
            card,
            checks: Arc::new(checks),
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
        &self.card
    }

    /// The same model with other levels: other parts of the scale of its Shore hardness. The promise of
    /// its sets of levels is of its own levels.
    ///
    /// # Errors
    ///
    /// Returns an error if the model gives no distribution over the scale, or the levels are no parts
    /// of it.
    pub fn with_levels(mut self, levels: Vec<Level>) -> Result<Self, LevelsError> {
        let Outputs::Bins { .. } = self.outputs else {
            return Err(LevelsError::Fixed);
        };
        Borders::of(&levels)?;
        self.card.levels = levels;
        Ok(self)
    }

    /// The input that the model judges.
    pub fn format(&self) -> Format {
        self.format
    }

    /// The checks in the file.
    pub fn checks(&self) -> &Checks {
        &self.checks
    }

    /// Judges what a model of format 1 takes: the taxels of a frame, or of the parts of a press, in the
    /// array of its card.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Self::judge`].
    ///
    /// # Panics
    ///
    /// Panics if the model takes another number of taxels.
    pub fn judge_taxels(&self, newtons: &[f32]) -> Result<Verdict, ModelError> {
        let shape = self.format.shape(self.card.grid);
        let input = match self.format {
            // As [`ModelFrame::pressed`].
            Format::Frame => {
                let pressed: Vec<f32> = newtons.iter().map(|newtons| newtons.max(0.0)).collect();
                Tensor::from_shape(&shape, &pressed)
            }
            _ => Tensor::from_shape(&shape, newtons),
        };
        let input = input.map_err(inference_error)?;
        self.verdict(&self.run(tvec!(input.into()))?, Knowledge::None)
    }

    /// Judges one frame on the model's grid. A model of courses judges it as a press with one
    /// frame and an unknown
    /// approach.
    ///
    /// # Errors
    ///
    /// Returns [`ModelError::NotFinite`] if an output is NaN or infinite,
    /// [`ModelError::Inference`] if the inference library fails, and [`ModelError::Grid`] if the model
    /// takes frames of another array.
    pub fn judge(&self, frame: &ModelFrame) -> Result<Verdict, ModelError> {
        match self.format {
            Format::Frame | Format::Parts => {
                self.card.check_array(Array::JX255N)?;
                match self.format {
                    Format::Parts => self.judge_taxels(&frame.newtons.repeat(parts::PARTS)),
                    _ => self.judge_taxels(&frame.newtons),
                }
            }
            Format::Course { .. } => self.judge_course(&Course {
                moments: vec![Sample {
                    time_s: 0.0,
                    approach_mm: None,
                    frame: *frame,
                }],
                arm_n_per_mm: 0.0,
            }),
        }
    }

    /// The most references that the model takes. Some models take none.
    pub fn most_references(&self) -> usize {
        self.lengths.references
    }

    /// What the model takes of these presses. A model that takes no references returns
    /// [`References::NONE`].
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Self::judge`].
    ///
    /// # Panics
    ///
    /// Panics if a press has no frame or too many, or there are more presses than the model takes.
    pub fn references(&self, presses: &[ReferencePress]) -> Result<References, ModelError> {
        let Outputs::Bins {
            reference: Some(reference),
            ..
        } = self.outputs
        else {
            return Ok(References::NONE);
        };
        let (found, most) = (presses.len(), self.lengths.references);
        assert!(found <= most, "{found} references of {most}");
        let mut features = Vec::with_capacity(found * self.lengths.features);
        for press in presses {
            let outputs = self.run_course(&Query {
                course: &press.course,
                piece: Some(press.piece),
                references: &References::NONE,
            })?;
            features.extend(read(&outputs, reference, "reference")?);
        }
        Ok(References::new(presses, features))
    }

    /// The same model, which knows a sensor by its references.
    ///
    /// # Errors
    ///
    /// Returns an error if another model computed the references.
    pub fn identified(&self, references: References) -> Result<Self, ReferencesError> {
        if !self.takes(&references) {
            let Lengths {
                references: most,
                features,
                ..
            } = self.lengths;
            return Err(ReferencesError {
                count: references.count,
                numbers: references.features.len(),
                most,
                features,
            });
        }
        Ok(Self {
            references,
            ..self.clone()
        })
    }

    /// Whether the model can take these references: none, or those that it computed.
    pub(crate) fn takes(&self, references: &References) -> bool {
        let Lengths {
            references: most,
            features,
            ..
        } = self.lengths;
        let is_of_this =
            references.count <= most && references.features.len() == references.count * features;
        references.count == 0 || is_of_this
    }

    /// The references of the sensor whose presses this model judges.
    pub fn known_references(&self) -> &References {
        &self.references
    }

    /// Judges the course of a press. A model of format 1 judges its last frame.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Self::judge`].
    ///
    /// # Panics
    ///
    /// Panics if the course has no frame, or has more frames than a model of courses takes.
    pub fn judge_course(&self, course: &Course) -> Result<Verdict, ModelError> {
        self.judge_beside(course, &self.references)
    }

    /// Judges the course of a press with `own` presses of the sensor beside the known references.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Self::judge`].
    ///
    /// # Panics
    ///
    /// Panics as [`Self::judge_course`] does.
    pub fn judge_course_with(
        &self,
        course: &Course,
        own: &References,
    ) -> Result<(Verdict, ReferenceKinds), ModelError> {
        let references = self.references.and(own, self.lengths.references);
        let verdict = self.judge_beside(course, &references)?;
        Ok((verdict, references.kinds()))
    }

    fn judge_beside(
        &self,
        course: &Course,
        references: &References,
    ) -> Result<Verdict, ModelError> {
        let last = course.moments.last().expect("a press has a frame");
        match self.format {
            Format::Frame => return self.judge(&last.frame),
            Format::Parts => {
                self.card.check_array(Array::JX255N)?;
                let moments = course.moments.iter();
                let moments: Vec<(f32, &[f32])> = moments
                    .map(|moment| (moment.time_s, &moment.frame.newtons[..]))
                    .collect();
                return self.judge_taxels(&parts::parts(&moments));
            }
            Format::Course { .. } => {}
        }
        let outputs = self.run_course(&Query {
            course,
            piece: None,
            references,
        })?;
        self.verdict(&outputs, references.kinds().knowledge())
    }

    /// Judges one of [`Self::checks`].
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Self::judge`].
    pub fn judge_check(&self, index: usize) -> Result<Verdict, ModelError> {
        match &*self.checks {
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
        let (found, most) = (query.course.moments.len(), self.lengths.frames);
        assert!(found <= most, "{found} frames of {most}");
        let tensor = |input: &Input| Ok(input.tensor(query, self.lengths)?.into());
        let inputs: TractResult<TVec<TValue>> = self.inputs.iter().map(tensor).collect();
        self.run(inputs.map_err(inference_error)?)
    }

    fn run(&self, inputs: TVec<TValue>) -> Result<TVec<TValue>, ModelError> {
        self.plan.run(inputs).map_err(inference_error)
    }

    /// What the outputs say.
    fn verdict(&self, outputs: &[TValue], knowledge: Knowledge) -> Result<Verdict, ModelError> {
        let promised = self.card.conformal.as_ref();
        let limits = promised.map(|promised| promised.limits(knowledge));
        let (logits, probabilities, shore) = match &self.outputs {
            Outputs::Levels {
                logits,
                probabilities,
                shore,
            } => {
                let shore = match shore {
                    Some(place) => match read(outputs, *place, "shore")?[..] {
                        // An interval has to contain its value, so widen it if it does not.
                        [value, low, high] => Some(Shore {
                            value,
                            low: low.min(value),
                            high: high.max(value),
                        }),
                        _ => None,
                    },
                    None => None,
                };
                (
                    read(outputs, *logits, "logits")?,
                    read(outputs, *probabilities, "probabilities")?,
                    shore,
                )
            }
            Outputs::Bins { bins, .. } => {
                let distribution = Distribution::of(&read(outputs, *bins, "bins")?);
                let borders = Borders::of(&self.card.levels);
                let borders = &borders.expect("the levels were checked when they came");
                let probabilities = distribution.levels(borders);
                let logits = probabilities.iter();
                let logits = logits.map(|p| p.max(f32::MIN_POSITIVE).ln()).collect();
                let tail = limits.map_or(TAIL, |limits| limits.tail);
                (
                    logits,
                    probabilities,
                    Some(distribution.shore(borders, tail)),
                )
            }
        };
        let (best, confidence) = argmax(&probabilities);
        Ok(Verdict {
            level: self.card.levels[best].level,
            logits,
            shore,
            levels: limits.map(|limits| limits.set(&probabilities)),
            probabilities,
            confidence,
        })
    }

    /// The Shore hardness within the part of the scale that the level covers, if the levels are parts of
    /// the scale.
    pub fn within(&self, shore: Shore, level: u8) -> Shore {
        let levels = &self.card.levels;
        let place = levels.iter().position(|known| known.level == level);
        match (place, Borders::of(levels)) {
            (Some(place), Ok(borders)) => shore.within(borders.part(place)),
            _ => shore,
        }
    }

    /// Judges every check frame or press. The first judgement also warms up the plan.
    fn reproduce_check(&self) -> Result<(), ModelError> {
        for check in 0..self.checks.count() {
            let verdict = self.judge_check(check)?;
            let same = |found: &[f32], expected: &[f32], most, what| {
                let difference = largest_difference(found, expected);
                match difference > most {
                    true => Err(ModelError::Differs {
                        check,
                        what,
                        difference,
                        most,
                    }),
                    false => Ok(()),
                }
            };
            let found = &verdict.probabilities;
            let expected = self.checks.probabilities(check);
            let what = "probabilities differ from the trainer's";
            same(found, expected, CHECK_TOLERANCE, what)?;
            let what = "`probabilities` differs from softmax(`logits`)";
            same(found, &softmax(&verdict.logits), CHECK_TOLERANCE, what)?;
            if let (Some(found), Some(expected)) = (verdict.shore, self.checks.shore(check)) {
                let [found, expected] = [found, expected].map(<[f32; 3]>::from);
                let what = "`shore` differs from the trainer's";
                same(&found, &expected, SHORE_TOLERANCE, what)?;
            }
        }
        Ok(())
    }
}

/// Reads a file's messages.
fn decode(bytes: &[u8]) -> Result<pb::ModelProto, ModelError> {
    if bytes.len() > MAX_FILE_BYTES {
        return Err(ModelError::TooLarge { found: bytes.len() });
    }
    let mut reader = bytes;
    let proto = tract_onnx::onnx().proto_model_for_read(&mut reader);
    proto.map_err(|error| ModelError::NotOnnx(root_cause(&error)))
}

fn graph_of(proto: &pb::ModelProto) -> Result<&pb::GraphProto, ModelError> {
    let graph = proto.graph.as_ref().filter(|_| proto.ir_version > 0);
    graph.ok_or_else(|| ModelError::NotOnnx("no graph in it".into()))
}

/// What a file says before the inference library builds its graph.
struct Examined {
    proto: pb::ModelProto,
    card: Card,
    checks: Checks,
    signature: file::Signature,
}

/// Everything in a model file that breaks the format, in the order in which [`Hrn::load`] reads it.
/// What only running the graph shows is not among it.
pub fn problems(bytes: &[u8]) -> Vec<ModelError> {
    let mut problems = Vec::new();
    examine(bytes, &mut problems);
    problems
}

/// Reads a file, and adds a problem for each part that breaks the format.
fn examine(bytes: &[u8], problems: &mut Vec<ModelError>) -> Option<Examined> {
    let proto = file::kept(decode(bytes), problems)?;
    let graph = file::kept(graph_of(&proto), problems)?;
    file::kept(file::check_opset(&proto), problems);
    file::kept(file::check_tensors_inside(graph), problems);
    let described = file::metadata(&proto, problems);
    let (format, levels, grid) = match &described {
        Some((card, _)) => (card.format.as_str(), Some(card.levels.len()), card.grid),
        None => (file::format_of(graph), None, None),
    };
    let signature = file::signature(graph, format, levels, grid, problems);
    if let (Some((card, checks)), Some(signature)) = (&described, &signature) {
        if let Outputs::Bins { .. } = signature.outputs {
            file::kept(file::check_borders(&card.levels), problems);
        }
        if let Checks::Courses(check) = checks {
            file::kept(file::check_lengths(check, signature.lengths), problems);
        }
    }
    problems.extend(guard::operator_problems(graph));
    let ((card, checks), signature) = described.zip(signature)?;
    Some(Examined {
        proto,
        card,
        checks,
        signature,
    })
}

#[expect(clippy::needless_pass_by_value, reason = "for `map_err`")]
fn inference_error(error: TractError) -> ModelError {
    ModelError::Inference(root_cause(&error))
}

/// An output's numbers.
fn read(outputs: &[TValue], place: usize, output: &'static str) -> Result<Vec<f32>, ModelError> {
    let view = outputs[place].try_as_plain_ram().map_err(inference_error)?;
    let values = view.as_slice::<f32>().map_err(inference_error)?.to_vec();
    match values.iter().all(|value| value.is_finite()) {
        true => Ok(values),
        false => Err(ModelError::NotFinite { output }),
    }
}

/// The SHA-256 of `bytes` as 64 hexadecimal digits.
pub fn sha256_hex(bytes: &[u8]) -> String {
    hex::encode(Sha256::digest(bytes))
}

/// The innermost message. The outer messages name only tract's own stages.
fn root_cause(error: &TractError) -> String {
    error.root_cause().to_string()
}

#[cfg(test)]
mod tests;
