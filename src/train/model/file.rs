//! Writes a recogniser as an ONNX file and takes it only if the daemon would.
//!
//! In: a [`Graph`] from newtons to logits, the temperature, the card, and check frames with the
//! trainer's probabilities. Out: the bytes of the file, already read back through
//! [`verdict::Hrn`](crate::verdict::Hrn), which reproduces the check frames or refuses.

use anyhow::{Context as _, ensure};
use prost::Message as _;
use tract_onnx::pb;

use crate::train::net::graph::{Graph, integer, model, value_info};
use crate::verdict::{Card, Check, Hrn};

/// Writes the file: `raw_logits` (`[1, L]`) over `temperature`, their softmax, and the metadata.
///
/// # Errors
///
/// If the daemon's loader refuses the file, or reads another card from it.
pub fn write(
    mut graph: Graph,
    raw_logits: &str,
    temperature: f32,
    card: &Card,
    check: &Check,
) -> anyhow::Result<Vec<u8>> {
    ensure!(
        temperature.is_finite() && temperature > 0.0,
        "temperature {temperature}: above 0"
    );
    let temperature = graph.constant("temperature", &[], &[temperature]);
    graph.node("Div", &[raw_logits, &temperature], "logits", Vec::new());
    graph.node(
        "Softmax",
        &["logits"],
        "probabilities",
        vec![integer("axis", 1)],
    );

    let levels = card.levels.len();
    let output = vec![
        value_info("logits", &[1, levels]),
        value_info("probabilities", &[1, levels]),
    ];
    let proto = model(graph, output, metadata(card, check)?);
    let bytes = proto.encode_to_vec();
    let read_back = Hrn::load(&bytes).context("the exported model does not pass the daemon's")?;
    ensure!(
        read_back.card() == card,
        "the exported model's card does not read back the same"
    );
    Ok(bytes)
}

fn metadata(card: &Card, check: &Check) -> anyhow::Result<Vec<pb::StringStringEntryProto>> {
    let entries = [
        ("hrn.format", card.format.clone()),
        ("hrn.levels", serde_json::to_string(&card.levels)?),
        ("hrn.pitch_mm", card.pitch_mm.to_string()),
        ("hrn.method", card.method.clone()),
        ("hrn.data", card.data.clone()),
        ("hrn.metrics", serde_json::to_string(&card.metrics)?),
        ("hrn.validation", card.validation.clone()),
        ("hrn.range", serde_json::to_string(&card.range)?),
        ("hrn.check", serde_json::to_string(check)?),
    ];
    let entry = |(key, value): (&str, String)| pb::StringStringEntryProto {
        key: key.to_owned(),
        value,
    };
    Ok(entries.into_iter().map(entry).collect())
}
