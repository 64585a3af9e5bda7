//! Writes a recogniser as an ONNX file and accepts it only if the daemon would.
//!
//! In: a [`Graph`] from newtons to logits, the temperature, the card, and check frames or presses
//! with the trainer's probabilities. Out: the bytes of the file, already read back through
//! [`verdict::Hrn`](hardnessd_core::verdict::Hrn), which refuses a file that does not reproduce its checks.

use anyhow::{Context as _, ensure};
use prost::Message as _;
use tract_onnx::pb;

use crate::net::bins::{BINS, LIFTS};
use crate::net::course::{EMBEDDING, REFERENCES};
use crate::net::graph::{Graph, frame_input, integer, model, value_info};
use hardnessd_core::verdict::{COURSE_FRAMES, Card, Checks, Hrn, course_inputs, identified_inputs};

/// The outputs of a graph.
#[derive(Debug, Clone)]
pub enum Outputs {
    /// Formats 1 and 2.
    Levels {
        /// Name of the logits `[1, L]` in the graph, before temperature.
        raw_logits: String,
        /// Name of the Shore hardness `[1, 3]` in the graph, if it has one. A model of format 2
        /// always has one.
        shore: Option<String>,
    },
    /// Format 3, whose graph also has the output `reference`.
    Bins {
        /// Name of the logits of the bins in the graph, before temperature.
        raw_bins: String,
        /// What is added to them after temperature.
        lifts: Vec<f32>,
    },
}

impl Outputs {
    fn raw(&self) -> &str {
        match self {
            Self::Levels { raw_logits, .. } => raw_logits,
            Self::Bins { raw_bins, .. } => raw_bins,
        }
    }
}

/// Writes the file: the logits over the temperature, their softmax if they are of levels, and the
/// metadata.
///
/// # Errors
///
/// Fails if the daemon's loader refuses the file, or reads another card from it.
pub fn write(
    mut graph: Graph,
    outputs: &Outputs,
    temperature: f32,
    card: &Card,
    checks: &Checks,
) -> anyhow::Result<Vec<u8>> {
    ensure!(
        temperature.is_finite() && temperature > 0.0,
        "temperature {temperature}: above 0"
    );
    let temperature = graph.constant("temperature", &[], &[temperature]);
    let mut divide = |output| graph.node("Div", &[outputs.raw(), &temperature], output, Vec::new());
    let (input, output) = match outputs {
        Outputs::Levels { shore, .. } => {
            divide("logits");
            let along = vec![integer("axis", 1)];
            graph.node("Softmax", &["logits"], "probabilities", along);
            let levels = card.levels.len();
            let mut output = vec![
                value_info("logits", &[1, levels]),
                value_info("probabilities", &[1, levels]),
            ];
            output.extend(shore.iter().map(|name| value_info(name, &[1, 3])));
            let input = match checks {
                Checks::Frames(_) => vec![frame_input()],
                Checks::Courses(_) => inputs(&course_inputs(COURSE_FRAMES.1)),
            };
            (input, output)
        }
        Outputs::Bins { lifts, .. } => {
            divide("bins on their scale");
            let lifts = graph.constant(LIFTS, &[1, BINS], lifts);
            let lifted = ["bins on their scale", lifts.as_str()];
            graph.node("Add", &lifted, "bins", Vec::new());
            let references = [REFERENCES, EMBEDDING];
            let input = inputs(&identified_inputs(COURSE_FRAMES.1, references));
            let output = vec![
                value_info("bins", &[1, BINS]),
                value_info("reference", &[1, EMBEDDING]),
            ];
            (input, output)
        }
    };
    let proto = model(graph, input, output, metadata(card, checks)?);
    let bytes = proto.encode_to_vec();
    let read_back = Hrn::load(&bytes).context("the exported model does not pass the daemon's")?;
    ensure!(
        read_back.card() == card,
        "the exported model's card does not read back the same"
    );
    Ok(bytes)
}

fn inputs(named: &[(&'static str, Vec<usize>)]) -> Vec<pb::ValueInfoProto> {
    let input = |(name, dims): &(&'static str, Vec<usize>)| value_info(name, dims);
    named.iter().map(input).collect()
}

pub(super) fn metadata(
    card: &Card,
    checks: &Checks,
) -> anyhow::Result<Vec<pb::StringStringEntryProto>> {
    let check = match checks {
        Checks::Frames(check) => serde_json::to_string(check)?,
        Checks::Courses(check) => serde_json::to_string(check)?,
    };
    let mut entries = vec![
        ("hrn.format", card.format.clone()),
        ("hrn.levels", serde_json::to_string(&card.levels)?),
        ("hrn.pitch_mm", card.pitch_mm.to_string()),
        ("hrn.method", card.method.clone()),
        ("hrn.data", card.data.clone()),
        ("hrn.metrics", serde_json::to_string(&card.metrics)?),
        ("hrn.validation", card.validation.clone()),
        ("hrn.range", serde_json::to_string(&card.range)?),
        ("hrn.check", check),
    ];
    if let Some(conformal) = &card.conformal {
        entries.push(("hrn.conformal", serde_json::to_string(conformal)?));
    }
    let entry = |(key, value): (&str, String)| pb::StringStringEntryProto {
        key: key.to_owned(),
        value,
    };
    Ok(entries.into_iter().map(entry).collect())
}
