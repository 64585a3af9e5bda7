//! `hardnessd identify`: presses on pieces whose properties are known become a sensor's references.
//!
//! In: a configuration, and recordings or presses that are made now. Out: an `.npz` file, which
//! `references` of the configuration names. The presses are those that the daemon's pipeline sees, as
//! it would give them to a model of courses.

use std::fs::File;
use std::future::Future;
use std::io::ErrorKind;
use std::os::unix::fs::FileTypeExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context as _, bail};
use clap::Args as ClapArgs;
use rustix::process::Signal;

use super::configuration::Configuration;
use super::exit::{FAILED, Fail, Failure, IO, USAGE};
use super::played::Played;
use super::{cannot_read, live};
use crate::daemon::config::{self, Config, Setup};
use hardnessd_core::line::extent;
use hardnessd_core::part::Part;
use hardnessd_core::recording::Labels;
use hardnessd_core::references;
use hardnessd_core::sensor::Sensor;
use hardnessd_core::verdict::{
    Borders, Level, MOST_REFERENCES, Model, Piece, ReferencePress, TimeSeries, Tried,
};

/// The most presses of a recording, each with up to 48 frames.
const MOST_PRESSES: usize = 1000;

/// Arguments of `identify`.
#[derive(Debug, Clone, ClapArgs)]
pub struct Args {
    #[expect(missing_docs, reason = "a comment would be taken for help")]
    #[command(flatten)]
    pub config: Configuration,
    /// New file for the references, which `references` of the configuration names
    #[arg(long, value_name = "R.npz")]
    out: PathBuf,
    /// Add to the file, which may exist
    #[arg(long)]
    append: bool,
    /// What is pressed: flat:MM (a rigid flat piece, its width), ball:MM (a rigid ball, its radius),
    /// shore:OO, level:N or unknown (any everyday objects) [default: the recording's labels `reference`, `shore` or `level`]
    #[arg(long = "as", value_name = "WHAT")]
    what: Option<String>,
    /// Positions of the arm for raw bytes: CSV with the columns time_s, counted from the first whole
    /// frame, and approach_mm [default: none]
    #[arg(long, value_name = "M.csv", requires = "what")]
    motion: Option<PathBuf>,
    /// Sensor that was pressed [default: the first]
    #[arg(long, value_name = "NAME")]
    sensor: Option<String>,
    /// Presses to make, or to take of each file, from light to hard: 1 to 64
    #[arg(long, value_name = "N", default_value_t = 5,
        value_parser = clap::value_parser!(u64).range(1..=MOST_REFERENCES as u64))]
    presses: u64,
    /// Recordings, or raw bytes back to back [default: record presses now]
    #[arg(value_name = "FILE")]
    files: Vec<PathBuf>,
}

/// Reads the configuration at `path`. Its references need not exist yet, and do not count.
///
/// # Errors
///
/// Returns the errors of [`Config::load`] and [`Setup::of`].
pub fn load(path: &Path) -> Result<Setup, config::Error> {
    let mut config = Config::load(path)?;
    for sensor in &mut config.sensors {
        sensor.references = None;
    }
    Setup::of(config, path)
}

