//! The trivial baseline: multinomial logistic regression on 18 hand-made features of a frame.
//!
//! What it reaches is what area, force and spread alone tell, and every table carries it. The
//! features are nodes of the exported graph, and training computes them by running that graph:
//! there is no second definition to disagree with.

use anyhow::Context as _;
use tract_onnx::pb;

use super::onnx::{self, Graph};
use crate::frame::{COLS, Frame, ROWS, TAXELS};
use crate::press;

/// Features of a frame.
pub const FEATURES: usize = 18;
/// Thresholds, beside the contact threshold, above which taxels are counted, in newtons.
const AREA_THRESHOLDS_N: [f32; 4] = [0.2, 0.5, 1.0, 2.0];
/// Keeps logarithms and quotients of an empty frame finite; far below one count of 0.04 N.
const TINY: f32 = 1e-4;
/// Weight of the squared coefficients beside the mean loss. It keeps Newton's method solvable
/// where two features say the same, and is too small to matter otherwise.
const RIDGE: f64 = 1e-4;

/// Builds the features' nodes one by one.
struct Builder {
    graph: Graph,
    columns: Vec<String>,
}

impl Builder {
    fn scalar(&mut self, value: f32) -> String {
        self.graph
            .constant(&format!("constant:{value}"), &[], &[value])
    }

    fn node(&mut self, op: &str, inputs: &[&str], output: &str) -> String {
        self.graph.node(op, inputs, output, Vec::new())
    }

    /// Sum over all taxels, `[1, 1]`.
    fn sum(&mut self, x: &str, output: &str) -> String {
        self.graph.node(
            "ReduceSum",
            &[x, "taxel axes"],
            output,
            vec![onnx::integer("keepdims", 0)],
        )
    }

    /// Adds log(x + tiny) as a feature.
    fn log_feature(&mut self, x: &str) {
        let raised = self.node("Add", &[x, "tiny"], &format!("{x} + tiny"));
        let log = self.node("Log", &[&raised], &format!("log {x}"));
        self.columns.push(log);
    }

    /// `x / (y + tiny)`.
    fn quotient(&mut self, x: &str, y: &str, output: &str) -> String {
        let raised = self.node("Add", &[y, "tiny"], &format!("{output} divisor"));
        self.node("Div", &[x, &raised], output)
    }

    /// Taxels of at least `threshold` as 1, others 0.
    fn mask(&mut self, threshold_n: f32) -> String {
        let threshold = self.scalar(threshold_n);
        let name = format!("at least {threshold_n}");
        let at_least = self.node(
            "GreaterOrEqual",
            &[onnx::INPUT, &threshold],
            &format!("{name}?"),
        );
        let to = onnx::integer("to", pb::tensor_proto::DataType::Float as i64);
        self.graph.node("Cast", &[&at_least], &name, vec![to])
    }

    /// Sum of |differences| of neighbours along rows and columns.
    fn variation(&mut self, x: &str, output: &str) -> String {
        let mut along = |kernel: &str, direction: &str| {
            let name = format!("{output} {direction}");
            let differences = self.node("Conv", &[x, kernel], &format!("{name} differences"));
            let sizes = self.node("Abs", &[&differences], &format!("{name} sizes"));
            self.sum(&sizes, &name)
        };
        let (down, right) = (along("down", "down"), along("right", "right"));
        self.node("Add", &[&down, &right], output)
    }

