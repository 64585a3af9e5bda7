//! The answer of a verdict in words: its level, or the levels that it lies between.
//!
//! `demo`, `tail`, `replay` and `watch` show it. The page and the Python client repeat the
//! rule, and all of them agree on the cases of `fixtures/answers.json`.

use serde_json::Value;

/// A level with less confidence is marked as weak. Of simulated presses with at least this
/// confidence, 87 to 98 % got the right level (`models/README.md`, "Accuracy").
const CONFIDENT: f64 = 0.7;
/// The note of a press that the model was not trained on. Its confidence says little, so its level is weak.
const OUTSIDE: &str = "outside_training";

/// What a `hardness` event says, such as `firm`, `firm?` or `firm or soft`, and whether it must not look like a sure
/// level. `labels` are those of the model's levels, in order. A label may have hidden characters.
pub(super) fn answer(verdict: &Value, labels: &[String]) -> (String, bool) {
    if let Some(level) = verdict["level"].as_u64() {
        let label = verdict["label"].as_str().map(str::to_owned);
        let label = label.unwrap_or_else(|| named(level, labels));
        let is_weak = verdict["confidence"].as_f64().unwrap_or_default() < CONFIDENT
            || items(verdict, "notes").any(|note| note == OUTSIDE);
        let mark = if is_weak { "?" } else { "" };
        return (label + mark, is_weak);
    }
    let text = match verdict["rejected"].as_str() {
        Some("low_force") => "low force".to_owned(),
        _ => between(verdict, labels),
    };
    (text, true)
}

/// What a verdict says, with its Shore hardness first: `63 +- 6 OO, firm`, where the interval of 90 % lies within
/// these limits, or `92 OO (24 to 99), firm`, where the estimate is outside the middle half of its interval, or a limit
/// would be beyond the scale of 0 to 100.
pub(super) fn with_shore(answer: &str, verdict: &Value) -> String {
    let shore = |key| verdict["shore"][key].as_f64();
    let (Some(value), Some(low), Some(high)) = (shore("value"), shore("low"), shore("high")) else {
        return answer.to_owned();
    };
    let (below, above) = (value - low, high - value);
    let most = below.max(above);
    let is_on_scale = most <= value.min(100.0 - value);
    match is_on_scale && below.min(above) >= (high - low) / 4.0 {
        true => format!("{value:.0} +- {most:.0} OO, {answer}"),
        false => format!("{value:.0} OO ({low:.0} to {high:.0}), {answer}"),
    }
}

/// The labels of the levels that a `hello` names.
pub(super) fn labels(hello: &Value) -> Vec<String> {
    items(&hello["model"], "levels")
        .filter_map(|level| level["label"].as_str().map(str::to_owned))
        .collect()
}

/// The items of a list of an event. Without a list there are none.
pub(super) fn items<'a>(event: &'a Value, key: &str) -> impl Iterator<Item = &'a Value> {
    event[key].as_array().into_iter().flatten()
}

/// The label of a level, or its number.
pub(super) fn named(level: u64, labels: &[String]) -> String {
    let place = usize::try_from(level).ok().and_then(|l| l.checked_sub(1));
    let label = place.and_then(|place| labels.get(place));
    label.map_or_else(|| format!("level {level}"), Clone::clone)
}

/// The level of this label, or else of this number.
pub(super) fn level_of(word: &str, labels: &[String]) -> Option<u64> {
    let labelled = labels.iter().position(|label| label == word);
    let numbered = || (0..labels.len()).find(|index| (index + 1).to_string() == word);
    labelled.or_else(numbered).map(|index| index as u64 + 1)
}

/// The levels that a rejected verdict lies between: its set of levels, otherwise the two likeliest.
fn between(verdict: &Value, labels: &[String]) -> String {
    let mut levels: Vec<u64> = items(verdict, "levels").filter_map(Value::as_u64).collect();
    if levels.len() < 2 {
        let mut likely: Vec<(u64, f64)> = (1..)
            .zip(items(verdict, "probabilities").filter_map(Value::as_f64))
            .collect();
        // The sort is stable: of equal ones, the lower levels come first.
        likely.sort_by(|one, other| other.1.total_cmp(&one.1));
        levels = likely.iter().take(2).map(|&(level, _)| level).collect();
        levels.sort_unstable();
    }
    match levels[..] {
        [] => "no level".to_owned(),
        [one] => format!("{}?", named(one, labels)),
        [one, other] => format!("{} or {}", named(one, labels), named(other, labels)),
        [first, .., last] => format!("{} to {}", named(first, labels), named(last, labels)),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_rejected_verdict_shows_what_it_lies_between_and_a_weak_one_is_marked() {
        let cases: Value =
            serde_json::from_str(include_str!("../../fixtures/answers.json")).unwrap();
        let labels = labels(&cases["hello"]);
        let cases_of = |key: &str| cases[key].as_array().unwrap().clone();
        for case in cases_of("cases") {
            let (text, is_weak) = answer(&case["verdict"], &labels);
            assert_eq!(
                (json!(text), json!(is_weak)),
                (case["text"].clone(), case["is_weak"].clone())
            );
        }
        for case in cases_of("shores") {
            let shown = format!("{}, firm", case["text"].as_str().unwrap());
            assert_eq!(with_shore("firm", &case), shown);
        }
    }
}
