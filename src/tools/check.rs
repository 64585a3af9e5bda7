//! `hardnessd check`: prints what the daemon would run, without opening a device.

use clap::Args as ClapArgs;

use super::configuration::Configuration;
use super::exit::Failure;
use crate::daemon::config::Setup;
use crate::daemon::publish;
use hardnessd_core::sensor::Settings;
use hardnessd_core::stderr_line;
use hardnessd_core::wire::Layout;

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
    for (sensor, checked) in setup.config.sensors.iter().zip(&setup.sensors) {
        lines += &line_of(sensor, checked.layout());
    }
    lines += &model(&setup);
    for warning in setup.warnings() {
        stderr_line!("warning: {}: {warning}", path.display());
    }
    match setup.in_force() {
        Ok(keys) => lines += &format!("\n{keys}"),
        Err(error) => stderr_line!("the keys in force cannot be shown: {error}"),
    }
    super::print(lines.as_bytes())?;
    Ok(())
}

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