    /// Second moments of `weights` about their centroid: adds log of their trace, and anisotropy
    /// 0 (round) to 1 (a line), as features. Gives the trace and squared distances.
    fn spread(&mut self, weights: &str, total: &str) -> (String, String) {
        let mut centred = Vec::new();
        for axis in ["row", "column"] {
            let product = self.node("Mul", &[weights, axis], &format!("{weights} x {axis}"));
            let sum = self.sum(&product, &format!("sum of {weights} x {axis}"));
            let centre = self.quotient(&sum, total, &format!("{axis} of {weights}"));
            centred.push(self.node("Sub", &[axis, &centre], &format!("{axis} - {centre}")));
        }
        let mut moment = |left: usize, right: usize, name: &str| {
            let square = self.node(
                "Mul",
                &[&centred[left], &centred[right]],
                &format!("{name} arm"),
            );
            let weighted = self.node("Mul", &[weights, &square], &format!("{name} weighted"));
            let sum = self.sum(&weighted, &format!("{name} sum"));
            (square, self.quotient(&sum, total, name))
        };
        let (rows_square, rr) = moment(0, 0, &format!("rr of {weights}"));
        let (columns_square, cc) = moment(1, 1, &format!("cc of {weights}"));
        let (_, rc) = moment(0, 1, &format!("rc of {weights}"));
        let trace = self.node("Add", &[&rr, &cc], &format!("spread of {weights}"));
        self.log_feature(&trace);

        // anisotropy = sqrt((rr - cc)^2 + 4 rc^2) / (rr + cc)
        let difference = self.node("Sub", &[&rr, &cc], &format!("rr - cc of {weights}"));
        let left = self.node(
            "Mul",
            &[&difference, &difference],
            &format!("{difference} squared"),
        );
        let twice = self.node("Add", &[&rc, &rc], &format!("2 rc of {weights}"));
        let right = self.node("Mul", &[&twice, &twice], &format!("{twice} squared"));
        let sum = self.node(
            "Add",
            &[&left, &right],
            &format!("discriminant of {weights}"),
        );
        let root = self.node("Sqrt", &[&sum], &format!("eccentricity of {weights}"));
        let anisotropy = self.quotient(&root, &trace, &format!("anisotropy of {weights}"));
        self.columns.push(anisotropy);
        let squares = self.node(
            "Add",
            &[&rows_square, &columns_square],
            &format!("arm of {weights}"),
        );
        (trace, squares)
    }
}

/// The graph from newtons to features `[1, FEATURES]`, and their name.
fn feature_graph() -> (Graph, String) {
    let mut b = Builder {
        graph: Graph::default(),
        columns: Vec::new(),
    };
    b.graph.indices("taxel axes", &[2, 3]);
    b.graph.constant("tiny", &[], &[TINY]);
    let coordinate = |of: fn(usize) -> usize| -> Vec<f32> {
        (0..TAXELS).map(|index| of(index) as f32).collect()
    };
    b.graph.constant(
        "row",
        &[1, 1, ROWS, COLS],
        &coordinate(|index| index / COLS),
    );
    b.graph.constant(
        "column",
        &[1, 1, ROWS, COLS],
        &coordinate(|index| index % COLS),
    );
    b.graph.constant("down", &[1, 1, 2, 1], &[-1.0, 1.0]);
    b.graph.constant("right", &[1, 1, 1, 2], &[-1.0, 1.0]);

    // Areas: 5.
    let contact = b.mask(press::Settings::default().contact_threshold_n);
    let area = b.sum(&contact, "area");
    b.log_feature(&area);
    for threshold_n in AREA_THRESHOLDS_N {
        let mask = b.mask(threshold_n);
        let count = b.sum(&mask, &format!("area of {threshold_n}"));
        // Often 0: log(1 + count), not log(tiny).
        let one = b
            .graph
            .constant(&format!("one for {threshold_n}"), &[], &[1.0]);
        let raised = b.node("Add", &[&count, &one], &format!("{count} + 1"));
        let log = b.node("Log", &[&raised], &format!("log of {count}"));
        b.columns.push(log);
    }

    // Force, peak, mean, peak's share: 4.
    let pressed = b.node("Mul", &[onnx::INPUT, &contact], "pressed");
    let force = b.sum(&pressed, "force");
    b.log_feature(&force);
    let options = vec![
        onnx::integers("axes", &[2, 3]),
        onnx::integer("keepdims", 0),
    ];
    let peak = b.graph.node("ReduceMax", &[&pressed], "peak", options);
    b.log_feature(&peak);
    let mean = b.quotient(&force, &area, "mean");
    b.log_feature(&mean);
    let share = b.quotient(&peak, &force, "peak share");
    b.columns.push(share);

    // Effective area F^2 / sum p^2: 1.
    let squares = b.node("Mul", &[&pressed, &pressed], "pressed squared");
    let energy = b.sum(&squares, "energy");
    let force_squared = b.node("Mul", &[&force, &force], "force squared");
    let effective_area = b.quotient(&force_squared, &energy, "effective area");
    b.log_feature(&effective_area);

    // Second moments of force and of contact: 4. Fourth over second squared: 1.
    let (spread, arm) = b.spread(&pressed, &force);
    let (contact_spread, _) = b.spread(&contact, &area);
    let arm_squared = b.node("Mul", &[&arm, &arm], "arm squared");
    let weighted = b.node("Mul", &[&pressed, &arm_squared], "fourth weighted");
    let sum = b.sum(&weighted, "fourth sum");
    let fourth = b.quotient(&sum, &force, "fourth");
    let spread_squared = b.node("Mul", &[&spread, &spread], "spread squared");
    let tails = b.quotient(&fourth, &spread_squared, "tails");
    b.log_feature(&tails);

    // Roughness: variation of force and of contact, each by its size: 2. How far the force
    // reaches beside the contact: 1.
    let variation = b.variation(&pressed, "variation");
    let roughness = b.quotient(&variation, &force, "roughness");
    b.columns.push(roughness);
    let border = b.variation(&contact, "border");
    let raggedness = b.quotient(&border, &area, "raggedness");
    b.columns.push(raggedness);
    let reach = b.quotient(&spread, &contact_spread, "reach");
    b.columns.push(reach);

    assert_eq!(
        b.columns.len(),
        FEATURES,
        "the features are those listed above"
    );
    let columns: Vec<&str> = b.columns.iter().map(String::as_str).collect();
    let features = b.graph.node(
        "Concat",
        &columns,
        "features",
        vec![onnx::integer("axis", 1)],
    );
    (b.graph, features)
}

