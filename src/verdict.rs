//! A press becomes a verdict: loads an HRN from ONNX bytes and judges presses with it.
//!
//! In: the bytes of a model file as `hrn-train export` writes them, then frames in newtons (format 1)
//! or the course of a press (format 2). Out: [`Verdict`]s. A file is refused unless all of it is as agreed and it
//! reproduces the probabilities that its trainer wrote into it, so a loaded [`Hrn`] is known to
//! compute what was evaluated. Never reads a file itself, never prints, never trains.

mod course;
mod file;
mod guard;

use std::time::Duration;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use tract_onnx::prelude::*;

use self::course::Input;
pub use self::course::{
    COURSE_FRAMES, CheckedCourse, Course, CourseCheck, CourseMoment, Shore, course_inputs,
};
use crate::frame::{COLS, Frame, ROWS};

/// The default model, built into the binary; `models/README.md` is its card.
pub const BUILT_IN: &[u8] = include_bytes!("../models/hrn.onnx");

/// Largest model file accepted, in bytes: 64 MB.
pub const MAX_FILE_BYTES: usize = 64_000_000;
/// Oldest ONNX operator set accepted.
pub const MIN_OPSET: i64 = 17;
/// The check frames' probabilities must be reproduced within this.
pub const CHECK_TOLERANCE: f32 = 1e-4;
/// The check presses' Shore hardness must be reproduced within this.
pub const SHORE_TOLERANCE: f32 = 1e-2;

/// One hardness level as `hello` tells it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Level {
    /// 1-based; 1 is the hardest.
    pub level: u8,
    /// A short name without control characters, such as `very-soft`.
    pub label: String,
    /// The Shore hardness it covers, such as `51-60`.
    pub shore: String,
}

/// What a model saw in training; outside it a verdict carries the note `outside_training`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Range {
    /// Least and greatest total force of a training frame, in newtons.
    pub force_n: [f32; 2],
    /// Least and greatest contact area of a training frame, in taxels.
    pub contact_area_taxels: [u32; 2],
}

/// What a model file says of itself: its `hrn.*` metadata.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Card {
    /// `hrn.format`: "1" or "2".
    pub format: String,
    /// `hrn.levels`: 1 to L in order.
    pub levels: Vec<Level>,
    /// `hrn.pitch_mm`: the distance between taxels that it was trained on.
    pub pitch_mm: f32,
    /// `hrn.method`: how it was trained, such as `hrn100`.
    pub method: String,
    /// `hrn.data`: name, seed and hash of the data, as written.
    pub data: String,
    /// `hrn.metrics`: what its trainer measured.
    pub metrics: serde_json::Value,
    /// `hrn.validation`: what it was validated on, such as `simulated data only`.
    pub validation: String,
    /// `hrn.range`.
    pub range: Range,
    /// `hrn.conformal`, of format 2 alone.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub conformal: Option<Conformal>,
}

/// `hrn.conformal`: which levels a verdict cannot tell apart.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Conformal {
    /// The set misses the true level in at most this share of presses.
    pub alpha: f32,
    /// The set holds every level of at least this probability, and the most likely one.
    pub threshold: f32,
}

impl Conformal {
    /// The levels of the set, ascending.
    pub fn set(self, probabilities: &[f32]) -> Vec<u8> {
        let (best, _) = argmax(probabilities);
        let levels = (1..).zip(probabilities.iter().enumerate());
        levels
            .filter(|&(_, (place, &p))| place == best || p >= self.threshold)
            .map(|(level, _)| level)
            .collect()
    }
}

/// What a file carries to be checked by.
#[derive(Debug, Clone, PartialEq)]
pub enum Checks {
    /// Of format 1.
    Frames(Check),
    /// Of format 2.
    Courses(CourseCheck),
}

impl Checks {
    /// Counts the frames or presses.
    pub fn count(&self) -> usize {
        match self {
            Self::Frames(check) => check.frames.len(),
            Self::Courses(check) => check.presses.len(),
        }
    }

    /// The probabilities that the trainer computed for one of them.
    fn probabilities(&self, index: usize) -> &[f32] {
        match self {
            Self::Frames(check) => &check.probabilities[index],
            Self::Courses(check) => &check.presses[index].probabilities,
        }
    }

