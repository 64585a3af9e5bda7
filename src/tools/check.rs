//! `hardnessd check`: prints what the daemon would run, without opening a device.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use clap::Args as ClapArgs;
use rustix::fs::Access;

use super::configuration::Configuration;
use super::exit::Failure;
use crate::daemon;
use crate::daemon::baud::{Excess, Load, Pace};
use crate::daemon::config::{Endpoint, SensorTable, Setup};
use hardnessd_core::exit::{CONFIG, Coded};
use hardnessd_core::frame::Pitch;
use hardnessd_core::tare::{self, Gains};
use hardnessd_core::verdict::Card;
use hardnessd_core::wire::Layout;

/// What `--help` says below the options.
const MORE: &str = "\
    It refuses what `run` would refuse, as far as no port has to be opened for it: also a frame \
    rate that the baud rate cannot carry, and a `dir` of [record] that cannot be written to. It \
    warns of taxels of another pitch than the model's, and of keys that change no verdict of \
    this model.";

/// Arguments of `check`.
#[derive(Debug, Clone, ClapArgs)]
#[command(after_help = MORE)]
pub struct Args {
    #[command(flatten)]
    config: Configuration,
}

/// An error of a configuration.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A path that the configuration names cannot be written to.
    #[error("{path}: {source}")]
    Daemon {
        /// Path of the configuration.
        path: PathBuf,
        /// The daemon's error, which names the path and the reason.
        source: daemon::Error,
    },
    /// The line cannot carry that many frames.
    #[error("{path}: sensor.frame_rate_hz of {sensor:?}: {excess}")]
    FrameRate {
        /// Path of the configuration.
        path: PathBuf,
        /// The sensor's name.
        sensor: String,
        /// What the line cannot carry.
        excess: Excess,
    },
}

impl Coded for Error {
    fn exit_code(&self) -> u8 {
        match self {
            Error::Daemon { source, .. } => source.exit_code(),
            Error::FrameRate { .. } => CONFIG,
        }
    }
}

/// Prints what the daemon would run. Warnings go to stderr.
///
/// # Errors
///
/// Returns a [`Failure`] if the configuration or its model cannot be used, a line cannot carry its
/// frames, or a path for sockets, the log or recordings cannot be written to.
pub fn run(args: &Args) -> Result<(), Failure> {
    let path = &args.config.path()?;
    let setup = Setup::load(path, None)?;
    daemon::check(&setup.config).map_err(|source| Error::Daemon {
        path: path.clone(),
        source,
    })?;
    let mut lines = format!("robot {}\n", setup.config.robot);
    for (sensor, checked) in setup.config.sensors.iter().zip(&setup.sensors) {
        lines += &line_of(sensor, checked.layout(), path)?;
        warn_of_pitch(sensor, setup.hrn.card(), path);
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
    lines += &if unix.enabled {
        let (path, mode) = (unix.path(), String::from(unix.mode));
        format!(
            "socket {}, mode {mode}, {} subscribers\ncontrol {}\n",
            path.display(),
            unix.max_clients,
            unix.control_path().display()
        )
    } else {
        "no socket\n".to_owned()
    };
    if let Some(record) = &setup.config.record {
        let what = if record.continuous {
            "recordings and black boxes"
        } else {
            "black boxes"
        };
        lines += &format!("{what} in {}\n", record.dir().display());
    }
    let tcp = setup.config.publish.tcp.as_ref().map(|tcp| tcp.listen);
    let http = setup.config.http.as_ref().map(|http| http.listen);
    let foxglove = setup.config.publish.foxglove.as_ref();
    let foxglove = foxglove.map(|foxglove| foxglove.listen);
    for (key, way, listen) in [
        ("publish.tcp.listen", "tcp ", tcp),
        ("publish.foxglove.listen", "foxglove ws://", foxglove),
        ("http.listen", "page http://", http),
    ] {
        if let Some(listen) = listen {
            lines += &format!("{way}{listen}\n");
            if !listen.ip().is_loopback() {
                hardnessd_core::stderr_line!(
                    "warning: {}: {key}: {listen} is open to anyone who can reach this machine; \
                     a loopback address, such as 127.0.0.1, is not",
                    path.display()
                );
            }
        }
    }
    lines += &networks(&setup, path);
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
fn warn_of_pitch(sensor: &SensorTable, card: &Card, path: &Path) {
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

/// Lines about zenoh and ROS 2.
fn networks(setup: &Setup, path: &Path) -> String {
    let publish = &setup.config.publish;
    let mut lines = String::new();
    if let Some(zenoh) = &publish.zenoh {
        lines += &format!(
            "zenoh tactile/{}/, listening on {:?}, connecting to {:?}\n",
            zenoh.site(&setup.config.robot),
            zenoh.listen,
            zenoh.connect
        );
        if let Some(motion) = &zenoh.motion {
            lines += &format!("zenoh positions of arms at {motion}\n");
        }
        let open = |endpoint: &&Endpoint| {
            let parsed = endpoint.address().parse::<SocketAddr>();
            parsed.map_or(true, |address| !address.ip().is_loopback())
        };
        for endpoint in zenoh.listen.iter().filter(open) {
            hardnessd_core::stderr_line!(
                "warning: {}: publish.zenoh.listen: {endpoint:?} is open to anyone who can reach it; \
                 a loopback address, such as 127.0.0.1, is not",
                path.display()
            );
        }
    }
    if let Some(ros2) = &publish.ros2 {
        let namespace = ros2.namespace.trim_end_matches('/');
        lines += &format!(
            "ros2 {namespace}/tactile/, domain {}, networks {:?}\n",
            ros2.domain_id(),
            ros2.networks
        );
        for (sensor, topic) in &ros2.motion {
            lines += &format!("ros2 positions of the arm of {sensor} at {topic}\n");
        }
    }
    lines
}

/// Pitches closer than this count as equal, because datasheets give two digits.
const PITCH_TOLERANCE_MM: f64 = 0.005;

fn line_of(sensor: &SensorTable, layout: &Layout, path: &Path) -> Result<String, Error> {
    let (shortest, longest) = (layout.min_frame_bytes(), layout.max_frame_bytes());
    let Load {
        pace,
        capacity,
        bytes_per_s,
        excess,
    } = Load::of(sensor, layout);
    if let Some(excess) = excess {
        let is_certain = excess.is_certain;
        let error = Error::FrameRate {
            path: path.to_owned(),
            sensor: sensor.name.clone(),
            excess,
        };
        if is_certain {
            return Err(error);
        }
        // Frames of some layouts vary in length, and a port that is not there may turn out to be USB CDC.
        hardnessd_core::stderr_line!("warning: {error}");
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
    Ok(format!(
        "sensor {}: {}, {}x{} taxels in {frame_bytes} bytes, {} frames/s: {load}{}{references}\n",
        sensor.name,
        sensor.port,
        array.rows,
        array.cols,
        sensor.frame_rate_hz,
        gains(&sensor.calibration)
    ))
}

/// The spread of a sensor's gains, if it has any.
fn gains(calibration: &tare::Settings) -> String {
    let Some(Gains::Taxels(rows)) = &calibration.gains else {
        return String::new();
    };
    let gains = rows.iter().flatten().copied();
    let least = gains.clone().fold(f32::INFINITY, f32::min);
    let most = gains.fold(0.0, f32::max);
    format!(", gains {least:.2} to {most:.2}")
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
