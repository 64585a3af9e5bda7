//! `hardnessd check`: prints what the daemon would run, without opening a device.

use std::fmt::Display;
use std::net::SocketAddr;
use std::path::Path;

use clap::Args as ClapArgs;
use rustix::fs::Access;

use super::configuration::Configuration;
use super::exit::{Coded, Failure};
use crate::daemon::baud::{Load, Pace};
use crate::daemon::config::{Setup, Zenoh};
use crate::daemon::{publish, record};
use hardnessd_core::frame::Pitch;
use hardnessd_core::sensor::Settings;
use hardnessd_core::tare;
use hardnessd_core::verdict::Card;
use hardnessd_core::wire::Layout;
use hardnessd_core::wording::as_written;

/// What `--help` says below the options.
const MORE: &str = "\
    It refuses what `run` would refuse, with the same exit code, as far as no port has to be opened \
    for it. It warns of a `dir` of [record] that cannot be written to, of taxels of another pitch than \
    the model's, of a full scale that no film has, and of keys that change no verdict of this model. \
    Below what would run, it prints every key in force and where it comes from: written, a preset, or \
    the default.";

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
        lines += &line_of(sensor, checked.layout(), path);
        warn_of_pitch(sensor, setup.hrn.card(), path);
        warn_of_scale(sensor, checked.layout(), path);
        if setup.ignores_references_of(&sensor.name) {
            hardnessd_core::stderr_line!(
                "warning: {}: sensor.references of {:?}: not used, because its presses make verdicts on each other \
                 worse: make others with `identify`",
                path.display(),
                sensor.name
            );
        }
    }
    lines += &model(&setup);
    for key in setup.without_effect() {
        hardnessd_core::stderr_line!(
            "warning: {}: {key}: changes no verdict, because the model {}",
            path.display(),
            setup.model_needs()
        );
    }
    let unix = &setup.config.publish.unix;
    if unix.enabled {
        for (key, socket) in [
            ("publish.unix.path", unix.path()),
            ("publish.unix.control_path", unix.control_path()),
        ] {
            warn_of_permissions(key, &socket, path);
        }
    }
    if let Some(record) = &setup.config.record
        && let Err(error) = record::check(record)
    {
        hardnessd_core::stderr_line!("warning: {}: {error}", path.display());
    }
    let tcp = setup.config.publish.tcp.as_ref().map(|tcp| tcp.listen);
    let http = setup.config.http.as_ref().map(|http| http.listen);
    let foxglove = setup.config.publish.foxglove.as_ref();
    let foxglove = foxglove.map(|foxglove| foxglove.listen);
    for (key, listen) in [
        ("publish.tcp.listen", tcp),
        ("publish.foxglove.listen", foxglove),
        ("http.listen", http),
    ] {
        if let Some(listen) = listen.filter(|listen| !listen.ip().is_loopback()) {
            warn_of_strangers(key, &listen, path);
        }
    }
    if let Some(zenoh) = &setup.config.publish.zenoh {
        let open = |address: &&str| {
            let parsed = address.parse::<SocketAddr>();
            parsed.map_or(true, |address| !address.ip().is_loopback())
        };
        let addresses = zenoh.listen.iter().filter_map(|one| Zenoh::address(one));
        for address in addresses.filter(open) {
            warn_of_strangers("publish.zenoh.listen", &address, path);
        }
    }
    lines += &format!("\n{}", setup.in_force());
    super::print(lines.as_bytes())?;
    Ok(())
}

/// Warns if you may not make a socket at `socket`. It is no error, because the daemon may run as another
/// user.
fn warn_of_permissions(key: &str, socket: &Path, path: &Path) {
    let above = socket.ancestors().skip(1);
    let mut above = above.map(|one| {
        if one == Path::new("") {
            Path::new(".")
        } else {
            one
        }
    });
    let Some(directory) = above.find(|one| one.is_dir()) else {
        return;
    };
    if rustix::fs::access(directory, Access::WRITE_OK).is_err() {
        hardnessd_core::stderr_line!(
            "warning: {}: {key}: you may not write to {}, but the user who runs the daemon must",
            path.display(),
            directory.display()
        );
    }
}

