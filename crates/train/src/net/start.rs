//! The start of further training: the weights of an exported file.

use burn::tensor::{Device, Tensor, TensorData};

use crate::net::bins::{BINS, LIFTS};
use crate::net::graph::Constant;
use crate::net::network::Weights;
use crate::net::shore;
use crate::net::standard::{FORCE_FACTOR, Standard};

/// The network of an exported file.
#[derive(Debug, Clone)]
pub struct ExportedNetwork {
    /// Weights of all layers.
    pub weights: Weights,
    /// The factor of the forces, and mean and deviation of the columns.
    pub standard: Standard,
    /// The temperature by which the logits are divided.
    pub temperature: f32,
    /// The widths by which the interval of Shore hardness is widened below and above, in Shore OO.
    pub widths: [f32; 2],
    /// What is added to the logits of bins after temperature, if the network has bins.
    pub lifts: Vec<f32>,
}

impl ExportedNetwork {
    /// Reads the network from an exported graph's constants. `initial` has the expected layers with
    /// any weights, and `columns` is the expected number of columns. `None` if the constants are of
    /// another network. `constant` gives a constant by its name, laid out like the weights.
    pub fn of_constants(
        initial: Weights,
        columns: usize,
        constant: impl Fn(&str) -> Option<Constant>,
        device: &Device,
    ) -> Option<Self> {
        let mut weights = initial;
        for weight in &mut weights.entries {
            let (dims, values) = constant(&weight.name)?;
            if dims != weight.dims {
                return None;
            }
            let count = values.len();
            weight.values = Tensor::from_data(TensorData::new(values, [count]), device);
        }
        let numbers = |name: &str, count: usize| {
            let (_, values) = constant(name)?;
            (values.len() == count).then_some(values)
        };
        Some(Self {
            weights,
            standard: Standard {
                force_factor: numbers(FORCE_FACTOR, 1).map_or(1.0, |factor| factor[0]),
                mean: numbers("column means", columns)?,
                deviation: numbers("column deviations", columns)?,
            },
            temperature: numbers("temperature", 1)?[0],
            widths: numbers("shore middles", shore::OUTPUTS)
                .map_or([0.0; 2], |middles| shore::widths(&middles)),
            lifts: numbers(LIFTS, BINS).unwrap_or_default(),
        })
    }
}
