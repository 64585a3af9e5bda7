//! 18 hand-made features of a frame: area, force, spread and the like.
//!
//! The features are nodes of the baseline's exported graph, and training computes them by running
//! that graph. So there is no second definition that could disagree.

use anyhow::Context as _;
use tract_onnx::pb;

use crate::net::frames::AREA_THRESHOLDS_N;
use crate::net::graph::{self, Graph};
use hardnessd_core::press;
use hardnessd_core::verdict::{COLS, ModelFrame, ROWS, TAXELS};

/// The number of features of a frame.
pub const FEATURES: usize = 18;
/// Keeps logarithms and quotients of an empty frame finite; far below one count of 0.04 N.
const TINY: f32 = 1e-4;

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
            vec![graph::integer("keepdims", 0)],
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

    /// A mask: 1 for taxels of at least `threshold_n`, 0 for the others.
    fn mask(&mut self, threshold_n: f32) -> String {
        let threshold = self.scalar(threshold_n);
        let name = format!("at least {threshold_n}");
        let at_least = self.node(
            "GreaterOrEqual",
            &[graph::INPUT, &threshold],
            &format!("{name}?"),
        );
        let to = graph::integer("to", pb::tensor_proto::DataType::Float as i64);
        self.graph.node("Cast", &[&at_least], &name, vec![to])
    }

    /// Sum of the absolute differences of neighbours along rows and columns.
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

    /// Adds two features of the second moments of `weights` about their centroid: the log of their
    /// trace, and the anisotropy from 0 (round) to 1 (a line). Returns the trace and the squared
    /// distances.
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

    /// Adds the constants: axes, coordinates and kernels.
    fn constants(&mut self) {
        let coordinate = |of: fn(usize) -> usize| -> Vec<f32> {
            (0..TAXELS).map(|index| of(index) as f32).collect()
        };
        let frame = [1, 1, ROWS, COLS];
        self.graph.indices("taxel axes", &[2, 3]);
        self.graph.constant("tiny", &[], &[TINY]);
        let rows = coordinate(|index| index / COLS);
        self.graph.constant("row", &frame, &rows);
        let columns = coordinate(|index| index % COLS);
        self.graph.constant("column", &frame, &columns);
        self.graph.constant("down", &[1, 1, 2, 1], &[-1.0, 1.0]);
        self.graph.constant("right", &[1, 1, 1, 2], &[-1.0, 1.0]);
    }

    /// Adds five features: the contact area, and the areas above higher thresholds. Returns the
    /// contact area.
    fn areas(&mut self, contact: &str) -> String {
        let area = self.sum(contact, "area");
        self.log_feature(&area);
        for threshold_n in AREA_THRESHOLDS_N {
            let mask = self.mask(threshold_n);
            let count = self.sum(&mask, &format!("area of {threshold_n}"));
            // The count is often 0, so the feature is log(1 + count) and not log(count + tiny).
            let one = self
                .graph
                .constant(&format!("one for {threshold_n}"), &[], &[1.0]);
            let raised = self.node("Add", &[&count, &one], &format!("{count} + 1"));
            let log = self.node("Log", &[&raised], &format!("log of {count}"));
            self.columns.push(log);
        }
        area
    }

    /// Adds five features: force, greatest taxel, mean, the greatest taxel's share, and the
    /// effective area F^2 / sum p^2. Returns the force.
    fn forces(&mut self, pressed: &str, area: &str) -> String {
        let force = self.sum(pressed, "force");
        self.log_feature(&force);
        let options = vec![
            graph::integers("axes", &[2, 3]),
            graph::integer("keepdims", 0),
        ];
        let peak = self.graph.node("ReduceMax", &[pressed], "peak", options);
        self.log_feature(&peak);
        let mean = self.quotient(&force, area, "mean");
        self.log_feature(&mean);
        let share = self.quotient(&peak, &force, "peak share");
        self.columns.push(share);

        let squares = self.node("Mul", &[pressed, pressed], "pressed squared");
        let energy = self.sum(&squares, "energy");
        let force_squared = self.node("Mul", &[&force, &force], "force squared");
        let effective_area = self.quotient(&force_squared, &energy, "effective area");
        self.log_feature(&effective_area);
        force
    }

    /// Adds five features: the second moments of force and of contact, and the fourth moment of
    /// force over the square of its second. Returns a sixth: the spread of the force over the
    /// spread of the contact.
    fn shape(&mut self, (pressed, force): (&str, &str), (contact, area): (&str, &str)) -> String {
        let (spread, arm) = self.spread(pressed, force);
        let (contact_spread, _) = self.spread(contact, area);
        let arm_squared = self.node("Mul", &[&arm, &arm], "arm squared");
        let weighted = self.node("Mul", &[pressed, &arm_squared], "fourth weighted");
        let sum = self.sum(&weighted, "fourth sum");
        let fourth = self.quotient(&sum, force, "fourth");
        let spread_squared = self.node("Mul", &[&spread, &spread], "spread squared");
        let tails = self.quotient(&fourth, &spread_squared, "tails");
        self.log_feature(&tails);
        self.quotient(&spread, &contact_spread, "reach")
    }

    /// Adds two features: the variation from taxel to taxel of force, over the force, and of
    /// contact, over the area.
    fn roughness(&mut self, (pressed, force): (&str, &str), (contact, area): (&str, &str)) {
        let variation = self.variation(pressed, "variation");
        let roughness = self.quotient(&variation, force, "roughness");
        self.columns.push(roughness);
        let border = self.variation(contact, "border");
        let raggedness = self.quotient(&border, area, "raggedness");
        self.columns.push(raggedness);
    }
}

