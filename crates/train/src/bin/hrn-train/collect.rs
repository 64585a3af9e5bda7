//! `hrn-train collect`.

use anyhow::{Context as _, ensure};
use hardnessd_core::part::Part;
use hardnessd_core::verdict::Borders;
use hrn_train::data::collect::{self, Collection, Settings};
use hrn_train::data::presses::Layout;
use hrn_train::data::source::papers_levels;
use hrn_train::run::disk::{check_new, lock};

use super::arguments::Collect;
use super::configuration::described;

pub(super) fn collect(arguments: &Collect) -> anyhow::Result<String> {
    let (sensor, levels) = described(arguments.config.as_deref())?;
    let captures = collect::captures(&arguments.captures)?;
    let out = &arguments.out;
    let earlier = Some(out.as_path()).filter(|out| arguments.append && out.exists());
    if earlier.is_none() {
        check_new(out).context("--append adds to a data set")?;
    }
    // No other call adds to the data set meanwhile, because the later one would undo the earlier one.
    let _locked = earlier.map(lock).transpose()?;
    let layout = Layout::of(arguments.sequences);
    let mut collection = match earlier {
        Some(earlier) => Collection::of(earlier, layout)?,
        None => Collection::default(),
    };
    let mut sources = collection.presses.sources.iter();
    let stated = sources.find_map(|source| source.levels.clone());
    if let (Some(stated), Some(levels)) = (&stated, &levels) {
        ensure!(
            stated == levels,
            "{}: its levels are not those of --config, so its presses would get other names: collect a new data set",
            out.display()
        );
    }
    let settings = Settings {
        levels: levels
            .or(stated.filter(|stated| Borders::of(stated).is_ok()))
            .unwrap_or_else(papers_levels),
        level: arguments.level,
        object: arguments.object,
        is_one_object: true,
        split: arguments.split,
    };
    let before = collection.presses.all.len();
    let skips = arguments.skip_unusable;
    let add = |recording| collection.add(recording, &settings);
    let used = collect::recordings(&captures, &sensor, layout, skips, add)?;
    ensure!(used > 0, "no recording can be used");
    let written = || -> anyhow::Result<()> {
        let part = match earlier {
            Some(_) => Part::over(out)?,
            None => Part::new(out)?,
        };
        collection.write(part.as_file(), layout)?;
        Ok(part.finish()?)
    };
    written().with_context(|| out.display().to_string())?;
    let presses = &collection.presses;
    let all = presses.all.len();
    let known = (before..all).filter(|&press| presses.is_known(press));
    Ok(format!(
        "{}: presses collected: {}, with the arm's approach: {}, in all: {all}; recordings left out: {}\n",
        out.display(),
        all - before,
        known.count(),
        captures.len() - used
    ))
}
