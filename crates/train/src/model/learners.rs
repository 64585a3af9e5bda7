//! Replaces the operators of classic learners that the daemon does not run, or not as onnxruntime.
//!
//! In: the nodes of a graph as skl2onnx writes them. Out: nodes of plain ONNX that compute the same
//! as onnxruntime. Other nodes stay as they are: the daemon's loader decides about those.

use tract_onnx::pb;

use crate::net::graph::{Graph, integer, integers};

/// The domain of ONNX's classic learners.
pub(super) const LEARNERS: &str = "ai.onnx.ml";

/// The rounds in which the probabilities of an SVC are coupled. onnxruntime stops at the first round
/// whose error is below [`COUPLING_ERROR`]. For a million random scores of 2 to 12 classes, it never
/// took more than 4 rounds (2026-11-26).
const COUPLING_ROUNDS: usize = 6;
/// The largest error of coupled probabilities, divided by the number of classes.
const COUPLING_ERROR: f32 = 0.005;
/// The most classes of an SVC. Its pairs grow with their square.
const MOST_CLASSES: usize = 32;
/// onnxruntime keeps the probability of a pair of classes this far from 0 and 1.
const LEAST_OF_PAIR: f32 = 1e-7;

/// A kind of learner that plain operators cannot replace.
#[derive(Debug, thiserror::Error)]
#[error("operator {operator}: {problem}")]
pub struct Learner {
    /// The operator.
    pub operator: String,
    /// The problem with it.
    pub problem: &'static str,
}

/// Replaces nodes. Returns the names of the operators that it replaced.
///
/// # Errors
///
/// Returns a [`Learner`] for a kind that it cannot replace.
pub(super) fn replace(graph: &mut pb::GraphProto, opset: i64) -> Result<Vec<String>, Learner> {
    let mut replaced: Vec<String> = Vec::new();
    let mut nodes = Vec::new();
    for mut node in std::mem::take(&mut graph.node) {
        if node.input.is_empty() {
            nodes.push(node);
            continue;
        }
        if node.domain == LEARNERS {
            number_classes(&mut node);
            if node.op_type == "TreeEnsembleClassifier" {
                settle_two_classes(&mut node)?;
            }
        }
        let mut plain = Plain {
            graph: Graph::default(),
            of: node.output.last().cloned().unwrap_or_default(),
            opset,
        };
        let is_replaced = match (node.domain.as_str(), node.op_type.as_str()) {
            (LEARNERS, "ArrayFeatureExtractor") => plain.columns(&node, &graph.initializer),
            (LEARNERS, "Binarizer") => plain.binarizer(&node),
            (LEARNERS, "Normalizer") => plain.normalizer(&node),
            (LEARNERS, "SVMClassifier") => plain.svm(&node)?,
            (LEARNERS, "Scaler") => plain.scaler(&node),
            ("" | "ai.onnx", "ReduceLogSumExp") => plain.log_sum_exp(&node),
            _ => false,
        };
        if !is_replaced {
            nodes.push(node);
            continue;
        }
        let (new_nodes, constants) = plain.graph.into_parts();
        nodes.extend(new_nodes);
        graph.initializer.extend(constants);
        if !replaced.contains(&node.op_type) {
            replaced.push(node.op_type);
        }
    }
    graph.node = nodes;
    Ok(replaced)
}

/// Gives the classes numbers in place of texts. Nothing reads the label any more, and the inference
/// library looks up no texts.
fn number_classes(node: &mut pb::NodeProto) {
    let numbers = match node.op_type.as_str() {
        "LinearClassifier" => "classlabels_ints",
        "TreeEnsembleClassifier" => "classlabels_int64s",
        _ => return,
    };
    let mut attributes = node.attribute.iter_mut();
    let texts = attributes.find(|found| found.name == "classlabels_strings");
    if let Some(texts) = texts.filter(|texts| !texts.strings.is_empty()) {
        let classes: Vec<i64> = (0..texts.strings.len() as i64).collect();
        *texts = integers(numbers, &classes);
    }
}

/// The trees of two classes may vote for one score. The inference library takes the score as that of class
/// 0, with a base value for each class, and the second probability as 1 less the first. onnxruntime
/// computes the same in these cases only.
fn settle_two_classes(node: &mut pb::NodeProto) -> Result<(), Learner> {
    let classes = ["classlabels_int64s", "classlabels_strings"].map(|name| attribute(node, name));
    let classes = classes.into_iter().flatten();
    let count: usize = classes
        .map(|found| found.ints.len() + found.strings.len())
        .sum();
    if count != 2 {
        return Ok(());
    }
    let voted = attribute(node, "class_ids").map_or(&[][..], |found| &found.ints);
    let base = floats(node, "base_values");
    let is_shared = voted.iter().all(|&class| class == 0);
    let is_mixed = floats(node, "class_weights")
        .iter()
        .any(|&weight| weight < 0.0);
    let is_settled = match (is_shared, text(node, "post_transform")) {
        (true, "LOGISTIC") => is_mixed && base.len() < 2,
        (true, "" | "NONE") => !is_mixed && base.len() < 2,
        (true, _) => false,
        (false, _) => base.iter().all(|&value| value == 0.0),
    };
    if !is_settled {
        return Err(Learner {
            operator: node.op_type.clone(),
            problem: "runtimes disagree about the scores of such an ensemble of two classes",
        });
    }
    let base = node
        .attribute
        .iter_mut()
        .find(|found| found.name == "base_values");
    if let Some(base) = base.filter(|_| is_shared) {
        base.floats.resize(2, 0.0);
    }
    Ok(())
}

