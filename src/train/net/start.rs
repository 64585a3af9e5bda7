//! A network that training goes on from: the weights of an exported file.

use burn::tensor::{Device, Tensor, TensorData};

use crate::train::net::network::Weights;
use crate::train::net::shore;
use crate::train::net::standard::Standard;

/// Shape and numbers of a constant of an exported graph.
pub type Constant = (Vec<usize>, Vec<f32>);

/// What an exported file tells of its network.
#[derive(Debug, Clone)]
pub struct Start {
    /// Weights of all layers.
    pub weights: Weights,
    /// Mean and deviation of the columns.
    pub standard: Standard,
    /// What the logits are divided by.
    pub temperature: f32,
    /// What is added below and above the interval of Shore, in Shore OO.
    pub widths: [f32; 2],
}

impl Start {
    /// From an exported graph's constants; `None` if they are of another network than `initial`, which has
    /// the same layers with any weights, and `columns` columns. `constant` gives a constant by its name, laid
    /// out as the weights are.
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
                mean: numbers("column means", columns)?,
                deviation: numbers("column deviations", columns)?,
            },
            temperature: numbers("temperature", 1)?[0],
            widths: numbers("shore middles", shore::OUTPUTS)
                .map_or([0.0; 2], |middles| shore::widths(&middles)),
        })
    }
}
