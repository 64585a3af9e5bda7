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

use super::adopt::set;
use super::foreign::{
    Foreign, check_sums, decode, has_course_inputs, mend_input, mend_nodes, mend_opset,
    mend_outputs,
};
use crate::data::dataset;
use hardnessd_core::trial;
use hardnessd_core::verdict::{
    Card, Check, CheckedCourse, Checks, Course, CourseCheck, CourseMoment, Hrn, Level, MIN_OPSET,
    ModelError, ModelFrame, Range, TAXELS,
};

/// The parts of the file and of its graph.
const OF_FILE: [&str; 3] = ["file", "opset", "data inside the file"];
const OF_GRAPH: [&str; 3] = ["input", "outputs", "graph"];
/// The metadata keys, in the order in which the loader reads them.
const KEYS: [&str; 10] = [
    "hrn.format",
    "hrn.levels",
    "hrn.pitch_mm",
    "hrn.range",
    "hrn.check",
    CONFORMAL,
    "hrn.method",
    "hrn.data",
    "hrn.metrics",
    "hrn.validation",
];
/// The key that only a file of format 2 or 3 may have.
const CONFORMAL: &str = "hrn.conformal";
/// The problem of a part that the loader did not reach.
const UNSEEN: &str = "not looked at, because of the other problem";
/// The number of check frames or check presses.
const CHECKS: usize = 8;

/// The format that a file is reviewed for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Format 1: the graph judges one frame.
    Frame,
    /// Format 2: an input of the graph has the name of one of format 2.
    Course,
    /// Format 3: an input is `references`.
    Identified,
}

/// The review of a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Review {
    /// The format that the file was reviewed for.
    pub format: Format,
    /// The findings, one for each part of the format.
    pub findings: Vec<Finding>,
}

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
            Some(problem) if problem == UNSEEN => write!(out, "unseen   {part}: {problem}"),
            Some(problem) => write!(out, "missing  {part}: {problem}"),
        }
    }
}

/// Reviews a file. The file passes if no finding has a problem. A child process tries the file before
/// it is loaded here.
pub fn review(bytes: &[u8]) -> Review {
    let mut problems: Vec<(&'static str, String, bool)> = Vec::new();
    let (mut format, mut stopped_at) = (Format::Frame, None);
    match decode(bytes) {
        Err(error) => {
            problems.push((OF_FILE[0], error.to_string(), false));
            stopped_at = Some(OF_FILE[0]);
        }
        Ok(mut proto) => {
            if has_course_inputs(&proto) {
                let mut inputs = proto.graph.iter().flat_map(|graph| &graph.input);
                format = match inputs.any(|input| input.name == "references") {
                    true => Format::Identified,
                    false => Format::Course,
                };
            }
            problems.extend(format.contradicted(&mut proto));
            let mut has_own_check = true;
            // Each turn mends one part, so there is at most one turn more than there are parts.
            for _ in 0..=format.parts().len() {
                let bytes = proto.encode_to_vec();
                let error = match trial::survives(&bytes).and_then(|()| Hrn::load(&bytes)) {
                    Ok(_) => break,
                    Err(ModelError::CheckDiffers { .. } | ModelError::ShoreDiffers { .. })
                        if !has_own_check =>
                    {
                        if let Some(reason) = scores(&bytes) {
                            problems.retain(|(part, ..)| *part != "outputs");
                            problems.push(("outputs", reason, false));
                        }
                        break;
                    }
                    Err(error) => error,
                };
                let part = part(&error);
                let known = problems.iter_mut().find(|(known, ..)| *known == part);
                let mended = match known {
                    // Mending did not suffice, so `adopt` does not either.
                    Some(problem) => {
                        *problem = (part, error.to_string(), false);
                        Mended::No(None)
                    }
                    None => {
                        let mended = format.mend_part(&mut proto, part);
                        let is_adopted =
                            matches!(mended, Mended::AsByAdopt) && format == Format::Frame;
                        let reason = mended.reason();
                        problems.push((part, reason.unwrap_or(error.to_string()), is_adopted));
                        mended
                    }
                };
                has_own_check &= part != "hrn.check";
                if matches!(mended, Mended::No(_)) {
                    stopped_at = Some(part);
                    break;
                }
            }
        }
    }
    let parts = format.parts();
    let reached = stopped_at.map_or(parts.len(), |stopped| {
        let order = parts.iter().position(|part| *part == stopped);
        order.map_or(parts.len(), |order| order + 1)
    });
    let finding = |part: &'static str| {
        let problem = problems.iter().find(|(of, ..)| *of == part);
        let is_reached = parts[..reached].contains(&part);
        Finding {
            part,
            problem: match problem {
                Some((_, problem, _)) => Some(problem.clone()),
                None if !is_reached => Some(UNSEEN.to_owned()),
                None => None,
            },
            is_mended: problem.is_some_and(|(_, _, is_mended)| *is_mended),
        }
    };
    Review {
        format,
        findings: format.shown().into_iter().map(finding).collect(),
    }
}

