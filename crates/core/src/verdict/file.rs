//! What a model file says before its graph is built (`docs/formats.md`).
//!
//! In: the file as ONNX's own messages. Out: the model's description, or all that breaks the format.
//! Nothing here runs the model.

use std::collections::BTreeSet;
use std::ops::RangeInclusive;
use std::sync::Arc;

use serde::de::DeserializeOwned;
use tract_onnx::pb;
use tract_onnx::pb::tensor_shape_proto::dimension::Value as Dimension;

use super::card::{Card, Checks, Conformal, Format, Limits, Range};
use super::course::COURSE_FRAMES;
use super::error::{MIN_OPSET, ModelError};
use super::inputs::{Input, Lengths};
use super::references::{Knowledge, MOST_REFERENCES};
use super::shore::{Borders, Level};
use crate::frame::{Array, MOST_SIDE};
use crate::wording::is_plain;

/// The longest `label` and `shore` of a level: every event carries a label.
const LONGEST_LABEL_BYTES: usize = 255;
/// The longest part of a name or a text in a message.
const NAME_CHARS: usize = 60;
/// The longest text of another key.
const LONGEST_LINE_BYTES: usize = 16_384;
/// The longest `hrn.metrics`. As a value, it takes some ten times the memory.
const LONGEST_METRICS_BYTES: usize = 1 << 20;
/// The numbers of bins that a model of format 3 may divide the scale into.
const BINS: RangeInclusive<usize> = 10..=400;
/// The numbers that such a model may take of a reference.
const NUMBERS: RangeInclusive<usize> = 1..=1024;

/// What breaks the format, so that all of it is said at once.
#[derive(Default)]
struct Problems(Vec<String>);

impl Problems {
    fn keep<T>(&mut self, read: Result<T, ModelError>) -> Option<T> {
        read.map_err(|error| self.0.push(error.to_string())).ok()
    }

    fn error(&self) -> ModelError {
        ModelError::new(self.0.join("; "))
    }
}

/// What a model file says.
#[derive(Debug, Clone)]
pub(super) struct File {
    pub(super) card: Card,
    pub(super) checks: Arc<Checks>,
    pub(super) format: Format,
    /// The inputs of a model of courses, in their order.
    pub(super) inputs: Vec<Input>,
    pub(super) lengths: Lengths,
    pub(super) outputs: Outputs,
}

