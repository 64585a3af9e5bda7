//! What can be used but is likely wrong, in words: `check` prints it, and the daemon logs it.

use super::{Config, Setup};
use hardnessd_core::sensor::Settings;
use hardnessd_core::verdict::{self, Card, Format};
use hardnessd_core::wire::{Checksum, Framing, HexBytes, Layout, Preset};
use hardnessd_core::wording::as_written;
use hardnessd_core::{motion, press, sensor};

/// Pitches closer than this count as equal, because datasheets give two digits.
const PITCH_TOLERANCE_MM: f64 = 0.005;

/// The newtons that a taxel may read at full scale. A film taxel that saturates below or beyond them
/// has a wrong scale.
const FULL_SCALES_N: (f64, f64) = (0.5, 5000.0);

impl Setup {
    /// All warnings, a line each.
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        let sensors = self.config.sensors.iter().zip(&self.sensors);
        for (index, (sensor, checked)) in sensors.enumerate() {
            let of_sensor = [
                self.guess(index),
                self.endless(index),
                pitch(sensor, self.hrn.card()),
                scale(sensor, checked.layout()),
                self.ignored(&sensor.name),
            ];
            let of_sensor = of_sensor.into_iter().flatten();
            warnings.extend(of_sensor.map(|(key, problem)| {
                let name = &sensor.name;
                format!("sensor.{key} of {name:?}: {problem}")
            }));
        }
        let needs = self.model_needs();
        let idle = self.without_effect().into_iter();
        warnings.extend(
            idle.map(|key| format!("{key}: changes no verdict, because the model {needs}")),
        );
        warnings
    }

    /// The keys that are written in the configuration and change no verdict of this model.
    pub fn without_effect(&self) -> Vec<String> {
        let Config {
            press,
            model,
            sensors,
            ..
        } = &self.config;
        let of = |key: &str, sensor: &sensor::Settings| format!("{key} of {:?}", sensor.name);
        let mut idle = Vec::new();
        if matches!(self.hrn.format(), Format::Course { .. }) {
            if press.early_settle_s != press::Settings::default().early_settle_s {
                idle.push("press.early_settle_s".to_owned());
            }
        } else {
            let given = |sensor: &&sensor::Settings| sensor.arm != motion::Settings::default();
            let arms = sensors.iter().filter(given);
            idle.extend(arms.map(|sensor| of("sensor.arm", sensor)));
            if model.early_confidence != verdict::Settings::default().early_confidence {
                idle.push("model.early_confidence".to_owned());
            }
        }
        if self.hrn.most_references() == 0 {
            let given = sensors.iter().filter(|sensor| sensor.references.is_some());
            idle.extend(given.map(|sensor| of("sensor.references", sensor)));
        }
        idle
    }

    /// The pitch or the scale is left out, and the preset is of no array whose pitch and scale are the defaults.
    fn guess(&self, index: usize) -> Option<Warning> {
        let preset = self.config.sensors[index].frame.preset();
        let is_of_array = matches!(preset, Preset::Jx255n | Preset::Jx255nU16);
        let keys = ["pitch_mm", "newtons_per_count"].into_iter();
        let is_guess = |key: &&str| {
            let key = format!("sensor.calibration.{key}");
            !is_of_array && !self.text.is_written(index, &key)
        };
        let guesses: Vec<&str> = keys.filter(is_guess).collect();
        let guesses = guesses.join(" and ");
        (!guesses.is_empty()).then(|| {
            let problem =
                "the default is a guess, and a wrong one gives wrong verdicts: measure it";
            ("calibration", format!("{guesses} not written: {problem}"))
        })
    }

    /// The frames of another sensor follow those of this one, and nothing shows where each of them ends.
    fn endless(&self, index: usize) -> Option<Warning> {
        let sensor = &self.config.sensors[index];
        let frame = sensor.frame.in_force().ok()?;
        let is_empty =
            |bytes: &Option<HexBytes>| bytes.as_ref().is_none_or(|bytes| bytes.0.is_empty());
        let is_endless = frame.checksum.unwrap_or_default() == Checksum::None
            && is_empty(&frame.tail)
            && !is_empty(&frame.sync)
            && frame.framing.unwrap_or_default() == Framing::None;
        let mut others = self.config.sensors.iter().filter(|other| {
            other.port == sensor.port && other.frame.request == sensor.frame.request
        });
        let sync_of = |other: &Settings| other.frame.in_force().ok()?.sync;
        let other = others.find(|other| sync_of(other) != frame.sync)?;
        is_endless.then(|| {
            let problem = format!(
                "found none, and no tail: a frame then ends where the next one of the same sync begins, but those \
                 of {:?} come between them",
                other.name
            );
            ("frame.checksum", problem)
        })
    }

    /// The references are not used.
    fn ignored(&self, sensor: &str) -> Option<Warning> {
        let problem =
            "not used, because its presses would make verdicts worse: make others with `identify`";
        let is_ignored = self.hrn_of(sensor).known_references().are_ignored();
        is_ignored.then(|| ("references", problem.to_owned()))
    }
}

/// A key of a `[[sensor]]`, and what is wrong there.
type Warning = (&'static str, String);

/// The taxels have another pitch than the model's.
fn pitch(sensor: &Settings, card: &Card) -> Option<Warning> {
    let pitch = sensor.calibration.pitch_mm;
    let is_models = |mm: f64| (mm - f64::from(card.pitch_mm)).abs() <= PITCH_TOLERANCE_MM;
    if is_models(pitch.rows_mm) && is_models(pitch.cols_mm) {
        return None;
    }
    let taken = match card.grid {
        None => "forces are shared out over the model's taxels",
        Some(_) => "frames are taken as they are",
    };
    let unknown = match card.holds(pitch) {
        true => "",
        false => ", and the model was not trained on such a pitch",
    };
    let expected = format!("expected the model's {:?}", card.pitch_mm);
    Some((
        "calibration.pitch_mm",
        format!("found {pitch}, {expected}: {taken}{unknown}"),
    ))
}

/// A taxel at full scale reads what no film bears.
fn scale(sensor: &Settings, layout: &Layout) -> Option<Warning> {
    let full_scale = layout.full_scale()?;
    let (scale, exponent) = (
        &sensor.calibration.newtons_per_count,
        sensor.calibration.exponent,
    );
    let full_n = as_written(*scale) * f64::from(full_scale).powf(exponent.into());
    let (least, most) = FULL_SCALES_N;
    let problem = format!(
        "found {scale}, with which {full_scale} counts are {full_n:.3} N on a taxel, expected {least} to {most} N: \
         measure it with `hardnessd calibrate force`"
    );
    let is_usual = (least..=most).contains(&full_n);
    (!is_usual).then_some(("calibration.newtons_per_count", problem))
}
