//! Text about a model, about an evaluation and about a data set.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::Path;

use hardnessd_core::verdict::Hrn;
use hardnessd_simulator::Split;
use hrn_train::compare::tables::thousands;
use hrn_train::data::presses::Presses;
use hrn_train::judge::metrics::Evaluation;
use hrn_train::model::evaluated::{Case, Difference, Evaluated, NEAR_BORDER};

/// The card of the model read from `path`.
pub(super) fn of_model(path: &Path, hrn: &Hrn) -> String {
    let card = hrn.card();
    let levels: String = card
        .levels
        .iter()
        .map(|level| {
            format!(
                "level {}       {}, Shore {}\n",
                level.level, level.label, level.shore
            )
        })
        .collect();
    let temperature = card.metrics["temperature"]
        .as_f64()
        .map_or_else(String::new, |temperature| {
            format!("temperature   {temperature:.3}\n")
        });
    let [least_n, most_n] = card.range.force_n;
    let [least_taxels, most_taxels] = card.range.contact_area_taxels;
    let names = [
        ("duration     ", "s"),
        ("frame period ", "s"),
        ("arm's speed  ", "mm/s"),
        ("approach     ", "mm"),
        ("arm          ", "N/mm"),
    ];
    let of_presses: String = names
        .iter()
        .zip(card.range.of_presses())
        .filter_map(|((name, unit), range)| {
            let [least, most] = range?;
            Some(format!(
                "{name} {least:.2} to {most:.2} {unit} in training\n"
            ))
        })
        .collect();
    format!(
        "{}\n\
         sha256        {}\n\
         format        {}\n\
         method        {}\n\
         validation    {}\n\
         {levels}\
         pitch         {} mm\n\
         force         {least_n:.2} to {most_n:.2} N in training\n\
         contact area  {least_taxels} to {most_taxels} taxels in training\n\
         {of_presses}\
         {temperature}\
         data          {}\n\
         metrics       {}\n\
         check frames  {}, all reproduced\n",
        path.display(),
        hrn.sha256(),
        card.format,
        card.method,
        card.validation,
        card.pitch_mm,
        card.data,
        card.metrics,
        hrn.checks().count()
    )
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

/// The number of presses of each level in each split, and a warning if the levels were probably counted
/// from 0.
pub(super) fn of_data(presses: &Presses) -> String {
    let mut text = String::new();
    let levels: Vec<u8> = presses.levels().iter().map(|level| level.level).collect();
    let count = |split, level| {
        let all = presses.all.iter();
        all.filter(|press| {
            press.split == split && press.level == level && press.reference.is_none()
        })
        .count()
    };
    for (split, name) in [(Split::Train, "training"), (Split::Test, "test")] {
        if presses.all.iter().all(|press| press.split != split) {
            continue;
        }
        let mut counts: Vec<String> = levels
            .iter()
            .map(|&level| format!("level {level} {}", thousands(count(split, level))))
            .collect();
        counts.push(format!(
            "unlabelled (level 0) {}",
            thousands(count(split, 0))
        ));
        let _ = writeln!(text, "{name} presses: {}", counts.join(", "));
    }
    let has = |level: u8| {
        [Split::Train, Split::Test]
            .iter()
            .any(|&split| count(split, level) > 0)
    };
    if let Some(&highest) = levels.last()
        && has(0)
        && !has(highest)
        && (1..highest).all(has)
    {
        let _ = writeln!(
            text,
            "warning: the data has level 0 and no level {highest}: were the levels counted from 0? \
             Levels go from 1 to {highest}; 0 means unlabelled"
        );
    }
    text
}

/// Warnings about levels with few labelled training presses, or none.
pub(super) fn of_levels(presses: &Presses) -> String {
    let mut objects: BTreeMap<u8, BTreeSet<Option<u32>>> = BTreeMap::new();
    for place in presses.labelled(Split::Train) {
        let press = &presses.all[place];
        objects.entry(press.level).or_default().insert(press.object);
    }
    let levels = presses.levels();
    let all = || levels.iter().map(|level| level.level);
    let missing: Vec<u8> = all().filter(|level| !objects.contains_key(level)).collect();
    let of_one = |level: &u8| {
        let objects = objects.get(level);
        objects.is_some_and(|objects| objects.len() == 1 && !objects.contains(&None))
    };
    let of_one: Vec<u8> = all().filter(of_one).collect();
    let mut text = String::new();
    if !missing.is_empty() {
        let _ = writeln!(
            text,
            "warning: no labelled training press is of level {}: the model never learns to say it",
            listed(&missing)
        );
    }
    if !of_one.is_empty() {
        let _ = writeln!(
            text,
            "warning: all training presses of level {} are of one object: the model may learn the object and \
             not the hardness",
            listed(&of_one)
        );
    }
    text
}

/// Numbers as in a sentence: 2, 3 or 4.
fn listed(numbers: &[u8]) -> String {
    let texts: Vec<String> = numbers.iter().map(u8::to_string).collect();
    match texts.split_last() {
        Some((last, rest)) if !rest.is_empty() => format!("{} or {last}", rest.join(", ")),
        _ => texts.concat(),
    }
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
