//! What a person says that is being pressed, and how many verdicts are right.
//!
//! In: verdicts, whose context has the truth: `level` (a number) and `object` (a text). Out: their score since the
//! truth last changed.

use serde_json::{Value, json};

use crate::score::Score;
use crate::tools::answer::{level_of, named};

/// What is being pressed.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Truth {
    level: Option<u64>,
    object: Option<String>,
}

impl Truth {
    /// The truth of a context. Nothing is known without one.
    fn of(context: &Value) -> Self {
        Self {
            level: context["level"].as_u64().filter(|&level| level > 0),
            object: context["object"].as_str().map(str::to_owned),
        }
    }

    /// Reads what a person typed: a level by number or label, a name, or a name and then a level.
    pub(super) fn read(text: &str, labels: &[String]) -> Self {
        let text = text.trim();
        let (before, last) = text.rsplit_once(' ').unwrap_or(("", text));
        let (object, level) = match level_of(last, labels) {
            None => (text, None),
            level => (before.trim(), level),
        };
        let object = (!object.is_empty()).then(|| object.to_owned());
        Self { level, object }
    }

    /// The keys of a sensor's context that say it.
    pub(super) fn keys(&self, sensor: &str) -> Value {
        json!({"sensor": sensor, "level": self.level, "object": self.object})
    }
}

/// The final verdicts since the truth last changed.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Count {
    truth: Truth,
    score: Score,
}

impl Count {
    /// Begins anew with another truth.
    pub(super) fn begin(&mut self, truth: Truth) {
        if truth != self.truth {
            *self = Self {
                truth,
                ..Self::default()
            };
        }
    }

    /// Counts a final verdict.
    pub(super) fn take(&mut self, event: &Value) {
        if event["phase"] == "final" {
            self.begin(Truth::of(&event["context"]));
            self.score.take(event["level"].as_u64(), self.truth.level);
        }
    }

    /// What is pressed and the counts, in words. Nothing where nobody says what is pressed.
    pub(super) fn line(&self, labels: &[String]) -> Option<String> {
        let label = self.truth.level.map(|level| named(level, labels));
        let pressed = match (label, self.truth.object.as_deref()) {
            (None, None) => return None,
            (Some(level), None) => level,
            (Some(level), Some(object)) => format!("{object} ({level})"),
            (None, Some(object)) => object.to_owned(),
        };
        let said = match (self.score.verdicts, self.truth.level) {
            (0, _) => "no verdict yet".to_owned(),
            (judged, None) => format!("{judged} judged"),
            (_, Some(_)) => self.score.in_words(),
        };
        Some(format!("{pressed}: {said}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels() -> Vec<String> {
        ["hard", "firm", "soft"].map(str::to_owned).to_vec()
    }

    #[test]
    fn a_person_types_a_level_a_name_or_both() {
        for (text, level, object) in [
            ("2", Some(2), None),
            (" firm ", Some(2), None),
            ("cup", None, Some("cup")),
            ("tea cup soft", Some(3), Some("tea cup")),
            ("cup 3", Some(3), Some("cup")),
            ("4", None, Some("4")),
            ("", None, None),
        ] {
            let object = object.map(str::to_owned);
            assert_eq!(
                Truth::read(text, &labels()),
                Truth { level, object },
                "{text:?}"
            );
        }
        let keys = Truth::read("2", &labels()).keys("a");
        assert_eq!(keys, json!({"sensor": "a", "level": 2, "object": null}));
        // A label goes before a number.
        let labels = ["80", "2"].map(str::to_owned);
        assert_eq!(Truth::read("2", &labels).level, Some(2));
        assert_eq!(Truth::read("80", &labels).level, Some(1));
    }

    #[test]
    fn final_verdicts_are_counted_from_the_moment_that_the_truth_changes() {
        let mut count = Count::default();
        let mut take = |phase: &str, level: Value, context: Value| {
            count.take(&json!({"phase": phase, "level": level, "context": context}));
            count.line(&labels())
        };
        assert_eq!(take("final", json!(2), Value::Null), None);
        let cup = json!({"level": 2, "object": "cup"});
        let said = take("final", json!(2), cup.clone());
        assert_eq!(said.as_deref(), Some("cup (firm): 1 of 1 right, 0 wrong"));
        take("early", json!(1), cup.clone());
        take("final", json!(1), cup.clone());
        let said = take("final", Value::Null, cup);
        let expected = "cup (firm): 1 of 3 right, 1 wrong, 1 without a level";
        assert_eq!(said.as_deref(), Some(expected));
        let said = take("final", json!(3), json!({"object": "cup"}));
        assert_eq!(said.as_deref(), Some("cup: 1 judged"));
        count.begin(Truth::read("hard", &labels()));
        assert_eq!(
            count.line(&labels()).as_deref(),
            Some("hard: no verdict yet")
        );
    }
}
