//! One line for each press, with the pressed material beside the verdict, and a count at the end.
//!
//! In: events of the daemon. Out: lines for people.

use serde_json::Value;

use crate::score::Score;
use crate::tools::answer::{self, answer, with_shore};
use hardnessd_simulator::{Pressed, SequenceSettings};

/// The counts of the presses so far.
#[derive(Debug)]
pub(super) struct Account {
    /// What is pressed.
    sequence: SequenceSettings,
    /// The labels of the model's levels.
    labels: Vec<String>,
    score: Score,
}

impl Account {
    pub(super) fn new(sequence: &SequenceSettings) -> Self {
        Self {
            sequence: sequence.clone(),
            labels: Vec::new(),
            score: Score::default(),
        }
    }

    /// The line for an event, if it has one.
    pub(super) fn line(&mut self, event: &Value) -> Option<String> {
        let text = |key: &str| event[key].as_str().unwrap_or_default();
        match (text("type"), text("phase"), text("state")) {
            ("hello", ..) => {
                self.labels = answer::labels(event);
                None
            }
            ("hardness", "final", _) => self.verdict(event),
            // The end of the demonstration may cut a press off.
            ("press", _, "aborted") if text("reason") != "shutdown" => {
                let begin = begin(event, &self.pressed(event)?);
                self.score.take(None, None);
                Some(format!("{begin}no verdict ({})", text("reason")))
            }
            ("gap", ..) => {
                let lost = event["lost"].as_u64();
                let lost = lost.map_or("some".to_owned(), |lost| lost.to_string());
                Some(format!(
                    "{lost} events were lost: this terminal was too slow"
                ))
            }
            _ => None,
        }
    }

    fn verdict(&mut self, event: &Value) -> Option<String> {
        let pressed = self.pressed(event)?;
        let level = event["level"].as_u64();
        let mark = self.score.take(level, Some(pressed.level.into()));
        let (begin, columns) = (begin(event, &pressed), self.answer_columns());
        let shown = with_shore(&answer(event, &self.labels).0, event);
        let force_n = event["force_n"].as_f64().unwrap_or_default();
        let line = format!("{begin}{shown:<columns$}  {mark:<5} {force_n:4.1} N");
        let notes = answer::items(event, "notes").filter_map(Value::as_str);
        Some(notes.fold(line, |line, note| line + "  " + &note.replace('_', " ")))
    }

    /// The columns of the longest answer of one or two neighbouring levels.
    fn answer_columns(&self) -> usize {
        let columns = |label: &String| label.chars().count();
        let pairs = self.labels.windows(2);
        let pairs = pairs.map(|pair| columns(&pair[0]) + " or ".len() + columns(&pair[1]));
        "100 OO (72 to 100), ".len() + pairs.max().unwrap_or_default()
    }

    /// What the press of an event pressed.
    fn pressed(&self, event: &Value) -> Option<Pressed> {
        let number = event["press"].as_u64().filter(|&number| number > 0)?;
        Some(self.sequence.pressed(number.try_into().ok()?))
    }

    /// The line with the counts.
    pub(super) fn close(&self) -> String {
        self.score.in_words() + " (simulated presses)"
    }
}

/// The begin of a line: the number of the press, and what was pressed.
fn begin(event: &Value, pressed: &Pressed) -> String {
    let number = event["press"].as_u64().unwrap_or_default();
    let Pressed { name, shore, .. } = pressed;
    format!("press {number:<2} {name:<14} {shore:2.0} OO -> ")
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn each_press_stands_beside_what_it_is_and_all_are_counted() {
        let mut account = Account::new(&SequenceSettings::default());
        let hello = json!({"type": "hello", "model": {"levels": [
            {"level": 1, "label": "hard"}, {"level": 2, "label": "medium"}]}});
        assert_eq!(account.line(&hello), None);
        let verdict = |press: u64, level: Option<u8>, label: &str, confidence: f64| {
            json!({"type": "hardness", "phase": "final", "press": press, "level": level,
                "label": label, "confidence": confidence, "force_n": 7.41, "notes": ["at_edge"],
                "shore": {"value": 84.2, "low": 72.4, "high": 90.0},
                "rejected": level.is_none().then_some("ambiguous"), "levels": [1, 2]})
        };
        let of = |press: u32| {
            let Pressed { name, shore, .. } = SequenceSettings::default().pressed(press);
            format!("press {press:<2} {name:<14} {shore:.0} OO -> ")
        };
        assert!(of(1).starts_with("press 1  hard-plastic   8"), "{}", of(1));
        for (press, level, label, confidence, expected) in [
            (1, Some(1), "hard", 1.0, "hard                   ok   "),
            (2, Some(1), "hard", 0.61, "hard?                  wrong"),
            (3, None, "", 0.3, "hard or medium         -    "),
        ] {
            let expected = format!("{}84 +- 12 OO, {expected}  7.4 N  at edge", of(press));
            let event = verdict(press.into(), level, label, confidence);
            assert_eq!(account.line(&event), Some(expected));
        }
        let aborted = json!({"type": "press", "state": "aborted", "press": 10, "reason": "short"});
        let expected = format!("{}no verdict (short)", of(10));
        assert_eq!(account.line(&aborted), Some(expected));
        let early = json!({"type": "hardness", "phase": "early", "press": 5, "level": 1});
        assert_eq!(account.line(&early), None);
        assert_eq!(
            account.close(),
            "1 of 4 right, 1 wrong, 2 without a level (simulated presses)"
        );
    }
}