/// Makes the file from recordings, or from presses that are made now, and says what is in it. `config` is the path of the configuration.
///
/// # Errors
///
/// Returns a [`Failure`] if there are no presses, nothing says what was pressed, a file cannot be used, or the signal
/// `end` comes first.
pub async fn run(
    args: Args,
    setup: Setup,
    config: &Path,
    end: impl Future<Output = Signal>,
) -> Result<String, Failure> {
    let sensor = setup.sensor_named(args.sensor.as_deref());
    let sensor = sensor.exit(USAGE)?.clone();
    // A file that cannot be made or added to shows before anything is pressed.
    let (mut all, part) = begin(&args)?;
    let hrn = setup.hrn.clone();
    // A model without references may be followed by one that has them.
    let most = match hrn.most_references() {
        0 => MOST_REFERENCES,
        most => most,
    };
    let check_count = |found: usize, remedy: &str| match found > most {
        true => {
            let many = format!("{found} presses in all, expected at most {most}: {remedy}");
            Err(Failure::new(FAILED, many))
        }
        false => Ok(()),
    };
    if args.files.is_empty() {
        check_count(
            all.len() + args.presses as usize,
            "make fewer, or another file",
        )?;
    }
    let levels = &hrn.card().levels;
    let what = args.what.as_deref().map(|what| piece(what, levels));
    let what = what.transpose().of("--as", USAGE)?;
    if args.files.is_empty() && what.is_none() {
        let unknown =
            "--as: found nothing, expected what will be pressed, such as flat:20 or ball:10";
        return Err(Failure::new(USAGE, unknown));
    }
    let read = {
        let (args, sensor, hrn) = (args.clone(), sensor.clone(), hrn.clone());
        move |file, path: &Path| of_file(&args, what, file, path, &sensor, &hrn)
    };
    let (name, wanted) = (sensor.name(), args.presses);
    let next = |seen: u64| match seen {
        0 => format!("press it {wanted} times, harder each time"),
        _ => format!("press {seen} of {wanted}"),
    };
    let made = live::gather(setup, name, wanted, &args.files, next, end, read);
    let made = made.await?;
    let is_twice = |(place, press): (usize, &ReferencePress)| {
        let mut earlier = all.iter().chain(&made[..place]);
        earlier.any(|earlier| earlier.course.moments == press.course.moments)
    };
    if made.iter().enumerate().any(is_twice) {
        let twice = "would have presses twice: name each recording once";
        return Err(Failure::new(
            FAILED,
            format!("{} {twice}", args.out.display()),
        ));
    }
    all.extend(made);
    check_count(all.len(), "leave recordings out")?;
    let bytes = references::write(&all).of(args.out.display(), IO)?;
    part.write(&bytes).of(args.out.display(), IO)?;
    let tried = if all.len() <= hrn.most_references() {
        let identified = hrn.identified_by(&all);
        identified.of(args.out.display(), FAILED)?.1
    } else {
        Tried::default()
    };
    Ok(account(&super::as_in(config, &args.out), &all, tried))
}

/// Begins the file, and reads the presses that it has already. Fails if there is a file that nothing is to
/// be added to.
fn begin(args: &Args) -> Result<(Vec<ReferencePress>, Part), Failure> {
    let out = &args.out;
    if !args.append {
        let part = Part::new(out);
        if part
            .as_ref()
            .is_err_and(|error| error.kind() == ErrorKind::AlreadyExists)
        {
            let exists = "exists already: add to it with --append, or name another file";
            return Err(Failure::new(IO, format!("{} {exists}", out.display())));
        }
        return Ok((Vec::new(), part.of(out.display(), IO)?));
    }
    // It refuses a pipe, whose reading might never end.
    let part = Part::over(out).of(out.display(), IO)?;
    match config::read_at_most(out, references::MAX_FILE_BYTES) {
        Ok(bytes) => Ok((references::read(&bytes).of(out.display(), FAILED)?, part)),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok((Vec::new(), part)),
        Err(error) => Err(cannot_read(out)(error)),
    }
}

/// The piece that a text names, with the model's levels.
fn piece(text: &str, levels: &[Level]) -> anyhow::Result<Piece> {
    let (kind, value) = text.split_once(':').unwrap_or((text, ""));
    let value = value.trim();
    let within = |least: f32, most: f32| {
        let number = value.parse().ok();
        number.filter(|number| (least..=most).contains(number))
    };
    let most = levels.len();
    let piece = match kind.trim() {
        "unknown" if value.is_empty() => Some(Piece::UNKNOWN),
        "flat" | "ball" => Piece::rigid(text),
        "shore" => within(0.0, 100.0).map(|oo| Piece::Shore { range: [oo; 2] }),
        "level" => {
            let borders = Borders::of(levels).context("the model's levels")?;
            let level = value.parse().ok();
            let level = level.filter(|level| (1..=most).contains(level));
            level.map(|level: usize| Piece::Shore {
                range: borders.part(level - 1),
            })
        }
        _ => None,
    };
    piece.with_context(|| {
        format!(
            "found {text:?}, expected flat:MM or ball:MM with 0.1 to 1000 mm, shore:OO with 0 to 100, level:N with 1 \
             to {most}, or unknown"
        )
    })
}