/// The plain nodes in place of a node.
struct Plain {
    graph: Graph,
    /// The last output of the node. The other outputs are labels.
    of: String,
    opset: i64,
}

impl Plain {
    fn name(&self, part: &str) -> String {
        format!("{}/{part}", self.of)
    }

    fn constant(&mut self, part: &str, dims: &[usize], values: &[f32]) -> String {
        let name = self.name(part);
        self.graph.constant(&name, dims, values)
    }

    fn indices(&mut self, part: &str, values: &[i64]) -> String {
        let name = self.name(part);
        self.graph.indices(&name, values)
    }

    fn node(&mut self, operator: &str, inputs: &[&str], part: &str) -> String {
        let name = self.name(part);
        self.graph.node(operator, inputs, &name, Vec::new())
    }

    /// The node that computes the output of the replaced node.
    fn last(&mut self, operator: &str, inputs: &[&str]) -> bool {
        let output = self.of.clone();
        self.graph.node(operator, inputs, &output, Vec::new());
        true
    }

    /// Reduces the last axis of a matrix to one column. Opset 18 made the axis of these operators an
    /// input.
    fn reduce(&mut self, operator: &str, input: &str, part: &str) -> String {
        let name = self.name(part);
        if self.opset < 18 {
            let axes = vec![integers("axes", &[1])];
            return self.graph.node(operator, &[input], &name, axes);
        }
        let axes = self.indices(&format!("{part}.axes"), &[1]);
        self.node(operator, &[input, &axes], part)
    }

    /// Some columns of a matrix. The daemon takes no index that depends on the input, so such a column
    /// of a constant is a product with ones and zeros.
    fn columns(&mut self, node: &pb::NodeProto, constants: &[pb::TensorProto]) -> bool {
        let [from, which] = &node.input[..] else {
            return false;
        };
        let constant = |name: &String| constants.iter().find(|tensor| tensor.name == *name);
        let float = pb::tensor_proto::DataType::Float as i32;
        let output = self.of.clone();
        match (constant(from), constant(which)) {
            (Some(table), None) if table.data_type == float => {
                let length = table.float_data.len().max(table.raw_data.len() / 4);
                let upright = self.indices("upright", &[-1, 1]);
                let which = self.node("Reshape", &[which, &upright], "which");
                let all: Vec<i64> = (0..length as i64).collect();
                let all = self.indices("all", &all);
                let is_chosen = self.node("Equal", &[&which, &all], "is_chosen");
                let chosen = self.name("chosen");
                let to = vec![integer("to", i64::from(float))];
                let chosen = self.graph.node("Cast", &[&is_chosen], &chosen, to);
                let table = self.node("Reshape", &[from, &upright], "table");
                let product = self.node("MatMul", &[&chosen, &table], "product");
                let flat = self.indices("flat", &[1, -1]);
                self.last("Reshape", &[&product, &flat])
            }
            _ => {
                let flat = self.indices("flat", &[-1]);
                let which = self.node("Reshape", &[which, &flat], "which");
                let axis = vec![integer("axis", -1)];
                self.graph.node("Gather", &[from, &which], &output, axis);
                true
            }
        }
    }

    /// `(x - offset) * scale`.
    fn scaler(&mut self, node: &pb::NodeProto) -> bool {
        let (offset, scale) = (floats(node, "offset"), floats(node, "scale"));
        let offset = self.constant("offset", &[offset.len()], offset);
        let scale = self.constant("scale", &[scale.len()], scale);
        let centred = self.node("Sub", &[&node.input[0], &offset], "centred");
        self.last("Mul", &[&centred, &scale])
    }

    /// 1 above the threshold, else 0.
    fn binarizer(&mut self, node: &pb::NodeProto) -> bool {
        let threshold = attribute(node, "threshold").map_or(0.0, |found| found.f);
        let threshold = self.constant("threshold", &[1], &[threshold]);
        let is_above = self.node("Greater", &[&node.input[0], &threshold], "above");
        let output = self.of.clone();
        let float = pb::tensor_proto::DataType::Float as i64;
        let to = vec![integer("to", float)];
        self.graph.node("Cast", &[&is_above], &output, to);
        true
    }

