//! Reports line by line what the model format requires of a file, for users who bring their own
//! model.
//!
//! In: the bytes of an ONNX file. Out: one [`Finding`] for each part of the format. The daemon's
//! loader names only the first problem that it finds. This module mends that part in a copy of the
//! file and asks the loader again, until the loader finds no further problem. So the loader alone
//! decides what is right.

use std::fmt;

use prost::Message as _;
use serde_json::json;
use tract_onnx::pb;

use super::adopt::{decode, mend, mend_input, mend_outputs, set};
use crate::frame::TAXELS;
use crate::train::data::dataset;
use crate::verdict::{Card, Check, Checks, Hrn, Level, MIN_OPSET, ModelError, Range};

/// The metadata keys of the format.
const KEYS: [&str; 9] = [
    "hrn.format",
    "hrn.levels",
    "hrn.pitch_mm",
    "hrn.method",
    "hrn.data",
    "hrn.validation",
    "hrn.metrics",
    "hrn.range",
    "hrn.check",
];

/// The result for one part of the format.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    /// The part of the format.
    pub part: &'static str,
    /// The problem with the part; `None` if there is none.
    pub problem: Option<String>,
    /// Whether `adopt` mends the problem.
    pub is_mended: bool,
}

impl fmt::Display for Finding {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            part,
            problem,
            is_mended,
        } = self;
        match problem {
            None => write!(out, "ok       {part}"),
            Some(problem) if *is_mended => write!(out, "adopt    {part}: {problem}"),
            Some(problem) => write!(out, "missing  {part}: {problem}"),
        }
    }
}

/// Reviews a file. The file passes if no finding has a problem.
pub fn review(bytes: &[u8]) -> Vec<Finding> {
    let mut problems: Vec<(&'static str, String, bool)> = Vec::new();
    let mut stopped_at = None;
    match decode(bytes) {
        Err(error) => {
            problems.push((PARTS[0], error.to_string(), false));
            stopped_at = Some(PARTS[0]);
        }
        Ok(mut proto) => {
            let mut has_own_check = true;
            // Each turn mends one part, so there is at most one turn more than there are parts.
            for _ in 0..=PARTS.len() {
                let error = match Hrn::load(&proto.encode_to_vec()) {
                    Ok(_) => break,
                    Err(ModelError::CheckDiffers { .. }) if !has_own_check => break,
                    Err(error) => error,
                };
                let part = part(&error);
                let is_known = problems.iter().any(|(known, ..)| *known == part);
                let is_mended = !is_known && mend_part(&mut proto, part);
                if !is_known {
                    problems.push((part, error.to_string(), is_mended));
                }
                has_own_check &= part != "hrn.check";
                if !is_mended {
                    stopped_at = Some(part);
                    break;
                }
            }
        }
    }
    let reached = stopped_at.map_or(PARTS.len(), |stopped| {
        let order = READ.iter().position(|part| *part == stopped);
        order.map_or(PARTS.len(), |order| order + 1)
    });
    let finding = |part: &'static str| {
        let problem = problems.iter().find(|(of, ..)| *of == part);
        let is_reached = READ[..reached].contains(&part);
        Finding {
            part,
            problem: match problem {
                Some((_, problem, _)) => Some(problem.clone()),
                None if !is_reached => {
                    Some("not looked at, because of the other problem".to_owned())
                }
                None => None,
            },
            is_mended: problem.is_some_and(|(_, _, is_mended)| *is_mended),
        }
    };
    PARTS.map(finding).to_vec()
}

/// The parts in the order of the findings.
const PARTS: [&str; 15] = [
    "file",
    "opset",
    "data inside the file",
    "input",
    "outputs",
    "graph",
    KEYS[0],
    KEYS[1],
    KEYS[2],
    KEYS[3],
    KEYS[4],
    KEYS[5],
    KEYS[6],
    KEYS[7],
    KEYS[8],
];

/// The parts in the order in which the loader reads them.
const READ: [&str; 15] = [
    "file",
    "opset",
    "data inside the file",
    KEYS[0],
    KEYS[1],
    KEYS[2],
    KEYS[7],
    KEYS[8],
    KEYS[3],
    KEYS[4],
    KEYS[6],
    KEYS[5],
    "input",
    "outputs",
    "graph",
];

/// The part that an error concerns.
fn part(error: &ModelError) -> &'static str {
    match error {
        ModelError::TooLarge { .. } | ModelError::NotOnnx(_) => "file",
        ModelError::Opset { .. } => "opset",
        ModelError::ExternalData { .. } => "data inside the file",
        ModelError::Signature { what, .. } if what.starts_with("input") => "input",
        ModelError::Signature { .. } => "outputs",
        ModelError::KeyMissing { key } | ModelError::KeyInvalid { key, .. } => KEYS
            .into_iter()
            .find(|known| known == key)
            .unwrap_or("file"),
        ModelError::CheckDiffers { .. } | ModelError::ShoreDiffers { .. } => "hrn.check",
        _ => "graph",
    }
}

/// Mends a part if `adopt` would mend it, and returns whether it did. The values only have to be
/// right in form.
fn mend_part(proto: &mut pb::ModelProto, part: &str) -> bool {
    match part {
        "input" => mend_input(proto, &mut Vec::new()).is_ok(),
        "outputs" => mend_outputs(proto, &mut Vec::new()).is_ok(),
        part if part.starts_with("hrn.") => {
            let mut mended = proto.clone();
            let levels = levels(proto);
            let card = Card {
                format: "1".to_owned(),
                pitch_mm: 1.0,
                method: "-".to_owned(),
                data: "-".to_owned(),
                metrics: json!({}),
                validation: "-".to_owned(),
                range: Range {
                    force_n: [0.0, 1.0],
                    contact_area_taxels: [0, 1],
                },
                conformal: None,
                levels,
            };
            let check = Check {
                frames: vec![vec![1.0; TAXELS]; 8],
                probabilities: vec![vec![0.0; card.levels.len()]; 8],
            };
            if set(&mut mended, &card, &Checks::Frames(check)).is_err() {
                return false;
            }
            // Replace only the refused key.
            proto.metadata_props.retain(|entry| entry.key != part);
            let mut props = mended.metadata_props.into_iter();
            proto
                .metadata_props
                .extend(props.find(|entry| entry.key == part));
            true
        }
        _ => false,
    }
}

/// A list of as many levels as the outputs have.
fn levels(proto: &pb::ModelProto) -> Vec<Level> {
    let count = mend(&mut proto.clone()).map_or(4, |(_, levels)| levels);
    let agreed = dataset::levels();
    if count == agreed.len() {
        return agreed;
    }
    let level = |level: u8| Level {
        level,
        label: level.to_string(),
        shore: "-".to_owned(),
    };
    (1..=u8::try_from(count).unwrap_or(u8::MAX))
        .map(level)
        .collect()
}

/// The requirements of the format, as one line before the findings.
pub fn wanted() -> String {
    format!(
        "ONNX of opset {MIN_OPSET} or newer, all in one file: `frame` to `logits` and `probabilities`, \
         with nine hrn.* keys (docs/formats.md)"
    )
}
