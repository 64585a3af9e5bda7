//! `hardnessd calibrate`: measures values of a configuration for the sensor and for the arm that
//! presses with it.
//!
//! A daemon with sockets serves the sensor and records meanwhile, so the robot's controller runs as
//! it always does. Afterwards, `calibrate` reads the recording and prints the values, their spread
//! and the lines for the configuration. It can also read recordings made earlier.

mod arm;
mod force;
mod gather;
mod taxels;

use std::collections::BTreeSet;
use std::future::Future;
use std::path::{Path, PathBuf};

use anyhow::ensure;
use clap::{Args as ClapArgs, ValueEnum};
use rustix::process::Signal;

use self::gather::Press;
use super::configuration::Configuration;
use super::exit::{FAILED, Fail, Failure, IO, USAGE};
use super::live;
use crate::daemon::config::Setup;
use hardnessd_core::line::extent;
use hardnessd_core::npy;
use hardnessd_core::part::Part;
use hardnessd_core::sensor::Sensor;
use hardnessd_core::stderr_line;
use hardnessd_core::wording::within;

/// What `--help` says below the options.
const MORE: &str = "\
    Without --from the command opens the sensor and the sockets of [publish.unix] as `run` does, \
    so stop the daemon first. It prints the values, their spread and the lines for the \
    configuration. With four weights, one at least twice another, `force` also finds `exponent`. \
    Exit code 1: the presses do not determine the values; stderr says what to do differently.";

/// Arguments of `calibrate`.
#[derive(Debug, Clone, ClapArgs)]
#[command(after_long_help = MORE)]
pub struct Args {
    /// arm: press something rigid a few times, while the robot sends the positions of its arm. force: put
    /// known weights on the sensor, on a foot of at least three taxels. taxels: press a bag of air or water on the
    /// whole array a few times
    what: What,
    #[expect(missing_docs, reason = "a comment would be taken for help")]
    #[command(flatten)]
    pub config: Configuration,
    /// Sensor to calibrate [default: the first]
    #[arg(long, value_name = "NAME")]
    sensor: Option<String>,
    /// force: the weights, in newtons, in the order in which they are put on (1 kg is 9.81 N)
    #[arg(long, value_name = "N", num_args = 1.., required_if_eq("what", "force"), value_parser = within(0.001, 1e6))]
    newtons: Vec<f64>,
    /// arm, taxels: presses to make, 2 to 1000 [default: arm 5, taxels 10]
    #[arg(long, value_name = "N", conflicts_with = "from", value_parser = clap::value_parser!(u64).range(2..=1000))]
    presses: Option<u64>,
    /// Take the presses from these recordings, and leave the sensor alone
    #[arg(long, value_name = "FILE", num_args = 1..)]
    from: Vec<PathBuf>,
    /// taxels: new file for the gains, which `gains` of the configuration names [default: gains.npy beside the
    /// configuration]
    #[arg(long, value_name = "FILE.npy")]
    out: Option<PathBuf>,
}

/// What can be calibrated.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum What {
    /// Stiffness of the arm, and the delay of its stamps.
    Arm,
    /// Newtons per count.
    Force,
    /// A gain for each taxel.
    Taxels,
}

/// Weights that disagree by more than this share get a warning.
const DOUBTFUL_ERROR: f64 = 0.1;

/// The name of the file for the gains, beside the configuration, if the command line names none.
const GAINS: &str = "gains.npy";

/// The number of presses if `--presses` does not give it.
const ARM_PRESSES: u64 = 5;
const TAXEL_PRESSES: u64 = 10;

impl Args {
    fn check(&self) -> anyhow::Result<()> {
        ensure!(
            matches!(self.what, What::Force) || self.newtons.is_empty(),
            "--newtons is only for `calibrate force`: leave it out"
        );
        ensure!(
            matches!(self.what, What::Taxels) || self.out.is_none(),
            "--out is only for `calibrate taxels`: leave it out"
        );
        Ok(())
    }

    /// The number of presses to make.
    fn wanted(&self) -> u64 {
        match self.what {
            What::Arm => self.presses.unwrap_or(ARM_PRESSES),
            What::Taxels => self.presses.unwrap_or(TAXEL_PRESSES),
            What::Force => self.newtons.len() as u64,
        }
    }
}