/// A fitted baseline.
#[derive(Debug, Clone, PartialEq)]
pub struct Baseline {
    /// Mean of each feature over the training samples.
    mean: Vec<f64>,
    /// Standard deviation of each.
    deviation: Vec<f64>,
    /// `[L][FEATURES + 1]`: a coefficient each, and the bias.
    coefficients: Vec<Vec<f64>>,
    /// Newton steps that the fit took.
    pub steps: u32,
    /// Mean loss on the training samples, and the ridge.
    pub loss: f64,
}

/// The features of every frame, a row each.
///
/// # Errors
///
/// If the graph cannot be run.
pub fn features<'a>(frames: impl Iterator<Item = &'a Frame>) -> anyhow::Result<Vec<Vec<f32>>> {
    let (graph, features) = feature_graph();
    let plan = onnx::Plan::new(graph, &features, &[1, FEATURES]).context("features")?;
    frames.map(|frame| plan.run(frame)).collect()
}

/// Mean and standard deviation of each feature over `rows`.
pub fn moments(rows: &[Vec<f32>]) -> (Vec<f64>, Vec<f64>) {
    let n = rows.len() as f64;
    let column = |index: usize| rows.iter().map(move |row| f64::from(row[index]));
    let mean: Vec<f64> = (0..FEATURES)
        .map(|index| column(index).sum::<f64>() / n)
        .collect();
    let deviation: Vec<f64> = (0..FEATURES)
        .map(|index| {
            let squares = column(index).map(|x| (x - mean[index]).powi(2));
            // A feature that never varies is no divisor.
            (squares.sum::<f64>() / n).sqrt().max(1e-6)
        })
        .collect();
    (mean, deviation)
}

impl Baseline {
    /// Fits by Newton's method: rows of features with their level, from 0.
    pub fn fit(rows: &[Vec<f32>], level_of: &[usize], levels: usize) -> Self {
        let (mean, deviation) = moments(rows);
        let coefficients = vec![vec![0.0; FEATURES + 1]; levels];
        let mut baseline = Self {
            mean,
            deviation,
            coefficients,
            steps: 0,
            loss: 0.0,
        };
        let rows: Vec<Vec<f64>> = rows.iter().map(|row| baseline.standardised(row)).collect();

        baseline.loss = baseline.loss_on(&rows, level_of);
        for _ in 0..50 {
            let step = baseline.newton_step(&rows, level_of);
            // Halve until the loss falls: far from the optimum a whole step may overshoot.
            let mut share = 1.0;
            let next = loop {
                let mut next = baseline.moved(&step, share);
                next.loss = next.loss_on(&rows, level_of);
                if next.loss < baseline.loss {
                    break Some(next);
                }
                share /= 2.0;
                if share < 1e-6 {
                    break None;
                }
            };
            let Some(next) = next else { break };
            let gain = baseline.loss - next.loss;
            baseline = next;
            baseline.steps += 1;
            if gain < 1e-9 {
                break;
            }
        }
        baseline
    }

