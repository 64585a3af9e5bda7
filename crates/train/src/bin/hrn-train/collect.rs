//! `hrn-train collect`.

use std::fmt::Write as _;
use std::fs::{self, File};
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread;

use anyhow::{Context as _, bail};
use hardnessd_core::sensor::{Description, Sensor};
use hardnessd_core::verdict::{BUILT_IN, Hrn};
use hrn_train::data::collect::{
    self, CollectError, Collection, Earlier, Labelling, Parts, Unusable,
};
use hrn_train::run::disk::{lock, write_streamed, write_whole};

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
    // The first lock keeps other calls from the data set, the second from the parts. The data set is
    // read under the lock, so that no other call adds to it meanwhile.
    let own = Directory::locked(beside(out), false)?;
    let kept = arguments.parts.as_ref();
    let kept = kept.map(|parts| Directory::locked(parts.clone(), true));
    let kept = kept.transpose()?;
    let earlier = if arguments.append {
        Earlier::read(out, arguments.sequences)?
    } else {
        None
    };
    let earlier_presses = earlier.as_ref().map(Earlier::presses);
    let parts = Parts::new(
        kept.as_ref().unwrap_or(&own).path.clone(),
        sensor,
        Arc::new(Hrn::load(BUILT_IN)?),
        arguments.sequences,
    )?;
    let labelling = Labelling {
        level: arguments.level,
        object: arguments.object,
        split: arguments.split.into(),
    };
    let unusable = match arguments.skip_unusable {
        true => Unusable::LeftOut,
        false => Unusable::Ends,
    };
    let jobs = arguments.jobs.unwrap_or_else(|| {
        let cores = thread::available_parallelism();
        cores.unwrap_or(NonZeroUsize::MIN)
    });
    let collection = collect::collect(&captures, &parts, labelling, earlier, jobs, unusable);
    let collection = collection.map_err(|error| match error.downcast::<CollectError>() {
        Ok(error) if captures.len() > 1 => NotCollected(error).into(),
        Ok(error) => error.into(),
        Err(error) => error,
    })?;
    if arguments.skip_unusable {
        write_left_out(&collection, out)?;
    }
    if collection.left_out.len() == captures.len() {
        let list = left_out_of(out);
        bail!("no recording can be used: {} says why", list.display());
    }
    if collection.presses == 0 {
        bail!(
            "the recordings lack the begin of every press: start to record before you touch the sensor"
        );
    }
    let is_replaced = earlier_presses.is_none() && out.is_file();
    write_streamed(out, |file| collection.write(file))?;
    if is_replaced {
        hardnessd_core::say!("{}: replaced the earlier file", out.display());
    }
    let all = earlier_presses.unwrap_or_default() + collection.presses;
    Ok(account(arguments, &collection, all))
}

/// Returns an error if the data set or the list of what was left out cannot be at `--out`, before
/// anything is read.
fn check_out(arguments: &Collect, captures: &[PathBuf]) -> anyhow::Result<()> {
    let out = &arguments.out;
    apart("--out", out, captures.iter().map(PathBuf::as_path))?;
    if out.is_dir() {
        bail!("{}: is a directory: name a file", out.display());
    }
    if arguments.skip_unusable && out.exists() && !out.is_file() {
        bail!(
            "{}: is no file, so no list of what is left out can be beside it: name a file, or leave \
             --skip-unusable out",
            out.display()
        );
    }
    Ok(())
}

/// A directory that this call alone uses. It is removed at the end unless it is kept.
struct Directory {
    path: PathBuf,
    is_kept: bool,
    /// The lock. The field is dropped after the directory is removed.
    _locked: File,
}

impl Directory {
    fn locked(path: PathBuf, is_kept: bool) -> anyhow::Result<Self> {
        match fs::create_dir(&path) {
            Err(error) if !path.is_dir() => Err(error)
                .with_context(|| format!("{}: the directory cannot be created", path.display())),
            _ => Ok(Self {
                _locked: lock(&path)?,
                path,
                is_kept,
            }),
        }
    }
}

impl Drop for Directory {
    fn drop(&mut self) {
        if !self.is_kept {
            // What is left behind costs disk space only.
            let _ = fs::remove_dir_all(&self.path);
        }
    }
}

/// The directory of one call, which locks the data set and has the parts without `--parts`. It is
/// beside the data set, which needs as much space. If that is a pipe or a device, it is among
/// temporary files.
fn beside(out: &Path) -> PathBuf {
    if out.exists() && !out.is_file() {
        let name = format!("hrn-train-collect-{}", std::process::id());
        return std::env::temp_dir().join(name);
    }
    with_more(out, ".collecting")
}

fn left_out_of(out: &Path) -> PathBuf {
    with_more(out, ".left-out.tsv")
}

/// A path with `more` after its file name.
fn with_more(path: &Path, more: &str) -> PathBuf {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(more);
    path.with_file_name(name)
}

fn write_left_out(collection: &Collection, out: &Path) -> anyhow::Result<()> {
    let mut list = String::new();
    for (path, reason) in &collection.left_out {
        let path = path.display().to_string();
        let one = |text: &str| text.replace(char::is_control, " ");
        let _ = writeln!(list, "{}\t{}", one(&path), one(reason));
    }
    write_whole(&left_out_of(out), list.as_bytes())
}

/// A number with a noun, whose plural is `many`.
fn counted(count: usize, one: &str, many: &str) -> String {
    format!("{count} {}", if count == 1 { one } else { many })
}

fn account(arguments: &Collect, collection: &Collection, all: usize) -> String {
    let out = &arguments.out;
    let collected = counted(collection.presses, "press", "presses");
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
        "{all} in all; an object's further presses must go into this file, not another"
    );
    if arguments.skip_unusable {
        let left_out = counted(collection.left_out.len(), "recording", "recordings");
        let list = left_out_of(out);
        let _ = writeln!(account, "{}: {left_out} left out", list.display());
    }
    account
}
