//! One line for each press, with the pressed material beside the verdict, and a count at the end.
//!
//! In: events of the daemon. Out: lines for people.

use serde_json::Value;

use crate::tools::answer::{self, Answer};
use hardnessd_simulator::Material;

/// The counts of the presses so far.
#[derive(Debug, Default)]
pub(super) struct Account {
    /// The materials in the order of the presses. After the last one, the first one follows again.
    materials: Vec<Material>,
    /// The labels of the model's levels.
    labels: Vec<String>,
    presses: u32,
    right: u32,
    wrong: u32,
}

impl Account {
    pub(super) fn new(materials: &[Material]) -> Self {
        Self {
            materials: materials.to_vec(),
            ..Self::default()
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
            ("hardness", "final", _) => Some(self.verdict(event)),
            ("press", _, "aborted") => {
                let (number, pressed) = self.pressed(event)?;
                self.presses += 1;
                let reason = text("reason");
                Some(format!(
                    "press {number:<2} {pressed}  ->  no verdict ({reason})"
                ))
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

    fn verdict(&mut self, event: &Value) -> String {
        let Some((number, pressed)) = self.pressed(event) else {
            return String::new();
        };
        self.presses += 1;
        let answer = Answer::of(event, &self.labels).text;
        let percent = 100.0 * event["confidence"].as_f64().unwrap_or_default();
        let force_n = event["force_n"].as_f64().unwrap_or_default();
        let level = event["level"].as_u64();
        let (shown, mark) = match level {
            None => (answer, "-"),
            Some(level) => {
                let is_right = self
                    .material(event)
                    .is_some_and(|m| u64::from(m.level()) == level);
                let count = if is_right {
                    &mut self.right
                } else {
                    &mut self.wrong
                };
                *count += 1;
                let shown = format!("{answer} {percent:.0} %");
                (shown, if is_right { "ok" } else { "wrong" })
            }
        };
        let columns = self.answer_columns();
        format!("press {number:<2} {pressed}  ->  {shown:<columns$}  {mark:<5}  {force_n:4.1} N")
    }

    /// The columns of the longest answer of one or two neighbouring levels.
    fn answer_columns(&self) -> usize {
        let columns = |label: &String| label.chars().count();
        let single = self.labels.iter().map(|one| columns(one) + " 100 %".len());
        let pairs = self.labels.windows(2);
        let pairs = pairs.map(|pair| columns(&pair[0]) + " or ".len() + columns(&pair[1]));
        single.chain(pairs).max().unwrap_or_default()
    }

    /// Number of a press, and the material that was pressed.
    fn pressed(&self, event: &Value) -> Option<(u64, String)> {
        let material = self.material(event)?;
        let pressed = format!("{} (level {})", material.name(), material.level());
        let named = self.materials.iter().map(|material| material.name().len());
        let columns = named.max().unwrap_or_default() + " (level 1)".len();
        Some((event["press"].as_u64()?, format!("{pressed:<columns$}")))
    }

    fn material(&self, event: &Value) -> Option<Material> {
        let before = event["press"].as_u64()?.checked_sub(1)?;
        let index = usize::try_from(before).ok()? % self.materials.len().max(1);
        self.materials.get(index).copied()
    }

    /// The line with the counts.
    pub(super) fn close(&self) -> String {
        let Self {
            presses,
            right,
            wrong,
            ..
        } = self;
        let plural = if *presses == 1 { "" } else { "es" };
        let mut line = format!("{presses} press{plural}: {right} right, {wrong} wrong");
        let without = presses - right - wrong;
        if without > 0 {
            line += &format!(", {without} without a level");
        }
        let judged = right + wrong;
        if judged > 0 {
            let share = 100.0 * f64::from(*right) / f64::from(judged);
            line += &format!(" ({share:.0} % right, on simulated presses)");
        }
        line
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn each_press_stands_beside_what_it_is_and_all_are_counted() {
        let mut account = Account::new(&[Material::HardPlastic, Material::Foam]);
        let hello = json!({"type": "hello", "model": {"levels": [
            {"level": 1, "label": "hard"}, {"level": 2, "label": "medium"}]}});
        assert_eq!(account.line(&hello), None);
        let verdict = |press: u64, level: Option<u8>, label: &str, confidence: f64| {
            json!({"type": "hardness", "phase": "final", "press": press, "level": level,
                "label": label, "confidence": confidence, "force_n": 7.41,
                "rejected": level.is_none().then_some("ambiguous"), "levels": [1, 2]})
        };
        for (event, expected) in [
            (
                verdict(1, Some(1), "hard", 1.0),
                "press 1  hard-plastic (level 1)  ->  hard 100 %      ok      7.4 N",
            ),
            (
                verdict(2, Some(1), "hard", 0.61),
                "press 2  foam (level 2)          ->  hard? 61 %      wrong   7.4 N",
            ),
            (
                verdict(3, None, "", 0.3),
                "press 3  hard-plastic (level 1)  ->  hard or medium  -       7.4 N",
            ),
            (
                json!({"type": "press", "state": "aborted", "press": 10, "reason": "short"}),
                "press 10 foam (level 2)          ->  no verdict (short)",
            ),
        ] {
            assert_eq!(account.line(&event).as_deref(), Some(expected));
        }
        let early = json!({"type": "hardness", "phase": "early", "press": 5, "level": 1});
        assert_eq!(account.line(&early), None);
        assert_eq!(
            account.close(),
            "4 presses: 1 right, 1 wrong, 2 without a level (50 % right, on simulated presses)"
        );
    }
}
