//! Text about a model, about an evaluation and about a data set.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::Path;

use hardnessd_core::verdict::{Hrn, Level};
use hardnessd_simulator::Split;
use hrn_train::compare::tables::thousands;
use hrn_train::data::presses::{Press, Presses};
use hrn_train::judge::metrics::Evaluation;
use hrn_train::model::evaluated::{Case, Difference, Evaluated, NEAR_BORDER};

/// The card of the model read from `path`.
pub(super) fn of_model(path: &Path, hrn: &Hrn) -> String {
    let card = hrn.card();
    let mut text = format!("{}\n", path.display());
    let mut row = |name: &str, value: String| {
        let _ = writeln!(text, "{name:<14}{value}");
    };
    row("sha256", hrn.sha256().to_owned());
    row("format", card.format.clone());
    row("method", card.method.clone());
    row("validation", card.validation.clone());
    for level in &card.levels {
        let name = format!("level {}", level.level);
        row(&name, format!("{}, Shore {}", level.label, level.shore));
    }
    row("pitch", format!("{} mm", card.pitch_mm));
    let [least, most] = card.range.contact_area_taxels;
    row(
        "contact area",
        format!("{least} to {most} taxels in training"),
    );
    let of_presses = card.range.of_presses().into_iter();
    let names = [
        ("force", "N"),
        ("duration", "s"),
        ("frame period", "s"),
        ("arm's speed", "mm/s"),
        ("approach", "mm"),
        ("arm", "N/mm"),
    ];
    let ranges = [Some(card.range.force_n)].into_iter().chain(of_presses);
    for ((name, unit), range) in names.into_iter().zip(ranges) {
        if let Some([least, most]) = range {
            row(name, format!("{least:.2} to {most:.2} {unit} in training"));
        }
    }
    if let Some(temperature) = card.metrics["temperature"].as_f64() {
        row("temperature", format!("{temperature:.3}"));
    }
    row("data", card.data.clone());
    row("metrics", card.metrics.to_string());
    row(
        "check frames",
        format!("{}, all reproduced", hrn.checks().count()),
    );
    text
}

/// The figures of an evaluation.
pub(super) fn of_evaluated(evaluation: &Evaluated) -> String {
    let percent = |share: f64| share * 100.0;
    let mut text = of_evaluation(&evaluation.levels);
    let _ = writeln!(
        text,
        "level off by more than one  {:.1} %",
        percent(evaluation.beyond_neighbour)
    );
    if let Some(shore) = &evaluation.shore {
        let shown = |rmse: Option<f64>| rmse.map_or("-".to_owned(), |rmse| format!("{rmse:.1}"));
        let levels = shore.rmse_by_level.iter().copied();
        let levels: Vec<String> = levels.map(shown).collect();
        let _ = writeln!(
            text,
            "Shore OO           rmse {:.2} (by level {}; within {NEAR_BORDER} of a border {}); 90 % interval holds \
             {:.1} %, {:.1} wide",
            shore.rmse,
            levels.join(", "),
            shown(shore.rmse_near_borders),
            percent(shore.coverage),
            shore.width
        );
    }
    if let Some(sets) = &evaluation.sets {
        let others = sets.accuracy_of_others;
        let others = others.map_or("-".to_owned(), |share| format!("{:.1} %", percent(share)));
        let _ = writeln!(
            text,
            "sets of levels     hold {:.1} %; {:.1} % of presses ambiguous, {others} of the others right",
            percent(sets.coverage),
            percent(sets.ambiguous)
        );
    }
    text
}

/// What a second model does better than a first one.
pub(super) fn of_difference(difference: &Difference) -> String {
    let points = |share: f64| format!("{:+.1}", 100.0 * share);
    let interval = match difference.interval {
        Some([low, high]) => format!("95 %: {} to {}", points(low), points(high)),
        None => "no interval: it needs two objects of each level, and presses that one alone judges rightly"
            .to_owned(),
    };
    let [first, second] = difference.only;
    format!(
        "the second less the first  {} points of accuracy ({interval}); right alone: the first on {first} presses, \
         the second on {second}\n",
        points(difference.accuracy)
    )
}

