//! The candidates: what may judge the presses of this robot, and the controls beside them.

use std::collections::{BTreeMap, BTreeSet};

use anyhow::Context as _;
use burn::tensor::Device;

use super::SEED;
use super::folds::Fold;
use crate::data::presses::Presses;
use crate::data::split::Parts;
use crate::learn::regression::{Regression, Seen};
use crate::learn::{self, Learning, Question, Stage};
use crate::methods::{Stages, last_stage};
use crate::net::network::Weights;
use crate::recipe;
use crate::settings::{Profile, Settings};
use hardnessd_core::frame::{Array, Frame};
use hardnessd_core::verdict::{BUILT_IN, Borders, Level, Model, Piece, ReferencePress};

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
    BuiltIn(Box<Model>),
    /// A regression.
    Regression(Seen),
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
    let hrn = match places.len() {
        count if count < LEAST_FOR_HRN => Err(format!("needs {LEAST_FOR_HRN} presses")),
        _ => Ok(Candidate::Hrn),
    };
    Ok(vec![
        ("built-in", built_in(&presses.levels())?),
        ("features", Ok(Candidate::Regression(Seen::Features))),
        ("taxels", taxels(presses, places).map(Candidate::Regression)),
        (HRN, hrn),
    ])
}

/// The built-in model, if it can say these levels.
fn built_in(levels: &[Level]) -> anyhow::Result<Result<Candidate, String>> {
    let hrn = Model::load(BUILT_IN)?;
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
    let seen = seen.ok_or("needs whole presses on one array of square taxels")?;
    match seen {
        Seen::Parts(array, _)
            if array.taxels() > MOST_TAXELS
                && spread_taxels(presses, places, array) >= SAME_PLACE_TAXELS =>
        {
            Err("presses fall on different places of a large array".to_owned())
        }
        _ => Ok(seen),
    }
}

/// How far the centres of presses on this array are from their mean, in taxels.
fn spread_taxels(presses: &Presses, places: &[usize], array: Array) -> f64 {
    let centre = |&place: &usize| {
        // Frames on the models' grid may have the contact in their middle.
        let parts = presses.parts(place, array);
        let of_all = |taxel| parts.iter().skip(taxel).step_by(array.taxels()).sum();
        let frame = Frame {
            array,
            newtons: (0..array.taxels()).map(of_all).collect(),
        };
        let (row, col) = frame.centre();
        [row, col]
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
    let lengths = presses.of(places).map(|press| press.unloaded.as_ref());
    let lengths: BTreeSet<usize> = lengths.map(|of| of.map_or(0, Vec::len)).collect();
    let length = lengths.first().copied().filter(|&length| length > 0)?;
    (lengths.len() == 1).then_some(Candidate::Regression(Seen::Unloaded(length)))
}

impl Candidate {
    /// Logits of the presses of a fold, by what was learnt from its others.
    ///
    /// # Errors
    ///
    /// Fails if the built-in model does, or a training diverges.
    pub fn judge(&self, presses: &Presses, fold: &Fold) -> anyhow::Result<Vec<Vec<f32>>> {
        match self {
            Self::BuiltIn(hrn) => {
                let references = references(hrn, presses, &fold.train)?;
                // As the daemon does, which uses no references that are worse than none.
                let (hrn, _) = hrn.identified_by(&references)?;
                let judge = |&press: &usize| {
                    let course = presses.course_for(press, hrn.card());
                    Ok(hrn.judge_course(&course)?.logits)
                };
                fold.test.iter().map(judge).collect()
            }
            Self::Regression(_) | Self::Hrn => {
                let (learning, weights) = self.learnt(presses, &fold.train)?;
                Ok(learning.judge(&weights, &[Question::alone(&fold.test)], None))
            }
        }
    }

    /// What is learnt from the presses `train`. The built-in model learns nothing.
    ///
    /// # Errors
    ///
    /// Fails if a training diverges.
    pub fn learnt<'a>(
        &self,
        presses: &'a Presses,
        train: &[usize],
    ) -> anyhow::Result<(Box<dyn Learning + 'a>, Vec<Weights>)> {
        let stage = |settings: Settings| Stage {
            name: "fit",
            presses,
            parts: Parts::labelled(train.to_vec()),
            settings,
            training: settings.training,
            seed: SEED,
            device: Device::flex(),
        };
        match self {
            Self::BuiltIn(_) => anyhow::bail!("the built-in model learns nothing"),
            Self::Regression(seen) => {
                let regression = Regression::new(stage(Settings::default()), *seen);
                let weights = regression.fitted();
                Ok((Box::new(regression), vec![weights]))
            }
            Self::Hrn => {
                let recipe = recipe::named(HRN).context("no recipe of the paper's network")?;
                let none = toml::Table::new();
                let mut settings = recipe.settings(Profile::Quick, train.len(), &none)?;
                settings.held_out = 0.0;
                let stages = Stages {
                    stage: stage(settings),
                    start: None,
                    run: None,
                };
                let learning = last_stage(recipe, &stages)?;
                let weights = learn::run(&*learning, None)?;
                Ok((learning, weights))
            }
        }
    }
}

/// As many presses as the model takes as references, of all objects in turn, light and hard ones.
///
/// # Errors
///
/// Fails if the levels have no ranges of Shore hardness.
pub fn references(
    hrn: &Model,
    presses: &Presses,
    places: &[usize],
) -> anyhow::Result<Vec<ReferencePress>> {
    let borders = Borders::of(&hrn.card().levels)?;
    let force_n = |place: &usize| presses.all[*place].force_n.unwrap_or_default();
    let mut turns = BTreeMap::<u8, usize>::new();
    let mut objects: Vec<(usize, u8, Vec<usize>)> = Vec::new();
    for ((_, level, ..), mut own) in presses.by_object(places) {
        own.sort_by(|one, other| force_n(one).total_cmp(&force_n(other)));
        let turn = turns.entry(level).or_default();
        objects.push((*turn, level, own));
        *turn += 1;
    }
    // The first object of each level, then the second ones.
    objects.sort();
    let most = hrn.most_references();
    let rounds = most.div_ceil(objects.len().max(1));
    let of_round = |round: usize| {
        let places = objects.iter();
        places.map(move |(.., own)| own[(2 * round + 1) * own.len() / (2 * rounds)])
    };
    let mut seen = BTreeSet::new();
    let chosen = (0..rounds).flat_map(of_round);
    let chosen = chosen.filter(|&place| seen.insert(place));
    let reference = |place: usize| {
        let press = &presses.all[place];
        let range = match press.shore {
            Some(shore) => [shore; 2],
            None => borders.part(usize::from(press.level) - 1),
        };
        ReferencePress {
            course: presses.course_for(place, hrn.card()),
            piece: Piece::Shore { range },
        }
    };
    Ok(chosen.take(most).map(reference).collect())
}