    /// onnxruntime divides by the greatest number, the daemon's inference library by the greatest
    /// absolute one. Their other norms are the same.
    fn normalizer(&mut self, node: &pb::NodeProto) -> bool {
        if !matches!(text(node, "norm"), "" | "MAX") {
            return false;
        }
        let input = &node.input[0];
        let greatest = self.reduce("ReduceMax", input, "greatest");
        let zero = self.constant("zero", &[1], &[0.0]);
        let one = self.constant("one", &[1], &[1.0]);
        let is_zero = self.node("Equal", &[&greatest, &zero], "is_zero");
        let divisor = self.node("Where", &[&is_zero, &one, &greatest], "divisor");
        self.last("Div", &[input, &divisor])
    }

    /// The daemon's inference library adds the powers as they are, which overflow or vanish. So
    /// subtract the greatest exponent first.
    fn log_sum_exp(&mut self, node: &pb::NodeProto) -> bool {
        // These three operators take their axes in the same form.
        let of_node = |operator: &str, input: &str, output: String| {
            let mut inputs = node.input.clone();
            input.clone_into(&mut inputs[0]);
            pb::NodeProto {
                name: output.clone(),
                op_type: operator.to_owned(),
                input: inputs,
                output: vec![output],
                attribute: node.attribute.clone(),
                ..Default::default()
            }
        };
        let input = &node.input[0];
        let mut with_all_axes = of_node("ReduceMax", input, self.name("greatest"));
        with_all_axes
            .attribute
            .retain(|found| found.name != "keepdims");
        let greatest = self.graph.push(with_all_axes);
        let below = self.node("Sub", &[input, &greatest], "below");
        let powers = self.node("Exp", &[&below], "powers");
        let sum = of_node("ReduceLogSum", &powers, self.name("sum"));
        let sum = self.graph.push(sum);
        let greatest = of_node("ReduceMax", input, self.name("shift"));
        let greatest = self.graph.push(greatest);
        self.last("Add", &[&sum, &greatest])
    }

    /// A support vector classifier: a score for each pair of classes, and their probabilities if it
    /// has been fitted with `probability=True`.
    fn svm(&mut self, node: &pb::NodeProto) -> Result<bool, Learner> {
        let refused = |problem| {
            Err(Learner {
                operator: node.op_type.clone(),
                problem,
            })
        };
        let [coefficients, support, rho] =
            ["coefficients", "support_vectors", "rho"].map(|name| floats(node, name));
        let classes = attribute(node, "vectors_per_class").map_or(&[][..], |found| &found.ints);
        if classes.len() > MOST_CLASSES {
            return refused("it has more than 32 classes");
        }
        // More vectors than coefficients fail the check of the lengths.
        let count = |&vectors: &i64| {
            usize::try_from(vectors)
                .unwrap_or(0)
                .min(coefficients.len())
        };
        let of_class: Vec<usize> = classes.iter().map(count).collect();
        let vectors: usize = of_class.iter().sum();
        let pairs: Vec<(usize, usize)> = (0..of_class.len())
            .flat_map(|first| (first + 1..of_class.len()).map(move |second| (first, second)))
            .collect();
        let [slopes, offsets] = ["prob_a", "prob_b"].map(|name| floats(node, name));
        let is_whole = !pairs.is_empty()
            && vectors > 0
            && support.len().is_multiple_of(vectors)
            && coefficients.len() == (of_class.len() - 1) * vectors
            && rho.len() == pairs.len()
            && slopes.len() == offsets.len()
            && [0, pairs.len()].contains(&slopes.len());
        if !is_whole {
            return refused("its lists differ in length");
        }
        if !matches!(text(node, "post_transform"), "" | "NONE") {
            return refused("this value of attribute `post_transform` is not supported");
        }
        let Some(kernels) = self.kernels(node, support, vectors) else {
            return refused("this value of attribute `kernel_type` is not supported");
        };
        // The weights of a pair are those of the vectors of its two classes, from two rows.
        let mut weights = vec![0.0; vectors * pairs.len()];
        let starts: Vec<usize> = of_class
            .iter()
            .scan(0, |next, &count| {
                Some(std::mem::replace(next, *next + count))
            })
            .collect();
        for (pair, &(first, second)) in pairs.iter().enumerate() {
            for (class, row) in [(first, second - 1), (second, first)] {
                for vector in starts[class]..starts[class] + of_class[class] {
                    weights[vector * pairs.len() + pair] = coefficients[row * vectors + vector];
                }
            }
        }
        let weights = self.constant("weights", &[vectors, pairs.len()], &weights);
        let rho = self.constant("rho", &[1, pairs.len()], rho);
        let weighted = self.node("MatMul", &[&kernels, &weights], "weighted");
        if !slopes.is_empty() {
            let scores = self.node("Add", &[&weighted, &rho], "scores");
            // The probability is 1 - sigmoid(slope * score + offset).
            let negated = |values: &[f32]| values.iter().map(|value| -value).collect::<Vec<_>>();
            let slopes = self.constant("slopes", &[1, pairs.len()], &negated(slopes));
            let offsets = self.constant("offsets", &[1, pairs.len()], &negated(offsets));
            let steep = self.node("Mul", &[&scores, &slopes], "steep");
            let shifted = self.node("Add", &[&steep, &offsets], "shifted");
            let of_pairs = self.node("Sigmoid", &[&shifted], "of_pairs");
            return Ok(self.coupled(&of_pairs, &pairs, of_class.len()));
        }
        if pairs.len() == 1 {
            let score = self.node("Add", &[&weighted, &rho], "score");
            let signs = self.constant("signs", &[1, 2], &[-1.0, 1.0]);
            return Ok(self.last("Mul", &[&score, &signs]));
        }
        Ok(self.last("Add", &[&weighted, &rho]))
    }

