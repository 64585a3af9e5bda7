//! A model from which a training starts.
//!
//! In: the file of a course model. Out: its weights, and the scale on which it takes features.

use std::path::Path;

use anyhow::{Context as _, anyhow};
use burn::tensor::Device;
use prost::Message as _;
use tract_onnx::pb;

use crate::data::source::Source;
use crate::net::course;
use crate::net::network::Weights;
use crate::net::standard::Standard;
use crate::run::disk::load;

/// What a training takes of a model.
#[derive(Debug)]
pub struct Start {
    /// The weights of its network.
    pub weights: Weights,
    /// The scale of its features.
    pub standard: Standard,
    /// The file. A model names it among its data.
    pub source: Source,
}

impl Start {
    /// Reads the model.
    ///
    /// # Errors
    ///
    /// Fails if the file cannot be read, is no model that the daemon takes, or has another network than the
    /// method `course` of this revision.
    pub fn read(path: &Path, device: &Device) -> anyhow::Result<Self> {
        let (_, bytes) = load(path)?;
        let shown = || path.display().to_string();
        let model = pb::ModelProto::decode(bytes.as_slice()).with_context(shown)?;
        let exported = |graph| course::exported(&graph, device);
        let exported = model.graph.and_then(exported);
        let (weights, standard) = exported
            .ok_or_else(|| anyhow!("not a model of the method course, or of another revision"))
            .with_context(shown)?;
        Ok(Self {
            weights,
            standard,
            source: Source::of(path, &bytes),
        })
    }
}