/// Whether a part was mended in the copy of the file, and else why not.
enum Mended {
    /// As `adopt` does it.
    AsByAdopt,
    /// Only so that the parts after it can be looked at.
    ToLookFurther(Option<Foreign>),
    No(Option<Foreign>),
}

impl Mended {
    /// Why `adopt` does not mend it, without the name of the part.
    fn reason(&self) -> Option<String> {
        let (Self::ToLookFurther(Some(reason)) | Self::No(Some(reason))) = self else {
            return None;
        };
        let text = reason.to_string();
        let without = ["inputs: ", "outputs: "].map(|part| text.strip_prefix(part));
        let found = without.into_iter().flatten().next().map(str::to_owned);
        Some(found.unwrap_or(text))
    }
}

impl Format {
    /// The metadata keys of the format, in the order in which the loader reads them.
    fn keys(self) -> impl Iterator<Item = &'static str> {
        let is_of = move |key: &&str| self != Self::Frame || *key != CONFORMAL;
        KEYS.into_iter().filter(is_of)
    }

    /// The parts in the order in which the loader reads them.
    fn parts(self) -> Vec<&'static str> {
        let keys = OF_FILE.into_iter().chain(self.keys());
        keys.chain(OF_GRAPH).collect()
    }

    /// The parts in the order of the findings.
    fn shown(self) -> Vec<&'static str> {
        let graph = OF_FILE.into_iter().chain(OF_GRAPH);
        graph.chain(self.keys()).collect()
    }

    /// The value of `hrn.format`.
    fn number(self) -> &'static str {
        match self {
            Self::Frame => "1",
            Self::Course => "2",
            Self::Identified => "3",
        }
    }

    /// The problem of a `hrn.format` that is not that of the graph's inputs. Mends it.
    fn contradicted(self, proto: &mut pb::ModelProto) -> Option<(&'static str, String, bool)> {
        let key = KEYS[0];
        let mut entries = proto.metadata_props.iter_mut();
        let entry = entries.find(|entry| entry.key == key)?;
        let (found, expected) = (entry.value.clone(), self.number());
        if found == expected || !["1", "2", "3"].contains(&found.as_str()) {
            return None;
        }
        expected.clone_into(&mut entry.value);
        let problem = format!("found {found:?}, expected {expected:?}, the format of these inputs");
        Some((key, problem, self == Self::Frame))
    }
}

/// Why the probabilities of a file are none, without the name of the part.
fn scores(bytes: &[u8]) -> Option<String> {
    let verdict = Hrn::read(bytes).and_then(|hrn| hrn.judge_check(0)).ok()?;
    let refused = check_sums(&[verdict.probabilities]).err();
    Mended::No(refused).reason()
}

