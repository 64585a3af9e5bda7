//! What a model file says before its graph is built (`docs/formats.md`).
//!
//! In: the file as ONNX's own messages. Out: the model's description, or all that breaks the format.
//! Nothing here runs the model.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::sync::Arc;

use serde::de::{DeserializeOwned, IgnoredAny};
use tract_onnx::pb;
use tract_onnx::pb::tensor_shape_proto::dimension::Value as Dimension;

use super::card::{Card, Checks, Conformal, Limits, Range};
use super::course::COURSE_FRAMES;
use super::error::{MIN_OPSET, ModelError};
use super::inputs::{Input, Lengths};
use super::references::{Knowledge, MOST_REFERENCES};
use super::shore::{Borders, Level, are_levels};
use crate::frame::{Array, MOST_SIDE};
use crate::wording::{is_plain, named};

/// The longest part of a name or a text in a message.
const NAME_CHARS: usize = 60;
/// The longest text that people read.
const LONGEST_LINE_BYTES: usize = 16_384;
/// The longest JSON but that of `hrn.check`. As a value, it takes some ten times the memory.
const LONGEST_JSON_BYTES: usize = 1 << 20;
/// The numbers of bins that a model of format 3 may divide the scale into.
const BINS: RangeInclusive<usize> = 10..=400;
/// The numbers that such a model may take of a reference.
const NUMBERS: RangeInclusive<usize> = 1..=1024;
/// The key of the checks.
const CHECK: &str = "hrn.check";
/// The keys of `hrn.range`. Earlier trainers also wrote the last five, into the built-in model too: they have
/// no effect.
const RANGES: [&str; 8] = [
    "force_n",
    "contact_area_taxels",
    "pitch_mm",
    "duration_s",
    "frame_period_s",
    "speed_mm_s",
    "approach_mm",
    "arm_n_per_mm",
];

/// What breaks the format, so that all of it is said at once.
#[derive(Default)]
struct Problems(Vec<String>);

impl Problems {
    fn keep<T>(&mut self, read: Result<T, ModelError>) -> Option<T> {
        read.map_err(|error| self.0.push(error.to_string())).ok()
    }
}

/// What a model file says.
#[derive(Debug, Clone)]
pub(super) struct File {
    pub(super) card: Card,
    pub(super) checks: Arc<Checks>,
    /// The inputs of the model, in their order.
    pub(super) inputs: Vec<Input>,
    pub(super) lengths: Lengths,
    /// The names of the outputs, in their order.
    pub(super) outputs: Vec<String>,
}

impl File {
    /// Reads a file.
    ///
    /// # Errors
    ///
    /// Returns an error with all that breaks the format.
    pub(super) fn read(proto: &pb::ModelProto) -> Result<Self, ModelError> {
        let graph = proto.graph.as_ref().filter(|_| proto.ir_version > 0);
        let graph = graph.ok_or_else(|| ModelError::new("not an ONNX model: no graph in it"))?;
        let mut problems = Problems::default();
        problems.keep(check_opset(proto));
        problems.keep(check_tensors_inside(graph));
        let metadata = Metadata::of(proto, &mut problems);
        let card = card(&metadata, &mut problems);
        let format = metadata.0.get("hrn.format").copied().unwrap_or("1");
        let given = given(graph);
        let inputs = problems.keep(match format {
            "3" => course_inputs(&given),
            _ => frame_input(&given, card.as_ref().and_then(|card| card.grid)),
        });
        let takes_references = given.iter().any(|(name, _)| *name == "references");
        let outputs = problems.keep(outputs(graph, format, takes_references));
        let (Some(card), Some((inputs, lengths)), Some(outputs), true) =
            (card, inputs, outputs, problems.0.is_empty())
        else {
            return Err(ModelError::new(problems.0.join("; ")));
        };
        if outputs.iter().any(|output| output == "bins") {
            Borders::of(&card.levels).map_err(|error| {
                ModelError::new(format!("model metadata `hrn.levels`: {error}"))
            })?;
        }
        let checks = match format {
            "3" => Checks::Courses(metadata.json(CHECK, "presses", |_| true)?),
            _ => Checks::Frames(metadata.json(CHECK, "frames and probabilities", |_| true)?),
        };
        // There are 8, or two a level: only a model of four levels has both.
        let (levels, count) = (card.levels.len(), checks.count());
        let rows = checks.expected();
        let mut lengths_of_rows = rows.iter().map(|(probabilities, _)| probabilities.len());
        let is_number = [8, 2 * levels].contains(&count) && rows.len() == count;
        if !is_number || !lengths_of_rows.all(|length| length == levels) {
            let found = format!("{count} of other lengths or number");
            let expected = format!("8, or two a level, each with {levels} probabilities");
            return Err(ModelError::of_key(CHECK, found, expected));
        }
        Ok(Self {
            card,
            checks: Arc::new(checks),
            inputs,
            lengths,
            outputs,
        })
    }

