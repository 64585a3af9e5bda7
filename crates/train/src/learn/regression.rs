//! Multinomial logistic regression on what is seen of a press: its features, or the taxels of the array in
//! eight parts of its time.
//!
//! The features show how much area, force and time alone say. The taxels say more where presses fall on the
//! same place of a small array.

use std::collections::BTreeMap;
use std::slice;

use burn::tensor::{Tensor, TensorData};

use super::learner::Learner;
use super::{Inputs, Learning, Question, Stage, Taken, share_right};
use crate::data::presses::Presses;
use crate::net::graph::{Graph, RAW};
use crate::net::network::{Weights, dense, numbers};
use crate::net::standard::Standard;
use crate::settings::Training;
use hardnessd_core::frame::{Array, Pitch};
use hardnessd_core::verdict::features::{FEATURES, FRAME};
use hardnessd_core::verdict::parts::PARTS;
use hardnessd_simulator::random::Stream;

/// Weight of the squared coefficients relative to the mean loss, on features. It keeps the optimum finite, and
/// is too small to matter otherwise.
const RIDGE: f64 = 1e-4;
/// The newtons of a taxel where its logarithm begins to bend, in contact thresholds: below it noise stays
/// small, above it a force twice as large adds as much as any other doubling.
const BEND_THRESHOLDS: f32 = 8.0;

/// What a regression sees of a press.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Seen {
    /// The features of the core.
    Features,
    /// The mean newtons of each taxel of the array in [`PARTS`] parts of the press, on a logarithmic scale that
    /// bends at so many newtons.
    Parts(Array, f32),
    /// As many newtons of the unloaded sensor. It is a control, and is never written.
    Unloaded(usize),
}

impl Seen {
    /// The taxels of the presses' own array. `None` if the presses are not on one, or are single frames.
    pub fn parts(presses: &Presses) -> Option<Self> {
        let grid = presses.grid().filter(|_| presses.are_over_time())?;
        let threshold_n = Pitch::square(grid.pitch_mm).contact_threshold_n();
        Some(Self::Parts(grid.array, BEND_THRESHOLDS * threshold_n))
    }

    fn columns(self) -> usize {
        match self {
            Self::Features => FEATURES,
            Self::Parts(array, _) => PARTS * array.taxels(),
            Self::Unloaded(taxels) => taxels,
        }
    }

    fn of(self, presses: &Presses, press: usize) -> Vec<f32> {
        match self {
            Self::Features => presses.course(press).features().to_vec(),
            Self::Parts(array, bend_n) => {
                let parts = presses.parts(press, array).into_iter();
                parts
                    .map(|n| n.signum() * (n.abs() / bend_n).ln_1p())
                    .collect()
            }
            // In millinewtons, because sessions may differ by little.
            Self::Unloaded(_) => {
                let unloaded = presses.all[press].unloaded.iter().flatten();
                unloaded.map(|newtons| 1e3 * newtons).collect()
            }
        }
    }
}

/// The regression, which learns from labelled presses.
#[derive(Debug)]
pub struct Regression<'a> {
    stage: Stage<'a>,
    seen: Seen,
    standard: Standard,
}

impl<'a> Regression<'a> {
    /// A regression in a stage, which gets its name and its settings.
    pub fn new(stage: Stage<'a>, seen: Seen) -> Self {
        let presses = stage.presses;
        let row = |&press: &usize| seen.of(presses, press);
        let rows: Vec<Vec<f32>> = stage.parts.train.iter().map(row).collect();
        let mut standard = Standard::of(seen.columns(), rows.iter().map(Vec::as_slice));
        // A frame alone says nothing of time. What the features of time are then, a whole press does not repeat.
        let known = match presses.are_over_time() {
            true => seen.columns(),
            false => FRAME,
        };
        // Nor says a column anything that does not vary.
        for column in 0..seen.columns() {
            if column >= known || !standard.varies(column) {
                standard.deviation[column] = f32::MAX;
            }
        }
        let stage = Stage {
            name: match seen {
                Seen::Features => "features",
                Seen::Parts(..) => "taxels",
                Seen::Unloaded(_) => "unloaded",
            },
            // The fit takes all presses at once, and ends by itself.
            training: Training {
                batch: rows.len(),
                epochs: 1,
                ..Training::default()
            },
            ..stage
        };
        Self {
            stage,
            seen,
            standard,
        }
    }

