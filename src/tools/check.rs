//! `hardnessd check`: prints what the daemon would run, without opening a device.

use clap::Args as ClapArgs;

use super::configuration::Configuration;
use super::exit::{Coded, Failure};
use crate::daemon::config::Setup;
use crate::daemon::publish;
use hardnessd_core::sensor::Settings;
use hardnessd_core::stderr_line;
use hardnessd_core::verdict::Card;
use hardnessd_core::wire::Layout;
use hardnessd_core::wording::as_written;

/// What `--help` says below the options.
const MORE: &str = "\
    It refuses what `run` would refuse, with the same exit code, as far as no port has to be opened \
    for it. It warns of a pitch and a scale that are not written, of taxels of another pitch than the model's, \
    of a full scale that no film has, and of keys that change no verdict of this model. Below what would run, it prints every key in force and \
    where it comes from: written, a preset, or the default.";

/// Arguments of `check`.
#[derive(Debug, Clone, ClapArgs)]
#[command(after_help = MORE)]
pub struct Args {
    #[command(flatten)]
    config: Configuration,
}

/// Prints what the daemon would run. Warnings go to stderr.
///
/// # Errors
///
/// Returns a [`Failure`] if the configuration or its model cannot be used, or a path for sockets cannot
/// be written to.
pub fn run(args: &Args) -> Result<(), Failure> {
    let path = &args.config.path()?;
    let setup = Setup::load(path, None)?;
    publish::check(&setup.config.publish.unix)
        .map_err(|error| Failure::of(error.exit_code(), path.display(), error))?;
    let mut lines = format!("robot {}\n", setup.config.robot);
    let mut warnings = Vec::new();
    let sensors = setup.config.sensors.iter().zip(&setup.sensors);
    for (index, (sensor, checked)) in sensors.enumerate() {
        lines += &line_of(sensor, checked.layout());
        let guess = setup.guess_warning(index);
        warnings
            .extend(guess.map(|guess| format!("sensor.calibration of {:?}: {guess}", sensor.name)));
        warnings.extend(pitch_warning(sensor, setup.hrn.card()));
        warnings.extend(scale_warning(sensor, checked.layout()));
        if setup.ignores_references_of(&sensor.name) {
            warnings.push(format!(
                "sensor.references of {:?}: not used, because its presses make verdicts on each other \
                 worse: make others with `identify`",
                sensor.name
            ));
        }
    }
    lines += &model(&setup);
    let needs = setup.model_needs();
    let idle = setup.without_effect().into_iter();
    warnings
        .extend(idle.map(|key| format!("{key}: changes no verdict, because the model {needs}")));
    for warning in warnings {
        stderr_line!("warning: {}: {warning}", path.display());
    }
    lines += &format!("\n{}", setup.in_force());
    super::print(lines.as_bytes())?;
    Ok(())
}

/// Warns if the taxels have another pitch than the model's.
fn pitch_warning(sensor: &Settings, card: &Card) -> Option<String> {
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
    Some(format!(
        "sensor.calibration.pitch_mm of {:?}: found {pitch}, expected the model's {:?}: {taken}{unknown}",
        sensor.name, card.pitch_mm
    ))
}

/// The newtons that a taxel may read at full scale. A film taxel that saturates below or beyond them
/// has a wrong scale.
const FULL_SCALES_N: (f64, f64) = (0.5, 5000.0);

/// Warns if a taxel at full scale reads what no film bears.
fn scale_warning(sensor: &Settings, layout: &Layout) -> Option<String> {
    let full_scale = layout.full_scale()?;
    let (scale, exponent) = (
        &sensor.calibration.newtons_per_count,
        sensor.calibration.exponent,
    );
    let full_n = as_written(*scale) * f64::from(full_scale).powf(exponent.into());
    let (least, most) = FULL_SCALES_N;
    if (least..=most).contains(&full_n) {
        return None;
    }
    Some(format!(
        "sensor.calibration.newtons_per_count of {:?}: found {scale}, with which \
         {full_scale} counts are {full_n:.3} N on a taxel, expected {least} to {most} N: measure it with \
         `hardnessd calibrate force`",
        sensor.name
    ))
}

/// Pitches closer than this count as equal, because datasheets give two digits.
const PITCH_TOLERANCE_MM: f64 = 0.005;

fn line_of(sensor: &Settings, layout: &Layout) -> String {
    let frame_bytes = match (layout.min_frame_bytes(), layout.max_frame_bytes()) {
        (shortest, longest) if shortest == longest => longest.to_string(),
        (shortest, longest) => format!("{shortest} to {longest}"),
    };
    format!(
        "sensor {}: {} at {} baud, {} taxels in {frame_bytes} bytes, {} frames/s\n",
        sensor.name,
        sensor.port,
        sensor.baud,
        layout.array(),
        sensor.frame_rate_hz
    )
}

fn model(setup: &Setup) -> String {
    let card = setup.hrn.card();
    let path = setup.config.model.path.as_ref();
    let levels = card.levels.iter();
    let levels: Vec<String> = levels
        .map(|level| format!("{} {}", level.level, level.label))
        .collect();
    format!(
        "model {}: {}, sha256 {}, validation: {}, pitch {} mm, levels: {}\n",
        path.map_or("built in".to_owned(), |path| path.display().to_string()),
        setup.model_needs(),
        setup.hrn.sha256(),
        card.validation,
        card.pitch_mm,
        levels.join(", ")
    )
}
