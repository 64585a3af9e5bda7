//! The checks of a model file before its graph is built (`docs/formats.md`).
//!
//! In: the file as ONNX's own messages. Out: the model's description, or the first part that breaks
//! the format. Nothing here runs the model.

use std::ops::RangeInclusive;

use serde::Deserialize;
use tract_onnx::pb;

use super::card::{Card, Check, Checks, Conformal, CourseCheck, Format, Limits, Range};
use super::course::COURSE_FRAMES;
use super::error::{MIN_OPSET, ModelError};
use super::features::FEATURES;
use super::grid::{COLS, ROWS};
use super::inputs::{Input, Lengths};
use super::parts::PARTS;
use super::references::{MOST_REFERENCES, PIECE};
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

fn invalid(key: &'static str, found: impl Into<String>, expected: impl Into<String>) -> ModelError {
    ModelError::KeyInvalid {
        key,
        found: found.into(),
        expected: expected.into(),
    }
}

pub(super) fn check_opset(proto: &pb::ModelProto) -> Result<(), ModelError> {
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

/// Refuses a graph whose weights lie in another file, as some exporters write them.
pub(super) fn check_tensors_inside(graph: &pb::GraphProto) -> Result<(), ModelError> {
    let external = Some(pb::tensor_proto::DataLocation::External as i32);
    let mut tensors = graph.initializer.iter();
    match tensors.find(|tensor| tensor.data_location == external) {
        Some(tensor) => Err(ModelError::ExternalData {
            tensor: tensor.name.clone(),
        }),
        None => Ok(()),
    }
}

/// What a model takes and gives.
pub(super) struct Signature {
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
        /// The number of bins that the model divides the scale into.
        count: usize,
        /// A model that takes no references has none.
        reference: Option<usize>,
    },
}

impl Signature {
    /// The name, the place and the length of each output.
    pub(super) fn shapes(&self, levels: usize) -> Vec<(&'static str, usize, usize)> {
        match self.outputs {
            Outputs::Levels {
                logits,
                probabilities,
                shore,
            } => {
                let of_levels = [
                    ("logits", logits, levels),
                    ("probabilities", probabilities, levels),
                ];
                let shore = shore.map(|place| ("shore", place, 3));
                of_levels.into_iter().chain(shore).collect()
            }
            Outputs::Bins {
                bins,
                count,
                reference,
            } => {
                let reference = reference.map(|at| ("reference", at, self.lengths.features));
                [("bins", bins, count)]
                    .into_iter()
                    .chain(reference)
                    .collect()
            }
        }
    }
}

/// The inputs of a graph. Before ONNX IR 4, every initialiser is also listed among the inputs.
fn inputs(graph: &pb::GraphProto) -> Vec<&pb::ValueInfoProto> {
    let is_weight = |name: &str| graph.initializer.iter().any(|tensor| tensor.name == name);
    let inputs = graph.input.iter();
    inputs.filter(|input| !is_weight(&input.name)).collect()
}

/// The format of a graph whose metadata do not name one.
pub(super) fn format_of(graph: &pb::GraphProto) -> &'static str {
    let inputs = inputs(graph);
    let is_of_course = |name: &str| Input::ALL.iter().any(|input| input.name() == name);
    match inputs.iter().any(|input| is_of_course(&input.name)) {
        true => "3",
        false => "1",
    }
}

/// Adds a problem if the inputs break the format, and one if the outputs do. Without `levels` any number
/// of them is right.
pub(super) fn signature(
    graph: &pb::GraphProto,
    number: &str,
    levels: Option<usize>,
    grid: Option<Array>,
    problems: &mut Vec<ModelError>,
) -> Option<Signature> {
    let found = inputs(graph);
    let taken = match number {
        "1" => {
            let format = check_frame_input(&describe(&found), grid);
            format.map(|format| (format, Lengths::default(), Vec::new()))
        }
        _ => check_course_inputs(&found).map(|(lengths, inputs)| {
            let most_frames = lengths.frames;
            (Format::Course { most_frames }, lengths, inputs)
        }),
    };
    let taken = kept(taken, problems);
    // Which outputs a model of courses has depends on its inputs.
    let lengths = match &taken {
        Some((_, lengths, _)) => *lengths,
        None if number == "1" => Lengths::default(),
        None => return None,
    };
    let outputs = kept(check_outputs(graph, number, levels, lengths), problems);
    let ((format, lengths, inputs), outputs) = taken.zip(outputs)?;
    Some(Signature {
        format,
        inputs,
        lengths,
        outputs,
    })
}