    /// The weights of least loss.
    pub fn fitted(&self) -> Weights {
        self.weights(&self.samples().fit())
    }

    fn samples(&self) -> Samples {
        // Each level counts the same, and within it each object, whatever the number of its presses.
        let unit = |place: &usize| {
            let press = &self.stage.presses.all[*place];
            (press.level, press.object)
        };
        let mut counts = BTreeMap::new();
        for place in &self.stage.parts.train {
            *counts.entry(unit(place)).or_insert(0.0) += 1.0;
        }
        let objects = |level: u8| counts.keys().filter(|unit| unit.0 == level).count() as f64;
        let levels = (1..=u8::MAX).filter(|&level| objects(level) > 0.0).count() as f64;
        let share = |place: &usize| {
            let unit = unit(place);
            1.0 / (levels * objects(unit.0) * counts[&unit])
        };
        let row = |&press: &usize| {
            let columns = self.row(press).into_iter().chain([1.0]);
            columns.map(f64::from).collect()
        };
        let presses = self.stage.presses.of(&self.stage.parts.train);
        Samples {
            rows: self.stage.parts.train.iter().map(row).collect(),
            shares: self.stage.parts.train.iter().map(share).collect(),
            of_level: presses.map(|press| usize::from(press.level) - 1).collect(),
            levels: self.stage.levels(),
            ridge: match self.seen {
                Seen::Features => RIDGE,
                // With as many taxels as this, the presses are what limits the fit.
                Seen::Parts(..) | Seen::Unloaded(_) => 1.0 / self.stage.parts.train.len() as f64,
            },
        }
    }

    /// The standardised columns of a press.
    fn row(&self, press: usize) -> Vec<f32> {
        self.standard.row(&self.seen.of(self.stage.presses, press))
    }

    /// The coefficients of each level, those of the columns and the bias, as a layer.
    fn weights(&self, coefficients: &[f64]) -> Weights {
        let (columns, levels) = (self.seen.columns(), self.stage.levels());
        let of = |column: usize| {
            let levels = coefficients.chunks_exact(columns + 1);
            levels.map(move |of_level| of_level[column] as f32)
        };
        let mut weights = Weights::new(&self.stage.device);
        let matrix = (0..columns).flat_map(of).collect();
        weights.add("levels.matrix", &[columns, levels], matrix);
        weights.add("levels.bias", &[levels], of(columns).collect());
        weights
    }
}