    /// Likewise the Shore hardness.
    fn shore(&self, index: usize) -> Option<Shore> {
        match self {
            Self::Frames(_) => None,
            Self::Courses(check) => Some(check.presses[index].shore),
        }
    }
}

/// `hrn.check` of format 1: frames and the probabilities that the trainer computed for them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Check {
    /// Newtons, row-major, 784 a frame; two frames a level.
    pub frames: Vec<Vec<f32>>,
    /// One row of L a frame.
    pub probabilities: Vec<Vec<f32>>,
}

/// Why a model file is refused, or a judgement failed.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// More than [`MAX_FILE_BYTES`].
    #[error("model file of {found} bytes: at most {MAX_FILE_BYTES} are accepted")]
    TooLarge {
        /// Size of the file.
        found: usize,
    },
    /// The bytes are no ONNX model.
    #[error("not an ONNX model: {0}")]
    NotOnnx(String),
    /// Operator set too old, or none named.
    #[error("ONNX opset {}: expected {MIN_OPSET} or newer", .found.map_or("missing".into(), |v| v.to_string()))]
    Opset {
        /// The default domain's version, if the file names one.
        found: Option<i64>,
    },
    /// Weights outside the file.
    #[error("tensor `{tensor}` lies in an external file: expected all data inside the model file")]
    ExternalData {
        /// Name of the tensor.
        tensor: String,
    },
    /// Inputs or outputs of other names, types or shapes.
    #[error("model {what} {found}: expected {expected}")]
    Signature {
        /// `input` or `outputs`.
        what: &'static str,
        /// As the file has them.
        found: String,
        /// As agreed.
        expected: String,
    },
    /// A metadata key is not there.
    #[error("model metadata `{key}` is missing")]
    KeyMissing {
        /// The key.
        key: &'static str,
    },
    /// A metadata key has an unusable value.
    #[error("model metadata `{key}`: found {found}, expected {expected}")]
    KeyInvalid {
        /// The key.
        key: &'static str,
        /// The value, or what is wrong with it.
        found: String,
        /// What would be right.
        expected: String,
    },
    /// An operator, an attribute, a tensor or a size that no model may have.
    #[error("model {place}: {problem}")]
    Guard {
        /// Which node, tensor, input or output.
        place: String,
        /// What is wrong with it.
        problem: String,
    },
    /// The graph cannot be run.
    #[error("model graph cannot be run: {0}")]
    Graph(String),
    /// Other probabilities than the trainer's.
    #[error(
        "check frame {frame}: probabilities differ from the trainer's by up to {difference:.6}: \
         expected at most {CHECK_TOLERANCE}"
    )]
    CheckDiffers {
        /// Index in `hrn.check`.
        frame: usize,
        /// The largest difference in that frame.
        difference: f32,
    },
    /// Another Shore hardness than the trainer's.
    #[error(
        "check press {press}: `shore` differs from the trainer's by up to {difference:.4}: expected \
         at most {SHORE_TOLERANCE}"
    )]
    ShoreDiffers {
        /// Index in `hrn.check`.
        press: usize,
        /// The largest difference of its three numbers.
        difference: f32,
    },
    /// `probabilities` is not the softmax of `logits`.
    #[error(
        "check frame {frame}: `probabilities` differs from softmax(`logits`) by up to \
         {difference:.6}: expected at most {CHECK_TOLERANCE}"
    )]
    NotSoftmax {
        /// Index in `hrn.check`.
        frame: usize,
        /// The largest difference in that frame.
        difference: f32,
    },
    /// A judgement gave NaN or infinity.
    #[error("model gave a number that is not finite in `{output}`")]
    NotFinite {
        /// The output.
        output: &'static str,
    },
    /// A judgement failed inside the inference library.
    #[error("model could not judge a frame: {0}")]
    Inference(String),
    /// Refused by the process that tried it, or that process did not come to an end.
    #[error("{0}")]
    Trial(String),
    /// A verdict takes so long that frames would wait.
    #[error(
        "model takes {:.1} ms for a verdict: expected at most {:.1} ms, a tenth of the fastest \
         sensor's frame period (but 1 to 20 ms)",
        .found.as_secs_f64() * 1e3,
        .expected.as_secs_f64() * 1e3
    )]
    Slow {
        /// Median of the processor time.
        found: Duration,
        /// What the sensors leave.
        expected: Duration,
    },
}