/// Serves the sensor until there are enough presses, or reads recordings. Returns the values in words. `config` is the path
/// of the configuration.
///
/// # Errors
///
/// Returns a [`Failure`] if the daemon cannot serve, a recording cannot be read, the presses do
/// not determine the values, or the signal `end` comes first.
pub async fn run(
    args: Args,
    setup: Setup,
    config: &Path,
    end: impl Future<Output = Signal>,
) -> Result<String, Failure> {
    args.check().exit(USAGE)?;
    let sensor = setup.sensor_named(args.sensor.as_deref());
    let sensor = sensor.exit(USAGE)?.clone();
    // Test the output file now, before anybody presses.
    let path = args.out.clone();
    let path = path.unwrap_or_else(|| config.with_file_name(GAINS));
    let out = match args.what {
        What::Taxels => Some(Part::new(&path).of(path.display(), IO)?),
        What::Arm | What::Force => None,
    };
    let read = {
        let (sensor, hrn) = (sensor.clone(), setup.hrn.clone());
        move |file, path: &Path| gather::presses(file, path, &sensor, &hrn)
    };
    let (name, wanted) = (sensor.name(), args.wanted());
    let next = |seen| next(&args, seen);
    let presses = live::gather(setup, name, wanted, &args.from, next, end, read);
    let presses = presses.await?;
    match out {
        None if matches!(args.what, What::Arm) => {
            let fit = arm::Fit::of(&presses).exit(FAILED)?;
            Ok(of_arm(&fit))
        }
        None => of_force(&args.newtons, &presses, &sensor),
        Some(part) => of_taxels(presses, &sensor, part, &path, config),
    }
}

/// What to do next, after `seen` presses.
fn next(args: &Args, seen: u64) -> String {
    let wanted = args.wanted();
    match (args.what, args.newtons.get(seen as usize)) {
        (What::Force, Some(newtons)) => {
            format!("put {newtons} N on the sensor, wait until it rests, and take it off")
        }
        (What::Force, None) => "done".to_owned(),
        _ if seen > 0 => format!("press {seen} of {wanted}"),
        (What::Arm, _) => {
            format!("press something rigid {wanted} times, while the robot tells where its arm is")
        }
        (What::Taxels, _) => format!(
            "lay a bag of air or water on the whole array, and press it through a plate {wanted} times"
        ),
    }
}

/// The values of known weights, their spread and the lines for the configuration.
fn of_force(newtons: &[f64], presses: &[Press], sensor: &Sensor) -> Result<String, Failure> {
    let (found, expected) = (presses.len(), newtons.len());
    if found != expected {
        let count = format!(
            "found {found} presses, expected {expected}: put each weight on once; with a scale that is far off, weights \
             are no presses or noise is one: set newtons_per_count to a guess from your data sheet, and record anew"
        );
        return Err(Failure::new(FAILED, count));
    }
    let weights: Vec<(f64, &Press)> = newtons.iter().copied().zip(presses).collect();
    let fit = force::Fit::of(&weights, sensor).exit(FAILED)?;
    let error = fit.error();
    if error > DOUBTFUL_ERROR {
        stderr_line!(
            "warning: the weights disagree by {:.0} %: was each put on alone, in this order, after \
             the zero was taken? If so, leave out the weight with the greatest error",
            100.0 * error
        );
    }
    let mut text = String::from("weight        read          error\n");
    for (newtons, read) in &fit.weights {
        let error = 100.0 * (read / newtons - 1.0);
        let [newtons, read] = [newtons, read].map(|n| format!("{n:.3} N"));
        text += &format!("{newtons:<13} {read:<13} {error:+.1} %\n");
    }
    // A fine count may have a ten-thousandth of the newtons of a coarse one.
    let digits = (4.0 - fit.newtons_per_count.log10().floor()).clamp(0.0, 20.0) as usize;
    let [least, most] = fit.alone.map(|newtons| format!("{newtons:.digits$}"));
    let newtons_per_count = format!("{:.digits$}", fit.newtons_per_count);
    let power = match fit.power {
        Some((exponent, error)) => {
            format!("exponent {exponent:.2}, error {:.1} %", 100.0 * error)
        }
        None => "needs four different weights, one twice another".to_owned(),
    };
    Ok(text
        + &format!(
            "\nnewtons_per_count  {newtons_per_count} (weight by weight {least} to {most})\n\
             line               error {:.1} %\n\
             power law          {power}\n\
             \n\
             [sensor.calibration]\n\
             newtons_per_count = {newtons_per_count}\n\
             exponent = {:.2}\n",
            100.0 * fit.line_error,
            fit.exponent
        ))
}

