//! Makes a model that the daemon loads from an ONNX file of another program.
//!
//! In: the file, with a graph from newtons to logits or probabilities, and the data set that it
//! learnt from. Out: the same graph, mended, with the metadata, and its evaluation on the test split.

use anyhow::{Context as _, ensure};
use prost::Message as _;
use serde_json::json;
use tract_onnx::pb;

use super::evaluated::Evaluated;
use super::export;
use super::file;
use super::foreign::{check_sums, decode, mend};
use crate::data::dataset::{self, Dataset};
use hardnessd_core::trial;
use hardnessd_core::verdict::{Card, Check, Checks, Hrn, ModelFrame};
use hardnessd_simulator::Split;

/// What the user states about a model besides its data.
#[derive(Debug, Clone)]
pub struct Stated {
    /// The value of `hrn.method`.
    pub method: String,
    /// The value of `hrn.validation`. `None` derives it from the presses that judge it.
    pub validation: Option<String>,
}

/// Sets the metadata of a file, replacing all its `hrn.` keys.
pub(super) fn set(proto: &mut pb::ModelProto, card: &Card, checks: &Checks) -> anyhow::Result<()> {
    proto
        .metadata_props
        .retain(|entry| !entry.key.starts_with("hrn."));
    proto.metadata_props.extend(file::metadata(card, checks)?);
    Ok(())
}

/// Adopts a file. Returns the file with its metadata, the changes in its graph, and its evaluation
/// on the test split if the data set has one. The daemon's own inference library computes the
/// probabilities of the check frames here, after a child process has tried the file.
///
/// # Errors
///
/// Fails if the inputs or outputs of the graph are not recognised, it has another number of levels
/// than the data set, the data set has no labelled training samples, or the daemon's loader refuses
/// the file.
pub fn adopt(
    bytes: &[u8],
    dataset: &Dataset,
    stated: &Stated,
) -> anyhow::Result<(Vec<u8>, Vec<String>, Option<Evaluated>)> {
    let mut proto = decode(bytes)?;
    let stated_levels = dataset.sources[0].levels.clone();
    let levels = stated_levels.unwrap_or_else(dataset::levels);
    let (done, found) = mend(&mut proto, &levels)?;
    let expected = levels.len();
    ensure!(
        found == expected,
        "outputs: found {found} levels, expected {expected}, those of the data set"
    );
    let train = dataset.labelled(Split::Train)?;
    let learnt = train.iter().map(|&index| dataset.samples[index].frame);
    let mut card = Card {
        format: "1".to_owned(),
        levels,
        pitch_mm: dataset.pitch_mm() as f32,
        method: stated.method.clone(),
        data: export::data(&dataset.sources)?,
        metrics: json!({}),
        validation: stated
            .validation
            .clone()
            .unwrap_or_else(|| export::validation(&dataset.validated()).to_owned()),
        range: export::range(learnt),
        conformal: None,
    };
    let frames = export::check_frames(dataset, &train);
    let mut check = Check {
        frames: frames.iter().map(|frame| frame.newtons.to_vec()).collect(),
        probabilities: vec![vec![0.0; expected]; frames.len()],
    };
    set(&mut proto, &card, &Checks::Frames(check.clone()))?;
    let unchecked = proto.encode_to_vec();
    trial::survives(&unchecked)?;
    let hrn = Hrn::read(&unchecked)?;
    let computed = |frame: &&ModelFrame| Ok(hrn.judge(frame)?.probabilities);
    let computed: anyhow::Result<Vec<Vec<f32>>> = frames.iter().map(computed).collect();
    check.probabilities = computed?;
    check_sums(&check.probabilities)?;
    let evaluation = match dataset.labelled(Split::Test) {
        Ok(test) => Some(export::evaluate(&hrn, dataset, &test)?),
        Err(_) => None,
    };
    if let Some(evaluation) = &evaluation {
        card.metrics["test"] = json!(evaluation.levels);
    }
    set(&mut proto, &card, &Checks::Frames(check))?;
    let adopted = proto.encode_to_vec();
    Hrn::load(&adopted).context("the adopted model")?;
    Ok((adopted, done, evaluation))
}
