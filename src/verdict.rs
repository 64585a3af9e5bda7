//! A frame becomes a verdict: loads an HRN from ONNX bytes and judges frames with it.
//!
//! In: the bytes of a model file (contract: `docs` of the model file in the README), then frames
//! in newtons. Out: [`Verdict`]s. A file is refused unless all of it is as agreed and it
//! reproduces the probabilities that its trainer wrote into it, so a loaded [`Hrn`] is known to
//! compute what was evaluated. Never reads a file itself, never prints, never trains.

use std::fmt::Write as _;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use tract_onnx::pb;
use tract_onnx::prelude::*;

use crate::frame::{COLS, Frame, ROWS, TAXELS};

/// The default model, built into the binary; `models/README.md` is its card.
pub const BUILT_IN: &[u8] = include_bytes!("../models/hrn.onnx");

/// Largest model file accepted, in bytes: 64 MB.
pub const MAX_FILE_BYTES: usize = 64_000_000;
/// Oldest ONNX operator set accepted.
pub const MIN_OPSET: i64 = 17;
/// The check frames' probabilities must be reproduced within this.
pub const CHECK_TOLERANCE: f32 = 1e-4;

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
    /// `hrn.format`; always "1" here.
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
}

/// `hrn.check`: frames and the probabilities that the trainer computed for them.
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
}

/// What an HRN says of one frame.
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
}

/// A hardness recognition network, ready to judge.
#[derive(Debug)]
pub struct Hrn {
    plan: Arc<TypedRunnableModel>,
    logits_output: usize,
    probabilities_output: usize,
    card: Card,
    check: Check,
    sha256: String,
}

impl Hrn {
    /// Loads a model file and reproduces its check frames.
    ///
    /// # Errors
    ///
    /// Whatever in the file is not as agreed; each [`ModelError`] but the last two names it.
    pub fn load(bytes: &[u8]) -> Result<Self, ModelError> {
        if bytes.len() > MAX_FILE_BYTES {
            return Err(ModelError::TooLarge { found: bytes.len() });
        }
        let onnx = tract_onnx::onnx();
        let mut reader = bytes;
        let proto = onnx
            .proto_model_for_read(&mut reader)
            .map_err(|error| ModelError::NotOnnx(root_cause(&error)))?;
        let graph = match &proto.graph {
            Some(graph) if proto.ir_version > 0 => graph,
            _ => return Err(ModelError::NotOnnx("no graph in it".into())),
        };
        check_opset(&proto)?;
        check_tensors_inside(graph)?;
        let (card, check) = read_metadata(&proto)?;
        check_signature(graph, card.levels.len())?;
        let position = |name: &str| graph.output.iter().position(|output| output.name == name);
        let (Some(logits_output), Some(probabilities_output)) =
            (position("logits"), position("probabilities"))
        else {
            return Err(ModelError::Graph("no outputs".into()));
        };

        let graph_error = |error: TractError| ModelError::Graph(root_cause(&error));
        let inference = onnx.model_for_proto_model(&proto).map_err(graph_error)?;
        // From here on only the plan is kept: the protobuf is as large again as the weights.
        drop(proto);
        let plan = inference
            .with_input_fact(0, f32::fact([1, 1, ROWS, COLS]).into())
            .and_then(InferenceModelExt::into_optimized)
            .and_then(TypedModel::into_runnable)
            .map_err(graph_error)?;

        let hrn = Self {
            plan,
            logits_output,
            probabilities_output,
            card,
            check,
            sha256: sha256_hex(bytes),
        };
        hrn.reproduce_check()?;
        Ok(hrn)
    }

    /// SHA-256 of the whole file, 64 hexadecimal digits.
    pub fn sha256(&self) -> &str {
        &self.sha256
    }

    /// What the file says of itself.
    pub fn card(&self) -> &Card {
        &self.card
    }

    /// The frames that the file carries to be checked by, with their probabilities.
    pub fn check(&self) -> &Check {
        &self.check
    }