/// The values, their spread and the lines for the configuration.
fn of_arm(fit: &arm::Fit) -> String {
    let [least_n, most_n] = fit.force_n;
    let (arm, [least_arm, most_arm]) = fit.n_per_mm;
    let (delay, [least_delay, most_delay]) = fit.delay_ms;
    format!(
        "presses    {}, up to {least_n:.1} to {most_n:.1} N\n\
         stiffness  {arm:.2} N/mm (press by press {least_arm:.2} to {most_arm:.2})\n\
         delay      {delay:.1} ms (press by press {least_delay:.1} to {most_delay:.1})\n\
         residual   {:.3} mm\n\
         \n\
         [sensor.arm]\n\
         stiffness_n_per_mm = {arm:.2}\n\
         delay_ms = {delay:.1}\n",
        fit.presses, fit.residual_mm
    )
}

/// Writes the gains to `part`, which becomes the file at `path`. Returns them with their spread and the
/// lines for the configuration.
fn of_taxels(
    mut presses: Vec<Press>,
    sensor: &Sensor,
    part: Part,
    path: &Path,
    config: &Path,
) -> Result<String, Failure> {
    let found = presses.len();
    presses.retain(|press| !press.saturated);
    if presses.len() < found {
        stderr_line!(
            "warning: {} of the presses reached full scale on a taxel and are left out: press more softly",
            found - presses.len()
        );
    }
    let array = sensor.layout().array();
    // Those of the sensor, and those that were dead in a recording.
    let recorded = presses.iter().map(|press| &press.calibration);
    let known = recorded.chain([sensor.calibration()]);
    let dead: BTreeSet<[usize; 2]> = known.flat_map(|known| known.dead_taxels.clone()).collect();
    let mut is_dead = vec![false; array.taxels()];
    for &[row, col] in &dead {
        is_dead[array.place(row, col)] = true;
    }
    let plain = presses.iter().map(gather::Press::without_gains);
    let pitch = sensor.calibration().pitch_mm;
    let fit = taxels::Fit::of(&plain.collect::<Vec<_>>(), &is_dead, pitch).exit(FAILED)?;
    let gains: Vec<f32> = fit.gains.iter().map(|gain| gain.unwrap_or(1.0)).collect();
    let bytes = npy::to_bytes(&[array.rows, array.cols], &gains);
    part.write(&bytes).of(path.display(), IO)?;

    let mut text = String::from("gains, in percent; . where no press tells of it:\n");
    for row in fit.gains.chunks(array.cols) {
        let shown = |gain: &Option<f32>| match gain {
            Some(gain) => format!(" {:3.0}", 100.0 * gain),
            None => "   .".to_owned(),
        };
        text += &(row.iter().map(shown).collect::<String>() + "\n");
    }
    let known = fit.gains.iter().flatten();
    let [least, most] = extent(known.clone().map(|&gain| gain.into()));
    text += &format!(
        "\ntaxels  {} of {} measured in {} presses\n\
         gains   {least:.2} to {most:.2}, spread {:.1} %\n\
         error   {:.1} % of a gain\n\
         \n\
         [sensor.calibration]\n\
         gains = {}\n",
        known.count(),
        gains.len(),
        fit.presses,
        100.0 * fit.spread,
        100.0 * fit.error,
        toml::Value::from(super::as_in(config, path))
    );
    if !dead.is_empty() {
        let dead = Vec::from_iter(dead);
        text += &format!("dead_taxels = {dead:?}\n");
    }
    Ok(text)
}