/// What an HRN says of a press.
#[derive(Debug, Clone, PartialEq)]
pub struct Verdict {
    /// 1-based argmax of the probabilities (Eq. 10); equal ones go to the lower level.
    pub level: u8,
    /// `[L]`, after temperature.
    pub logits: Vec<f32>,
    /// `[L]`, softmax of the logits.
    pub probabilities: Vec<f32>,
    /// The largest probability.
    pub confidence: f32,
    /// A model of format 2 has it, and one of format 1 may.
    pub shore: Option<Shore>,
    /// The conformal set, where the file has a threshold.
    pub levels: Option<Vec<u8>>,
}

/// What a model judges.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Format 1: the frame of the largest contact area.
    Frame,
    /// Format 2: the course of a press.
    Course {
        /// Frames at most.
        most_frames: usize,
    },
}

/// A hardness recognition network, ready to judge.
///
/// # Example
///
/// The built-in model judges one of the frames that it carries as a check.
///
/// ```
/// use hardnessd::verdict::{BUILT_IN, Hrn};
///
/// let hrn = Hrn::load(BUILT_IN)?;
/// let verdict = hrn.judge_check(0)?;
/// assert_eq!(verdict.probabilities.len(), hrn.card().levels.len());
/// assert_eq!(verdict.confidence, verdict.probabilities[usize::from(verdict.level) - 1]);
/// # Ok::<(), hardnessd::verdict::ModelError>(())
/// ```
#[derive(Debug)]
pub struct Hrn {
    plan: Arc<TypedRunnableModel>,
    format: Format,
    /// Of format 2, in the order of the file.
    inputs: Vec<Input>,
    logits_output: usize,
    probabilities_output: usize,
    /// A model of format 2 has it, and one of format 1 may.
    shore_output: Option<usize>,
    card: Card,
    checks: Checks,
    sha256: String,
}

impl Hrn {
    /// Loads a model file and reproduces its check frames.
    ///
    /// # Errors
    ///
    /// If anything in the file is not as agreed, which the [`ModelError`] names, or if one of its check
    /// frames cannot be judged: as [`Hrn::judge`].
    pub fn load(bytes: &[u8]) -> Result<Self, ModelError> {
        let hrn = Self::read(bytes)?;
        hrn.reproduce_check()?;
        Ok(hrn)
    }