/// Warns if the taxels have another pitch than the model's.
fn warn_of_pitch(sensor: &Settings, card: &Card, path: &Path) {
    let Pitch { rows_mm, cols_mm } = sensor.calibration.pitch_mm;
    let is_models = |mm: f64| (mm - f64::from(card.pitch_mm)).abs() <= PITCH_TOLERANCE_MM;
    if is_models(rows_mm) && is_models(cols_mm) {
        return;
    }
    let effect = if card.holds(sensor.calibration.pitch_mm) {
        "forces are shared out over the model's taxels"
    } else {
        "forces are shared out over the model's taxels, and the model was not trained on such a pitch"
    };
    hardnessd_core::stderr_line!(
        "warning: {}: sensor.calibration.pitch_mm of {:?}: found {}, expected the model's {:?}: \
         {effect}",
        path.display(),
        sensor.name,
        sensor.calibration.pitch_mm,
        card.pitch_mm
    );
}

/// The newtons that a taxel may read at full scale. A film taxel that saturates below or beyond them
/// has a wrong scale.
const FULL_SCALES_N: (f64, f64) = (0.5, 5000.0);

/// Warns if a taxel at full scale reads what no film bears.
fn warn_of_scale(sensor: &Settings, layout: &Layout, path: &Path) {
    let Some(full_scale) = layout.full_scale() else {
        return;
    };
    let tare::Settings {
        newtons_per_count,
        exponent,
        ..
    } = sensor.calibration;
    let full_n = as_written(newtons_per_count) * f64::from(full_scale).powf(exponent.into());
    let (least, most) = FULL_SCALES_N;
    if (least..=most).contains(&full_n) {
        return;
    }
    hardnessd_core::stderr_line!(
        "warning: {}: sensor.calibration.newtons_per_count of {:?}: found {newtons_per_count}, with which \
         {full_scale} counts are {:.3} N on a taxel, expected {least} to {most} N: measure it with \
         `hardnessd calibrate force`",
        path.display(),
        sensor.name,
        full_n
    );
}

/// Warns of an address that others can reach.
fn warn_of_strangers(key: &str, address: &dyn Display, path: &Path) {
    hardnessd_core::stderr_line!(
        "warning: {}: {key}: {address} is open to anyone who can reach this machine; a loopback address, \
         such as 127.0.0.1, is not",
        path.display()
    );
}

/// Pitches closer than this count as equal, because datasheets give two digits.
const PITCH_TOLERANCE_MM: f64 = 0.005;

fn line_of(sensor: &Settings, layout: &Layout, path: &Path) -> String {
    let (shortest, longest) = (layout.min_frame_bytes(), layout.max_frame_bytes());
    let Load {
        pace,
        capacity,
        bytes_per_s,
        excess,
    } = Load::of(sensor, layout);
    if let Some(excess) = excess {
        // Frames of some layouts vary in length, and a port that is not there may turn out to be USB CDC.
        hardnessd_core::stderr_line!(
            "warning: {}: sensor.frame_rate_hz of {:?}: {excess}",
            path.display(),
            sensor.name
        );
    }
    let array = layout.array();
    let frame_bytes = if shortest == longest {
        format!("{longest}")
    } else {
        format!("{shortest} to {longest}")
    };
    let load = if pace == Pace::Free {
        format!("{bytes_per_s:.0} bytes/s, whatever the baud rate")
    } else {
        format!(
            "{bytes_per_s:.0} of {capacity:.0} bytes/s at {} baud",
            sensor.baud
        )
    };
    let references = sensor.references.as_ref();
    let references = references.map_or(String::new(), |file| {
        format!(", references {}", file.display())
    });
    format!(
        "sensor {}: {}, {}x{} taxels in {frame_bytes} bytes, {} frames/s: {load}{}{references}\n",
        sensor.name,
        sensor.port,
        array.rows,
        array.cols,
        sensor.frame_rate_hz,
        gains(&sensor.calibration)
    )
}

/// The spread of a sensor's gains, if it has any.
fn gains(calibration: &tare::Settings) -> String {
    let extent = calibration.gains.as_ref().and_then(tare::Gains::extent);
    extent.map_or(String::new(), |(least, most)| {
        format!(", gains {least:.2} to {most:.2}")
    })
}

fn model(setup: &Setup) -> String {
    let card = setup.hrn.card();
    let path = setup.config.model.path.as_ref();
    let levels: Vec<String> = card
        .levels
        .iter()
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