/// The format of a model with this one input.
fn check_frame_input(found: &str, grid: Option<Array>) -> Result<Format, ModelError> {
    let Array { rows, cols } = grid.unwrap_or(Array::JX255N);
    let frame = format!("frame f32 [1,1,{rows},{cols}]");
    let parts = format!("parts f32 [1,{PARTS},{rows},{cols}]");
    match grid {
        _ if found == frame => Ok(Format::Frame),
        Some(_) if found == parts => Ok(Format::Parts),
        _ => Err(ModelError::Signature {
            what: "input",
            found: found.to_owned(),
            expected: grid.map_or(frame.clone(), |_| format!("{frame} or {parts}")),
        }),
    }
}

/// Refuses outputs that break the format.
fn check_outputs(
    graph: &pb::GraphProto,
    number: &str,
    levels: Option<usize>,
    lengths: Lengths,
) -> Result<Outputs, ModelError> {
    let mut outputs: Vec<&pb::ValueInfoProto> = graph.output.iter().collect();
    outputs.sort_by(|left, right| left.name.cmp(&right.name));
    let found = describe(&outputs);
    let of = |name: &str| {
        let output = outputs.iter().find(|output| output.name == name);
        output.and_then(|output| length(output, 1)).unwrap_or(0)
    };
    let levels = levels.unwrap_or_else(|| of("logits")).max(2);
    let of_levels = format!("logits f32 [1,{levels}], probabilities f32 [1,{levels}]");
    let bins = Some(of("bins")).filter(|bins| BINS.contains(bins));
    let of_bins = |bins: &dyn std::fmt::Display| match lengths.references {
        0 => format!("bins f32 [1,{bins}]"),
        _ => format!(
            "bins f32 [1,{bins}], reference f32 [1,{}]",
            lengths.features
        ),
    };
    let has_bins = bins.is_some_and(|bins| found == of_bins(&bins));
    let has_levels = found == of_levels || found == format!("{of_levels}, shore f32 [1,3]");
    let with_bins = format!("{}, B {} to {}", of_bins(&"B"), BINS.start(), BINS.end());
    let (is_agreed, expected) = match (number, lengths.references) {
        ("1", _) => (has_levels, of_levels),
        // Without references, a model may name the levels itself.
        (_, 0) => (
            has_bins || has_levels,
            format!("{with_bins}; or {of_levels}"),
        ),
        _ => (has_bins, with_bins),
    };
    if !is_agreed {
        return Err(ModelError::Signature {
            what: "outputs",
            found,
            expected,
        });
    }
    // The inference library assumes that a node computes each output.
    let is_missing = |output: &&&pb::ValueInfoProto| {
        let mut nodes = graph.node.iter();
        !nodes.any(|node| node.output.contains(&output.name))
    };
    if let Some(output) = outputs.iter().find(is_missing) {
        return Err(ModelError::Graph(format!(
            "no node computes `{}`",
            output.name
        )));
    }
    let position = |name: &str| graph.output.iter().position(|output| output.name == name);
    let place = |name: &str| position(name).expect("the outputs are as agreed");
    Ok(match bins.filter(|_| has_bins) {
        Some(count) => Outputs::Bins {
            bins: place("bins"),
            count,
            reference: position("reference"),
        },
        None => Outputs::Levels {
            logits: place("logits"),
            probabilities: place("probabilities"),
            shore: position("shore"),
        },
    })
}

/// The length of a value along an axis, if it is stated.
fn length(value: &pb::ValueInfoProto, axis: usize) -> Option<usize> {
    use pb::tensor_shape_proto::dimension::Value as Dimension;
    let pb::type_proto::Value::TensorType(tensor) = value.r#type.as_ref()?.value.as_ref()?;
    match tensor.shape.as_ref()?.dim.get(axis)?.value.as_ref()? {
        &Dimension::DimValue(length) => usize::try_from(length).ok(),
        Dimension::DimParam(_) => None,
    }
}