impl Learning for Regression<'_> {
    fn stage(&self) -> &Stage<'_> {
        &self.stage
    }

    fn sides(&self) -> Vec<Learner> {
        let nothing = vec![0.0; (self.seen.columns() + 1) * self.stage.levels()];
        vec![Learner::fresh(self.weights(&nothing), self.stage.training)]
    }

    /// Fits the coefficients.
    fn step(&self, sides: &mut [Learner], _samples: &[usize], _step: u64, _rate: f64) -> Taken {
        let samples = self.samples();
        let fitted = samples.fit();
        let weights = self.weights(&fitted);
        let Stage { presses, parts, .. } = &self.stage;
        let question = Question::alone(&parts.train);
        let judged = self.judge(slice::from_ref(&weights), &[question], None);
        let levels = presses.of(&parts.train).map(|press| press.level);
        sides[0].weights = weights;
        Taken {
            loss: samples.loss(&fitted).0,
            accuracy: Some(share_right(levels, judged.iter().map(Vec::as_slice))),
            ..Taken::default()
        }
    }

    fn judge(
        &self,
        weights: &[Weights],
        questions: &[Question],
        _vary: Option<&mut Stream>,
    ) -> Vec<Vec<f32>> {
        let presses = questions.iter().flat_map(|question| &question.presses);
        let rows: Vec<f32> = presses.flat_map(|&press| self.row(press)).collect();
        let columns = self.seen.columns();
        let shape = [rows.len() / columns, columns];
        let rows = Tensor::from_data(TensorData::new(rows, shape), &self.stage.device);
        let logits = numbers(&dense(&weights[0], "levels", rows));
        let rows = logits.chunks(self.stage.levels());
        rows.map(<[f32]>::to_vec).collect()
    }

    fn graph(&self, weights: &[Weights]) -> Graph {
        let (inputs, mut columns) = match self.seen {
            Seen::Unloaded(_) => unreachable!("a control is never written"),
            Seen::Features => (Inputs::Features, "features"),
            Seen::Parts(array, _) => (Inputs::Parts(array), "parts"),
        };
        let mut graph = Graph::of(&weights[0], inputs);
        if let Seen::Parts(_, bend_n) = self.seen {
            let width = self.seen.columns();
            graph.add(&format!("flat = Reshape(parts, [1x{width}])"));
            let log = format!("Log(Add(Div(Abs(flat), {bend_n}), 1))");
            graph.add(&format!("seen = Mul(Sign(flat), {log})"));
            columns = "seen";
        }
        self.standard.add_to(&mut graph, columns);
        graph.add(&format!("{RAW} = Dense(standardised, levels)"));
        graph
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Rows of numbers, and the level of each, from 0.
struct Samples {
    rows: Vec<Vec<f64>>,
    /// What each row counts; all together 1.
    shares: Vec<f64>,
    of_level: Vec<usize>,
    levels: usize,
    ridge: f64,
}

/// The pairs of steps that L-BFGS remembers.
const REMEMBERED: usize = 10;
/// The most steps of a fit.
const MOST_STEPS: usize = 1000;
/// A fit ends when no element of the gradient is larger.
const LEAST_GRADIENT: f64 = 1e-6;

impl Samples {
    /// The coefficients of least loss, level by level: by L-BFGS (Nocedal and Wright, "Numerical
    /// optimization", algorithm 7.4), because with many taxels a matrix of second derivatives would be too
    /// large.
    fn fit(&self) -> Vec<f64> {
        let width = self.rows.first().map_or(0, Vec::len);
        let mut x = vec![0.0; width * self.levels];
        let (mut loss, mut gradient) = self.loss(&x);
        let mut pairs: Vec<[Vec<f64>; 2]> = Vec::new();
        for _ in 0..MOST_STEPS {
            if gradient.iter().all(|g| g.abs() <= LEAST_GRADIENT) {
                break;
            }
            let direction = downhill(&gradient, &pairs);
            let slope = dot(&direction, &gradient);
            // Halve the step until the loss falls enough (Armijo).
            let mut share = if pairs.is_empty() {
                1.0 / gradient.iter().map(|g| g.abs()).sum::<f64>().max(1.0)
            } else {
                1.0
            };
            let taken = (0..40).find_map(|_| {
                let next = x.iter().zip(&direction).map(|(x, d)| x + share * d);
                let next: Vec<f64> = next.collect();
                let (found, of_next) = self.loss(&next);
                let is_enough = found <= loss + 1e-4 * share * slope;
                share /= 2.0;
                is_enough.then_some((next, found, of_next))
            });
            let Some((next, found, of_next)) = taken else {
                break;
            };
            let difference = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a - b).collect();
            let pair: [Vec<f64>; 2] = [difference(&next, &x), difference(&of_next, &gradient)];
            if dot(&pair[0], &pair[1]) > 0.0 {
                pairs.push(pair);
            }
            if pairs.len() > REMEMBERED {
                pairs.remove(0);
            }
            (x, loss, gradient) = (next, found, of_next);
        }
        x
    }

    /// The weighted mean of the cross-entropy plus the ridge, and its gradient.
    fn loss(&self, coefficients: &[f64]) -> (f64, Vec<f64>) {
        let mut gradient: Vec<f64> = coefficients.iter().map(|c| self.ridge * c).collect();
        let mut loss = 0.5 * self.ridge * dot(coefficients, coefficients);
        let samples = self.rows.iter().zip(&self.shares).zip(&self.of_level);
        for ((row, share), &level) in samples {
            let of_levels = coefficients.chunks_exact(row.len());
            let logits: Vec<f64> = of_levels.map(|of| dot(of, row)).collect();
            let top = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let sum: f64 = logits.iter().map(|logit| (logit - top).exp()).sum();
            loss -= share * (logits[level] - top - sum.ln());
            let of_levels = gradient.chunks_exact_mut(row.len()).enumerate();
            for ((place, of), logit) in of_levels.zip(&logits) {
                let p = (logit - top).exp() / sum;
                let residual = share * (p - f64::from(u8::from(place == level)));
                of.iter_mut().zip(row).for_each(|(g, x)| *g += residual * x);
            }
        }
        (loss, gradient)
    }
}

