//! `hrn-train collect`.

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use hardnessd::daemon::config::{Config, SensorTable, Setup};
use hardnessd::train::data::collect::{self, Capture, Labelling};
use hardnessd::train::run::disk::write_whole;

use super::arguments::Collect;
use super::files::write;

pub(super) fn collect(arguments: &Collect) -> anyhow::Result<String> {
    let setup = match &arguments.config {
        Some(config) => Setup::load(config)?,
        None => {
            let defaults = Config::new(vec![SensorTable::new(PathBuf::new())]);
            Setup::of(defaults, Path::new("defaults"))?
        }
    };
    let sensor = setup.sensors.first();
    let sensor = sensor.context("the configuration has no sensor")?;
    let captures = arguments
        .captures
        .iter()
        .map(|path| Capture::read(path, sensor, &setup.hrn))
        .collect::<Result<Vec<_>, _>>()?;
    if arguments.sequences {
        return collect_courses(arguments, &captures);
    }
    let before = if arguments.append {
        collect::existing(&arguments.out)?
    } else {
        None
    };
    let presses: usize = captures.iter().map(Capture::presses).sum();
    let all = before
        .as_ref()
        .map_or(0, |(dataset, _)| dataset.samples.len())
        + presses;
    let is_added_to = before.is_some();
    let bytes = collect::to_bytes(&captures, labelling(arguments), before)?;
    if is_added_to {
        write_whole(&arguments.out, &bytes)?;
    } else {
        write(&arguments.out, &bytes)?;
    }
    let out = arguments.out.display();
    let collected = presses_of(presses);
    Ok(format!(
        "{out}: {collected} collected, {all} in all; an object's further presses must go into \
         this file, not another\n"
    ))
}

/// A number of presses as text.
fn presses_of(count: usize) -> String {
    format!("{count} press{}", if count == 1 { "" } else { "es" })
}

fn labelling(arguments: &Collect) -> Labelling {
    Labelling {
        level: arguments.level,
        object: arguments.object,
        split: arguments.split.into(),
    }
}

fn collect_courses(arguments: &Collect, captures: &[Capture]) -> anyhow::Result<String> {
    let before = if arguments.append {
        collect::existing_courses(&arguments.out)?
    } else {
        None
    };
    let is_added_to = before.is_some();
    let before_count = before
        .as_ref()
        .map_or(0, |(courses, ..)| courses.presses.len());
    let (mut whole, mut known) = (0, 0);
    for capture in captures {
        let of_capture = capture.courses();
        (whole, known) = (whole + of_capture.0, known + of_capture.1);
    }
    let left_out = captures.iter().map(Capture::presses).sum::<usize>() - whole;
    if whole == 0 {
        anyhow::bail!(
            "the recordings lack the begin of every press: start to record before you touch the sensor"
        );
    }
    let bytes = collect::courses_to_bytes(captures, labelling(arguments), before)?;
    if is_added_to {
        write_whole(&arguments.out, &bytes)?;
    } else {
        write(&arguments.out, &bytes)?;
    }
    let collected = presses_of(whole);
    Ok(format!(
        "{}: {collected} collected, {known} of them with the arm's approach, {left_out} left out \
         because the recording lacks their begin, {} in all; an object's further presses must go into this \
         file, not another\n",
        arguments.out.display(),
        before_count + whole
    ))
}