/// The lengths of the inputs of a model of courses, and the inputs in their order. A model takes those
/// that it needs, and of those for references all or none.
fn check_course_inputs(
    inputs: &[&pb::ValueInfoProto],
) -> Result<(Lengths, Vec<Input>), ModelError> {
    let named = |input: &Input| inputs.iter().find(|value| value.name == input.name());
    let takes_references = Input::OF_REFERENCES
        .iter()
        .any(|input| named(input).is_some());
    let is_needed = |input: &Input| {
        named(input).is_some() || (takes_references && Input::OF_REFERENCES.contains(input))
    };
    let wanted: Vec<Input> = Input::ALL.into_iter().filter(is_needed).collect();
    let along = |input: &Input, axis| named(input).and_then(|value| length(value, axis));
    let of_frames = Input::OF_FRAMES.iter().find(|input| named(input).is_some());
    let lengths = Lengths {
        // A model that takes no frame takes the features of any number of them.
        frames: of_frames.map_or(COURSE_FRAMES.1, |input| along(input, 1).unwrap_or(0)),
        references: along(&Input::References, 1).unwrap_or(0),
        features: along(&Input::References, 2).unwrap_or(0),
    };
    let described: Vec<String> = inputs.iter().map(|input| describe_value(input)).collect();
    let is_in_range = (COURSE_FRAMES.0..=COURSE_FRAMES.1).contains(&lengths.frames)
        && (!takes_references
            || ((1..=MOST_REFERENCES).contains(&lengths.references)
                && NUMBERS.contains(&lengths.features)));
    let agreed = |input: Input| {
        let shape = input.shape(lengths);
        let shape: Vec<String> = shape.iter().map(usize::to_string).collect();
        format!("{} f32 [{}]", input.name(), shape.join(","))
    };
    let read = |described: &String| {
        let mut wanted = wanted.iter().copied();
        wanted.find(|&input| agreed(input) == *described)
    };
    let read: Option<Vec<Input>> = described.iter().map(read).collect();
    match read {
        Some(read)
            if is_in_range
                && !read.is_empty()
                && read.len() == wanted.len()
                && wanted.iter().all(|input| read.contains(input)) =>
        {
            Ok((lengths, read))
        }
        _ => Err(ModelError::Signature {
            what: "inputs",
            found: describe(inputs),
            expected: expected_inputs(),
        }),
    }
}

/// The inputs of format 3 in words.
fn expected_inputs() -> String {
    let described = |input: Input| {
        let shape = match input {
            Input::Frames => format!("1,T,{ROWS},{COLS}"),
            Input::ArmNPerMm => "1,1".to_owned(),
            Input::Piece => format!("1,{PIECE}"),
            Input::References => "1,R,E".to_owned(),
            Input::Given => "1,R".to_owned(),
            Input::Features => format!("1,{FEATURES}"),
            Input::TimeS | Input::ApproachMm | Input::Known | Input::Mask => "1,T".to_owned(),
        };
        format!("{} f32 [{shape}]", input.name())
    };
    let (least, most) = COURSE_FRAMES;
    let (few, many) = (NUMBERS.start(), NUMBERS.end());
    format!(
        "{}, T {least} to {most}, R 1 to {MOST_REFERENCES}, E {few} to {many}; all but what the graph needs \
         may be missing, `piece`, `references` and `given` only together",
        Input::ALL.map(described).join(", ")
    )
}

/// Refuses check presses that have more frames, and references of which there are more, than the
/// model takes.
pub(super) fn check_lengths(check: &CourseCheck, lengths: Lengths) -> Result<(), ModelError> {
    let key = "hrn.check";
    let (most, found) = (lengths.references, check.references.len());
    if found > most {
        let expected = format!("at most {most}, as the input `references` has");
        return Err(invalid(key, format!("{found} references"), expected));
    }
    let presses = check.presses.iter().map(|press| &press.course);
    let references = check.references.iter().map(|press| &press.course);
    let mut frames = presses.chain(references).map(|course| course.moments.len());
    let most = lengths.frames;
    match frames.find(|&found| found > most) {
        Some(found) => Err(invalid(
            key,
            format!("a press of {found} frames"),
            format!("at most {most}, as the input `frames` has"),
        )),
        None => Ok(()),
    }
}

