//! The checks of a model file before its graph is built (`docs/formats.md`).
//!
//! In: the file as ONNX's own messages. Out: the model's description, or the first part that breaks
//! the format. Nothing here runs the model.

use std::ops::RangeInclusive;

use serde::Deserialize;
use tract_onnx::pb;

use super::card::{Card, Check, Checks, Conformal, CourseCheck, Format, Range};
use super::course::COURSE_FRAMES;
use super::error::{MIN_OPSET, ModelError};
use super::features::FEATURES;
use super::grid::{COLS, ROWS, TAXELS};
use super::inputs::{Input, Lengths};
use super::references::{MOST_REFERENCES, PIECE};
use super::shore::{Borders, Level};
use crate::wording::is_plain;

/// The longest `label` and `shore` of a level: every event carries a label.
const LONGEST_LABEL_BYTES: usize = 255;
/// The longest part of a name or a text in a message.
const NAME_CHARS: usize = 60;
/// The longest text of another key.
const LONGEST_LINE_BYTES: usize = 16_384;
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
    /// The number of bins that a model of format 3 divides the scale into.
    pub(super) bins: usize,
}

/// Refuses inputs and outputs that break the format.
pub(super) fn check_signature(
    graph: &pb::GraphProto,
    card: &Card,
    checks: &Checks,
) -> Result<Signature, ModelError> {
    // Before ONNX IR 4, every initialiser is also listed among the inputs.
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
    let has_references = card.format == "3";
    let (format, inputs, lengths) = match checks {
        Checks::Frames(_) => {
            let (found, expected) = (describe(&inputs), format!("frame f32 [1,1,{ROWS},{COLS}]"));
            if found != expected {
                return Err(ModelError::Signature {
                    what: "input",
                    found,
                    expected,
                });
            }
            (Format::Frame, Vec::new(), Lengths::default())
        }
        Checks::Courses(check) => {
            let (lengths, inputs) = check_course_inputs(&inputs, has_references)?;
            check_lengths(check, lengths)?;
            let most_frames = lengths.frames;
            (Format::Course { most_frames }, inputs, lengths)
        }
    };
    let mut outputs: Vec<&pb::ValueInfoProto> = graph.output.iter().collect();
    outputs.sort_by(|left, right| left.name.cmp(&right.name));
    let found = describe(&outputs);
    let bins = outputs.first().and_then(|output| length(output, 1));
    let bins = bins.filter(|bins| BINS.contains(bins)).unwrap_or_default();
    let levels = card.levels.len();
    let of_levels = format!("logits f32 [1,{levels}], probabilities f32 [1,{levels}]");
    let with_shore = format!("{of_levels}, shore f32 [1,3]");
    let features = lengths.features;
    let (is_agreed, expected) = match format {
        _ if has_references => {
            let of = |bins: &dyn std::fmt::Display| {
                format!("bins f32 [1,{bins}], reference f32 [1,{features}]")
            };
            let (least, most) = (BINS.start(), BINS.end());
            let expected = format!("{}, B {least} to {most}", of(&"B"));
            (found == of(&bins), expected)
        }
        Format::Frame => (found == of_levels || found == with_shore, of_levels),
        Format::Course { .. } => (found == with_shore, with_shore),
    };
    if !is_agreed {
        return Err(ModelError::Signature {
            what: "outputs",
            found,
            expected,
        });
    }
    // The inference library assumes that a node computes each output.
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
    Ok(Signature {
        format,
        inputs,
        lengths,
        bins,
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

/// The lengths of the inputs of a model of courses, and the inputs in their order.
fn check_course_inputs(
    inputs: &[&pb::ValueInfoProto],
    has_references: bool,
) -> Result<(Lengths, Vec<Input>), ModelError> {
    let wanted = match has_references {
        true => &Input::ALL[..],
        false => &Input::ALL[..Input::OF_FORMAT_2],
    };
    let along = |name: &str, axis| {
        let input = inputs.iter().find(|input| input.name == name);
        input.and_then(|input| length(input, axis)).unwrap_or(0)
    };
    let lengths = Lengths {
        frames: along("frames", 1),
        references: along("references", 1),
        features: along("references", 2),
    };
    let described: Vec<String> = inputs.iter().map(|input| describe_value(input)).collect();
    let is_in_range = (COURSE_FRAMES.0..=COURSE_FRAMES.1).contains(&lengths.frames)
        && (!has_references
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
                && read.len() == wanted.len()
                && wanted.iter().all(|input| read.contains(input)) =>
        {
            Ok((lengths, read))
        }
        _ => Err(ModelError::Signature {
            what: "inputs",
            found: describe(inputs),
            expected: expected_inputs(wanted),
        }),
    }
}

/// The inputs of a format in words.
fn expected_inputs(wanted: &[Input]) -> String {
    let described = |input: &Input| {
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
    let described: Vec<String> = wanted.iter().map(described).collect();
    let (least, most) = COURSE_FRAMES;
    let mut text = format!("{}, T {least} to {most}", described.join(", "));
    if wanted.len() > Input::OF_FORMAT_2 {
        let (few, many) = (NUMBERS.start(), NUMBERS.end());
        text += &format!(", R 1 to {MOST_REFERENCES}, E {few} to {many}");
    }
    text
}

/// Refuses check presses that have more frames, and references of which there are more, than the
/// model takes.
fn check_lengths(check: &CourseCheck, lengths: Lengths) -> Result<(), ModelError> {
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
pub fn describe(values: &[&pb::ValueInfoProto]) -> String {
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

/// Reads and checks all `hrn.*` keys.
pub(super) fn read_metadata(proto: &pb::ModelProto) -> Result<(Card, Checks), ModelError> {
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
        if value.trim().is_empty() || !is_plain(value) || value.len() > LONGEST_LINE_BYTES {
            let expected = format!(
                "text without control or bidirectional characters, of at most {LONGEST_LINE_BYTES} bytes"
            );
            return Err(invalid(key, shown(value), expected));
        }
        Ok(value.to_owned())
    };

    let format = text("hrn.format")?.to_owned();
    if !["1", "2", "3"].contains(&format.as_str()) {
        let expected = "\"1\", \"2\" or \"3\"";
        return Err(invalid("hrn.format", format!("{format:?}"), expected));
    }
    let levels: Vec<Level> = json("hrn.levels", text("hrn.levels")?, "the levels as in hello")?;
    check_levels(&levels)?;
    if format == "3" {
        let expected = "ranges of Shore OO from the hardest to the softest";
        Borders::of(&levels).map_err(|error| invalid("hrn.levels", error.to_string(), expected))?;
    }
    let pitch = text("hrn.pitch_mm")?;
    let pitch_mm = match pitch.trim().parse::<f32>() {
        Ok(value) if value.is_finite() && value > 0.0 => value,
        _ => {
            let found = format!("{pitch:?}");
            return Err(invalid("hrn.pitch_mm", found, "millimetres above 0"));
        }
    };
    let range: Range = json("hrn.range", text("hrn.range")?, "trained force and area")?;
    check_range(&range, &format)?;
    let check = text("hrn.check")?;
    let (checks, conformal) = if format == "1" {
        let check: Check = json("hrn.check", check, "frames and probabilities")?;
        check_check(&check, levels.len())?;
        (Checks::Frames(check), None)
    } else {
        let check: CourseCheck = json("hrn.check", check, "presses with what the trainer says")?;
        check_course_check(&check, levels.len())?;
        let conformal = match text("hrn.conformal") {
            Err(ModelError::KeyMissing { .. }) => None,
            found => Some(read_conformal(found?)?),
        };
        (Checks::Courses(check), conformal)
    };
    let card = Card {
        format,
        levels,
        pitch_mm,
        method: line("hrn.method")?,
        data: line("hrn.data")?,
        metrics: json("hrn.metrics", text("hrn.metrics")?, "JSON")?,
        validation: line("hrn.validation")?,
        range,
        conformal,
    };
    Ok((card, checks))
}

fn read_conformal(text: &str) -> Result<Conformal, ModelError> {
    let key = "hrn.conformal";
    let expected = "`alpha` between 0 and 1, and `threshold`, 0 to 1";
    let conformal: Conformal = json(key, text, expected)?;
    let Conformal { alpha, threshold } = conformal;
    if alpha > 0.0 && alpha < 1.0 && (0.0..=1.0).contains(&threshold) {
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
        "`force_n` and `contact_area_taxels` alone: the others are of format 2"
    } else if !of_presses.all(|&[low, high]| high.is_finite() && 0.0 <= low && low <= high) {
        "[least, greatest] of finite numbers, in the ranges of format 2 from 0"
    } else if !force_ordered || area_low > area_high {
        "[least, greatest] of finite numbers"
    } else {
        return Ok(());
    };
    Err(invalid("hrn.range", format!("{range:?}"), expected))
}

fn check_check(check: &Check, levels: usize) -> Result<(), ModelError> {
    let key = "hrn.check";
    let unusable = |n: &&f32| !(n.is_finite() && **n >= 0.0);
    if let Some(newtons) = check.frames.iter().flatten().find(unusable) {
        let found = format!("{newtons} in a frame");
        return Err(invalid(key, found, "newtons of 0 or more"));
    }
    // There are 8 check frames, or two a level. Only a model of four levels has both.
    if [8, 2 * levels].contains(&check.frames.len())
        && check.frames.len() == check.probabilities.len()
        && check.frames.iter().all(|newtons| newtons.len() == TAXELS)
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
        format!("8 frames of {TAXELS} newtons, or two a level, as many rows of {levels}");
    Err(invalid(key, found, expected))
}
