//! `hrn-train collect`.

use std::fmt::Write as _;
use std::fs;
use std::io::{self, ErrorKind, Write as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context as _, bail};
use hardnessd_core::part;
use hardnessd_core::sensor::{Description, Sensor};
use hardnessd_core::verdict::{BUILT_IN_HRN, Hrn};
use hrn_train::data::collect::{self, Collection, Labelling, Part, Settings, Unnumbered};
use hrn_train::data::presses::Layout;
use hrn_train::data::source::papers_levels;
use hrn_train::run::disk::lock;

use super::arguments::Collect;
use super::configuration::first_sensor;
use super::failure::NotCollected;
use super::files::apart;

pub(super) fn collect(arguments: &Collect) -> anyhow::Result<String> {
    let sensor = match &arguments.config {
        Some(config) => first_sensor(config)?,
        None => Sensor::new(Description::default())?,
    };
    let captures = collect::captures(&arguments.captures)?;
    let out = &arguments.out;
    check_out(arguments, &captures)?;
    let is_appended = arguments.append && out.exists();
    // No other call adds to the data set meanwhile, because the later one would undo the earlier one.
    let _locked = is_appended.then(|| lock(out)).transpose()?;
    let layout = match arguments.sequences {
        true => Layout::OverTime,
        false => Layout::Frames,
    };
    let earlier = is_appended.then(|| Part::of_data_set(out, layout));
    let settings = Settings {
        sensor,
        hrn: Arc::new(Hrn::load(BUILT_IN_HRN)?),
        unnumbered: Unnumbered::One,
        levels: papers_levels(),
        labelling: Labelling {
            level: arguments.level,
            object: arguments.object,
            split: arguments.split,
        },
        layout,
        skip_unusable: arguments.skip_unusable,
    };
    let collection = collect::collect(&captures, earlier.transpose()?, &settings);
    let collection = collection.map_err(|error| match captures.len() {
        1 => anyhow::Error::new(error),
        _ => NotCollected(error).into(),
    })?;
    if collection.left_out.len() == captures.len() {
        write_left_out(&collection, arguments)?;
        let list = left_out_of(out);
        bail!("no recording can be used: {} says why", list.display());
    }
    if collection.added == 0 {
        bail!(
            "the recordings lack the begin of every press: start to record before you touch the sensor"
        );
    }
    write(out, is_appended, |file| collection.write(file).map(drop))?;
    if arguments.skip_unusable {
        write_left_out(&collection, arguments)?;
    }
    Ok(account(arguments, &collection))
}

/// Returns an error if the data set or the list of what was left out cannot be at `--out`, before
/// anything is read.
fn check_out(arguments: &Collect, captures: &[PathBuf]) -> anyhow::Result<()> {
    let out = &arguments.out;
    apart("--out", out, captures.iter().map(PathBuf::as_path))?;
    let list = arguments.skip_unusable.then(|| left_out_of(out));
    for path in [Some(out.clone()), list].into_iter().flatten() {
        let found = if path.exists() && !path.is_file() {
            "is no file: name a file"
        } else if path.symlink_metadata().is_ok() && !arguments.append {
            "exists already: add to it with --append, or name another --out"
        } else {
            continue;
        };
        let error = io::Error::new(ErrorKind::AlreadyExists, found);
        return Err(error).with_context(|| path.display().to_string());
    }
    Ok(())
}

/// Writes a file as a whole. It replaces only what it adds to.
fn write(
    path: &Path,
    is_appended: bool,
    write: impl FnOnce(&fs::File) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    let written = || -> anyhow::Result<()> {
        let part = match is_appended {
            true => part::Part::over(path)?,
            false => part::Part::new(path)?,
        };
        write(part.as_file())?;
        Ok(part.finish()?)
    };
    written().with_context(|| path.display().to_string())
}

fn left_out_of(out: &Path) -> PathBuf {
    let mut name = out.file_name().unwrap_or_default().to_owned();
    name.push(".left-out.tsv");
    out.with_file_name(name)
}

/// Writes the list, or adds to that of the data set.
fn write_left_out(collection: &Collection, arguments: &Collect) -> anyhow::Result<()> {
    let path = left_out_of(&arguments.out);
    let is_appended = arguments.append && path.exists();
    let mut list = match is_appended {
        true => fs::read_to_string(&path).with_context(|| path.display().to_string())?,
        false => String::new(),
    };
    for (path, reason) in &collection.left_out {
        let path = path.display().to_string();
        let one = |text: &str| text.replace(char::is_control, " ");
        let _ = writeln!(list, "{}\t{}", one(&path), one(reason));
    }
    write(&path, is_appended, |mut file| {
        Ok(file.write_all(list.as_bytes())?)
    })
}

/// A number with a noun, whose plural is `many`.
fn counted(count: usize, one: &str, many: &str) -> String {
    format!("{count} {}", if count == 1 { one } else { many })
}

fn account(arguments: &Collect, collection: &Collection) -> String {
    let out = &arguments.out;
    let collected = counted(collection.added, "press", "presses");
    let mut account = format!("{}: {collected} collected, ", out.display());
    if arguments.sequences {
        let (known, partial) = (collection.known, collection.partial);
        let _ = write!(
            account,
            "{known} of them with the arm's approach, {partial} left out because the recording lacks \
             their begin, "
        );
    }
    let _ = writeln!(
        account,
        "{} in all; an object's further presses must go into this file, not another",
        collection.presses()
    );
    if arguments.skip_unusable {
        let left_out = counted(collection.left_out.len(), "recording", "recordings");
        let list = left_out_of(out);
        let _ = writeln!(account, "{}: {left_out} left out", list.display());
    }
    account
}