/// The places of a model's outputs.
#[derive(Debug, Clone)]
pub(super) enum Outputs {
    /// Format 1, and a model of format 3 that names the levels itself.
    Levels {
        logits: usize,
        probabilities: usize,
        /// Such a model may have this output.
        shore: Option<usize>,
    },
    /// Format 3.
    Bins {
        bins: usize,
        /// A model that takes no references has none.
        reference: Option<usize>,
    },
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
        let metadata = Metadata(&proto.metadata_props);
        let card = card(&metadata, &mut problems);
        let given = given(graph);
        let inputs = problems.keep(match metadata.find("hrn.format") {
            Some("3") => course_inputs(&given),
            _ => frame_input(&given, card.as_ref().and_then(|card| card.grid))
                .map(|format| (format, Vec::new(), Lengths::default())),
        });
        // Which outputs a model of courses has depends on its inputs.
        let taken = inputs
            .as_ref()
            .map(|(format, _, lengths)| (*format, *lengths));
        let frame = (Format::Frame, Lengths::default());
        let taken = taken.or((metadata.find("hrn.format") == Some("1")).then_some(frame));
        let outputs = taken.and_then(|(format, lengths)| {
            let outputs = outputs(graph, format, lengths);
            problems.keep(outputs)
        });
        let (Some(card), Some((format, inputs, lengths)), Some(outputs), true) =
            (card, inputs, outputs, problems.0.is_empty())
        else {
            return Err(problems.error());
        };
        if let Outputs::Bins { .. } = outputs {
            let borders = Borders::of(&card.levels);
            borders.map_err(|error| {
                ModelError::new(format!("model metadata `hrn.levels`: {error}"))
            })?;
        }
        let key = "hrn.check";
        let checks = match format {
            Format::Course { .. } => {
                Checks::Courses(metadata.json(key, "presses with what the trainer says")?)
            }
            _ => Checks::Frames(metadata.json(key, "frames and probabilities")?),
        };
        let file = Self {
            card,
            checks: Arc::new(checks),
            format,
            inputs,
            lengths,
            outputs,
        };
        file.check_checks()?;
        Ok(file)
    }

    /// The name, the place and the length of each output.
    pub(super) fn outputs(&self) -> Vec<(&'static str, usize, RangeInclusive<usize>)> {
        let levels = self.card.levels.len();
        match self.outputs {
            Outputs::Levels {
                logits,
                probabilities,
                shore,
            } => {
                let of_levels = [
                    ("logits", logits, levels..=levels),
                    ("probabilities", probabilities, levels..=levels),
                ];
                let shore = shore.map(|place| ("shore", place, 3..=3));
                of_levels.into_iter().chain(shore).collect()
            }
            Outputs::Bins { bins, reference } => {
                let features = self.lengths.features;
                let reference = reference.map(|at| ("reference", at, features..=features));
                [("bins", bins, BINS)]
                    .into_iter()
                    .chain(reference)
                    .collect()
            }
        }
    }

    /// Refuses checks of another number. There are 8, or two a level: only a model of four levels has
    /// both.
    fn check_checks(&self) -> Result<(), ModelError> {
        let (levels, count) = (self.card.levels.len(), self.checks.count());
        let rows = self.checks.expected();
        let mut lengths = rows.iter().map(|(probabilities, _)| probabilities.len());
        let fits = [8, 2 * levels].contains(&count) && rows.len() == count;
        if fits && lengths.all(|length| length == levels) {
            return Ok(());
        }
        let found = format!("{count} of other lengths or number");
        let expected = format!("8, or two a level, each with {levels} probabilities");
        Err(ModelError::of_key("hrn.check", found, expected))
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

/// The format of a model with this one input.
fn frame_input(given: &[Given<'_>], grid: Option<Array>) -> Result<Format, ModelError> {
    let parts = grid.map(|_| ("parts", Format::Parts));
    let formats = [Some(("frame", Format::Frame)), parts];
    for (name, format) in formats.into_iter().flatten() {
        if given == [(name, Some(format.shape(grid)))] {
            return Ok(format);
        }
    }
    let expected = formats.into_iter().flatten();
    let expected = expected.map(|(name, format)| described(name, &format.shape(grid)));
    let expected: Vec<String> = expected.collect();
    Err(unexpected(given, &expected.join(" or ")))
}

/// The inputs of a model of courses in their order, and their lengths. A model takes those that it needs,
/// and of those for references all or none.
fn course_inputs(given: &[Given<'_>]) -> Result<(Format, Vec<Input>, Lengths), ModelError> {
    let named = |input: &Input| given.iter().find(|(name, _)| *name == input.name());
    let along = |input: &Input, axis: usize| named(input)?.1.as_ref()?.get(axis).copied();
    let mut of_frames = Input::OF_FRAMES.iter();
    let lengths = Lengths {
        // A model that takes no frame takes the features of any number of them.
        frames: of_frames
            .find_map(|input| along(input, 1))
            .unwrap_or(COURSE_FRAMES.1),
        references: along(&Input::References, 1).unwrap_or(0),
        features: along(&Input::References, 2).unwrap_or(0),
    };
    let input_of = |(name, shape): &Given<'_>| {
        let input = Input::ALL.into_iter().find(|input| input.name() == *name)?;
        (*shape == Some(input.shape(lengths))).then_some(input)
    };
    let inputs: Option<Vec<Input>> = given.iter().map(input_of).collect();
    let of_references = Input::OF_REFERENCES.iter().filter_map(named).count();
    let fits = match of_references {
        0 => true,
        3 => {
            (1..=MOST_REFERENCES).contains(&lengths.references)
                && NUMBERS.contains(&lengths.features)
        }
        _ => false,
    };
    let fits = fits && (COURSE_FRAMES.0..=COURSE_FRAMES.1).contains(&lengths.frames);
    match inputs.filter(|inputs| fits && !inputs.is_empty()) {
        Some(inputs) => {
            let most_frames = lengths.frames;
            Ok((Format::Course { most_frames }, inputs, lengths))
        }
        None => {
            let names = Input::ALL.map(Input::name).join(", ");
            let expected = format!("some of {names}, of the shapes in results/course-format.md");
            Err(unexpected(given, &expected))
        }
    }
}

/// The outputs. What the graph computes for them shows their lengths.
fn outputs(
    graph: &pb::GraphProto,
    format: Format,
    lengths: Lengths,
) -> Result<Outputs, ModelError> {
    let place = |name: &str| graph.output.iter().position(|output| output.name == name);
    let of_levels = || {
        Some(Outputs::Levels {
            logits: place("logits")?,
            probabilities: place("probabilities")?,
            shore: place("shore"),
        })
    };
    let of_bins = || {
        let reference = place("reference");
        (reference.is_some() == (lengths.references > 0)).then_some(())?;
        let bins = place("bins")?;
        Some(Outputs::Bins { bins, reference })
    };
    let (found, expected) = match format {
        Format::Course { .. } if lengths.references > 0 => (of_bins(), "bins, reference"),
        Format::Course { .. } => (
            of_bins().or_else(of_levels),
            "bins; or logits, probabilities",
        ),
        _ => (of_levels(), "logits, probabilities"),
    };
    found.ok_or_else(|| {
        let names: Vec<&str> = graph.output.iter().map(|output| &*output.name).collect();
        let found = shown(&names.join(", "));
        ModelError::new(format!("model outputs: found {found}, expected {expected}"))
    })
}

/// The metadata of a file.
struct Metadata<'a>(&'a [pb::StringStringEntryProto]);

impl<'a> Metadata<'a> {
    fn find(&self, key: &str) -> Option<&'a str> {
        let mut entries = self.0.iter();
        let entry = entries.find(|entry| entry.key == key)?;
        Some(entry.value.as_str())
    }

    fn check_once(&self) -> Result<(), ModelError> {
        let mut seen = BTreeSet::new();
        let twice = self.0.iter().find(|entry| !seen.insert(&entry.key));
        match twice {
            Some(entry) => {
                let key = shown(&entry.key);
                Err(ModelError::new(format!(
                    "model metadata: found {key} twice, expected it once"
                )))
            }
            None => Ok(()),
        }
    }

    fn text(&self, key: &str) -> Result<&'a str, ModelError> {
        let missing = || ModelError::new(format!("model metadata `{key}` is missing"));
        self.find(key).ok_or_else(missing)
    }

    fn line(&self, key: &'static str) -> Result<String, ModelError> {
        let value = self.text(key)?;
        check_line(key, value)?;
        Ok(value.to_owned())
    }

    fn json<T: DeserializeOwned>(&self, key: &str, expected: &str) -> Result<T, ModelError> {
        let read = serde_json::from_str(self.text(key)?);
        read.map_err(|error| ModelError::of_key(key, error, expected))
    }

    /// The value of a key that a file need not have.
    fn json_if_any<T: DeserializeOwned>(
        &self,
        key: &str,
        expected: &str,
    ) -> Result<Option<T>, ModelError> {
        let found = self.find(key).map(|_| self.json(key, expected));
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
    let levels = problems.keep(levels(metadata));
    let pitch_mm = problems.keep(pitch_mm(metadata));
    let lines = ["hrn.method", "hrn.data", "hrn.validation"];
    let [method, data, validation] = lines.map(|key| problems.keep(metadata.line(key)));
    let metrics = problems.keep(metrics(metadata));
    problems.keep(metadata.check_once());
    let format = format?;
    let range = problems.keep(range(metadata, &format));
    let grid = problems.keep(grid(metadata, &format));
    let conformal = problems.keep(match &*format {
        "1" => Ok(None),
        _ => conformal(metadata),
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
        grid: grid?,
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

fn levels(metadata: &Metadata<'_>) -> Result<Vec<Level>, ModelError> {
    let levels: Vec<Level> = metadata.json("hrn.levels", "the levels as in hello")?;
    check_levels(&levels)?;
    Ok(levels)
}

fn pitch_mm(metadata: &Metadata<'_>) -> Result<f32, ModelError> {
    let (key, expected) = ("hrn.pitch_mm", "millimetres above 0");
    let pitch_mm: f32 = metadata.json(key, expected)?;
    match pitch_mm.is_finite() && pitch_mm > 0.0 {
        true => Ok(pitch_mm),
        false => Err(ModelError::of_key(key, pitch_mm, expected)),
    }
}

fn metrics(metadata: &Metadata<'_>) -> Result<serde_json::Value, ModelError> {
    let key = "hrn.metrics";
    let bytes = metadata.text(key)?.len();
    if bytes > LONGEST_METRICS_BYTES {
        let expected = format!("at most {LONGEST_METRICS_BYTES}");
        return Err(ModelError::of_key(key, format!("{bytes} bytes"), expected));
    }
    metadata.json(key, "JSON")
}

fn range(metadata: &Metadata<'_>, format: &str) -> Result<Range, ModelError> {
    let key = "hrn.range";
    let range: Range = metadata.json(key, "trained force and area")?;
    if format == "1" && range.of_presses().iter().any(Option::is_some) {
        let expected = "`force_n` and `contact_area_taxels` alone: the others are of format 3";
        return Err(ModelError::of_key(key, format!("{range:?}"), expected));
    }
    check_range(&range)?;
    Ok(range)
}

fn grid(metadata: &Metadata<'_>, format: &str) -> Result<Option<Array>, ModelError> {
    let key = "hrn.grid";
    let expected = format!("[rows, columns], each 1 to {MOST_SIDE}, in a file of format 1");
    let Some([rows, cols]) = metadata.json_if_any::<[usize; 2]>(key, &expected)? else {
        return Ok(None);
    };
    let is_side = |side| (1..=MOST_SIDE).contains(&side);
    match is_side(rows) && is_side(cols) && format == "1" {
        true => Ok(Some(Array { rows, cols })),
        false => Err(ModelError::of_key(
            key,
            format!("[{rows}, {cols}]"),
            expected,
        )),
    }
}

fn conformal(metadata: &Metadata<'_>) -> Result<Option<Conformal>, ModelError> {
    let key = "hrn.conformal";
    let expected = "`alpha` between 0 and 1, `threshold`, 0 to 1, and perhaps `contexts`, each with \
                    `threshold` and `tail`, 0 to 0.5";
    let Some(conformal) = metadata.json_if_any::<Conformal>(key, expected)? else {
        return Ok(None);
    };
    let fits = |Limits { threshold, tail }: Limits| {
        (0.0..=1.0).contains(&threshold) && (0.0..0.5).contains(&tail)
    };
    let mut limits = Knowledge::ALL
        .into_iter()
        .map(|known| conformal.limits(known));
    let is_share = conformal.alpha > 0.0 && conformal.alpha < 1.0;
    match is_share && limits.all(fits) && (0.0..=1.0).contains(&conformal.threshold) {
        true => Ok(Some(conformal)),
        false => Err(ModelError::of_key(key, format!("{conformal:?}"), expected)),
    }
}

/// Checks the levels that a model states: numbers from 1, and labels that can be shown.
///
/// # Errors
///
/// Returns an error for the first level that breaks the format.
pub fn check_levels(levels: &[Level]) -> Result<(), ModelError> {
    let key = "hrn.levels";
    let numbers: Vec<u8> = levels.iter().map(|level| level.level).collect();
    let consecutive = numbers.iter().copied().eq((1..=u8::MAX).take(levels.len()));
    if levels.len() < 2 || !consecutive {
        let expected = "levels 1, 2, ... in order, at least two";
        return Err(ModelError::of_key(key, format!("{numbers:?}"), expected));
    }
    for text in levels.iter().flat_map(|level| [&level.label, &level.shore]) {
        if text.is_empty() || !is_plain(text) || text.len() > LONGEST_LABEL_BYTES {
            let expected = format!(
                "`label` and `shore` of 1 to {LONGEST_LABEL_BYTES} bytes, without control or bidirectional \
                 characters"
            );
            return Err(ModelError::of_key(key, shown(text), expected));
        }
    }
    Ok(())
}

/// The beginning of a text, quoted.
pub(super) fn shown(text: &str) -> String {
    let begin: String = text.chars().take(NAME_CHARS).collect();
    match begin.len() < text.len() {
        true => format!("{begin:?}... of {} bytes", text.len()),
        false => format!("{text:?}"),
    }
}

fn check_range(range: &Range) -> Result<(), ModelError> {
    let of_presses = range.of_presses().into_iter().flatten();
    let mut pairs = of_presses.chain([range.force_n]).chain(range.pitch_mm);
    let is_ordered = |[low, high]: [f32; 2]| low.is_finite() && high.is_finite() && low <= high;
    let [least, most] = range.contact_area_taxels;
    match least <= most && pairs.all(is_ordered) {
        true => Ok(()),
        false => {
            let expected = "[least, greatest] of finite numbers";
            Err(ModelError::of_key(
                "hrn.range",
                format!("{range:?}"),
                expected,
            ))
        }
    }
}
