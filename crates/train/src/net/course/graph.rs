//! The network of courses as ONNX nodes: from the inputs of format 3 to bins of Shore hardness, and to a
//! press's embedding as a reference.

use super::references::{self, BESIDE, EMBEDDING};
use super::{JOINT, REFERENCES};
use crate::net::builder::Builder;
use crate::net::graph::{Graph, Inputs, integer};
use crate::net::network::Weights;
use crate::net::standard::Standard;
use hardnessd_core::verdict::PIECE;

/// The graph from the inputs of format 3 to the logits of the bins, before temperature, and their
/// name. The press's embedding as a reference is in `reference`, if the model takes references.
pub fn graph(weights: &Weights, standard: &Standard, inputs: Inputs) -> (Graph, String) {
    let mut b = Builder(Graph::default());
    let features = standard.scaled(&mut b, "features");
    let beside = match inputs {
        Inputs::References => {
            b.embedding(weights, &features);
            b.beside(weights, &features)
        }
        // What the network gets without any reference.
        Inputs::Frame | Inputs::Parts(_) | Inputs::Features => {
            b.0.constant("beside", &[1, BESIDE], &[0.0; BESIDE])
        }
    };
    let along = vec![integer("axis", 1)];
    let mut x = b.with(
        "Concat",
        &[&features, &beside],
        "press and references",
        along,
    );
    for (name, dims) in JOINT {
        x = b.dense(weights, name, dims, &x);
        if name != "head" {
            x = b.node("Relu", &[&x], name);
        }
    }
    (b.0, x)
}

impl Builder {
    /// The columns of [`references::embeddings`] from the input `piece`.
    fn piece(&mut self) -> String {
        let axis = self.0.indices("piece axis", &[1]);
        let mut at = |place: usize, name: &str| {
            let [first, end] = [place, place + 1].map(|end| {
                self.0
                    .indices(&format!("piece {end} of {name}"), &[end as i64])
            });
            self.node("Slice", &["piece", &first, &end, &axis], name)
        };
        let names = [
            "flat",
            "width",
            "ball",
            "radius",
            "known hardness",
            "least",
            "greatest",
        ];
        let [flat, width, ball, radius, known, low, high]: [String; PIECE] =
            std::array::from_fn(|place| at(place, names[place]));
        let mut length = |is: &str, mm: &str| {
            let least = self.scalar(&format!("least {mm}"), 0.1);
            let scale = self.scalar(&format!("scale of {mm}"), references::MM);
            let mm = self.node("Max", &[mm, &least], &format!("{mm} at least"));
            let mm = self.node("Div", &[&mm, &scale], &format!("{mm} scaled"));
            let mm = self.node("Log", &[&mm], &format!("{mm} log"));
            self.node("Mul", &[is, &mm], &format!("{mm} known"))
        };
        let (width, radius) = (length(&flat, &width), length(&ball, &radius));
        let sum = self.node("Add", &[&low, &high], "ends together");
        let half = self.scalar("half", 0.5);
        let middle = self.node("Mul", &[&sum, &half], "middle");
        let zero = self.scalar("middle of the scale", references::MIDDLE);
        let middle = self.node("Sub", &[&middle, &zero], "middle off");
        let span = self.node("Sub", &[&high, &low], "span");
        let unit = self.scalar("unit of hardness", references::UNIT);
        let mut scaled = |x: &str| {
            let x = self.node("Div", &[x, &unit], &format!("{x} in units"));
            self.node("Mul", &[&known, &x], &format!("{x} known"))
        };
        let (middle, span) = (scaled(&middle), scaled(&span));
        let columns = [&flat, &width, &ball, &radius, &known, &middle, &span];
        let columns = columns.map(String::as_str);
        self.with(
            "Concat",
            &columns,
            "piece columns",
            vec![integer("axis", 1)],
        )
    }

    /// The output `reference` from standardised features `[1, FEATURES]`.
    fn embedding(&mut self, weights: &Weights, features: &str) {
        let [first, second, _] = references::LAYERS;
        let piece = self.piece();
        let along = vec![integer("axis", 1)];
        let all = self.with("Concat", &[features, &piece], "press and piece", along);
        let x = self.dense(weights, first.0, first.1, &all);
        let x = self.node("Relu", &[&x], first.0);
        let x = self.dense(weights, second.0, second.1, &x);
        self.node("Relu", &[&x], "reference");
    }

    /// What the inputs `references` and `given` say beside standardised features `[1, FEATURES]`.
    fn beside(&mut self, weights: &Weights, features: &str) -> String {
        let [.., (question, dims)] = references::LAYERS;
        let all = self.reshaped("references", &[REFERENCES, EMBEDDING], "all references");
        let ones = self
            .0
            .constant("each reference", &[REFERENCES, 1], &[1.0; REFERENCES]);
        let count = self.node("MatMul", &["given", &ones], "count");
        let one = self.scalar("one", 1.0);
        let divisor = self.node("Max", &[&count, &one], "count at least 1");
        let sum = self.node("MatMul", &["given", &all], "sum of references");
        let mean = self.node("Div", &[&sum, &divisor], "mean of references");

        let question = self.dense(weights, question, dims, features);
        let transposed = vec![integer("transB", 1)];
        let scores = self.with("Gemm", &[&question, &all], "scores", transposed);
        let divisor = self.scalar("divisor of scores", references::SCORES);
        let scores = self.node("Div", &[&scores, &divisor], "scores scaled");
        // What is not given has no weight.
        let missing = self.node("Sub", &["given", &one], "missing");
        let low = self.scalar("low", 1e4);
        let missing = self.node("Mul", &[&missing, &low], "missing scores");
        let scores = self.node("Add", &[&scores, &missing], "scores of the given");
        let along = || vec![integer("axis", 1)];
        let attention = self.with("Softmax", &[&scores], "softmax of scores", along());
        let attention = self.node("Mul", &[&attention, "given"], "attention");
        let attended = self.node("MatMul", &[&attention, &all], "attended");

        let is_any = self.node("Min", &[&count, &one], "is any given");
        let log = self.logarithm_of(&count, 1.0);
        let divisor = self.scalar("divisor of the count", references::COUNT);
        let log = self.node("Div", &[&log, &divisor], "count scaled");
        let parts = [mean.as_str(), &attended, &is_any, &log];
        self.with("Concat", &parts, "beside", along())
    }
}