    /// Loads a model file whose check frames nobody has computed yet: for who is about to write them.
    ///
    /// # Errors
    ///
    /// As [`Hrn::load`], but for the check frames.
    pub fn read(bytes: &[u8]) -> Result<Self, ModelError> {
        if bytes.len() > MAX_FILE_BYTES {
            return Err(ModelError::TooLarge { found: bytes.len() });
        }
        // What a file says of values inside the graph is not needed, and was not checked.
        let onnx = tract_onnx::onnx().with_ignore_value_info(true);
        let mut reader = bytes;
        let mut proto = onnx
            .proto_model_for_read(&mut reader)
            .map_err(|error| ModelError::NotOnnx(root_cause(&error)))?;
        let graph = match &proto.graph {
            Some(graph) if proto.ir_version > 0 => graph,
            _ => return Err(ModelError::NotOnnx("no graph in it".into())),
        };
        file::check_opset(&proto)?;
        file::check_tensors_inside(graph)?;
        let (card, checks) = file::read_metadata(&proto)?;
        let (format, inputs) = file::check_signature(graph, &card, &checks)?;
        guard::check(&proto, graph)?;
        let position = |name: &str| graph.output.iter().position(|output| output.name == name);
        let shore_output = position("shore");
        let (Some(logits_output), Some(probabilities_output)) =
            (position("logits"), position("probabilities"))
        else {
            return Err(ModelError::Graph("no outputs".into()));
        };

        let graph_error = |error: TractError| ModelError::Graph(root_cause(&error));
        // The inference library would keep a copy.
        proto.metadata_props.clear();
        let inference = onnx.model_for_proto_model(&proto).map_err(graph_error)?;
        // From here on only the plan is kept: the protobuf is as large again as the weights.
        drop(proto);
        let shapes = match format {
            Format::Frame => vec![vec![1, 1, ROWS, COLS]],
            Format::Course { most_frames } => inputs
                .iter()
                .map(|input| input.shape(most_frames))
                .collect(),
        };
        let inference = shapes
            .iter()
            .enumerate()
            .try_fold(inference, |model, (at, shape)| {
                model.with_input_fact(at, f32::fact(shape).into())
            });
        let optimized = inference
            .and_then(InferenceModelExt::into_optimized)
            .map_err(graph_error)?;
        // The inference library does not hold a graph to the shapes it declares.
        let of_levels = |output| (output, f32::fact([1, card.levels.len()]));
        let agreed = [of_levels(logits_output), of_levels(probabilities_output)];
        let of_shore = shore_output.map(|output| (output, f32::fact([1, 3])));
        for (output, agreed) in agreed.into_iter().chain(of_shore) {
            let computed = optimized.output_fact(output).map_err(graph_error)?;
            if computed.without_value() != agreed {
                return Err(ModelError::Signature {
                    what: "outputs",
                    found: format!("computed as {computed:?}"),
                    expected: format!("{agreed:?}"),
                });
            }
        }
        let plan = optimized.into_runnable().map_err(graph_error)?;

        Ok(Self {
            plan,
            format,
            inputs,
            logits_output,
            probabilities_output,
            shore_output,
            card,
            checks,
            sha256: sha256_hex(bytes),
        })
    }

    /// SHA-256 of the whole file, 64 hexadecimal digits.
    pub fn sha256(&self) -> &str {
        &self.sha256
    }

    /// What the file says of itself.
    pub fn card(&self) -> &Card {
        &self.card
    }

    /// What it judges.
    pub fn format(&self) -> Format {
        self.format
    }

    /// What the file carries to be checked by.
    pub fn checks(&self) -> &Checks {
        &self.checks
    }

    /// Judges one frame. A model of format 2 judges it as a press of which nothing else is known.
    ///
    /// # Errors
    ///
    /// [`ModelError::NotFinite`] if an output is NaN or infinite, [`ModelError::Inference`] if
    /// the inference library fails.
    pub fn judge(&self, frame: &Frame) -> Result<Verdict, ModelError> {
        match self.format {
            Format::Frame => {
                let input = Tensor::from_shape(&[1, 1, ROWS, COLS], &frame.newtons);
                self.run(tvec!(input.map_err(inference_error)?.into()))
            }
            Format::Course { .. } => self.judge_course(&Course {
                moments: vec![CourseMoment {
                    time_s: 0.0,
                    approach_mm: None,
                    frame: *frame,
                }],
                arm_n_per_mm: 0.0,
            }),
        }
    }

    /// Judges the course of a press. A model of format 1 judges its last frame.
    ///
    /// # Errors
    ///
    /// As [`Self::judge`].
    ///
    /// # Panics
    ///
    /// If the course has no frame, or more than the model takes.
    pub fn judge_course(&self, course: &Course) -> Result<Verdict, ModelError> {
        let last = course.moments.last().expect("a press has a frame");
        let Format::Course { most_frames } = self.format else {
            return self.judge(&last.frame);
        };
        let found = course.moments.len();
        assert!(found <= most_frames, "{found} frames of {most_frames}");
        let tensor = |input: &Input| Ok(input.tensor(course, most_frames)?.into());
        let inputs: TractResult<TVec<TValue>> = self.inputs.iter().map(tensor).collect();
        self.run(inputs.map_err(inference_error)?)
    }

    /// Judges one of [`Self::checks`].
    ///
    /// # Errors
    ///
    /// As [`Self::judge`].
    pub fn judge_check(&self, index: usize) -> Result<Verdict, ModelError> {
        match &self.checks {
            Checks::Frames(check) => {
                let mut frame = Frame::default();
                frame.newtons.copy_from_slice(&check.frames[index]);
                self.judge(&frame)
            }
            Checks::Courses(check) => self.judge_course(&check.presses[index].course),
        }
    }