    /// The place of an output. `None` if the model has none of this name.
    pub(super) fn place_of(&self, output: &str) -> Option<usize> {
        self.outputs.iter().position(|name| name == output)
    }

    /// The lengths that an output may have, if it is used.
    pub(super) fn lengths_of(&self, output: &str) -> Option<RangeInclusive<usize>> {
        let (levels, features) = (self.card.levels.len(), self.lengths.features);
        match output {
            "logits" | "probabilities" => Some(levels..=levels),
            "shore" => Some(3..=3),
            "bins" => Some(BINS),
            "reference" => Some(features..=features),
            _ => None,
        }
    }
}

fn check_opset(proto: &pb::ModelProto) -> Result<(), ModelError> {
    let mut imports = proto.opset_import.iter();
    let found = imports.find(|import| import.domain.is_empty() || import.domain == "ai.onnx");
    let found = match found.map(|import| import.version) {
        Some(version) if version >= MIN_OPSET => return Ok(()),
        Some(version) => version.to_string(),
        None => "missing".to_owned(),
    };
    let problem = format!("ONNX opset {found}: expected {MIN_OPSET} or newer");
    Err(ModelError::new(problem))
}

/// Refuses a graph whose weights lie in another file, as some exporters write them.
fn check_tensors_inside(graph: &pb::GraphProto) -> Result<(), ModelError> {
    let external = Some(pb::tensor_proto::DataLocation::External as i32);
    let mut tensors = graph.initializer.iter();
    match tensors.find(|tensor| tensor.data_location == external) {
        Some(tensor) => Err(ModelError::new(format!(
            "tensor `{}` lies in an external file: expected all data inside the model file (PyTorch: \
             `external_data=False`)",
            tensor.name
        ))),
        None => Ok(()),
    }
}

/// An input as the file states it: its name and its shape, if it is a fixed one of f32.
type Given<'a> = (&'a str, Option<Vec<usize>>);

/// The inputs of a graph. Before ONNX IR 4, every initialiser is also listed among the inputs.
fn given(graph: &pb::GraphProto) -> Vec<Given<'_>> {
    let is_weight = |name: &str| graph.initializer.iter().any(|tensor| tensor.name == name);
    let inputs = graph.input.iter();
    let inputs = inputs.filter(|input| !is_weight(&input.name));
    inputs
        .map(|input| (input.name.as_str(), shape(input)))
        .collect()
}

fn shape(value: &pb::ValueInfoProto) -> Option<Vec<usize>> {
    let pb::type_proto::Value::TensorType(tensor) = value.r#type.as_ref()?.value.as_ref()?;
    let is_float = tensor.elem_type == pb::tensor_proto::DataType::Float as i32;
    let lengths = tensor.shape.as_ref()?.dim.iter();
    let length = |length: &pb::tensor_shape_proto::Dimension| match length.value.as_ref()? {
        &Dimension::DimValue(length) => usize::try_from(length).ok(),
        Dimension::DimParam(_) => None,
    };
    lengths
        .map(length)
        .collect::<Option<_>>()
        .filter(|_| is_float)
}

fn described(name: &str, shape: &[usize]) -> String {
    let shape: Vec<String> = shape.iter().map(usize::to_string).collect();
    format!("{name} f32 [{}]", shape.join(","))
}

/// The error of inputs that are not as the format has them.
fn unexpected(given: &[Given<'_>], expected: &str) -> ModelError {
    let one = |(name, shape): &Given<'_>| {
        let name: String = name.chars().take(NAME_CHARS).collect();
        match shape {
            Some(shape) => described(&name, shape),
            None => format!("{name} of another type or no fixed shape"),
        }
    };
    let found: Vec<String> = given.iter().map(one).collect();
    let found = if found.is_empty() {
        "none".to_owned()
    } else {
        found.join(", ")
    };
    ModelError::new(format!("model inputs: found {found}, expected {expected}"))
}