/// The graph from newtons to features `[1, FEATURES]`, and the features' name.
pub(super) fn feature_graph() -> (Graph, String) {
    let mut b = Builder {
        graph: Graph::default(),
        columns: Vec::new(),
    };
    b.constants();
    let contact = b.mask(press::Thresholds::default().contact_threshold_n);
    let area = b.areas(&contact);
    let pressed = b.node("Mul", &[graph::INPUT, &contact], "pressed");
    let force = b.forces(&pressed, &area);
    let reach = b.shape((&pressed, &force), (&contact, &area));
    b.roughness((&pressed, &force), (&contact, &area));
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
        vec![graph::integer("axis", 1)],
    );
    (b.graph, features)
}

/// The features of every frame, a row per frame.
///
/// # Errors
///
/// Returns an error if the graph cannot be run.
pub fn features<'a>(frames: impl Iterator<Item = &'a ModelFrame>) -> anyhow::Result<Vec<Vec<f32>>> {
    let (graph, features) = feature_graph();
    let plan = graph::Plan::new(graph, &features, &[1, FEATURES]).context("features")?;
    frames.map(|frame| plan.run(frame)).collect()
}

/// Mean and standard deviation of each feature.
#[derive(Debug, Clone, PartialEq)]
pub struct Moments {
    /// The means.
    pub mean: Vec<f64>,
    /// The standard deviations.
    pub deviation: Vec<f64>,
}

impl Moments {
    /// The moments over `rows`, which must not be empty.
    pub fn of(rows: &[Vec<f32>]) -> Self {
        let (n, width) = (rows.len() as f64, rows[0].len());
        let column = |index: usize| rows.iter().map(move |row| f64::from(row[index]));
        let mean: Vec<f64> = (0..width)
            .map(|index| column(index).sum::<f64>() / n)
            .collect();
        let deviation = (0..width).map(|index| {
            let squares = column(index).map(|x| (x - mean[index]).powi(2));
            // The lower limit avoids a division by 0 for a feature that never varies.
            (squares.sum::<f64>() / n).sqrt().max(1e-6)
        });
        let deviation = deviation.collect();
        Self { mean, deviation }
    }

    /// Features minus mean, divided by deviation.
    pub fn standardised(&self, row: &[f32]) -> Vec<f64> {
        let scale = self.mean.iter().zip(&self.deviation);
        row.iter()
            .zip(scale)
            .map(|(x, (mean, deviation))| (f64::from(*x) - mean) / deviation)
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn features_follow_their_names() {
        // Two taxels of 1 N and 3 N, side by side in row 4.
        let mut frame = ModelFrame::default();
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
        let row = &features([&ModelFrame::default()].into_iter()).unwrap()[0];
        assert!(row.iter().all(|x| x.is_finite()), "{row:?}");
    }
}