/// The references of a file: of those of the command line, some presses, and of presses of now, all.
fn of_file(
    args: &Args,
    what: Option<Piece>,
    file: File,
    path: &Path,
    sensor: &Sensor,
    hrn: &Arc<Model>,
) -> Result<Vec<ReferencePress>, Failure> {
    let found = file.metadata().of(path.display(), IO)?;
    if found.file_type().is_char_device() {
        let device = format!("{}: found a device, expected a recording", path.display());
        return Err(Failure::new(FAILED, device));
    }
    let mut played = Played::open(path, file, sensor, hrn, args.motion.as_deref())?;
    played.playback.keep_courses();
    let grid_mm = hrn.card().pitch_mm.into();
    let mut courses = Vec::new();
    played.play(|played, _, _| {
        let ended = played.playback.ended().into_iter();
        let ended = ended.filter(|press| press.sensor == sensor.name());
        courses.extend(ended.map(|press| press.course(grid_mm)));
        if courses.len() > MOST_PRESSES {
            let path = path.display();
            let many = format!("{path}: found more than {MOST_PRESSES} presses: record fewer");
            return Err(Failure::new(FAILED, many));
        }
        Ok(true)
    })?;
    let labels = played.playback.labels();
    let labelled = || labelled(&labels, &hrn.card().levels).of(path.display(), FAILED);
    let piece = what.map_or_else(labelled, Ok)?;
    if courses.is_empty() {
        let (path, sensor) = (path.display(), sensor.name());
        let none = format!("{path}: found no press of sensor {sensor:?}, expected at least one");
        return Err(Failure::new(FAILED, none));
    }
    if !args.files.is_empty() {
        courses = spread(courses, args.presses as usize);
    }
    let press = |course| ReferencePress { course, piece };
    Ok(courses.into_iter().map(press).collect())
}

/// The greatest force of a press, in newtons.
fn greatest_n(course: &TimeSeries) -> f64 {
    let forces = course.moments.iter().map(|moment| moment.frame.force_n());
    forces.fold(0.0, f64::max)
}

/// At most `most` of the presses, evenly up to the hardest: presses of unlike force tell most.
fn spread(mut courses: Vec<TimeSeries>, most: usize) -> Vec<TimeSeries> {
    courses.sort_by(|a, b| greatest_n(a).total_cmp(&greatest_n(b)));
    let (found, wanted) = (courses.len(), most.min(courses.len()));
    let places = (1..=wanted).map(|number| number * found / wanted - 1);
    places.map(|place| courses[place].clone()).collect()
}

/// The piece that the labels of a recording name.
fn labelled(labels: &Labels, levels: &[Level]) -> anyhow::Result<Piece> {
    for (key, kind) in [("reference", ""), ("shore", "shore:"), ("level", "level:")] {
        if let Some(found) = labels.get(key) {
            return piece(&format!("{kind}{found}"), levels).context(format!("label {key}"));
        }
    }
    bail!("found no label `reference`, `shore` or `level`: say what was pressed with --as");
}