    fn run(&self, inputs: TVec<TValue>) -> Result<Verdict, ModelError> {
        let outputs = self.plan.run(inputs).map_err(inference_error)?;
        let read = |index: usize, output: &'static str| {
            let view = outputs[index].try_as_plain_ram().map_err(inference_error)?;
            let values = view.as_slice::<f32>().map_err(inference_error)?.to_vec();
            if values.iter().all(|value| value.is_finite()) {
                Ok(values)
            } else {
                Err(ModelError::NotFinite { output })
            }
        };
        let logits = read(self.logits_output, "logits")?;
        let probabilities = read(self.probabilities_output, "probabilities")?;
        let (best, confidence) = argmax(&probabilities);
        let level = self.card.levels[best].level;
        let shore = match self.shore_output {
            Some(output) => match read(output, "shore")?[..] {
                // An interval that does not hold the value is none.
                [value, low, high] => Some(Shore {
                    value,
                    low: low.min(value),
                    high: high.max(value),
                }),
                _ => None,
            },
            None => None,
        };
        Ok(Verdict {
            level,
            logits,
            shore,
            levels: self.card.conformal.map(|set| set.set(&probabilities)),
            probabilities,
            confidence,
        })
    }

    /// Judges every check frame or press; the first judgement is also the plan's warm-up.
    fn reproduce_check(&self) -> Result<(), ModelError> {
        for index in 0..self.checks.count() {
            let verdict = self.judge_check(index)?;
            let expected = self.checks.probabilities(index);
            let difference = largest_difference(&verdict.probabilities, expected);
            if difference > CHECK_TOLERANCE {
                return Err(ModelError::CheckDiffers {
                    frame: index,
                    difference,
                });
            }
            let difference = largest_difference(&verdict.probabilities, &softmax(&verdict.logits));
            if difference > CHECK_TOLERANCE {
                return Err(ModelError::NotSoftmax {
                    frame: index,
                    difference,
                });
            }
            if let (Some(found), Some(expected)) = (verdict.shore, self.checks.shore(index)) {
                let [found, expected] = [found, expected].map(<[f32; 3]>::from);
                let difference = largest_difference(&found, &expected);
                if difference > SHORE_TOLERANCE {
                    return Err(ModelError::ShoreDiffers {
                        press: index,
                        difference,
                    });
                }
            }
        }
        Ok(())
    }
}

#[expect(clippy::needless_pass_by_value, reason = "for `map_err`")]
fn inference_error(error: TractError) -> ModelError {
    ModelError::Inference(root_cause(&error))
}

/// Index and value of the largest; the first of equal ones.
pub(crate) fn argmax(values: &[f32]) -> (usize, f32) {
    let mut best = (0, f32::NEG_INFINITY);
    for (index, &value) in values.iter().enumerate() {
        if value > best.1 {
            best = (index, value);
        }
    }
    best
}

fn softmax(logits: &[f32]) -> Vec<f32> {
    let (_, largest) = argmax(logits);
    let exponentials: Vec<f32> = logits.iter().map(|logit| (logit - largest).exp()).collect();
    let sum: f32 = exponentials.iter().sum();
    exponentials.iter().map(|value| value / sum).collect()
}

fn largest_difference(left: &[f32], right: &[f32]) -> f32 {
    left.iter()
        .zip(right)
        .map(|(l, r)| (l - r).abs())
        .fold(0.0, f32::max)
}

/// SHA-256 of `bytes` as 64 hexadecimal digits.
pub fn sha256_hex(bytes: &[u8]) -> String {
    hex::encode(Sha256::digest(bytes))
}

/// The innermost message: tract's outer ones name its own stages.
fn root_cause(error: &TractError) -> String {
    error.root_cause().to_string()
}

#[cfg(test)]
#[path = "../tests/bench/course_model.rs"]
pub(crate) mod course_model;
#[cfg(test)]
mod tests;