    /// Judges one frame.
    ///
    /// # Errors
    ///
    /// [`ModelError::NotFinite`] if an output is NaN or infinite, [`ModelError::Inference`] if
    /// the inference library fails.
    pub fn judge(&self, frame: &Frame) -> Result<Verdict, ModelError> {
        let inference_error = |error: TractError| ModelError::Inference(root_cause(&error));
        let input =
            Tensor::from_shape(&[1, 1, ROWS, COLS], &frame.newtons).map_err(inference_error)?;
        let outputs = self
            .plan
            .run(tvec!(input.into()))
            .map_err(inference_error)?;
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
        Ok(Verdict {
            level,
            logits,
            probabilities,
            confidence,
        })
    }

    /// Judges every check frame; the first judgement is also the plan's warm-up.
    fn reproduce_check(&self) -> Result<(), ModelError> {
        for (index, (newtons, expected)) in self
            .check
            .frames
            .iter()
            .zip(&self.check.probabilities)
            .enumerate()
        {
            let mut frame = Frame::default();
            frame.newtons.copy_from_slice(newtons);
            let verdict = self.judge(&frame)?;
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
        }
        Ok(())
    }
}

/// Index and value of the largest; the first of equal ones.
fn argmax(values: &[f32]) -> (usize, f32) {
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
    let mut hex = String::with_capacity(64);
    for byte in Sha256::digest(bytes) {
        write!(hex, "{byte:02x}").expect("a String grows without failing");
    }
    hex
}

/// The innermost message: tract's outer ones name its own stages.
fn root_cause(error: &TractError) -> String {
    error.root_cause().to_string()
}

fn check_opset(proto: &pb::ModelProto) -> Result<(), ModelError> {
    let found = proto
        .opset_import
        .iter()
        .find(|import| import.domain.is_empty() || import.domain == "ai.onnx")
        .map(|import| import.version);
    match found {
        Some(version) if version >= MIN_OPSET => Ok(()),
        _ => Err(ModelError::Opset { found }),
    }
}

/// Refuses data that lies outside the file, in subgraphs and attributes too.
fn check_tensors_inside(graph: &pb::GraphProto) -> Result<(), ModelError> {
    let inside = |tensor: &pb::TensorProto| {
        let external = pb::tensor_proto::DataLocation::External as i32;
        if tensor.data_location == Some(external) || !tensor.external_data.is_empty() {
            return Err(ModelError::ExternalData {
                tensor: tensor.name.clone(),
            });
        }
        Ok(())
    };
    let sparse_inside = |sparse: &pb::SparseTensorProto| {
        sparse
            .values
            .iter()
            .chain(&sparse.indices)
            .try_for_each(inside)
    };
    graph.initializer.iter().try_for_each(inside)?;
    graph
        .sparse_initializer
        .iter()
        .try_for_each(sparse_inside)?;
    for attribute in graph.node.iter().flat_map(|node| &node.attribute) {
        attribute
            .t
            .iter()
            .chain(&attribute.tensors)
            .try_for_each(inside)?;
        attribute
            .sparse_tensor
            .iter()
            .chain(&attribute.sparse_tensors)
            .try_for_each(sparse_inside)?;
        attribute
            .g
            .iter()
            .chain(&attribute.graphs)
            .try_for_each(check_tensors_inside)?;
    }
    Ok(())
}

/// Refuses other inputs and outputs than the agreed ones.
fn check_signature(graph: &pb::GraphProto, levels: usize) -> Result<(), ModelError> {
    let describe = |values: &[&pb::ValueInfoProto]| {
        values
            .iter()
            .map(|value| describe_value(value))
            .collect::<Vec<_>>()
            .join(", ")
    };
    // Before ONNX IR 4 every initialiser is listed among the inputs too.
    let inputs: Vec<&pb::ValueInfoProto> = graph
        .input
        .iter()
        .filter(|input| {
            graph
                .initializer
                .iter()
                .all(|tensor| tensor.name != input.name)
        })
        .collect();
    let (found, expected) = (describe(&inputs), format!("frame f32 [1,1,{ROWS},{COLS}]"));
    if found != expected {
        return Err(ModelError::Signature {
            what: "input",
            found,
            expected,
        });
    }
    let mut outputs: Vec<&pb::ValueInfoProto> = graph.output.iter().collect();
    outputs.sort_by(|left, right| left.name.cmp(&right.name));
    let found = describe(&outputs);
    let expected = format!("logits f32 [1,{levels}], probabilities f32 [1,{levels}]");
    if found != expected {
        return Err(ModelError::Signature {
            what: "outputs",
            found,
            expected,
        });
    }
    // The inference library takes it for granted that somebody computes the outputs.
    for output in outputs {
        if !graph
            .node
            .iter()
            .any(|node| node.output.contains(&output.name))
        {
            return Err(ModelError::Graph(format!(
                "no node computes `{}`",
                output.name
            )));
        }
    }
    Ok(())
}