/// The input of a model of format 1, and its lengths.
fn frame_input(
    given: &[Given<'_>],
    grid: Option<Array>,
) -> Result<(Vec<Input>, Lengths), ModelError> {
    let lengths = Lengths {
        array: grid.unwrap_or(Array::JX255N),
        frames: usize::MAX,
        references: 0,
        features: 0,
    };
    let mut expected = Vec::new();
    for input in [Some(Input::Frame), grid.map(|_| Input::Parts)] {
        let Some(input) = input else { continue };
        let (name, shape) = (input.name(), input.shape(lengths));
        expected.push(described(&name, &shape));
        if *given == [(&*name, Some(shape))] {
            return Ok((vec![input], lengths));
        }
    }
    Err(unexpected(given, &expected.join(" or ")))
}

/// The inputs of a model of courses in their order, and their lengths. A model takes those that it needs,
/// and of those for references all or none.
fn course_inputs(given: &[Given<'_>]) -> Result<(Vec<Input>, Lengths), ModelError> {
    let inputs = given.iter().map(|(name, _)| named::<Input>(name).ok());
    let inputs: Vec<Input> = inputs.flatten().collect();
    let along = |wanted: Input, axis: usize| {
        let at = inputs.iter().position(|input| *input == wanted)?;
        given.get(at)?.1.as_ref()?.get(axis).copied()
    };
    let lengths = Lengths {
        array: Array::JX255N,
        // A model that takes no frame takes the features of any number of them.
        frames: Input::OF_FRAMES
            .into_iter()
            .find_map(|input| along(input, 1))
            .unwrap_or(COURSE_FRAMES.1),
        references: along(Input::References, 1).unwrap_or(0),
        features: along(Input::References, 2).unwrap_or(0),
    };
    let shapes = given.iter().map(|(_, shape)| shape.clone());
    let is_of_course = |input: &Input| !matches!(input, Input::Frame | Input::Parts);
    let takes = Input::OF_REFERENCES.map(|input| inputs.contains(&input));
    let are_some = (1..=MOST_REFERENCES).contains(&lengths.references);
    let fits = takes == [are_some; 3] && (!are_some || NUMBERS.contains(&lengths.features));
    if fits
        && !inputs.is_empty()
        && inputs.iter().all(is_of_course)
        && (COURSE_FRAMES.0..=COURSE_FRAMES.1).contains(&lengths.frames)
        && shapes.eq(inputs.iter().map(|input| Some(input.shape(lengths))))
    {
        return Ok((inputs, lengths));
    }
    let expected = "some of frames, time_s, approach_mm, known, mask, arm_n_per_mm, piece, references, given, \
                    features, of the shapes in results/course-format.md";
    Err(unexpected(given, expected))
}

/// The names of the outputs. What the graph computes for them shows their lengths.
fn outputs(
    graph: &pb::GraphProto,
    format: &str,
    takes_references: bool,
) -> Result<Vec<String>, ModelError> {
    let names: Vec<String> = graph
        .output
        .iter()
        .map(|output| output.name.clone())
        .collect();
    let has = |wanted: &str| names.iter().any(|name| name == wanted);
    let has_levels = has("logits") && has("probabilities");
    let (fits, expected) = match format {
        "3" if takes_references => (has("bins") && has("reference"), "bins, reference"),
        "3" => (has("bins") || has_levels, "bins; or logits, probabilities"),
        _ => (has_levels, "logits, probabilities"),
    };
    if !fits {
        let found = shown(&names.join(", "));
        let problem = format!("model outputs: found {found}, expected {expected}");
        return Err(ModelError::new(problem));
    }
    Ok(names)
}

/// The metadata of a file.
struct Metadata<'a>(BTreeMap<&'a str, &'a str>);

impl<'a> Metadata<'a> {
    fn of(proto: &'a pb::ModelProto, problems: &mut Problems) -> Self {
        let mut found = BTreeMap::new();
        for entry in &proto.metadata_props {
            if found.insert(&*entry.key, &*entry.value).is_some() {
                let key = shown(&entry.key);
                let problem = format!("model metadata: found {key} twice, expected it once");
                problems.0.push(problem);
            }
        }
        Self(found)
    }

    fn text(&self, key: &str) -> Result<&'a str, ModelError> {
        let missing = || ModelError::new(format!("model metadata `{key}` is missing"));
        self.0.get(key).copied().ok_or_else(missing)
    }

    fn line(&self, key: &'static str) -> Result<String, ModelError> {
        let value = self.text(key)?;
        check_line(key, value)?;
        Ok(value.to_owned())
    }

    /// The value of a key, if it `fits`.
    fn json<T: DeserializeOwned>(
        &self,
        key: &str,
        expected: &str,
        fits: impl Fn(&T) -> bool,
    ) -> Result<T, ModelError> {
        let text = self.text(key)?;
        if key != CHECK && text.len() > LONGEST_JSON_BYTES {
            let found = format!("{} bytes", text.len());
            let expected = format!("at most {LONGEST_JSON_BYTES}");
            return Err(ModelError::of_key(key, found, expected));
        }
        let value = serde_json::from_str(text);
        let value = value.map_err(|error| ModelError::of_key(key, error, expected))?;
        match fits(&value) {
            true => Ok(value),
            false => Err(ModelError::of_key(key, shown(text), expected)),
        }
    }

    /// The value of a key that a file need not have, if it `fits`.
    fn json_if_any<T: DeserializeOwned>(
        &self,
        key: &str,
        expected: &str,
        fits: impl Fn(&T) -> bool,
    ) -> Result<Option<T>, ModelError> {
        let found = self.0.get(key).map(|_| self.json(key, expected, fits));
        found.transpose()
    }
}

/// Checks a text of a model file that people read.
///
/// # Errors
///
/// Returns an error if the text is empty or too long, or has control or bidirectional characters.
pub fn check_line(key: &'static str, value: &str) -> Result<(), ModelError> {
    if value.trim().is_empty() || !is_plain(value) || value.len() > LONGEST_LINE_BYTES {
        let expected = format!(
            "text without control or bidirectional characters, of at most {LONGEST_LINE_BYTES} bytes"
        );
        return Err(ModelError::of_key(key, shown(value), expected));
    }
    Ok(())
}

/// Reads what a file says of itself.
fn card(metadata: &Metadata<'_>, problems: &mut Problems) -> Option<Card> {
    let format = problems.keep(format(metadata));
    let levels = "levels 1, 2, ... in order, at least two, each with `label` and `shore` of 1 to 255 bytes without \
                  control or bidirectional characters";
    let levels =
        problems.keep(metadata.json("hrn.levels", levels, |of: &Vec<Level>| are_levels(of)));
    let is_length = |mm: &f32| mm.is_finite() && *mm > 0.0;
    let pitch_mm = problems.keep(metadata.json("hrn.pitch_mm", "millimetres above 0", is_length));
    let lines = ["hrn.method", "hrn.data", "hrn.validation"];
    let [method, data, validation] = lines.map(|key| problems.keep(metadata.line(key)));
    let metrics = problems.keep(metadata.json("hrn.metrics", "JSON", |_| true));
    let format = format?;
    let is_of_frames = format == "1";
    let range = problems.keep(range(metadata));
    let grid = format!("[rows, columns], each 1 to {MOST_SIDE}, in a file of format 1");
    let grid = problems.keep(
        metadata.json_if_any("hrn.grid", &grid, |sides: &[usize; 2]| {
            is_of_frames && sides.iter().all(|side| (1..=MOST_SIDE).contains(side))
        }),
    );
    let conformal = "`alpha` between 0 and 1, `threshold`, 0 to 1, and perhaps `contexts`, each with `threshold` and \
                     `tail`, 0 to 0.5";
    let conformal = problems.keep(match is_of_frames {
        true => Ok(None),
        false => metadata.json_if_any("hrn.conformal", conformal, is_promise),
    });
    Some(Card {
        format,
        levels: levels?,
        pitch_mm: pitch_mm?,
        method: method?,
        data: data?,
        metrics: metrics?,
        validation: validation?,
        range: range?,
        grid: grid?.map(|[rows, cols]| Array { rows, cols }),
        conformal: conformal?,
    })
}

fn format(metadata: &Metadata<'_>) -> Result<String, ModelError> {
    let key = "hrn.format";
    let format = metadata.text(key)?;
    match ["1", "3"].contains(&format) {
        true => Ok(format.to_owned()),
        false => Err(ModelError::of_key(key, shown(format), "\"1\" or \"3\"")),
    }
}

fn range(metadata: &Metadata<'_>) -> Result<Range, ModelError> {
    let key = "hrn.range";
    let expected = "[least, greatest] of finite numbers for `force_n` and `contact_area_taxels`, and perhaps \
                    `pitch_mm`";
    let given: BTreeMap<String, IgnoredAny> = metadata.json(key, expected, |_| true)?;
    match given.keys().find(|name| !RANGES.contains(&name.as_str())) {
        Some(unknown) => Err(ModelError::of_key(key, shown(unknown), expected)),
        None => metadata.json(key, expected, is_range),
    }
}

fn is_range(range: &Range) -> bool {
    let mut pairs = [range.force_n].into_iter().chain(range.pitch_mm);
    let [least, most] = range.contact_area_taxels;
    least <= most && pairs.all(|[low, high]| low.is_finite() && high.is_finite() && low <= high)
}

fn is_promise(conformal: &Conformal) -> bool {
    let fits = |Limits { threshold, tail }: Limits| {
        (0.0..=1.0).contains(&threshold) && (0.0..0.5).contains(&tail)
    };
    let mut limits = Knowledge::ALL
        .into_iter()
        .map(|known| conformal.limits(known));
    let is_share = conformal.alpha > 0.0 && conformal.alpha < 1.0;
    is_share && limits.all(fits) && (0.0..=1.0).contains(&conformal.threshold)
}

/// The beginning of a text, quoted.
pub(super) fn shown(text: &str) -> String {
    let begin: String = text.chars().take(NAME_CHARS).collect();
    match begin.len() < text.len() {
        true => format!("{begin:?}... of {} bytes", text.len()),
        false => format!("{text:?}"),
    }
}