    /// Features less mean over deviation, and a 1 for the bias.
    fn standardised(&self, row: &[f32]) -> Vec<f64> {
        let one = |((x, mean), deviation): ((&f32, &f64), &f64)| (f64::from(*x) - mean) / deviation;
        row.iter()
            .zip(&self.mean)
            .zip(&self.deviation)
            .map(one)
            .chain([1.0])
            .collect()
    }

    fn probabilities_of(&self, row: &[f64]) -> Vec<f64> {
        let logits: Vec<f64> = self
            .coefficients
            .iter()
            .map(|level| level.iter().zip(row).map(|(c, x)| c * x).sum())
            .collect();
        let top = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let shares: Vec<f64> = logits.iter().map(|logit| (logit - top).exp()).collect();
        let sum: f64 = shares.iter().sum();
        shares.iter().map(|share| share / sum).collect()
    }

    /// Probabilities of the levels for one row of features.
    pub fn probabilities(&self, row: &[f32]) -> Vec<f32> {
        let probabilities = self.probabilities_of(&self.standardised(row));
        probabilities.into_iter().map(|p| p as f32).collect()
    }

    /// Mean cross-entropy and the ridge.
    fn loss_on(&self, rows: &[Vec<f64>], level_of: &[usize]) -> f64 {
        let losses = rows
            .iter()
            .zip(level_of)
            .map(|(row, &level)| -self.probabilities_of(row)[level].ln());
        let squares: f64 = self.coefficients.iter().flatten().map(|c| c * c).sum();
        losses.sum::<f64>() / rows.len() as f64 + 0.5 * RIDGE * squares
    }

    /// Gradient and Hessian of the loss, solved for the step downhill.
    fn newton_step(&self, rows: &[Vec<f64>], level_of: &[usize]) -> Vec<f64> {
        let (levels, width) = (self.coefficients.len(), FEATURES + 1);
        let size = levels * width;
        let flat: Vec<f64> = self.coefficients.concat();
        let mut gradient: Vec<f64> = flat.iter().map(|c| RIDGE * c).collect();
        let mut hessian = vec![vec![0.0; size]; size];
        for (index, row) in hessian.iter_mut().enumerate() {
            row[index] = RIDGE;
        }
        let n = rows.len() as f64;
        for (row, &level) in rows.iter().zip(level_of) {
            let p = self.probabilities_of(row);
            for a in 0..levels {
                let residual = (p[a] - f64::from(u8::from(a == level))) / n;
                for i in 0..width {
                    gradient[a * width + i] += residual * row[i];
                }
                for b in 0..=a {
                    let curvature = p[a] * (f64::from(u8::from(a == b)) - p[b]) / n;
                    for i in 0..width {
                        let scaled = curvature * row[i];
                        let target = &mut hessian[a * width + i][b * width..][..width];
                        target
                            .iter_mut()
                            .zip(row)
                            .for_each(|(h, x)| *h += scaled * x);
                    }
                }
            }
        }
        solve(hessian, gradient)
    }

    fn moved(&self, step: &[f64], share: f64) -> Self {
        let mut moved = self.clone();
        let coefficients = moved.coefficients.iter_mut().flatten();
        coefficients.zip(step).for_each(|(c, s)| *c -= share * s);
        moved
    }

    /// The graph from newtons to logits, and the logits' name. Standardisation is inside.
    pub fn graph(&self) -> (Graph, String) {
        let (mut graph, features) = feature_graph();
        let levels = self.coefficients.len();
        let narrow = |values: &[f64]| values.iter().map(|&v| v as f32).collect::<Vec<f32>>();
        let mean = graph.constant("mean of features", &[1, FEATURES], &narrow(&self.mean));
        let deviation = graph.constant(
            "deviation of features",
            &[1, FEATURES],
            &narrow(&self.deviation),
        );
        let centred = graph.node("Sub", &[&features, &mean], "centred", Vec::new());
        let standard = graph.node("Div", &[&centred, &deviation], "standardised", Vec::new());
        let matrix: Vec<f64> = (0..FEATURES)
            .flat_map(|feature| self.coefficients.iter().map(move |level| level[feature]))
            .collect();
        let bias: Vec<f64> = self
            .coefficients
            .iter()
            .map(|level| level[FEATURES])
            .collect();
        let matrix = graph.constant("matrix", &[FEATURES, levels], &narrow(&matrix));
        let bias = graph.constant("bias", &[levels], &narrow(&bias));
        let logits = graph.node(
            "Gemm",
            &[&standard, &matrix, &bias],
            "raw_logits",
            Vec::new(),
        );
        (graph, logits)
    }
}

