//! A builder of graph nodes.

use tract_onnx::pb;

use crate::net::graph::Graph;
use crate::net::network::Weights;

/// Adds nodes one by one. Scalars are given by value.
pub(crate) struct Builder(pub(crate) Graph);

impl Builder {
    pub(crate) fn node(&mut self, op: &str, inputs: &[&str], output: &str) -> String {
        self.0.node(op, inputs, output, Vec::new())
    }

    pub(crate) fn with(
        &mut self,
        op: &str,
        inputs: &[&str],
        output: &str,
        attributes: Vec<pb::AttributeProto>,
    ) -> String {
        self.0.node(op, inputs, output, attributes)
    }

    pub(crate) fn scalar(&mut self, name: &str, value: f32) -> String {
        self.0
            .constant(&format!("{name} as a number"), &[], &[value])
    }

    pub(crate) fn reshaped(&mut self, x: &str, dims: &[usize], output: &str) -> String {
        let dims: Vec<i64> = dims.iter().map(|&length| length as i64).collect();
        let shape = self.0.indices(&format!("shape of {output}"), &dims);
        self.node("Reshape", &[x, &shape], output)
    }

    /// log(x + `added`).
    pub(crate) fn logarithm_of(&mut self, x: &str, added: f32) -> String {
        let added = self.scalar(&format!("added to {x}"), added);
        let raised = self.node("Add", &[x, &added], &format!("{x} raised"));
        self.node("Log", &[&raised], &format!("log of {x}"))
    }

    pub(crate) fn clipped(&mut self, x: &str, least: f32, most: f32) -> String {
        let low = self.scalar(&format!("least {x}"), least);
        let high = self.scalar(&format!("most {x}"), most);
        self.node("Clip", &[x, &low, &high], &format!("{x} clipped"))
    }

    /// Passes `x` `[rows, inputs]` through the layer `name`.
    pub(crate) fn dense(
        &mut self,
        weights: &Weights,
        name: &str,
        dims: [usize; 2],
        x: &str,
    ) -> String {
        let matrix = weights.numbers(&format!("{name}.matrix"));
        let matrix = self.0.constant(&format!("{name}.matrix"), &dims, &matrix);
        let bias = weights.numbers(&format!("{name}.bias"));
        let bias = self.0.constant(&format!("{name}.bias"), &dims[1..], &bias);
        self.node("Gemm", &[x, &matrix, &bias], &format!("{name}.sum"))
    }
}