/// Inputs or outputs of a graph, each as `name type [shape]`.
fn describe(values: &[&pb::ValueInfoProto]) -> String {
    let all: Vec<String> = values.iter().map(|value| describe_value(value)).collect();
    match all.is_empty() {
        true => "none".to_owned(),
        false => all.join(", "),
    }
}

fn describe_value(value: &pb::ValueInfoProto) -> String {
    use pb::tensor_shape_proto::dimension::Value as Dimension;
    use pb::type_proto::Value;
    let short = |name: &str| name.chars().take(NAME_CHARS).collect::<String>();
    let name = short(&value.name);
    let Some(Value::TensorType(tensor)) = value.r#type.as_ref().and_then(|t| t.value.as_ref())
    else {
        return format!("{name} of no tensor type");
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
            Some(Dimension::DimParam(name)) => short(name),
            None => "?".to_owned(),
        })
        .collect();
    format!("{name} {datum} [{}]", dimensions.join(","))
}

/// What was read, or none beside the problem.
pub(super) fn kept<T>(read: Result<T, ModelError>, problems: &mut Vec<ModelError>) -> Option<T> {
    read.map_err(|problem| problems.push(problem)).ok()
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
        return Err(invalid(key, shown(value), expected));
    }
    Ok(())
}

/// Reads all `hrn.*` keys, and adds a problem for each that is missing or wrong. What is read beside a
/// problem may be missing from the card.
pub(super) fn metadata(
    proto: &pb::ModelProto,
    problems: &mut Vec<ModelError>,
) -> Option<(Card, Checks)> {
    let text = |key: &'static str| {
        let mut entries = proto.metadata_props.iter().filter(|entry| entry.key == key);
        let first = entries.next().ok_or(ModelError::KeyMissing { key })?;
        match entries.count() {
            0 => Ok(first.value.as_str()),
            more => Err(invalid(key, format!("it {} times", 1 + more), "it once")),
        }
    };
    let line = |key: &'static str| {
        let value = text(key)?;
        check_line(key, value)?;
        Ok(value.to_owned())
    };
    let format = || {
        let format = text("hrn.format")?;
        if !["1", "3"].contains(&format) {
            let expected = "\"1\" or \"3\"";
            return Err(invalid("hrn.format", format!("{format:?}"), expected));
        }
        Ok(format.to_owned())
    };
    let levels = || {
        let levels: Vec<Level> = json("hrn.levels", text("hrn.levels")?, "the levels as in hello")?;
        check_levels(&levels)?;
        Ok(levels)
    };
    let pitch_mm = || {
        let pitch = text("hrn.pitch_mm")?;
        match pitch.trim().parse::<f32>() {
            Ok(value) if value.is_finite() && value > 0.0 => Ok(value),
            _ => {
                let found = format!("{pitch:?}");
                Err(invalid("hrn.pitch_mm", found, "millimetres above 0"))
            }
        }
    };
    let format = kept(format(), problems);
    let of = format.as_deref();
    let levels = kept(levels(), problems);
    let count = levels.as_ref().map(Vec::len);
    let pitch_mm = kept(pitch_mm(), problems);
    let range = || {
        let range: Range = json("hrn.range", text("hrn.range")?, "trained force and area")?;
        check_range(&range, of.unwrap_or("3"))?;
        Ok(range)
    };
    let range = kept(range(), problems);
    let grid = match text("hrn.grid") {
        Err(ModelError::KeyMissing { .. }) => None,
        found => kept(found.and_then(|text| read_grid(text, of)), problems),
    };
    let checks = kept(text("hrn.check"), problems)
        .zip(of)
        .and_then(|(check, format)| kept(read_checks(check, format, count, grid), problems));
    let conformal = match text("hrn.conformal") {
        Err(ModelError::KeyMissing { .. }) => None,
        _ if of == Some("1") => None,
        found => kept(found.and_then(read_conformal), problems),
    };
    let [method, data, validation] =
        ["hrn.method", "hrn.data", "hrn.validation"].map(|key| kept(line(key), problems));
    let metrics = || {
        let metrics = text("hrn.metrics")?;
        if metrics.len() > LONGEST_METRICS_BYTES {
            let found = format!("{} bytes", metrics.len());
            let expected = format!("at most {LONGEST_METRICS_BYTES}");
            return Err(invalid("hrn.metrics", found, expected));
        }
        json("hrn.metrics", metrics, "JSON")
    };
    let metrics = kept(metrics(), problems);
    let card = Card {
        format: format?,
        levels: levels?,
        pitch_mm: pitch_mm?,
        method: method?,
        data: data?,
        metrics: metrics?,
        validation: validation?,
        range: range?,
        grid,
        conformal,
    };
    Some((card, checks?))
}