/// Solves `matrix x = right` by Cholesky's decomposition; only the lower triangle is read, and the
/// matrix is positive definite because of the ridge.
fn solve(mut matrix: Vec<Vec<f64>>, mut right: Vec<f64>) -> Vec<f64> {
    let n = right.len();
    for i in 0..n {
        for j in 0..=i {
            let known: f64 = (0..j).map(|k| matrix[i][k] * matrix[j][k]).sum();
            let rest = matrix[i][j] - known;
            matrix[i][j] = if i == j {
                rest.sqrt()
            } else {
                rest / matrix[j][j]
            };
        }
    }
    for i in 0..n {
        let known: f64 = (0..i).map(|k| matrix[i][k] * right[k]).sum();
        right[i] = (right[i] - known) / matrix[i][i];
    }
    for i in (0..n).rev() {
        let known: f64 = (i + 1..n).map(|k| matrix[k][i] * right[k]).sum();
        right[i] = (right[i] - known) / matrix[i][i];
    }
    right
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn features_follow_their_names() {
        // Two taxels of 1 N and 3 N, side by side in row 4.
        let mut frame = Frame::default();
        frame.newtons[4 * COLS + 10] = 1.0;
        frame.newtons[4 * COLS + 11] = 3.0;
        let row = &features([&frame].into_iter()).unwrap()[0];
        let expected = [
            2.0_f32.ln(),                  // area
            3.0_f32.ln(),                  // 1 + area at 0.2 N
            3.0_f32.ln(),                  // 1 + area at 0.5 N
            3.0_f32.ln(),                  // 1 + area at 1 N
            2.0_f32.ln(),                  // 1 + area at 2 N
            4.0_f32.ln(),                  // force
            3.0_f32.ln(),                  // peak
            2.0_f32.ln(),                  // mean
            0.75,                          // peak's share
            1.6_f32.ln(),                  // effective area: 16 / 10
            (0.1875_f32).ln(),             // spread of force: 0.25 x 0.75
            1.0,                           // on a line
            0.25_f32.ln(),                 // spread of contact
            1.0,                           // on a line
            (0.08203_f32 / 0.03516).ln(),  // fourth moment over squared second
            (1.0 + 2.0 + 3.0 + 8.0) / 4.0, // roughness: along the row, then beside it
            (2.0 + 4.0) / 2.0,             // raggedness
            0.75,                          // reach
        ];
        for (index, (found, expected)) in row.iter().zip(expected).enumerate() {
            assert!(
                (found - expected).abs() < 5e-3,
                "feature {index}: {found} {expected}"
            );
        }
    }

    #[test]
    fn an_empty_frame_has_finite_features() {
        let row = &features([&Frame::default()].into_iter()).unwrap()[0];
        assert!(row.iter().all(|x| x.is_finite()), "{row:?}");
    }

    #[test]
    fn the_solver_solves() {
        let matrix = vec![vec![4.0, 0.0], vec![2.0, 3.0]];
        // [[4, 2], [2, 3]] x = [8, 7] has x = [1.25, 1.5].
        let x = solve(matrix, vec![8.0, 7.0]);
        assert!(
            (x[0] - 1.25).abs() < 1e-12 && (x[1] - 1.5).abs() < 1e-12,
            "{x:?}"
        );
    }

    #[test]
    fn the_fit_finds_the_optimum() {
        // Only feature 0 tells the level, wrongly in one case of four: the best logit is ln 3.
        let row = |x: f32| {
            let mut row = vec![0.0; FEATURES];
            row[0] = x;
            row
        };
        let rows: Vec<Vec<f32>> = (0..80)
            .map(|n| row(if n % 2 == 0 { 1.0 } else { -1.0 }))
            .collect();
        let level_of: Vec<usize> = (0..80).map(|n| (n % 2) ^ usize::from(n % 8 < 2)).collect();
        let baseline = Baseline::fit(&rows, &level_of, 2);
        let p = baseline.probabilities(&row(1.0))[0];
        assert!((p - 0.75).abs() < 2e-3, "{p}");
    }
}
