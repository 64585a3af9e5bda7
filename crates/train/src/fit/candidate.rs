//! The candidates: what may judge the presses of this robot, and the controls beside them.

use std::sync::Arc;

use anyhow::Context as _;
use burn::tensor::Device;

use super::folds::{Fold, objects};
use crate::data::presses::Presses;
use crate::data::split::Parts;
use crate::learn::regression::{Regression, Seen, Table};
use crate::learn::{self, Learning, Question};
use crate::methods::{Stages, last_stage};
use crate::net::network::Weights;
use crate::recipe;
use crate::run::{Description, Run};
use crate::settings::Profile;
use hardnessd_core::verdict::{BUILT_IN, Borders, COLS, Hrn, Level, Piece, ReferencePress};

/// The paper's network needs this many presses.
pub const LEAST_FOR_HRN: usize = 1_500;
/// The most taxels whose every part a regression sees, if presses do not fall on the same place.
const MOST_TAXELS: usize = 256;
/// Presses fall on the same place if their centres spread less than this, in taxels.
const SAME_PLACE_TAXELS: f64 = 1.5;
/// The recipe of the paper's network.
const HRN: &str = "hrn";

/// What may judge presses.
#[derive(Debug)]
pub enum Candidate {
    /// The built-in model, with the presses as references.
    BuiltIn(Box<Hrn>),
    /// A regression.
    Regression(Arc<Table>),
    /// The paper's network.
    Hrn,
}