/// A graph input or output as `name type [shape]`.
fn describe_value(value: &pb::ValueInfoProto) -> String {
    use pb::tensor_shape_proto::dimension::Value as Dimension;
    use pb::type_proto::Value;
    let Some(Value::TensorType(tensor)) = value.r#type.as_ref().and_then(|t| t.value.as_ref())
    else {
        return format!("{} of no tensor type", value.name);
    };
    let datum = match pb::tensor_proto::DataType::try_from(tensor.elem_type) {
        Ok(pb::tensor_proto::DataType::Float) => "f32".to_owned(),
        Ok(other) => format!("{other:?}").to_lowercase(),
        Err(_) => format!("type {}", tensor.elem_type),
    };
    let dimensions: Vec<String> = tensor
        .shape
        .iter()
        .flat_map(|shape| &shape.dim)
        .map(|dimension| match &dimension.value {
            Some(Dimension::DimValue(length)) => length.to_string(),
            Some(Dimension::DimParam(name)) => name.clone(),
            None => "?".to_owned(),
        })
        .collect();
    format!("{} {datum} [{}]", value.name, dimensions.join(","))
}

/// Reads and checks all `hrn.*` keys.
fn read_metadata(proto: &pb::ModelProto) -> Result<(Card, Check), ModelError> {
    let text = |key: &'static str| {
        proto
            .metadata_props
            .iter()
            .find(|entry| entry.key == key)
            .map(|entry| entry.value.as_str())
            .ok_or(ModelError::KeyMissing { key })
    };
    let line = |key: &'static str| {
        let value = text(key)?;
        if value.trim().is_empty() || value.chars().any(char::is_control) {
            let expected = "text without control characters".to_owned();
            return Err(ModelError::KeyInvalid {
                key,
                found: format!("{value:?}"),
                expected,
            });
        }
        Ok(value.to_owned())
    };

    let format = text("hrn.format")?.to_owned();
    if format != "1" {
        let (found, expected) = (format!("{format:?}"), "\"1\"".to_owned());
        return Err(ModelError::KeyInvalid {
            key: "hrn.format",
            found,
            expected,
        });
    }
    let levels: Vec<Level> = json("hrn.levels", text("hrn.levels")?, "the levels as in hello")?;
    check_levels(&levels)?;
    let pitch = text("hrn.pitch_mm")?;
    let pitch_mm = match pitch.trim().parse::<f32>() {
        Ok(value) if value.is_finite() && value > 0.0 => value,
        _ => {
            let expected = "millimetres above 0".to_owned();
            let found = format!("{pitch:?}");
            return Err(ModelError::KeyInvalid {
                key: "hrn.pitch_mm",
                found,
                expected,
            });
        }
    };
    let range: Range = json("hrn.range", text("hrn.range")?, "trained force and area")?;
    check_range(&range)?;
    let check: Check = json("hrn.check", text("hrn.check")?, "frames and probabilities")?;
    check_check(&check, levels.len())?;
    let card = Card {
        format,
        levels,
        pitch_mm,
        method: line("hrn.method")?,
        data: line("hrn.data")?,
        metrics: json("hrn.metrics", text("hrn.metrics")?, "JSON")?,
        validation: line("hrn.validation")?,
        range,
    };
    Ok((card, check))
}

fn json<T: for<'a> Deserialize<'a>>(
    key: &'static str,
    value: &str,
    expected: &str,
) -> Result<T, ModelError> {
    serde_json::from_str(value).map_err(|error| ModelError::KeyInvalid {
        key,
        found: error.to_string(),
        expected: expected.to_owned(),
    })
}