/// Reads `hrn.grid`.
fn read_grid(text: &str, format: Option<&str>) -> Result<Array, ModelError> {
    let key = "hrn.grid";
    let expected = format!("[rows, columns], each 1 to {MOST_SIDE}");
    if format.is_some_and(|format| format != "1") {
        return Err(invalid(
            key,
            shown(text),
            "none beside a format other than 1",
        ));
    }
    let [rows, cols]: [usize; 2] = json(key, text, &expected)?;
    match (1..=MOST_SIDE).contains(&rows) && (1..=MOST_SIDE).contains(&cols) {
        true => Ok(Array { rows, cols }),
        false => Err(invalid(key, shown(text), expected)),
    }
}

/// Reads `hrn.check`. Without `levels` any number of probabilities is right.
fn read_checks(
    text: &str,
    format: &str,
    levels: Option<usize>,
    grid: Option<Array>,
) -> Result<Checks, ModelError> {
    let key = "hrn.check";
    if format == "1" {
        let check: Check = json(key, text, "frames and probabilities")?;
        let levels = levels.or_else(|| check.probabilities.first().map(Vec::len));
        check_check(&check, levels.unwrap_or_default(), grid)?;
        return Ok(Checks::Frames(check));
    }
    let check: CourseCheck = json(key, text, "presses with what the trainer says")?;
    let levels = levels.or_else(|| check.presses.first().map(|press| press.probabilities.len()));
    check_course_check(&check, levels.unwrap_or_default())?;
    Ok(Checks::Courses(check))
}

fn read_conformal(text: &str) -> Result<Conformal, ModelError> {
    let key = "hrn.conformal";
    let expected = "`alpha` between 0 and 1, `threshold`, 0 to 1, and perhaps `contexts`, each with \
                    `threshold` and `tail`, 0 to 0.5";
    let conformal: Conformal = json(key, text, expected)?;
    let is_threshold = |threshold: f32| (0.0..=1.0).contains(&threshold);
    let are_limits =
        |limits: &Limits| is_threshold(limits.threshold) && (0.0..0.5).contains(&limits.tail);
    let Conformal {
        alpha,
        threshold,
        contexts,
    } = &conformal;
    if *alpha > 0.0 && *alpha < 1.0 && is_threshold(*threshold) && contexts.values().all(are_limits)
    {
        return Ok(conformal);
    }
    Err(invalid(key, format!("{conformal:?}"), expected))
}

fn check_course_check(check: &CourseCheck, levels: usize) -> Result<(), ModelError> {
    let key = "hrn.check";
    let count = check.presses.len();
    if ![8, 2 * levels].contains(&count) {
        let found = format!("{count} presses");
        return Err(invalid(key, found, "8, or two a level"));
    }
    if let Some(press) = check
        .presses
        .iter()
        .find(|press| press.probabilities.len() != levels)
    {
        let found = format!("{} probabilities of a press", press.probabilities.len());
        return Err(invalid(key, found, levels.to_string()));
    }
    let presses = check.presses.iter().map(|press| &press.course);
    let references = check.references.iter().map(|press| &press.course);
    for course in presses.chain(references) {
        let numbers = course.moments.iter();
        let mut numbers = numbers.flat_map(|m| [m.time_s, m.approach_mm.unwrap_or(0.0)]);
        if !numbers.all(f32::is_finite) || course.arm_n_per_mm.is_nan() || course.arm_n_per_mm < 0.0
        {
            let expected = "finite times and positions, and an arm of 0 N/mm or more";
            return Err(invalid(key, "another number in a press", expected));
        }
    }
    Ok(())
}