/// The part that an error concerns.
fn part(error: &ModelError) -> &'static str {
    match error {
        ModelError::TooLarge { .. } | ModelError::NotOnnx(_) => "file",
        ModelError::Opset { .. } => "opset",
        ModelError::ExternalData { .. } => "data inside the file",
        ModelError::Signature { what, .. } if what.starts_with("input") => "input",
        ModelError::Signature { .. } => "outputs",
        ModelError::KeyMissing { key } | ModelError::KeyInvalid { key, .. } => key,
        ModelError::CheckDiffers { .. } | ModelError::ShoreDiffers { .. } => "hrn.check",
        _ => "graph",
    }
}

impl Format {
    /// Mends a part. The values only have to be right in form. Of format 1, it mends what `adopt` would
    /// mend. It also claims a newer opset, so that the parts after it can be looked at.
    fn mend_part(self, proto: &mut pb::ModelProto, part: &str) -> Mended {
        let mut done = Vec::new();
        let by_adopt = |result: Result<(), Foreign>| match result {
            Ok(()) => Mended::AsByAdopt,
            Err(reason) => Mended::No(Some(reason)),
        };
        match part {
            "opset" => {
                let result = match self {
                    Self::Frame => mend_opset(proto, &mut done).map_err(Some),
                    Self::Course | Self::Identified => Err(None),
                };
                let mut sets = proto.opset_import.iter_mut();
                let of_onnx = sets.find(|set| ["", "ai.onnx"].contains(&set.domain.as_str()));
                match (result, of_onnx) {
                    (Ok(()), Some(_)) => Mended::AsByAdopt,
                    (result, Some(set)) => {
                        set.version = MIN_OPSET;
                        Mended::ToLookFurther(result.err().flatten())
                    }
                    (result, None) => Mended::No(result.err().flatten()),
                }
            }
            "input" if self == Self::Frame => by_adopt(mend_input(proto, &mut done)),
            "outputs" if self == Self::Frame => {
                by_adopt(mend_outputs(proto, None, &mut done).map(|_| ()))
            }
            "graph" if self == Self::Frame => match mend_nodes(proto, &mut done) {
                Ok(()) if done.is_empty() => Mended::No(None),
                result => by_adopt(result),
            },
            part if part.starts_with("hrn.") => {
                let mut mended = proto.clone();
                let levels = levels(proto);
                let count = levels.len();
                let card = Card {
                    format: self.number().to_owned(),
                    pitch_mm: 1.0,
                    method: "-".to_owned(),
                    data: "-".to_owned(),
                    metrics: json!({}),
                    validation: "-".to_owned(),
                    range: Range::ANY,
                    conformal: None,
                    levels,
                };
                if set(&mut mended, &card, &self.checks(count)).is_err() {
                    return Mended::No(None);
                }
                // Replace only the refused key.
                proto.metadata_props.retain(|entry| entry.key != part);
                let mut props = mended.metadata_props.into_iter();
                proto
                    .metadata_props
                    .extend(props.find(|entry| entry.key == part));
                Mended::AsByAdopt
            }
            _ => Mended::No(None),
        }
    }

    /// Checks of the right form for a model of `levels` levels.
    fn checks(self, levels: usize) -> Checks {
        let probabilities = vec![0.0; levels];
        match self {
            Self::Frame => Checks::Frames(Check {
                frames: vec![vec![1.0; TAXELS]; CHECKS],
                probabilities: vec![probabilities; CHECKS],
            }),
            Self::Course | Self::Identified => {
                let moment = CourseMoment {
                    time_s: 0.0,
                    approach_mm: None,
                    frame: ModelFrame {
                        newtons: [1.0; TAXELS],
                    },
                };
                let press = CheckedCourse {
                    course: Course {
                        moments: vec![moment],
                        arm_n_per_mm: 0.0,
                    },
                    probabilities,
                    shore: [0.0; 3].into(),
                    identified: false,
                };
                Checks::Courses(CourseCheck {
                    presses: vec![press; CHECKS],
                    references: Vec::new(),
                })
            }
        }
    }