fn check_levels(levels: &[Level]) -> Result<(), ModelError> {
    let key = "hrn.levels";
    let numbers: Vec<u8> = levels.iter().map(|level| level.level).collect();
    let consecutive = numbers
        .iter()
        .zip(1..=u8::MAX)
        .all(|(&number, wanted)| number == wanted);
    if levels.len() < 2 || levels.len() > usize::from(u8::MAX) || !consecutive {
        let expected = "levels 1, 2, ... in order, at least two".to_owned();
        return Err(ModelError::KeyInvalid {
            key,
            found: format!("{numbers:?}"),
            expected,
        });
    }
    for text in levels.iter().flat_map(|level| [&level.label, &level.shore]) {
        if text.is_empty() || text.chars().any(char::is_control) {
            let expected = "labels without control characters".to_owned();
            return Err(ModelError::KeyInvalid {
                key,
                found: format!("{text:?}"),
                expected,
            });
        }
    }
    Ok(())
}

fn check_range(range: &Range) -> Result<(), ModelError> {
    let [force_low, force_high] = range.force_n;
    let [area_low, area_high] = range.contact_area_taxels;
    let force_ordered = force_low.is_finite() && force_high.is_finite() && force_low <= force_high;
    if force_ordered && area_low <= area_high {
        return Ok(());
    }
    let expected = "[least, greatest] of finite numbers".to_owned();
    Err(ModelError::KeyInvalid {
        key: "hrn.range",
        found: format!("{range:?}"),
        expected,
    })
}