    /// The kernel of the input with each support vector, `[1, vectors]`. `None` for an unknown kernel.
    fn kernels(&mut self, node: &pb::NodeProto, support: &[f32], vectors: usize) -> Option<String> {
        let input = &node.input[0];
        let features = support.len() / vectors;
        let &[gamma, coef0, degree] = floats(node, "kernel_params") else {
            return None;
        };
        let kind = text(node, "kernel_type");
        if kind == "RBF" {
            // exp(-gamma |x - vector|^2)
            let support = self.constant("support", &[vectors, features], support);
            let apart = self.node("Sub", &[input, &support], "apart");
            let squares = self.reduce("ReduceSumSquare", &apart, "squares");
            let minus_gamma = self.constant("minus_gamma", &[1], &[-gamma]);
            let exponents = self.node("Mul", &[&squares, &minus_gamma], "exponents");
            let row = self.indices("row", &[1, -1]);
            let exponents = self.node("Reshape", &[&exponents, &row], "exponents_row");
            return Some(self.node("Exp", &[&exponents], "kernels"));
        }
        let columns: Vec<f32> = (0..features)
            .flat_map(|feature| support.iter().skip(feature).step_by(features).copied())
            .collect();
        let support = self.constant("support", &[features, vectors], &columns);
        let products = self.node("MatMul", &[input, &support], "products");
        if matches!(kind, "" | "LINEAR") {
            return Some(products);
        }
        let gamma = self.constant("gamma", &[1], &[gamma]);
        let coef0 = self.constant("coef0", &[1], &[coef0]);
        let scaled = self.node("Mul", &[&products, &gamma], "scaled");
        let shifted = self.node("Add", &[&scaled, &coef0], "kernel_shifted");
        match kind {
            "POLY" => {
                let degree = self.constant("degree", &[1], &[degree]);
                Some(self.node("Pow", &[&shifted, &degree], "kernels"))
            }
            "SIGMOID" => Some(self.node("Tanh", &[&shifted], "kernels")),
            _ => None,
        }
    }

