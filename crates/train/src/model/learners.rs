//! Replaces the operators of classic learners that the daemon does not run, or not as onnxruntime.
//!
//! In: the nodes of a graph as skl2onnx writes them. Out: nodes of plain ONNX that compute the same
//! as onnxruntime. Other nodes stay as they are: the daemon's loader decides about those.

mod svm;

use tract_onnx::pb;

use crate::net::graph::{Graph, integer, integers};

/// The domain of ONNX's classic learners.
pub(super) const LEARNERS: &str = "ai.onnx.ml";

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
    let mut replaced = normalise(graph);
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

/// Puts a softmax in place of `exp(x - log(sum(exp(x))))`, as naive Bayes computes it. Its `x` are sums
/// of hundreds of logarithms. What f32 loses of the difference scales all probabilities, so that they
/// do not add up to 1. Returns the operators that it replaced.
fn normalise(graph: &mut pb::GraphProto) -> Vec<String> {
    let by = |name: &str| {
        let mut nodes = graph.node.iter();
        nodes.find(|node| node.output.first().is_some_and(|output| output == name))
    };
    let axis_of = |sum: &pb::NodeProto| {
        let stated = attribute(sum, "axes").map(|found| found.ints.clone());
        let axes = stated.or_else(|| {
            let name = sum.input.get(1)?;
            let tensor = graph.initializer.iter().find(|found| found.name == *name)?;
            let raw = tensor.raw_data.as_chunks().0.iter();
            let raw = raw.map(|bytes| i64::from_le_bytes(*bytes));
            Some(tensor.int64_data.iter().copied().chain(raw).collect())
        });
        <[i64; 1]>::try_from(axes?).ok().map(|[axis]| axis)
    };
    let softmax_of = |node: &pb::NodeProto| {
        let [difference] = &node.input[..] else {
            return None;
        };
        let difference = by(difference).filter(|node| node.op_type == "Sub")?;
        let [x, subtracted] = &difference.input[..] else {
            return None;
        };
        let mut sum = by(subtracted)?;
        if sum.op_type == "Reshape" {
            sum = by(sum.input.first()?)?;
        }
        let is_of_x = sum.op_type == "ReduceLogSumExp" && sum.input.first() == Some(x);
        is_of_x.then(|| Some((x.clone(), axis_of(sum)?)))?
    };
    let found: Vec<(usize, (String, i64))> = (graph.node.iter().enumerate())
        .filter(|(_, node)| node.op_type == "Exp")
        .filter_map(|(place, node)| Some((place, softmax_of(node)?)))
        .collect();
    let replaced = found.first().map(|_| "ReduceLogSumExp".to_owned());
    for (place, (x, axis)) in found {
        let node = &mut graph.node[place];
        "Softmax".clone_into(&mut node.op_type);
        node.input = vec![x];
        node.attribute = vec![integer("axis", axis)];
    }
    replaced.into_iter().collect()
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
mod tests;