/// The direction of the next step: the gradient by the inverse second derivatives that the remembered pairs
/// of steps and changes of the gradient show.
fn downhill(gradient: &[f64], pairs: &[[Vec<f64>; 2]]) -> Vec<f64> {
    let mut direction: Vec<f64> = gradient.iter().map(|g| -g).collect();
    let add = |to: &mut [f64], times: f64, of: &[f64]| {
        to.iter_mut().zip(of).for_each(|(to, of)| *to += times * of);
    };
    let mut shares = Vec::new();
    for [step, change] in pairs.iter().rev() {
        let share = dot(step, &direction) / dot(step, change);
        add(&mut direction, -share, change);
        shares.push(share);
    }
    if let Some([step, change]) = pairs.last() {
        let scale = dot(step, change) / dot(change, change);
        direction.iter_mut().for_each(|d| *d *= scale);
    }
    for ([step, change], share) in pairs.iter().zip(shares.into_iter().rev()) {
        let back = dot(change, &direction) / dot(step, change);
        add(&mut direction, share - back, step);
    }
    direction
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fit_finds_the_optimum() {
        // Only the first number shows the level, and is wrong in one of four cases, so the best logit is
        // ln 3. The second number never varies.
        let row = |n: usize| vec![if n.is_multiple_of(2) { 1.0 } else { -1.0 }, 0.0, 1.0];
        let samples = Samples {
            rows: (0..80).map(row).collect(),
            shares: vec![1.0 / 80.0; 80],
            of_level: (0..80).map(|n| (n % 2) ^ usize::from(n % 8 < 2)).collect(),
            levels: 2,
            ridge: 1e-6,
        };
        let fitted = samples.fit();
        let [first, second] = [0, 1].map(|level| dot(&fitted[3 * level..3 * level + 3], &row(0)));
        assert!((first - second - 3.0_f64.ln()).abs() < 1e-3, "{fitted:?}");
        assert!(fitted.iter().skip(1).step_by(3).all(|c| *c == 0.0));
    }

    #[test]
    fn a_fit_of_more_columns_than_rows_ends_at_a_flat_place() {
        let mut stream = Stream::new(1, "columns");
        let rows = (0..40).map(|_| (0..200).map(|_| stream.normal()).collect());
        let samples = Samples {
            rows: rows.collect(),
            shares: vec![1.0 / 40.0; 40],
            of_level: (0..40).map(|n| n % 3).collect(),
            levels: 3,
            ridge: 1.0 / 40.0,
        };
        let (_, gradient) = samples.loss(&samples.fit());
        assert!(gradient.iter().all(|g| g.abs() <= LEAST_GRADIENT));
    }
}