    /// The probabilities of the classes from those of their pairs, by the second method of Wu, Lin
    /// and Weng, "Probability estimates for multi-class classification by pairwise coupling" (2004),
    /// Algorithm 2: the minimum of `p Q p` for `p` of sum 1, class after class.
    fn coupled(&mut self, of_pairs: &str, pairs: &[(usize, usize)], classes: usize) -> bool {
        let bounds = [LEAST_OF_PAIR, 1.0 - LEAST_OF_PAIR];
        let [least, most] = [("least", bounds[0]), ("most", bounds[1])]
            .map(|(part, bound)| self.constant(part, &[], &[bound]));
        let one = self.constant("one", &[1, 1], &[1.0]);
        let firsts = self.node("Clip", &[of_pairs, &least, &most], "firsts");
        let seconds = self.node("Sub", &[&one, &firsts], "seconds");
        // `terms` [1, 3 pairs]: what the matrix Q is made of.
        let first_squares = self.node("Mul", &[&firsts, &firsts], "first_squares");
        let second_squares = self.node("Mul", &[&seconds, &seconds], "second_squares");
        let products = self.node("Mul", &[&firsts, &seconds], "pair_products");
        let terms = self.name("terms");
        let inputs = [&*first_squares, &*second_squares, &*products];
        let axis = vec![integer("axis", 1)];
        let terms = self.graph.node("Concat", &inputs, &terms, axis);
        let mut rows = Vec::new();
        for class in 0..classes {
            // Q_tt is the sum of the squares of the other's probability in each pair with t, Q_tj the
            // product of the two, negated.
            let mut chosen = vec![0.0; 3 * pairs.len() * classes];
            for (pair, &(first, second)) in pairs.iter().enumerate() {
                let mut choose = |term: usize, column: usize, value: f32| {
                    chosen[(term * pairs.len() + pair) * classes + column] = value;
                };
                if class == first {
                    choose(1, class, 1.0);
                    choose(2, second, -1.0);
                } else if class == second {
                    choose(0, class, 1.0);
                    choose(2, first, -1.0);
                }
            }
            let chosen = self.constant(
                &format!("chosen{class}"),
                &[3 * pairs.len(), classes],
                &chosen,
            );
            rows.push(self.node("MatMul", &[&terms, &chosen], &format!("row{class}")));
        }
        let matrix = self.name("matrix");
        let inputs: Vec<&str> = rows.iter().map(String::as_str).collect();
        let axis = vec![integer("axis", 0)];
        let matrix = self.graph.node("Concat", &inputs, &matrix, axis);
        let mut steps = Vec::new();
        for (class, row) in rows.into_iter().enumerate() {
            let at = self.indices(&format!("class{class}"), &[class as i64]);
            let mut unit = vec![0.0; classes];
            unit[class] = 1.0;
            let unit = self.constant(&format!("unit{class}"), &[1, classes], &unit);
            let diagonal = self.entry(&row, &at, &format!("diagonal{class}"));
            steps.push((at, unit, row, diagonal));
        }
        let error = self.constant("error", &[1, 1], &[COUPLING_ERROR / classes as f32]);
        let even = vec![1.0 / classes as f32; classes];
        let mut found = self.constant("even", &[1, classes], &even);
        for round in 0..COUPLING_ROUNDS {
            let part = |name: &str| format!("{name}.{round}");
            let mut p = found.clone();
            let mut qp = self.node("MatMul", &[&p, &matrix], &part("qp"));
            let products = self.node("Mul", &[&p, &qp], &part("p_qp"));
            let ones = self.indices(&part("axes"), &[1]);
            let mut pqp = self.node("ReduceSum", &[&products, &ones], &part("pqp"));
            let errors = self.node("Sub", &[&qp, &pqp], &part("errors"));
            let errors = self.node("Abs", &[&errors], &part("abs"));
            let greatest = self.reduce("ReduceMax", &errors, &part("greatest"));
            let is_done = self.node("Less", &[&greatest, &error], &part("done"));
            for (class, (at, unit, row, diagonal)) in steps.iter().enumerate() {
                let part = |name: &str| format!("{name}.{round}.{class}");
                let entry = self.entry(&qp, at, &part("entry"));
                let gap = self.node("Sub", &[&pqp, &entry], &part("gap"));
                let step = self.node("Div", &[&gap, diagonal], &part("step"));
                let sum = self.node("Add", &[&step, &one], &part("sum"));
                // p = (p + step e_t) / (1 + step), and so Qp and pQp.
                let moved = self.node("Mul", &[&step, unit], &part("p_step"));
                let moved = self.node("Add", &[&p, &moved], &part("p_moved"));
                p = self.node("Div", &[&moved, &sum], &part("p"));
                let both = self.node("Add", &[&pqp, &entry], &part("both"));
                let moved = self.node("Mul", &[&step, &both], &part("pqp_step"));
                let moved = self.node("Add", &[&pqp, &moved], &part("pqp_moved"));
                let moved = self.node("Div", &[&moved, &sum], &part("pqp_once"));
                pqp = self.node("Div", &[&moved, &sum], &part("pqp_twice"));
                let moved = self.node("Mul", &[&step, row], &part("qp_step"));
                let moved = self.node("Add", &[&qp, &moved], &part("qp_moved"));
                qp = self.node("Div", &[&moved, &sum], &part("qp_next"));
            }
            found = self.node("Where", &[&is_done, &found, &p], &part("found"));
        }
        self.last("Identity", &[&found])
    }

    /// One number of a row, `[1, 1]`.
    fn entry(&mut self, row: &str, at: &str, part: &str) -> String {
        let name = self.name(part);
        let axis = vec![integer("axis", 1)];
        self.graph.node("Gather", &[row, at], &name, axis)
    }
}

pub(super) fn attribute<'a>(node: &'a pb::NodeProto, name: &str) -> Option<&'a pb::AttributeProto> {
    node.attribute.iter().find(|found| found.name == name)
}

fn floats<'a>(node: &'a pb::NodeProto, name: &str) -> &'a [f32] {
    attribute(node, name).map_or(&[], |found| &found.floats)
}

fn text<'a>(node: &'a pb::NodeProto, name: &str) -> &'a str {
    attribute(node, name).map_or("", |found| str::from_utf8(&found.s).unwrap_or("?"))
}

#[cfg(test)]
mod tests {
    use tract_onnx::prelude::*;

    use super::*;
    use crate::net::graph::{Graph, model, number, value_info};
    use hardnessd_core::verdict::MIN_OPSET;

    fn floats_attribute(name: &str, values: &[f32]) -> pb::AttributeProto {
        pb::AttributeProto {
            name: name.to_owned(),
            r#type: pb::attribute_proto::AttributeType::Floats as i32,
            floats: values.to_vec(),
            ..Default::default()
        }
    }

    fn text_attribute(name: &str, value: &str) -> pb::AttributeProto {
        pb::AttributeProto {
            name: name.to_owned(),
            r#type: pb::attribute_proto::AttributeType::String as i32,
            s: value.into(),
            ..Default::default()
        }
    }

    fn texts_attribute(name: &str, values: &[&str]) -> pb::AttributeProto {
        pb::AttributeProto {
            name: name.to_owned(),
            r#type: pb::attribute_proto::AttributeType::Strings as i32,
            strings: values.iter().map(|&value| value.into()).collect(),
            ..Default::default()
        }
    }

