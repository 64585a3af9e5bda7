//! Replaces support vector classifiers.
//!
//! In: a node `SVMClassifier`. Out: plain nodes for its kernel, the scores of the pairs of classes
//! and the probabilities that libsvm couples from them.

use tract_onnx::pb;

use super::{Learner, Plain, attribute, floats, text};
use crate::net::graph::integer;

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

impl Plain {
    /// A support vector classifier: a score for each pair of classes, and their probabilities if it
    /// has been fitted with `probability=True`.
    pub(super) fn svm(&mut self, node: &pb::NodeProto) -> Result<bool, Learner> {
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
