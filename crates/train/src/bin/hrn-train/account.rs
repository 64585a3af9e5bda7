//! Text about a model and about an evaluation.

use std::fmt::Write as _;
use std::path::Path;

use hrn_train::judge::evaluated::{Case, Difference, Evaluated};
use hrn_train::run::disk::load;
use serde_json::{Map, Value};

/// The card of the model read from `path`, key by key.
pub(super) fn of_model(path: &Path) -> anyhow::Result<String> {
    let (hrn, _) = load(path)?;
    let mut text = format!("{}\nsha256        {}\n", path.display(), hrn.sha256());
    // As text first: a value made at once would give a number of 32 bits the digits of one of 64.
    let card: Map<String, Value> = serde_json::from_str(&serde_json::to_string(hrn.card())?)?;
    for (key, value) in card {
        let value = match value {
            Value::String(value) => value,
            other => other.to_string(),
        };
        let _ = writeln!(text, "{key:<14}{value}");
    }
    let checks = hrn.checks().count();
    Ok(text + &format!("check frames  {checks}, all reproduced\n"))
}

/// The figures of an evaluation, and the confusion matrix with a row for each true level.
pub(super) fn of_evaluated(evaluated: &Evaluated) -> String {
    let of = evaluated;
    let percent = |share: f64| format!("{:.1} %", 100.0 * share);
    let mut text = String::new();
    let mut row = |name: &str, value: String| {
        let _ = writeln!(text, "{name:<19}{value}");
    };
    let by = |unit: &str, interval: Option<[f64; 2]>| {
        let [low, high] = interval?.map(percent);
        Some(format!("95 % by {unit}: {low} to {high}"))
    };
    let interval = by("object", of.accuracy_interval_by_object)
        .or(by("cover", of.accuracy_interval_by_cover))
        .unwrap_or_else(|| {
            "no interval: it needs two objects of each level, and a right and a wrong verdict"
                .to_owned()
        });
    let number = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.4}"));
    row("samples", of.n.to_string());
    row("accuracy", format!("{} ({interval})", percent(of.accuracy)));
    row("balanced accuracy", percent(of.balanced_accuracy));
    row("kappa", number(of.kappa));
    row("kappa, quadratic", number(of.kappa_quadratic));
    row("calibration error", percent(of.ece));
    row("mean NLL", format!("{:.4} nats", of.nll));
    let levels = 1..=of.confusion.len();
    let levels: String = levels.map(|level| format!("{level:>7}")).collect();
    row("truth \\ said", levels);
    let rows = of.confusion.iter().zip(&of.category_accuracy);
    for ((counts, right), level) in rows.zip(1..) {
        let counts: String = counts.iter().map(|count| format!("{count:>7}")).collect();
        let right = right.map_or("-".to_owned(), percent);
        row(&format!("level {level}"), format!("{counts}   {right}"));
    }
    row("off by two or more", percent(evaluated.beyond_neighbour));
    if let Some(shore) = &evaluated.shore {
        let shown = |rmse: Option<f64>| rmse.map_or("-".to_owned(), |rmse| format!("{rmse:.1}"));
        let levels: Vec<String> = shore.rmse_by_level.iter().copied().map(shown).collect();
        row(
            "Shore OO",
            format!(
                "rmse {:.2} (by level {}); 90 % interval holds {}, {:.1} wide",
                shore.rmse,
                levels.join(", "),
                percent(shore.coverage),
                shore.width
            ),
        );
    }
    if let Some(sets) = &evaluated.sets {
        let others = sets.accuracy_of_others.map_or("-".to_owned(), percent);
        let (coverage, ambiguous) = (percent(sets.coverage), percent(sets.ambiguous));
        let text = format!(
            "hold {coverage}; {ambiguous} of presses ambiguous, {others} of the others right"
        );
        row("sets of levels", text);
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

/// Verdicts as CSV, one line each after the header: object, true level, verdict's level,
/// probabilities, Shore OO with its interval, and the true Shore OO. Unknown values are empty.
pub(super) fn csv(cases: &[Case]) -> String {
    let first = cases.first().map(|case| &case.verdict.probabilities);
    let levels = first.map_or(0, Vec::len);
    let probabilities = (1..=levels).map(|level| format!("probability_{level},"));
    let probabilities: String = probabilities.collect();
    let mut text =
        format!("object,level,judged,{probabilities}shore,shore_low,shore_high,true_shore\n");
    for case in cases {
        let verdict = &case.verdict;
        let object = case.object.map_or_else(String::new, |of| of.to_string());
        let mut cells = vec![object, case.level.to_string(), verdict.level.to_string()];
        cells.extend(verdict.probabilities.iter().map(|of| format!("{of:.6}")));
        let [value, low, high] = match verdict.shore {
            Some(of) => [of.value, of.low, of.high].map(Some),
            None => [None; 3],
        };
        let known = |shore: Option<f32>| shore.map_or_else(String::new, |of| format!("{of:.3}"));
        cells.extend([value, low, high, case.shore].map(known));
        text += &(cells.join(",") + "\n");
    }
    text
}
