//! The verdicts of a model file on presses, beside references of their sensors.

use std::collections::{BTreeMap, BTreeSet};

use anyhow::ensure;

use crate::data::presses::Presses;
use crate::judge::evaluated::Case;
use hardnessd_core::frame::Array;
use hardnessd_core::judge::OwnPresses;
use hardnessd_core::verdict::{
    Format, Model, Piece, ReferencePress, References, TimeSeries, Verdict,
};
use hardnessd_simulator::random::Stream;

/// The references of its sensor that a model is given beside a press.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::Args)]
pub struct Given {
    /// Give the model this many presses of each rigid piece as references of each sensor
    #[arg(long, hide_short_help = true, value_name = "N", default_value_t = 0)]
    pub rigid: usize,
    /// Give the model a press of this many objects of each level as references of each sensor; the
    /// objects are not judged
    #[arg(long, hide_short_help = true, value_name = "N", default_value_t = 0)]
    pub labelled: usize,
    /// Give the model up to this many presses of other objects on the same sensor, of which it knows nothing
    #[arg(long, hide_short_help = true, value_name = "N", default_value_t = 0)]
    pub own: usize,
}

impl Given {
    /// What a run's evaluation gives a model: two presses of each piece.
    pub const USUAL: Self = Self {
        rigid: 2,
        labelled: 0,
        own: 0,
    };
}

/// As many presses of each rigid piece on a sensor as are given.
pub fn rigid(presses: &Presses, sensor: u32, given: Given) -> Vec<(usize, Piece)> {
    let of_sensor = presses.all.iter().enumerate();
    let pieces = of_sensor.filter(|(_, press)| press.sensor == sensor);
    let pieces = pieces.filter_map(|(place, press)| Some((place, press.reference?)));
    let is_ball = |(_, piece): &(usize, Piece)| matches!(piece, Piece::Ball { .. });
    let (balls, flats): (Vec<_>, Vec<_>) = pieces.partition(is_ball);
    // The simulator presses harder each time, so presses that lie apart differ in force.
    let spread = |of_piece: Vec<(usize, Piece)>| {
        let count = given.rigid.min(of_piece.len());
        let last = of_piece.len();
        (1..=count).map(move |number| of_piece[number * last / count - 1])
    };
    spread(flats).chain(spread(balls)).collect()
}

/// The references for the presses of each half of a sensor's objects, by sensor, and the objects that serve as
/// references with their hardness.
type BySensor = (BTreeMap<u32, [References; 2]>, BTreeSet<Option<u32>>);

/// The references of each sensor that has some of these presses.
fn references_of_sensors(
    hrn: &Model,
    presses: &Presses,
    places: &[usize],
    given: Given,
) -> anyhow::Result<BySensor> {
    let (mut references, mut objects) = (BTreeMap::new(), BTreeSet::new());
    if hrn.most_references() == 0 || given == Given::default() {
        return Ok((references, objects));
    }
    let mut by_sensor = BTreeMap::<u32, Vec<usize>>::new();
    for &place in places {
        let sensor = presses.all[place].sensor;
        by_sensor.entry(sensor).or_default().push(place);
    }
    for (sensor, places) in by_sensor {
        let mut known = rigid(presses, sensor, given);
        let mut of_level = BTreeMap::<u8, BTreeSet<Option<u32>>>::new();
        for &place in &places {
            let press = &presses.all[place];
            let of_level = of_level.entry(press.level).or_default();
            if of_level.len() < given.labelled && of_level.insert(press.object) {
                objects.insert(press.object);
                let range = |shore| Piece::Shore { range: [shore; 2] };
                known.extend(press.shore.map(|shore| (place, range(shore))));
            }
        }
        let known = known.into_iter().take(hrn.most_references());
        let known = known.map(|(place, piece)| ReferencePress {
            course: presses.course_for(place, hrn.card()),
            piece,
        });
        let known: Vec<ReferencePress> = known.collect();
        // As the daemon does, which uses no references that are worse than none.
        let (identified, _) = hrn.identified_by(&known)?;
        let own = own_presses(hrn, presses, places, given.own)?;
        references.insert(sensor, own.map(|own| identified.references_with(&own)));
    }
    Ok((references, objects))
}

/// Own presses of a sensor, for each half of its objects from the other half: at most two of an object.
fn own_presses(
    hrn: &Model,
    presses: &Presses,
    mut of_sensor: Vec<usize>,
    count: usize,
) -> anyhow::Result<[References; 2]> {
    let mut of_half: [Vec<TimeSeries>; 2] = Default::default();
    Stream::new(0, "own presses").shuffle(&mut of_sensor);
    let mut of_object = BTreeMap::<Option<u32>, u32>::new();
    for place in of_sensor {
        let object = presses.all[place].object;
        let half = &mut of_half[1 - half_of(object)];
        let of_object = of_object.entry(object).or_default();
        *of_object += 1;
        if *of_object <= 2 && half.len() < count {
            half.push(presses.course_for(place, hrn.card()));
        }
    }
    let [first, second] = of_half;
    let references = |courses: &[TimeSeries]| OwnPresses::references_of(hrn, courses, count);
    Ok([references(&first)?, references(&second)?])
}

/// The half of the objects that an object belongs to.
fn half_of(object: Option<u32>) -> usize {
    object.map_or(0, |object| object as usize % 2)
}

/// The verdicts of a model on labelled presses, with the references of the press's sensor. A model of frames judges each
/// press's best frame.
///
/// # Errors
///
/// Fails if the model has fewer levels than the data, or fails to judge a press.
pub fn of(
    hrn: &Model,
    presses: &Presses,
    places: &[usize],
    given: Given,
) -> anyhow::Result<Vec<Case>> {
    let levels = hrn.card().levels.len();
    let (references, objects) = references_of_sensors(hrn, presses, places, given)?;
    let mut verdicts = Vec::new();
    for &place in places {
        let press = &presses.all[place];
        if objects.contains(&press.object) {
            continue;
        }
        ensure!(
            usize::from(press.level) <= levels,
            "the model has {levels} levels, and the data has a press of level {}",
            press.level
        );
        let verdict = match hrn.format() {
            Format::Frame => {
                hrn.card().check_array(Array::JX255N)?;
                hrn.judge_taxels(&presses.frame_for(place, hrn.card()).newtons)?
            }
            Format::Parts => {
                let array = presses.grid().map_or(Array::JX255N, |grid| grid.array);
                hrn.card().check_array(array)?;
                hrn.judge_taxels(&presses.parts(place, array))?
            }
            Format::Course { .. } => {
                let of_sensor = references.get(&press.sensor);
                let none = References::NONE;
                let references = of_sensor.map_or(&none, |of| &of[half_of(press.object)]);
                hrn.judge_beside(&presses.course_for(place, hrn.card()), references)?
            }
        };
        // As the daemon publishes it.
        let shore = verdict.shore.map(|shore| hrn.within(shore, verdict.level));
        verdicts.push((place, Verdict { shore, ..verdict }));
    }
    let judged: Vec<usize> = verdicts.iter().map(|&(place, _)| place).collect();
    let units = presses.units(&judged);
    let case = |(number, (place, verdict)): (usize, (usize, Verdict))| {
        let press = &presses.all[place];
        let unit = units.as_ref();
        Case {
            press: place,
            level: press.level,
            shore: press.shore,
            object: press.object,
            unit: unit.map(|(unit, numbers)| (*unit, numbers[number])),
            verdict,
        }
    };
    Ok(verdicts.into_iter().enumerate().map(case).collect())
}