/// The figures of the levels, and the confusion matrix with a row for each true level.
fn of_evaluation(evaluation: &Evaluation) -> String {
    let percent = |share: f64| share * 100.0;
    let by = |unit: &str, interval: Option<[f64; 2]>| {
        interval.map(|[low, high]| {
            let (low, high) = (percent(low), percent(high));
            format!("95 % by {unit}: {low:.1} to {high:.1} %")
        })
    };
    let interval = by("object", evaluation.accuracy_interval_by_object)
        .or(by("cover", evaluation.accuracy_interval_by_cover))
        .unwrap_or_else(|| {
            "no interval: it needs two objects of each level, and a right and a wrong verdict"
                .to_owned()
        });
    let number = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.4}"));
    let levels: String = (1..=evaluation.confusion.len())
        .map(|level| format!("{level:>7}"))
        .collect();
    let rows: String = evaluation
        .confusion
        .iter()
        .zip(&evaluation.category_accuracy)
        .enumerate()
        .map(|(level, (row, right))| {
            let counts: String = row.iter().map(|count| format!("{count:>7}")).collect();
            let right = right.map_or("-".to_owned(), |right| format!("{:.1} %", percent(right)));
            format!("level {}       {counts}   {right}\n", level + 1)
        })
        .collect();
    format!(
        "samples            {}\n\
         accuracy           {:.1} % ({interval})\n\
         balanced accuracy  {:.1} %\n\
         kappa              {}\n\
         kappa, quadratic   {}\n\
         calibration error  {:.1} %\n\
         negative log-likelihood  {} nats a sample\n\
         truth \\ said  {levels}\n\
         {rows}",
        evaluation.n,
        percent(evaluation.accuracy),
        percent(evaluation.balanced_accuracy),
        number(evaluation.kappa),
        number(evaluation.kappa_quadratic),
        percent(evaluation.ece),
        format_args!("{:.4}", evaluation.nll)
    )
}

/// The number of presses of each level in each split.
pub(super) fn of_data(presses: &Presses) -> String {
    let mut text = String::new();
    for (split, name) in [(Split::Train, "training"), (Split::Test, "test")] {
        let all = presses.all.iter();
        let own: Vec<&Press> = all.filter(|press| press.split == split).collect();
        if own.is_empty() {
            continue;
        }
        let own = own.into_iter().filter(|press| press.reference.is_none());
        let count = |level| thousands(own.clone().filter(|press| press.level == level).count());
        let counts = presses.levels().into_iter();
        let counts = counts.map(|of| format!("level {} {}, ", of.level, count(of.level)));
        let counts: String = counts.collect();
        let _ = writeln!(
            text,
            "{name} presses: {counts}unlabelled (level 0) {}",
            count(0)
        );
    }
    text
}

/// Warnings about levels with few labelled training presses, or none.
pub(super) fn of_levels(presses: &Presses) -> String {
    let mut text = String::new();
    for Level { level, .. } in presses.levels() {
        let places = presses.labelled(Split::Train);
        let own = places.filter(|&place| presses.all[place].level == level);
        let objects: BTreeSet<Option<u32>> = own.map(|place| presses.all[place].object).collect();
        let warning = match (objects.len(), objects.contains(&None)) {
            (0, _) => "no labelled training press: the model never learns to say it",
            (1, false) => {
                "all training presses are of one object: the model may learn the object and not the hardness"
            }
            _ => continue,
        };
        let _ = writeln!(text, "warning: level {level}: {warning}");
    }
    text
}

/// Verdicts as CSV, one line each after the header: object, true level, verdict's level,
/// probabilities, Shore OO with its interval, and the true Shore OO. Unknown values are empty.
pub(super) fn csv(cases: &[Case]) -> String {
    let mut text = String::new();
    for case in cases {
        let (verdict, level) = (&case.verdict, case.level);
        if text.is_empty() {
            text += "object,level,judged";
            for level in 1..=verdict.probabilities.len() {
                let _ = write!(text, ",probability_{level}");
            }
            text += ",shore,shore_low,shore_high,true_shore\n";
        }
        let object = case.object.map(|object| object.to_string());
        let object = object.unwrap_or_default();
        let _ = write!(text, "{object},{level},{}", verdict.level);
        for probability in &verdict.probabilities {
            let _ = write!(text, ",{probability:.6}");
        }
        match verdict.shore {
            Some(shore) => {
                let _ = write!(
                    text,
                    ",{:.3},{:.3},{:.3}",
                    shore.value, shore.low, shore.high
                );
            }
            None => text += ",,,",
        }
        let truth = case.shore.map(|shore| format!("{shore:.3}"));
        let _ = writeln!(text, ",{}", truth.unwrap_or_default());
    }
    text
}
