//! Verdicts over all presses of one object, which the controller names in its context.
//!
//! In: the final verdicts of presses, each with the name of its object. Out: one verdict for the
//! object. Presses of one object err alike, because its shape and material stay the same. So n of
//! them count for less than n independent ones.

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::event::ObjectVerdict;
use crate::verdict::{Shore, Verdict, argmax, softmax};

/// The most objects that are remembered, those that were pressed last.
const MOST_OBJECTS: usize = 64;
/// The sum of n logarithms is divided by n to the power of this: 0 for presses that err
/// independently, 1 for presses that all err alike. Of 0 to 1 in steps of 0.25, this gives the model
/// of courses the best probabilities on 3 to 5 presses of 600 simulated objects. Four presses gain
/// it 3 points of accuracy.
const ALIKE: f32 = 0.75;
/// Below it, the logarithm of a probability is not believed.
const LEAST_PROBABILITY: f32 = 1e-4;

/// No sum of presses reaches it, and what is computed of a smaller one is finite.
const MOST_SUM: f32 = 1e24;

/// The objects that were pressed.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Objects {
    /// The object that was pressed last comes last.
    known: Vec<Object>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Object {
    name: String,
    presses: u64,
    /// For each level, the sum of the logarithms of its probabilities.
    log_sums: Vec<f32>,
    /// The sums of Shore hardness: value, low and high, each times its weight, and the weight.
    shore_sums: [f32; 4],
}

/// The name of the object in a context.
pub(super) fn object_of(context: Option<&Value>) -> Option<String> {
    match context?.get("object")? {
        Value::String(name) => Some(name.clone()),
        Value::Number(number) => Some(number.to_string()),
        _ => None,
    }
}

impl Objects {
    /// The verdict on the object `name` with this press.
    pub(super) fn with(&self, name: &str, verdict: &Verdict) -> ObjectVerdict {
        self.after(name, verdict).verdict()
    }

    /// The verdict on the object `name` without this press. `None` before its first one.
    pub(super) fn without(&self, name: &str, verdict: &Verdict) -> Option<ObjectVerdict> {
        Some(self.find(name, verdict)?.clone().verdict())
    }

    /// Adds the press to the object `name`.
    pub(super) fn add(&mut self, name: &str, verdict: &Verdict) {
        let object = self.after(name, verdict);
        self.known.retain(|known| known.name != name);
        self.known.push(object);
        let many = self.known.len().saturating_sub(MOST_OBJECTS);
        self.known.drain(..many);
    }

    /// The object, if it was pressed. After a change of the model, it may be known with other levels, and then begins
    /// anew.
    fn find(&self, name: &str, verdict: &Verdict) -> Option<&Object> {
        let levels = verdict.probabilities.len();
        let is_same = |known: &&Object| known.name == name && known.log_sums.len() == levels;
        self.known.iter().find(is_same)
    }

    /// The object after another press.
    fn after(&self, name: &str, verdict: &Verdict) -> Object {
        let known = self.find(name, verdict).cloned();
        let mut object = known.unwrap_or_else(|| Object {
            name: name.to_owned(),
            presses: 0,
            log_sums: vec![0.0; verdict.probabilities.len()],
            shore_sums: [0.0; 4],
        });
        object.add(verdict);
        object
    }

    /// Whether the next verdicts on these objects are finite. A recording may hold anything.
    pub(super) fn is_usable(&self) -> bool {
        let is_finite = |sum: &f32| sum.abs() <= MOST_SUM;
        self.known.iter().all(|object| {
            let mut sums = object.log_sums.iter().chain(&object.shore_sums);
            let [.., weight] = object.shore_sums;
            sums.all(is_finite) && weight >= 0.0
        })
    }
}

impl Object {
    fn add(&mut self, verdict: &Verdict) {
        self.presses = self.presses.saturating_add(1);
        for (sum, &probability) in self.log_sums.iter_mut().zip(&verdict.probabilities) {
            *sum += probability.max(LEAST_PROBABILITY).ln();
        }
        if let Some(Shore { value, low, high }) = verdict.shore {
            // A press with a narrow interval says more.
            let weight = 1.0 / (high - low).max(1.0).powi(2);
            for (sum, term) in self.shore_sums.iter_mut().zip([value, low, high, 1.0]) {
                *sum += weight * term;
            }
        }
    }

    fn verdict(self) -> ObjectVerdict {
        let divisor = (self.presses as f32).powf(ALIKE);
        let scores: Vec<f32> = self.log_sums.iter().map(|sum| sum / divisor).collect();
        let (best, _) = argmax(&scores);
        let [value, low, high, weight] = self.shore_sums;
        ObjectVerdict {
            name: self.name,
            presses: self.presses,
            level: best as u8 + 1,
            probabilities: softmax(&scores),
            shore: (weight > 0.0).then(|| Shore {
                value: value / weight,
                low: low / weight,
                high: high / weight,
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn verdict(probabilities: &[f32], shore: Option<[f32; 3]>) -> Verdict {
        Verdict {
            level: 1,
            logits: Vec::new(),
            probabilities: probabilities.to_vec(),
            confidence: 0.0,
            shore: shore.map(Shore::from),
            levels: None,
        }
    }

    #[test]
    fn presses_that_agree_make_the_object_surer_and_others_do_not_count() {
        let mut objects = Objects::default();
        let press = verdict(&[0.6, 0.3, 0.1], Some([60.0, 50.0, 70.0]));
        assert!(objects.without("cup", &press).is_none());
        let first = objects.with("cup", &press);
        assert_eq!((first.presses, first.level), (1, 1));
        assert!((first.probabilities[0] - 0.6).abs() < 1e-6);
        objects.add("cup", &press);
        assert_eq!(objects.without("cup", &press).as_ref(), Some(&first));
        objects.add("can", &verdict(&[0.0, 0.0, 1.0], None));
        let wide = verdict(&[0.6, 0.3, 0.1], Some([80.0, 50.0, 90.0]));
        let second = objects.with("cup", &wide);
        assert_eq!(second.presses, 2);
        assert!((0.62..0.8).contains(&second.probabilities[0]), "{second:?}");
        assert!((second.probabilities.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        // The press with the narrow interval counts four times as much.
        let shore = second.shore.unwrap();
        assert!((shore.value - 64.0).abs() < 1e-3, "{shore:?}");
        // One impossible press is outvoted.
        objects.add("cup", &press);
        objects.add("cup", &press);
        let outvoted = objects.with("cup", &verdict(&[0.0, 1.0, 0.0], None));
        assert_eq!(outvoted.presses, 4);
        assert!(outvoted.probabilities.iter().all(|p| p.is_finite()));
    }

    #[test]
    fn memory_is_bounded_and_a_model_with_other_levels_begins_anew() {
        let mut objects = Objects::default();
        for number in 0..100 {
            objects.add(&number.to_string(), &verdict(&[0.5, 0.5], None));
        }
        let press = verdict(&[0.9, 0.1], None);
        assert_eq!(objects.known.len(), MOST_OBJECTS);
        assert_eq!(objects.with("20", &press).presses, 1);
        assert_eq!(objects.with("99", &press).presses, 2);
        let other = verdict(&[0.2, 0.2, 0.6], None);
        assert_eq!(objects.with("99", &other).presses, 1);
        objects.add("99", &other);
        assert_eq!(objects.with("99", &other).presses, 2);
    }
}