    /// A node of `ai.onnx.ml` from `x` to `y`.
    fn learner(
        operator: &str,
        outputs: &[&str],
        attribute: Vec<pb::AttributeProto>,
    ) -> pb::NodeProto {
        pb::NodeProto {
            op_type: operator.to_owned(),
            domain: LEARNERS.to_owned(),
            input: vec!["x".to_owned()],
            output: outputs.iter().map(|&output| output.to_owned()).collect(),
            attribute,
            ..Default::default()
        }
    }

    /// What the inference library computes for `y` of length `length` once `nodes` are replaced. The
    /// constants are `t`, numbers, and `which`, indices.
    fn run(nodes: &[pb::NodeProto], opset: i64, x: &[f32], length: usize) -> Vec<f32> {
        let mut graph = Graph::default();
        graph.constant("t", &[3], &[0.1, 0.7, 0.2]);
        graph.indices("which", &[2, 0]);
        for node in nodes {
            graph.push(node.clone());
        }
        let inputs = vec![value_info("x", &[1, x.len()])];
        let outputs = vec![value_info("y", &[1, length])];
        let mut proto = model(graph, inputs, outputs, Vec::new());
        proto.opset_import[0].version = opset;
        replace(proto.graph.as_mut().unwrap(), opset).unwrap();
        let plan = tract_onnx::onnx()
            .model_for_proto_model(&proto)
            .and_then(|model| model.with_input_fact(0, f32::fact([1, x.len()]).into()))
            .and_then(InferenceModelExt::into_optimized)
            .and_then(IntoRunnable::into_runnable)
            .unwrap();
        let input = Tensor::from_shape(&[1, x.len()], x).unwrap();
        let outputs = plan.run(tvec!(input.into())).unwrap();
        assert_eq!(outputs[0].shape(), [1, length]);
        let output = outputs[0].try_as_plain_ram().unwrap();
        output.as_slice::<f32>().unwrap().to_vec()
    }

    fn assert_near(found: &[f32], expected: &[f64]) {
        assert_eq!(found.len(), expected.len());
        for (found_one, expected_one) in found.iter().zip(expected) {
            let difference = (f64::from(*found_one) - expected_one).abs();
            assert!(difference < 1e-5, "{found:?}, {expected:?}");
        }
    }

    #[test]
    fn simple_steps_compute_what_onnxruntime_does() {
        let x = [-4.0, 0.5, 2.0];
        let scaler = [
            floats_attribute("offset", &[1.0]),
            floats_attribute("scale", &[2.0, 3.0, 4.0]),
        ];
        let of_columns = |which: &str| pb::NodeProto {
            input: vec!["x".to_owned(), which.to_owned()],
            ..learner("ArrayFeatureExtractor", &["y"], Vec::new())
        };
        for opset in [MIN_OPSET, 18] {
            for (node, expected) in [
                (
                    learner("Scaler", &["y"], scaler.to_vec()),
                    &[-10.0, -1.5, 4.0][..],
                ),
                (
                    learner("Binarizer", &["y"], vec![number("threshold", 0.5)]),
                    &[0.0, 0.0, 1.0],
                ),
                // The greatest number, not the greatest absolute one.
                (
                    learner("Normalizer", &["y"], vec![text_attribute("norm", "MAX")]),
                    &[-2.0, 0.25, 1.0],
                ),
                (of_columns("which"), &[2.0, -4.0]),
            ] {
                assert_near(&run(&[node], opset, &x, expected.len()), expected);
            }
        }
        assert_near(
            &run(
                &[learner(
                    "Normalizer",
                    &["y"],
                    vec![text_attribute("norm", "MAX")],
                )],
                MIN_OPSET,
                &[0.0, -1.0, -2.0],
                3,
            ),
            &[0.0, -1.0, -2.0],
        );
    }

    #[test]
    fn a_sum_of_powers_neither_overflows_nor_vanishes() {
        let node = pb::NodeProto {
            op_type: "ReduceLogSumExp".to_owned(),
            input: vec!["x".to_owned()],
            output: vec!["y".to_owned()],
            attribute: vec![integers("axes", &[1]), integer("keepdims", 1)],
            ..Default::default()
        };
        for shift in [-1000.0_f32, 0.0, 1000.0] {
            let x = [shift, shift + 1.0];
            let expected = f64::from(shift) + (1.0 + 1_f64.exp()).ln();
            let found = run(std::slice::from_ref(&node), MIN_OPSET, &x, 1)[0];
            assert!(
                (f64::from(found) - expected).abs() < 1e-4,
                "{found}, {expected}"
            );
        }
    }

    #[test]
    fn an_index_that_depends_on_the_input_becomes_a_product() {
        let least = pb::NodeProto {
            op_type: "ArgMin".to_owned(),
            input: vec!["x".to_owned()],
            output: vec!["at".to_owned()],
            attribute: vec![integer("axis", 1)],
            ..Default::default()
        };
        let found = pb::NodeProto {
            input: vec!["t".to_owned(), "at".to_owned()],
            ..learner("ArrayFeatureExtractor", &["y"], Vec::new())
        };
        let nodes = [least, found];
        for (x, expected) in [
            ([1.0, 2.0, 3.0], 0.1),
            ([1.0, 0.0, 3.0], 0.7),
            ([1.0, 2.0, 0.0], 0.2),
        ] {
            assert_near(&run(&nodes, MIN_OPSET, &x, 1), &[expected]);
        }
    }