    /// The requirements of the format, as one line before the findings.
    pub fn wanted(self) -> String {
        let (graph, keys) = match self {
            Self::Frame => ("`frame` to `logits` and `probabilities`", "nine hrn.* keys"),
            Self::Course => (
                "the course of a press to `logits`, `probabilities` and `shore`",
                "nine hrn.* keys, and a tenth if you like",
            ),
            Self::Identified => (
                "the course of a press and references of its sensor to `bins` and `reference`",
                "nine hrn.* keys, and a tenth if you like",
            ),
        };
        format!(
            "ONNX of opset {MIN_OPSET} or newer, all in one file: {graph}, with {keys} \
             (docs/formats.md)"
        )
    }
}

/// A list of as many levels as the outputs have.
fn levels(proto: &pb::ModelProto) -> Vec<Level> {
    let count = mend_outputs(&mut proto.clone(), None, &mut Vec::new()).unwrap_or(4);
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

#[cfg(test)]
mod tests {
    use super::*;
    use hardnessd_core::test_support::course_model::{course_model, encoded};
    use hardnessd_core::verdict::{BUILT_IN, BUILT_IN_HRN};

    /// The parts of a file that have a problem, with the problem.
    fn problems(bytes: &[u8]) -> Vec<(&'static str, String)> {
        let findings = review(bytes).findings;
        let with_problem = findings.into_iter().filter(|finding| {
            assert!(finding.problem.is_some() || !finding.is_mended);
            finding.problem.is_some()
        });
        with_problem
            .map(|finding| (finding.part, finding.problem.unwrap_or_default()))
            .collect()
    }

    #[test]
    fn a_good_file_of_each_format_passes() {
        for (bytes, format, parts) in [
            (BUILT_IN_HRN.to_vec(), Format::Frame, 15),
            (course_model(8, &[]), Format::Course, 16),
            (BUILT_IN.to_vec(), Format::Identified, 16),
        ] {
            assert_eq!(problems(&bytes), []);
            let review = review(&bytes);
            assert_eq!((review.format, review.findings.len()), (format, parts));
        }
        assert!(Format::Course.wanted().contains("course of a press"));
    }

    #[test]
    fn a_graph_of_presses_without_metadata_lacks_the_keys_of_its_format_alone() {
        let bare = encoded(8, &[], |proto| proto.metadata_props.clear());
        let review = review(&bare);
        assert_eq!(review.format, Format::Course);
        for Finding {
            part,
            problem,
            is_mended,
        } in review.findings
        {
            let is_required = part.starts_with("hrn.") && part != CONFORMAL;
            let expected = format!("model metadata `{part}` is missing");
            assert_eq!(problem, is_required.then_some(expected), "{part}");
            assert!(!is_mended, "adopt takes models of one frame");
        }
    }

    #[test]
    fn each_problem_of_a_model_of_presses_is_told_of_its_own_part() {
        let set = |key: &'static str, text: &'static str| {
            encoded(8, &[], |proto| {
                proto.metadata_props.retain(|entry| entry.key != key);
                proto.metadata_props.push(pb::StringStringEntryProto {
                    key: key.to_owned(),
                    value: text.to_owned(),
                });
            })
        };
        for (key, text, expected) in [
            (
                CONFORMAL,
                r#"{"alpha":0.1,"threshold":2}"#,
                "between 0 and 1",
            ),
            ("hrn.format", "1", "found \"1\", expected \"2\""),
            ("hrn.format", "3", "found \"3\", expected \"2\""),
            ("hrn.format", "4", "expected \"1\", \"2\" or \"3\""),
            ("hrn.pitch_mm", "-1", "millimetres above 0"),
            ("hrn.check", "{}", "missing field"),
        ] {
            let problems = problems(&set(key, text));
            assert_eq!(problems.len(), 1, "{problems:?}");
            assert_eq!(problems[0].0, key);
            assert!(problems[0].1.contains(expected), "{problems:?}");
        }
        let one_input_less = encoded(8, &[], |proto| {
            proto.graph.as_mut().unwrap().input.pop();
        });
        let problems = problems(&one_input_less);
        assert_eq!(problems[0].0, "input");
        assert!(problems[0].1.contains("T 3 to 48"), "{problems:?}");
    }
}
