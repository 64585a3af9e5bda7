//! `hrn-train fit`.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Context as _, bail};
use hardnessd_core::exit::USAGE;
use hardnessd_core::trial;
use hardnessd_core::verdict::{Borders, Level};
use hardnessd_core::wording;
use hrn_train::exit::coded;
use hrn_train::fit::{self, Division, Estimate, Report, Row, Written};
use hrn_train::run::disk::{check_new, write_new};

use super::arguments::Fit;
use super::configuration::described;

/// The most wrongly judged presses that are listed.
const LISTED: usize = 20;

pub(super) fn fit(arguments: &Fit) -> anyhow::Result<String> {
    let (sensor, levels) = described(arguments.config.as_deref())?;
    let out = arguments.out.display();
    let ending = arguments.out.extension();
    if ending.is_none_or(|ending| ending != "onnx") {
        let text = format!("--out: found {out}, expected a name that ends with .onnx");
        return Err(coded(USAGE, text));
    }
    check_new(&arguments.out)?;
    let references = arguments.out.with_extension("npz");
    check_new(&references).with_context(|| {
        format!("--out {out}: references would be written beside it: name another --out")
    })?;
    let (report, written) = fit::fit(&arguments.data, &sensor, levels)?;
    let text = match arguments.json {
        true => wording::json_escaped(&serde_json::to_string(&report)?) + "\n",
        false => of_report(&report),
    };
    match save(written, &arguments.out, &references, sensor.frame_rate_hz()) {
        Ok(lines) if arguments.json || lines.is_empty() => Ok(text),
        Ok(lines) => Ok(format!(
            "{text}\nThe daemon loads it. Its lines in the configuration:\n\n{lines}"
        )),
        // The table took minutes.
        Err(error) => {
            super::print(&text)?;
            Err(error)
        }
    }
}

/// Writes the model or the references, and gives their lines in the configuration.
fn save(
    written: Option<Written>,
    model: &Path,
    references: &Path,
    rate_hz: f64,
) -> anyhow::Result<String> {
    Ok(match written {
        None => bail!("nothing was written, because no candidate is better than guessing"),
        Some(Written::Model(bytes)) => {
            trial::load(&bytes, Some(trial::verdict_most(rate_hz)))
                .context("the daemon refuses the model")?;
            write_new(model, &bytes)?;
            format!("[model]\npath = {}\n", shown(model))
        }
        Some(Written::References(bytes, levels)) => {
            let own = levels.as_deref().map(of_levels).transpose()?;
            let line = match bytes {
                Some(bytes) => {
                    write_new(references, &bytes)?;
                    let path = shown(references);
                    format!("references = {path}   # in the table of the [[sensor]]\n")
                }
                None => String::new(),
            };
            line + &own.unwrap_or_default()
        }
    })
}

/// A path as TOML has it.
fn shown(path: &Path) -> String {
    let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    toml::Value::from(path.to_string_lossy().into_owned()).to_string()
}

/// The `[[level]]` tables of levels that are parts of the scale.
fn of_levels(levels: &[Level]) -> anyhow::Result<String> {
    let borders = Borders::of(levels)?;
    let table = |(place, level): (usize, &Level)| {
        let label = toml::Value::from(level.label.as_str());
        let [low, high] = borders.part(place);
        format!("[[level]]\nlabel = {label}\nshore = [{low:?}, {high:?}]\n")
    };
    Ok(levels.iter().enumerate().map(table).collect())
}

fn of_report(report: &Report) -> String {
    let mut text = format!("{} presses\n", report.presses);
    for of in &report.levels {
        let (
            Level {
                level,
                label,
                shore,
            },
            presses,
        ) = (&of.level, of.presses);
        let objects = match of.objects {
            1 => "1 object".to_owned(),
            count => format!("{count} objects"),
        };
        text += &format!("  level {level} {label} ({shore}): {presses} presses of {objects}\n");
    }
    text += "\nbalanced accuracy (95 %)      on new objects           on later presses\n";
    for row in report.candidates.iter().chain(&report.controls) {
        text += &of_row(row);
    }
    if let Some(best) = &report.best {
        let by = match report.chosen_by {
            Some(Division::NewObjects) => "objects that it had not met",
            _ => "later presses",
        };
        let _ = writeln!(text, "\n{best} on {by}:\ntruth \\ said");
        for (of, row) in report.levels.iter().zip(&report.confusion) {
            let counts: String = row.iter().map(|count| format!("{count:>6}")).collect();
            let _ = writeln!(text, "  {:<16}{counts}", of.level.label);
        }
        for wrong in report.wrong.iter().take(LISTED) {
            let (press, level, said) = (&wrong.press, &wrong.level, &wrong.said);
            text += &format!("  wrong: {press} is {level}, {best} says {said}\n");
        }
        if report.wrong.len() > LISTED {
            let more = report.wrong.len() - LISTED;
            let _ = writeln!(text, "  and {more} more, which --json lists");
        }
    }
    for remark in &report.remarks {
        let _ = writeln!(text, "\n{}.", capital(remark));
    }
    text
}

fn of_row(row: &Row) -> String {
    if let Some(left_out) = &row.left_out {
        return format!("  {:<27} left out: {left_out}\n", row.name);
    }
    let shown = |estimate: &Option<Estimate>| match estimate {
        None => "-".to_owned(),
        Some(of) => {
            let percent = |share: f64| format!("{:.1}", 100.0 * share);
            let interval = of.interval.map_or_else(String::new, |[low, high]| {
                format!(" ({} to {})", percent(low), percent(high))
            });
            format!("{} %{interval}", percent(of.balanced_accuracy))
        }
    };
    let (new, later) = (shown(&row.new_objects), shown(&row.later_presses));
    format!("  {:<27} {new:<24} {later}\n", row.name)
}

fn capital(text: &str) -> String {
    let mut chars = text.chars();
    let first = chars.next().map(|first| first.to_uppercase().to_string());
    first.unwrap_or_default() + chars.as_str()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_are_written_as_the_configuration_takes_them() {
        let levels = [
            Level::new(1, "green", ">65"),
            Level::new(2, "half \"ripe\"", "40-65"),
            Level::new(3, "ripe", "<=40"),
        ];
        let text = of_levels(&levels).unwrap();
        let tables: toml::Table = text.parse().unwrap();
        let shore = |place: usize| tables["level"][place]["shore"].as_array().unwrap().clone();
        assert_eq!(shore(0), [65.0, 100.0].map(toml::Value::from));
        assert_eq!(shore(1), [40.0, 65.0].map(toml::Value::from));
        assert_eq!(shore(2), [0.0, 40.0].map(toml::Value::from));
        assert_eq!(tables["level"][1]["label"].as_str(), Some("half \"ripe\""));
    }
}