    /// A small SVC of three classes with two, one and two support vectors of two numbers.
    fn svc(kernel: &str, probabilities: bool) -> Vec<pb::AttributeProto> {
        let mut attributes = vec![
            integers("vectors_per_class", &[2, 1, 2]),
            floats_attribute("support_vectors", &SUPPORT),
            floats_attribute("coefficients", &COEFFICIENTS),
            floats_attribute("rho", &RHO),
            floats_attribute("kernel_params", &[0.5, 0.25, 3.0]),
            text_attribute("kernel_type", kernel),
            integers("classlabels_ints", &[1, 2, 3]),
        ];
        if probabilities {
            attributes.push(floats_attribute("prob_a", &PROB_A));
            attributes.push(floats_attribute("prob_b", &PROB_B));
        }
        attributes
    }

    const SUPPORT: [f32; 10] = [0.0, 1.0, 1.0, 0.5, -1.0, 0.25, 2.0, -1.0, 0.5, 0.75];
    const COEFFICIENTS: [f32; 10] = [1.0, 0.5, -1.5, -0.5, -0.75, 0.25, 1.0, 0.5, -1.0, -0.25];
    const RHO: [f32; 3] = [0.1, -0.2, 0.3];
    const PROB_A: [f32; 3] = [-2.0, -1.5, -0.5];
    const PROB_B: [f32; 3] = [0.1, 0.2, -0.3];

    /// The scores of the pairs 0-1, 0-2 and 1-2, as libsvm defines them.
    fn scores(kernel: &str, x: [f32; 2]) -> [f64; 3] {
        let kernels: Vec<f64> = SUPPORT
            .chunks(2)
            .map(|vector| {
                let terms = x
                    .iter()
                    .zip(vector)
                    .map(|(&x, &v)| (f64::from(x), f64::from(v)));
                let product: f64 = terms.clone().map(|(x, v)| x * v).sum();
                match kernel {
                    "RBF" => (-0.5 * terms.map(|(x, v)| (x - v).powi(2)).sum::<f64>()).exp(),
                    "POLY" => (0.5 * product + 0.25).powi(3),
                    "SIGMOID" => (0.5 * product + 0.25).tanh(),
                    _ => product,
                }
            })
            .collect();
        let of_class = [0..2, 2..3, 3..5];
        [(0, 1), (0, 2), (1, 2)].map(|(i, j): (usize, usize)| {
            let weighted = |row: usize, class: usize| -> f64 {
                let vectors = of_class[class].clone();
                let weighted = vectors.map(|m| f64::from(COEFFICIENTS[row * 5 + m]) * kernels[m]);
                weighted.sum()
            };
            weighted(j - 1, i) + weighted(i, j) + f64::from(RHO[i + j - 1])
        })
    }

    #[test]
    fn an_svc_scores_its_pairs_as_libsvm() {
        for kernel in ["LINEAR", "POLY", "RBF", "SIGMOID"] {
            for x in [[0.0, 0.0], [1.5, -0.5], [-2.0, 3.0]] {
                let node = learner("SVMClassifier", &["label", "y"], svc(kernel, false));
                assert_near(&run(&[node], MIN_OPSET, &x, 3), &scores(kernel, x));
            }
        }
    }

    /// libsvm's coupling of the probabilities of pairs, with its stop.
    fn coupled(of_pairs: [f64; 3]) -> [f64; 3] {
        let mut r = [[0.0; 3]; 3];
        for ((i, j), value) in [(0, 1), (0, 2), (1, 2)].into_iter().zip(of_pairs) {
            r[i][j] = value.clamp(1e-7, 1.0 - 1e-7);
            r[j][i] = 1.0 - r[i][j];
        }
        let mut q = [[0.0; 3]; 3];
        for t in 0..3 {
            for j in (0..3).filter(|&j| j != t) {
                q[t][t] += r[j][t] * r[j][t];
                q[t][j] = -r[j][t] * r[t][j];
            }
        }
        let mut p = [1.0 / 3.0; 3];
        for _ in 0..100 {
            let qp = q.map(|row| row.iter().zip(p).map(|(q, p)| q * p).sum::<f64>());
            let pqp: f64 = p.iter().zip(qp).map(|(p, qp)| p * qp).sum();
            if qp.iter().all(|qp| (qp - pqp).abs() < 0.005 / 3.0) {
                break;
            }
            for t in 0..3 {
                let qp_t: f64 = q[t].iter().zip(p).map(|(q, p)| q * p).sum();
                let pqp: f64 = (0..3)
                    .map(|i| p[i] * q[i].iter().zip(p).map(|(q, p)| q * p).sum::<f64>())
                    .sum();
                p[t] += (pqp - qp_t) / q[t][t];
                let sum: f64 = p.iter().sum();
                p = p.map(|p| p / sum);
            }
        }
        p
    }

