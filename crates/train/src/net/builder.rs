//! A builder of graph nodes, shared by the networks of frames and of courses.

use tract_onnx::pb;

use crate::net::graph::Graph;
use crate::net::network::Weights;

/// Adds nodes one by one. Scalars are given by value.
pub(super) struct Builder(pub(super) Graph);

impl Builder {
    pub(super) fn node(&mut self, op: &str, inputs: &[&str], output: &str) -> String {
        self.0.node(op, inputs, output, Vec::new())
    }

    pub(super) fn with(
        &mut self,
        op: &str,
        inputs: &[&str],
        output: &str,
        attributes: Vec<pb::AttributeProto>,
    ) -> String {
        self.0.node(op, inputs, output, attributes)
    }

    pub(super) fn scalar(&mut self, name: &str, value: f32) -> String {
        self.0
            .constant(&format!("{name} as a number"), &[], &[value])
    }

    pub(super) fn reshaped(&mut self, x: &str, dims: &[usize], output: &str) -> String {
        let dims: Vec<i64> = dims.iter().map(|&length| length as i64).collect();
        let shape = self.0.indices(&format!("shape of {output}"), &dims);
        self.node("Reshape", &[x, &shape], output)
    }

    /// log(x + `added`).
    pub(super) fn logarithm_of(&mut self, x: &str, added: f32) -> String {
        let added = self.scalar(&format!("added to {x}"), added);
        let raised = self.node("Add", &[x, &added], &format!("{x} raised"));
        self.node("Log", &[&raised], &format!("log of {x}"))
    }

    /// `x / (y + little)`.
    pub(super) fn quotient(&mut self, x: &str, y: &str, little: f32, output: &str) -> String {
        let little = self.scalar(&format!("little of {output}"), little);
        let raised = self.node("Add", &[y, &little], &format!("divisor of {output}"));
        self.node("Div", &[x, &raised], output)
    }

    pub(super) fn clipped(&mut self, x: &str, least: f32, most: f32) -> String {
        let low = self.scalar(&format!("least {x}"), least);
        let high = self.scalar(&format!("most {x}"), most);
        self.node("Clip", &[x, &low, &high], &format!("{x} clipped"))
    }

    /// Passes `x` `[rows, inputs]` through the layer `name`.
    pub(super) fn dense(
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