/// A candidate and its name, or the reason why it is left out.
pub type Entry = (&'static str, Result<Candidate, String>);

/// All candidates for the labelled presses `places`. Where two are equally good, the first one counts.
///
/// # Errors
///
/// Fails if the built-in model does.
pub fn all(presses: &Presses, places: &[usize]) -> anyhow::Result<Vec<Entry>> {
    let table = |seen| {
        let table = Table::of(presses, seen, places.iter().copied());
        Candidate::Regression(Arc::new(table))
    };
    let hrn = match places.len() {
        count if count < LEAST_FOR_HRN => Err(format!("needs {LEAST_FOR_HRN} presses")),
        _ => Ok(Candidate::Hrn),
    };
    Ok(vec![
        ("built-in", built_in(&presses.levels())?),
        ("features", Ok(table(Seen::Features))),
        ("taxels", taxels(presses, places).map(table)),
        (HRN, hrn),
    ])
}

/// The built-in model, if it can say these levels.
fn built_in(levels: &[Level]) -> anyhow::Result<Result<Candidate, String>> {
    let hrn = Hrn::load(BUILT_IN)?;
    if hrn.card().levels == levels {
        return Ok(Ok(Candidate::BuiltIn(Box::new(hrn))));
    }
    let no_ranges = |_| "cannot say levels without ranges of Shore OO".to_owned();
    let own = hrn.with_levels(levels.to_vec()).map_err(no_ranges);
    Ok(own.map(|hrn| Candidate::BuiltIn(Box::new(hrn))))
}

/// The taxels, if the array is small or presses fall on the same place.
fn taxels(presses: &Presses, places: &[usize]) -> Result<Seen, String> {
    let seen = Seen::parts(presses);
    let seen = seen.ok_or("needs whole presses on one array of at most 28x28 square taxels")?;
    let is_small = matches!(seen, Seen::Parts(array, _) if array.taxels() <= MOST_TAXELS);
    match is_small || spread_taxels(presses, places) < SAME_PLACE_TAXELS {
        true => Ok(seen),
        false => Err("presses fall on different places of a large array".to_owned()),
    }
}

/// How far the centres of presses are from their mean, in taxels.
fn spread_taxels(presses: &Presses, places: &[usize]) -> f64 {
    let centre = |&place: &usize| {
        let frame = presses.frame(place);
        let pressed = frame.newtons.iter().map(|n| f64::from(n.max(0.0)));
        let force_n = pressed.clone().sum::<f64>().max(f64::MIN_POSITIVE);
        let along = |of: fn(usize) -> usize| {
            let moments = pressed
                .clone()
                .enumerate()
                .map(|(place, n)| n * of(place) as f64);
            moments.sum::<f64>() / force_n
        };
        [along(|place| place / COLS), along(|place| place % COLS)]
    };
    let centres: Vec<[f64; 2]> = places.iter().map(centre).collect();
    let count = centres.len() as f64;
    let mean = [0, 1].map(|axis| centres.iter().map(|of| of[axis]).sum::<f64>() / count);
    let square = |of: &[f64; 2]| (of[0] - mean[0]).powi(2) + (of[1] - mean[1]).powi(2);
    (centres.iter().map(square).sum::<f64>() / count).sqrt()
}

/// The control: what the sensor alone tells of the levels before anything touches it. `None` if the presses are
/// not from recordings.
pub fn unloaded(presses: &Presses, places: &[usize]) -> Option<Candidate> {
    let lengths = presses
        .of(places)
        .map(|press| press.unloaded.as_ref().map(Vec::len));
    let length = lengths
        .clone()
        .next()
        .flatten()
        .filter(|&length| length > 0)?;
    let is_same = { lengths }.all(|other| other == Some(length));
    let seen = Seen::Unloaded(length);
    let table = || Table::of(presses, seen, places.iter().copied());
    is_same.then(|| Candidate::Regression(Arc::new(table())))
}

impl Candidate {
    /// Logits of the presses of a fold, by what was learnt from its others.
    ///
    /// # Errors
    ///
    /// Fails if the built-in model does, or a training diverges.
    pub fn judge(
        &self,
        presses: &Presses,
        fold: &Fold,
        seed: u64,
    ) -> anyhow::Result<Vec<Vec<f32>>> {
        match self {
            Self::BuiltIn(hrn) => {
                let references = references(hrn, presses, &fold.train)?;
                // As the daemon does, which uses no references that are worse than none.
                let (hrn, _) = hrn.identified_by(&references)?;
                let judge = |&press: &usize| Ok(hrn.judge_course(&presses.course(press))?.logits);
                fold.test.iter().map(judge).collect()
            }
            Self::Regression(_) | Self::Hrn => {
                self.learn(presses, &fold.train, seed, |learning, weights| {
                    Ok(asked(learning, weights, &fold.test))
                })
            }
        }
    }

    /// Learns from the presses `train` and takes what was learnt. The built-in model learns nothing.
    ///
    /// # Errors
    ///
    /// Fails if a training diverges, or `take` fails.
    pub fn learn<T>(
        &self,
        presses: &Presses,
        train: &[usize],
        seed: u64,
        take: impl FnOnce(&dyn Learning, &[Weights]) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        match self {
            Self::BuiltIn(_) => anyhow::bail!("the built-in model learns nothing"),
            Self::Regression(table) => {
                let device = Device::flex();
                let regression = Regression::new(presses, table.clone(), [train, &[]], &device);
                take(&regression, &[regression.fitted()])
            }
            Self::Hrn => with_hrn(presses, train, seed, take),
        }
    }
}

fn asked(learning: &dyn Learning, weights: &[Weights], presses: &[usize]) -> Vec<Vec<f32>> {
    let question = Question {
        presses: presses.to_vec(),
        references: Vec::new(),
    };
    learning.judge(weights, &[question], None)
}

/// Trains the paper's network, in a directory that is removed.
fn with_hrn<T>(
    presses: &Presses,
    train: &[usize],
    seed: u64,
    take: impl FnOnce(&dyn Learning, &[Weights]) -> anyhow::Result<T>,
) -> anyhow::Result<T> {
    let recipe = recipe::named(HRN).context("no recipe of the paper's network")?;
    let mut settings = recipe.settings(Profile::Quick, train.len(), &toml::Table::new())?;
    settings.validation.share = 0.0;
    let directory = tempfile::tempdir()?;
    let run = Run::open(
        directory.path(),
        &Description {
            method: recipe.name.clone(),
            profile: Profile::Quick,
            seed,
            labels: train.len(),
            settings,
            data: presses.sources.clone(),
        },
        false,
    )?;
    let stages = Stages {
        presses,
        parts: &Parts {
            train: train.to_vec(),
            ..Parts::default()
        },
        settings: &settings,
        seed,
        run: &run,
        device: &Device::flex(),
    };
    let learning = &*last_stage(recipe, &stages)?;
    let level = |press: usize| presses.all[press].level;
    let weights = learn::run(learning, level, &run, stages.device)?;
    take(learning, &weights)
}

/// As many presses as the model takes as references, of all objects in turn, light and hard ones.
///
/// # Errors
///
/// Fails if the levels have no ranges of Shore hardness.
pub fn references(
    hrn: &Hrn,
    presses: &Presses,
    places: &[usize],
) -> anyhow::Result<Vec<ReferencePress>> {
    let borders = Borders::of(&hrn.card().levels)?;
    let mut objects: Vec<((usize, u8), Vec<usize>)> = Vec::new();
    for ((level, ..), own) in objects_in_order(presses, places) {
        let of_level = objects
            .iter()
            .filter(|((_, other), _)| *other == level)
            .count();
        objects.push(((of_level, level), own));
    }
    // The first object of each level, then the second ones.
    objects.sort_by_key(|(turn, _)| *turn);
    let most = hrn.most_references();
    let rounds = most.div_ceil(objects.len().max(1));
    let mut chosen = Vec::new();
    for round in 0..rounds {
        for (_, own) in &objects {
            let place = own[(2 * round + 1) * own.len() / (2 * rounds)];
            if !chosen.contains(&place) {
                chosen.push(place);
            }
        }
    }
    let reference = |place: usize| {
        let press = &presses.all[place];
        let range = match press.shore {
            Some(shore) => [shore; 2],
            None => borders.part(usize::from(press.level) - 1),
        };
        ReferencePress {
            course: presses.course(place),
            piece: Piece::Shore { range },
        }
    };
    Ok(chosen.into_iter().take(most).map(reference).collect())
}

/// The objects, each with its presses from light to hard.
fn objects_in_order(
    presses: &Presses,
    places: &[usize],
) -> impl Iterator<Item = ((u8, crate::data::source::Object, usize), Vec<usize>)> {
    let force_n = |place: &usize| presses.all[*place].force_n.unwrap_or_default();
    objects(presses, places)
        .into_iter()
        .map(move |(object, mut own)| {
            own.sort_by(|one, other| force_n(one).total_cmp(&force_n(other)));
            (object, own)
        })
}