fn check_check(check: &Check, levels: usize) -> Result<(), ModelError> {
    let usable = |newtons: &Vec<f32>| {
        newtons.len() == TAXELS && newtons.iter().all(|n| n.is_finite() && *n >= 0.0)
    };
    // Two frames a level; a model of more than four levels may keep to eight.
    let least = 8.min(2 * levels);
    if check.frames.len() >= least
        && check.frames.len() == check.probabilities.len()
        && check.frames.iter().all(usable)
        && check.probabilities.iter().all(|row| row.len() == levels)
    {
        return Ok(());
    }
    let lengths = |rows: &[Vec<f32>]| {
        let mut lengths: Vec<usize> = rows.iter().map(Vec::len).collect();
        lengths.dedup();
        lengths
    };
    let found = format!(
        "{} frames of lengths {:?}, {} rows of probabilities of lengths {:?}",
        check.frames.len(),
        lengths(&check.frames),
        check.probabilities.len(),
        lengths(&check.probabilities)
    );
    let expected = format!("at least {least} frames of {TAXELS} newtons, as many rows of {levels}");
    Err(ModelError::KeyInvalid {
        key: "hrn.check",
        found,
        expected,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use prost::Message as _;

    fn proto() -> pb::ModelProto {
        pb::ModelProto::decode(BUILT_IN).unwrap()
    }

    fn graph(proto: &mut pb::ModelProto) -> &mut pb::GraphProto {
        proto.graph.as_mut().unwrap()
    }

    fn value<'a>(proto: &'a mut pb::ModelProto, key: &str) -> &'a mut String {
        let entry = proto
            .metadata_props
            .iter_mut()
            .find(|entry| entry.key == key);
        &mut entry.unwrap().value
    }

    /// Dimensions of a graph input or output.
    fn dims(value: &mut pb::ValueInfoProto) -> &mut Vec<pb::tensor_shape_proto::Dimension> {
        let pb::type_proto::Value::TensorType(tensor) =
            value.r#type.as_mut().unwrap().value.as_mut().unwrap();
        &mut tensor.shape.as_mut().unwrap().dim
    }

    #[test]
    fn the_built_in_model_loads_and_judges() {
        let hrn = Hrn::load(BUILT_IN).unwrap();
        let labels: Vec<&str> = hrn.card().levels.iter().map(|l| l.label.as_str()).collect();
        assert_eq!(labels, ["hard", "firm", "soft", "very-soft"]);
        assert_eq!(hrn.sha256().len(), 64);
        for (newtons, expected) in hrn.check().frames.iter().zip(&hrn.check().probabilities) {
            let mut frame = Frame::default();
            frame.newtons.copy_from_slice(newtons);
            let verdict = hrn.judge(&frame).unwrap();
            let (best, confidence) = argmax(&verdict.probabilities);
            assert_eq!(
                (usize::from(verdict.level), verdict.confidence),
                (best + 1, confidence)
            );
            assert!(largest_difference(&verdict.probabilities, expected) < CHECK_TOLERANCE);
            assert!((verdict.probabilities.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        }
    }

    #[test]
    fn what_is_not_as_agreed_is_refused_with_what_was_found_and_expected() {
        fn check(expected: &str, change: impl FnOnce(&mut pb::ModelProto)) {
            let mut changed = proto();
            change(&mut changed);
            let error = Hrn::load(&changed.encode_to_vec()).unwrap_err().to_string();
            assert!(
                error.contains(expected),
                "{error}\nshould contain\n{expected}"
            );
        }
        check("ONNX opset 16: expected 17 or newer", |p| {
            p.opset_import[0].version = 16;
        });
        check("ONNX opset missing", |p| p.opset_import.clear());
        check("not an ONNX model: no graph in it", |p| p.graph = None);
        check(
            "model input image f32 [1,1,28,28]: expected frame f32 [1,1,28,28]",
            |p| {
                graph(p).input[0].name = "image".into();
            },
        );
        check(
            "model input frame f32 [1,1,28,27]: expected frame f32 [1,1,28,28]",
            |p| {
                use pb::tensor_shape_proto::dimension::Value;
                dims(&mut graph(p).input[0])[3].value = Some(Value::DimValue(27));
            },
        );
        check("model input frame f32 [batch,1,28,28]: expected", |p| {
            use pb::tensor_shape_proto::dimension::Value;
            dims(&mut graph(p).input[0])[0].value = Some(Value::DimParam("batch".into()));
        });
        check(
            "model input frame double [1,1,28,28]: expected frame f32",
            |p| {
                let kind = graph(p).input[0]
                    .r#type
                    .as_mut()
                    .unwrap()
                    .value
                    .as_mut()
                    .unwrap();
                let pb::type_proto::Value::TensorType(tensor) = kind;
                tensor.elem_type = pb::tensor_proto::DataType::Double as i32;
            },
        );
        check(
            "model outputs logits f32 [1,4]: expected logits f32 [1,4], probabilities",
            |p| {
                graph(p).output.remove(1);
            },
        );
        check("expected logits f32 [1,3], probabilities f32 [1,3]", |p| {
            let levels = r#"[{"level":1,"label":"a","shore":">70"},
                {"level":2,"label":"b","shore":"60"},{"level":3,"label":"c","shore":"50"}]"#;
            *value(p, "hrn.levels") = levels.into();
            let check: Check = serde_json::from_str(value(p, "hrn.check")).unwrap();
            let narrow = Check {
                probabilities: check
                    .probabilities
                    .iter()
                    .map(|row| row[..3].to_vec())
                    .collect(),
                ..check
            };
            *value(p, "hrn.check") = serde_json::to_string(&narrow).unwrap();
        });
        check("no node computes `logits`", |p| {
            graph(p).node.retain(|node| node.output[0] != "logits");
        });
        check("tensor `scale` lies in an external file", |p| {
            let tensor = graph(p)
                .initializer
                .iter_mut()
                .find(|t| t.name == "scale")
                .unwrap();
            tensor.data_location = Some(pb::tensor_proto::DataLocation::External as i32);
        });
        check("model graph cannot be run", |p| {
            graph(p).node[0].op_type = "Divination".into();
        });

        for key in [
            "hrn.format",
            "hrn.levels",
            "hrn.pitch_mm",
            "hrn.method",
            "hrn.data",
            "hrn.metrics",
            "hrn.validation",
            "hrn.range",
            "hrn.check",
        ] {
            check(&format!("model metadata `{key}` is missing"), |p| {
                p.metadata_props.retain(|entry| entry.key != key);
            });
        }
        let set = |key: &'static str, text: &'static str| {
            move |p: &mut pb::ModelProto| *value(p, key) = text.into()
        };
        check(
            "`hrn.format`: found \"2\", expected \"1\"",
            set("hrn.format", "2"),
        );
        check(
            "`hrn.pitch_mm`: found \"-1\", expected",
            set("hrn.pitch_mm", "-1"),
        );
        check("`hrn.levels`: found", set("hrn.levels", "[]"));
        check(
            "`hrn.levels`: found [1, 2, 4, 3], expected levels 1, 2",
            |p| {
                let mut levels: Vec<Level> = serde_json::from_str(value(p, "hrn.levels")).unwrap();
                levels.swap(2, 3);
                *value(p, "hrn.levels") = serde_json::to_string(&levels).unwrap();
            },
        );
        check(
            "`hrn.levels`: found \"ha\\u{1b}rd\", expected labels without",
            |p| {
                *value(p, "hrn.levels") = value(p, "hrn.levels").replace("hard", "ha\\u001brd");
            },
        );
        check(
            "`hrn.range`: found",
            set("hrn.range", "{\"force_n\":[1,2]}"),
        );
        check("`hrn.metrics`: found", set("hrn.metrics", "{"));
        check("`hrn.check`: found 1 frames of lengths [2]", |p| {
            *value(p, "hrn.check") = r#"{"frames":[[1,2]],"probabilities":[[1,0,0,0]]}"#.into();
        });
        check(
            "check frame 3: probabilities differ from the trainer's by up to 0.01",
            |p| {
                let mut check: Check = serde_json::from_str(value(p, "hrn.check")).unwrap();
                check.probabilities[3][0] += 0.01;
                *value(p, "hrn.check") = serde_json::to_string(&check).unwrap();
            },
        );
        // Other weights than those checked: the trainer's probabilities do not come out.
        check(
            "check frame 0: probabilities differ from the trainer's",
            |p| {
                let bias = graph(p)
                    .initializer
                    .iter_mut()
                    .find(|t| t.name == "head.bias")
                    .unwrap();
                bias.raw_data[..4].copy_from_slice(&5.0_f32.to_le_bytes());
            },
        );
        check("a number that is not finite in `logits`", |p| {
            let bias = graph(p)
                .initializer
                .iter_mut()
                .find(|t| t.name == "head.bias")
                .unwrap();
            bias.raw_data[..4].copy_from_slice(&f32::NAN.to_le_bytes());
        });
        // Probabilities of the right values, but logits of another temperature.
        check("differs from softmax(`logits`)", |p| {
            let nodes = &mut graph(p).node;
            let mut sharp = nodes
                .iter()
                .find(|node| node.output[0] == "logits")
                .unwrap()
                .clone();
            nodes
                .iter_mut()
                .find(|node| node.output[0] == "logits")
                .unwrap()
                .output[0] = "true logits".into();
            nodes
                .iter_mut()
                .find(|node| node.op_type == "Softmax")
                .unwrap()
                .input[0] = "true logits".into();
            sharp.op_type = "Add".into();
            sharp.name = "shifted".into();
            sharp.input = vec!["true logits".into(), "head.bias shifted".into()];
            let mut shift = graph(p).initializer[0].clone();
            shift.name = "head.bias shifted".into();
            shift.dims = vec![4];
            shift.raw_data = [1.0_f32, 0.0, 0.0, 0.0]
                .iter()
                .flat_map(|v| v.to_le_bytes())
                .collect();
            graph(p).initializer.push(shift);
            graph(p).node.push(sharp);
        });
    }

    #[test]
    fn an_oversized_or_foreign_file_is_refused() {
        let error = Hrn::load(&vec![0; MAX_FILE_BYTES + 1])
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("64000001 bytes: at most 64000000"),
            "{error}"
        );
        for bytes in [&b""[..], b"not a model", &BUILT_IN[..BUILT_IN.len() / 2]] {
            let error = Hrn::load(bytes).unwrap_err();
            assert!(matches!(error, ModelError::NotOnnx(_)), "{error}");
        }
    }

    #[test]
    fn equal_probabilities_go_to_the_lower_level() {
        assert_eq!(argmax(&[0.1, 0.4, 0.4, 0.1]), (1, 0.4));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        /// A damaged file is refused or judges finite numbers; the daemon, which ends on any
        /// panic, must not end on a reload.
        #[test]
        fn a_damaged_file_never_panics(
            place in 0..BUILT_IN.len(),
            byte in any::<u8>(),
            near_end in any::<bool>(),
        ) {
            let mut bytes = BUILT_IN.to_vec();
            // Structure lies at both ends of the file, weights in between.
            let place = if near_end { bytes.len() - 1 - place % 4096 } else { place };
            bytes[place] = byte;
            let _ = Hrn::load(&bytes);
        }
    }
}