    #[test]
    fn an_svc_couples_the_probabilities_of_its_pairs_as_libsvm() {
        for opset in [MIN_OPSET, 18] {
            for x in [[0.0, 0.0], [1.5, -0.5], [-2.0, 3.0], [9.0, 9.0]] {
                let node = learner("SVMClassifier", &["label", "y"], svc("LINEAR", true));
                let mut of_pairs = scores("LINEAR", x);
                for (pair, value) in of_pairs.iter_mut().enumerate() {
                    let steep = *value * f64::from(PROB_A[pair]) + f64::from(PROB_B[pair]);
                    *value = 1.0 / (1.0 + steep.exp());
                }
                assert_near(&run(&[node], opset, &x, 3), &coupled(of_pairs));
            }
        }
    }

    #[test]
    fn a_broken_learner_is_refused_or_left_as_it_is() {
        let replaced = |node: pb::NodeProto| {
            let mut graph = pb::GraphProto {
                node: vec![node],
                ..Default::default()
            };
            replace(&mut graph, MIN_OPSET).map_err(|error| error.to_string())
        };
        let without_input = pb::NodeProto {
            input: Vec::new(),
            ..learner("Scaler", &["y"], Vec::new())
        };
        assert_eq!(replaced(without_input), Ok(Vec::new()));
        let svc_with = |changed: pb::AttributeProto| {
            let mut attributes = svc("RBF", true);
            attributes.retain(|found| found.name != changed.name);
            attributes.push(changed);
            replaced(learner("SVMClassifier", &["label", "y"], attributes)).unwrap_err()
        };
        for changed in [
            integers("vectors_per_class", &[]),
            integers("vectors_per_class", &[i64::MAX, i64::MAX, 1]),
            integers("vectors_per_class", &[-1, 4, 2]),
            floats_attribute("support_vectors", &[1.0]),
            floats_attribute("coefficients", &[]),
            floats_attribute("prob_a", &[1.0]),
        ] {
            let found = svc_with(changed);
            assert_eq!(found, "operator SVMClassifier: its lists differ in length");
        }
        let many = svc_with(integers("vectors_per_class", &[1; 33]));
        assert!(many.contains("more than 32 classes"), "{many}");
        let kernel = svc_with(text_attribute("kernel_type", "COSINE"));
        assert!(kernel.contains("`kernel_type`"), "{kernel}");
    }

    /// One tree of two leaves that votes for one score of two classes.
    fn two_classes(post_transform: &str, weights: [f32; 2], base: &[f32]) -> pb::NodeProto {
        let attributes = vec![
            integers("nodes_treeids", &[0, 0, 0]),
            integers("nodes_nodeids", &[0, 1, 2]),
            integers("nodes_featureids", &[0, 0, 0]),
            integers("nodes_truenodeids", &[1, 0, 0]),
            integers("nodes_falsenodeids", &[2, 0, 0]),
            floats_attribute("nodes_values", &[0.5, 0.0, 0.0]),
            texts_attribute("nodes_modes", &["BRANCH_LEQ", "LEAF", "LEAF"]),
            integers("class_treeids", &[0, 0]),
            integers("class_nodeids", &[1, 2]),
            integers("class_ids", &[0, 0]),
            floats_attribute("class_weights", &weights),
            floats_attribute("base_values", base),
            texts_attribute("classlabels_strings", &["hard", "soft"]),
            text_attribute("post_transform", post_transform),
        ];
        learner("TreeEnsembleClassifier", &["label", "y"], attributes)
    }

    #[test]
    fn trees_of_two_classes_with_texts_share_a_score() {
        let logistic = |score: f64| 1.0 / (1.0 + (-score).exp());
        for (x, score) in [(0.0, 0.25 - 2.0), (1.0, 0.25 + 3.0)] {
            let found = run(
                &[two_classes("LOGISTIC", [-2.0, 3.0], &[0.25])],
                MIN_OPSET,
                &[x],
                2,
            );
            assert_near(&found, &[logistic(-score), logistic(score)]);
        }
        let found = run(
            &[two_classes("NONE", [0.25, 0.75], &[0.0])],
            MIN_OPSET,
            &[1.0],
            2,
        );
        assert_near(&found, &[0.25, 0.75]);
        for (transform, weights, base) in [
            ("LOGISTIC", [2.0, 3.0], &[0.25][..]),
            ("LOGISTIC", [-2.0, 3.0], &[0.25, 0.25]),
            ("NONE", [-0.25, 0.75], &[]),
            ("SOFTMAX", [-0.25, 0.75], &[]),
        ] {
            let mut graph = pb::GraphProto {
                node: vec![two_classes(transform, weights, base)],
                ..Default::default()
            };
            let refused = replace(&mut graph, MIN_OPSET).unwrap_err().to_string();
            assert!(refused.contains("runtimes disagree"), "{refused}");
        }
    }
}
