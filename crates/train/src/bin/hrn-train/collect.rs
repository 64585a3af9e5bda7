//! `hrn-train collect`.

use std::io::{self, ErrorKind};
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context as _, bail};
use hardnessd_core::part::Part;
use hardnessd_core::sensor::{Description, Sensor};
use hardnessd_core::verdict::{BUILT_IN_HRN, Hrn};
use hrn_train::data::collect::{self, LeaveOut, Settings, Unnumbered};
use hrn_train::data::presses::Layout;
use hrn_train::data::source::papers_levels;
use hrn_train::run::disk::lock;

use super::arguments::Collect;
use super::configuration::first_sensor;

pub(super) fn collect(arguments: &Collect) -> anyhow::Result<String> {
    let sensor = match &arguments.config {
        Some(config) => first_sensor(config)?,
        None => Sensor::new(Description::default())?,
    };
    let captures = collect::captures(&arguments.captures)?;
    let out = &arguments.out;
    check_out(arguments)?;
    let earlier = Some(out.as_path()).filter(|out| arguments.append && out.exists());
    // No other call adds to the data set meanwhile, because the later one would undo the earlier one.
    let _locked = earlier.map(lock).transpose()?;
    let settings = Settings {
        sensor,
        hrn: Arc::new(Hrn::load(BUILT_IN_HRN)?),
        levels: papers_levels(),
        level: arguments.level,
        object: arguments.object,
        unnumbered: Unnumbered::One,
        split: arguments.split,
        layout: match arguments.sequences {
            true => Layout::OverTime,
            false => Layout::Frames,
        },
        leave_out: match arguments.skip_unusable {
            true => LeaveOut::Unusable,
            false => LeaveOut::None,
        },
    };
    let collection = collect::collect(&captures, earlier, &settings)?;
    collection.say_left_out();
    let left_out = collection.left_out.len();
    if left_out == captures.len() {
        bail!("no recording can be used");
    }
    let part = match earlier {
        Some(_) => Part::over(out),
        None => Part::new(out),
    };
    let written = || -> anyhow::Result<()> {
        let part = part?;
        collection.write(part.as_file(), settings.layout)?;
        Ok(part.finish()?)
    };
    written().with_context(|| out.display().to_string())?;
    let [added, known] = collection.added();
    Ok(format!(
        "{}: presses collected: {added}, with the arm's approach: {known}, in all: {}; recordings left out: {left_out}\n",
        out.display(),
        collection.presses()
    ))
}

/// Returns an error if the data set cannot be at `--out`, before anything is read.
fn check_out(arguments: &Collect) -> anyhow::Result<()> {
    let out: &Path = &arguments.out;
    let found = if out.exists() && !out.is_file() {
        "is no file: name a file"
    } else if out.symlink_metadata().is_ok() && !arguments.append {
        "exists already: add to it with --append, or name another --out"
    } else {
        return Ok(());
    };
    let error = io::Error::new(ErrorKind::AlreadyExists, found);
    Err(error).with_context(|| out.display().to_string())
}