fn json<T: for<'a> Deserialize<'a>>(
    key: &'static str,
    value: &str,
    expected: &str,
) -> Result<T, ModelError> {
    serde_json::from_str(value).map_err(|error| invalid(key, error.to_string(), expected))
}

/// Refuses levels that are no parts of the scale that a model divides.
pub(super) fn check_borders(levels: &[Level]) -> Result<(), ModelError> {
    let expected = "ranges of Shore OO from the hardest to the softest";
    let borders = Borders::of(levels);
    borders.map_err(|error| invalid("hrn.levels", error.to_string(), expected))?;
    Ok(())
}

/// Checks the levels that a model states: numbers from 1, and labels that can be shown.
pub fn check_levels(levels: &[Level]) -> Result<(), ModelError> {
    let key = "hrn.levels";
    let numbers: Vec<u8> = levels.iter().map(|level| level.level).collect();
    let consecutive = numbers
        .iter()
        .zip(1..=u8::MAX)
        .all(|(&number, wanted)| number == wanted);
    if levels.len() < 2 || levels.len() > usize::from(u8::MAX) || !consecutive {
        let expected = "levels 1, 2, ... in order, at least two";
        return Err(invalid(key, format!("{numbers:?}"), expected));
    }
    for text in levels.iter().flat_map(|level| [&level.label, &level.shore]) {
        if text.is_empty() || !is_plain(text) || text.len() > LONGEST_LABEL_BYTES {
            let expected = format!(
                "`label` and `shore` of 1 to {LONGEST_LABEL_BYTES} bytes, without control or bidirectional \
                 characters"
            );
            return Err(invalid(key, shown(text), expected));
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

fn check_range(range: &Range, format: &str) -> Result<(), ModelError> {
    let [force_low, force_high] = range.force_n;
    let [area_low, area_high] = range.contact_area_taxels;
    let force_ordered = force_low.is_finite() && force_high.is_finite() && force_low <= force_high;
    let of_presses = range.of_presses();
    let mut of_presses = of_presses.iter().flatten();
    let expected = if format == "1" && of_presses.clone().next().is_some() {
        "`force_n` and `contact_area_taxels` alone: the others are of format 3"
    } else if !of_presses.all(|&[low, high]| high.is_finite() && 0.0 <= low && low <= high) {
        "[least, greatest] of finite numbers, in the ranges of presses from 0"
    } else if !force_ordered || area_low > area_high {
        "[least, greatest] of finite numbers"
    } else {
        return Ok(());
    };
    Err(invalid("hrn.range", format!("{range:?}"), expected))
}

fn check_check(check: &Check, levels: usize, grid: Option<Array>) -> Result<(), ModelError> {
    let key = "hrn.check";
    let taxels = grid.unwrap_or(Array::JX255N).taxels();
    let first = check.frames.first().map_or(0, Vec::len);
    let is_in_parts = grid.is_some() && first == PARTS * taxels;
    let length = if is_in_parts { first } else { taxels };
    // The parts of a press keep the sign of their newtons.
    let unusable = |n: &&f32| !(n.is_finite() && (is_in_parts || **n >= 0.0));
    if let Some(newtons) = check.frames.iter().flatten().find(unusable) {
        let found = format!("{newtons} in a frame");
        return Err(invalid(key, found, "newtons of 0 or more"));
    }
    // There are 8 check frames, or two a level. Only a model of four levels has both.
    if [8, 2 * levels].contains(&check.frames.len())
        && check.frames.len() == check.probabilities.len()
        && check.frames.iter().all(|newtons| newtons.len() == length)
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
    let expected =
        format!("8 frames of {length} newtons, or two a level, as many rows of {levels}");
    Err(invalid(key, found, expected))
}