/// What the file holds, what is missing, and the lines of the configuration. `out` is the file's path as
/// the configuration may name it.
fn account(out: &str, references: &[ReferencePress], tried: Tried) -> String {
    let count = |is: fn(&Piece) -> bool| references.iter().filter(|p| is(&p.piece)).count();
    let flat = count(|piece| matches!(piece, Piece::Flat { .. }));
    let ball = count(|piece| matches!(piece, Piece::Ball { .. }));
    let unknown = count(|piece| piece.is_unknown());
    let mut text = format!(
        "presses on  rigid flat piece {flat}, rigid ball {ball}, known hardness {}, unknown {unknown}\n",
        references.len() - flat - ball - unknown
    );
    let forces = references.iter().map(|press| greatest_n(&press.course));
    let [least, most] = extent(forces);
    text += &format!("greatest force of a press  {least:.1} to {most:.1} N\n");
    let is_without = |press: &&ReferencePress| {
        let mut moments = press.course.moments.iter();
        moments.all(|moment| moment.approach_mm.is_none())
    };
    let without = references.iter().filter(is_without).count();
    if without > 0 {
        text += &format!(
            "without the arm's approach {without}: such a press does not show how deep the sensor gives way\n"
        );
    }
    if tried.presses > 0 {
        let (presses, [with, without]) = (tried.presses, tried.right);
        text +=
            &format!("judged rightly  {with} of {presses} with the others, {without} with none\n");
    }
    if tried.right[0] * 2 < tried.presses {
        text += "what is known of the pieces and the verdicts differ for most: check the hardness that you gave, and newtons \
                 with `calibrate force`\n";
    }
    if tried.left_out > 0 {
        text += &format!(
            "unknown presses left out {}: the daemon uses six or more, whose estimated hardness differs by a standard \
             deviation of 12 OO or more: press other objects\n",
            tried.left_out
        );
    }
    if references.len() == tried.left_out as usize {
        return text;
    }
    if tried.are_worse() {
        text += "these references make verdicts worse, so the daemon will not use them: check newtons with \
                 `calibrate force`, press from 5 N on, add other pieces, or leave `references` out\n";
        return text;
    }
    if flat + ball > 0 && (flat < 2 || ball < 2) {
        text += "a light and a hard press on a rigid flat piece and on a rigid ball tell most\n";
    }
    let out = toml::Value::from(out);
    text + &format!("\n[[sensor]]\nreferences = {out}\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use hardnessd_core::verdict::{ModelFrame, Moment, TAXELS};

    fn press(newtons: f32) -> TimeSeries {
        TimeSeries {
            moments: vec![Moment {
                time_s: 0.0,
                approach_mm: None,
                frame: ModelFrame {
                    newtons: [newtons; TAXELS],
                },
            }],
            arm_n_per_mm: 0.0,
        }
    }

    #[test]
    fn the_presses_that_are_taken_differ_in_force() {
        let taken = |most| {
            let courses = [5.0, 1.0, 4.0, 2.0, 3.0].map(press).to_vec();
            let taken = spread(courses, most);
            let newtons = taken
                .iter()
                .map(|course| course.moments[0].frame.newtons[0]);
            newtons.collect::<Vec<_>>()
        };
        assert_eq!(taken(1), [5.0]);
        assert_eq!(taken(2), [2.0, 5.0]);
        assert_eq!(taken(64), [1.0, 2.0, 3.0, 4.0, 5.0]);
        assert_eq!(spread(Vec::new(), 5), []);
    }

    #[test]
    fn the_account_shows_the_forces() {
        let presses = [0.03, 0.01, 0.02].map(|newtons| ReferencePress {
            piece: Piece::Ball { radius_mm: 10.0 },
            course: press(newtons),
        });
        let text = account("r.npz", &presses, Tried::default());
        assert!(text.contains("press  7.8 to 23.5 N\n"), "{text}");
    }

    #[test]
    fn a_text_names_a_piece() {
        let levels = [Level::new(1, "hard", ">70"), Level::new(2, "soft", "0-70")];
        for (text, expected) in [
            ("flat:20", Piece::Flat { width_mm: 20.0 }),
            ("ball: 7.5", Piece::Ball { radius_mm: 7.5 }),
            ("shore:63", Piece::Shore { range: [63.0; 2] }),
            (
                "level:1",
                Piece::Shore {
                    range: [70.0, 100.0],
                },
            ),
            ("unknown", Piece::UNKNOWN),
        ] {
            assert_eq!(piece(text, &levels).unwrap(), expected, "{text}");
        }
        for text in [
            "flat",
            "flat:",
            "flat:0",
            "ball:nan",
            "shore:101",
            "level:x",
            "level:3",
            "egg:3",
        ] {
            assert!(piece(text, &levels).is_err(), "{text}");
        }
    }
}
