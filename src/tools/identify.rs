//! `hardnessd identify`: presses on pieces whose properties are known become a sensor's references.
//!
//! In: a configuration, and recordings or presses that are made now. Out: an `.npz` file, which
//! `references` of the configuration names. The presses are those that the daemon's pipeline sees, as
//! it would give them to a model of courses.

use std::fs::File;
use std::future::Future;
use std::io::{self, BufReader, Read};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;

use clap::Args as ClapArgs;

use super::configuration::Configuration;
use super::exit::{Fail, Failure};
use super::replay::{self, feed, no_frame};
use super::{cannot_read, live, open, print_apart, unplayable};
use crate::daemon::config::{self, Config, Setup};
use crate::thread::spawn_thread;
use hardnessd_core::exit::{FAILED, IO, USAGE};
use hardnessd_core::motion::Point;
use hardnessd_core::part::Part;
use hardnessd_core::pipeline::{Clock, Pipeline};
use hardnessd_core::recording::{FileKind, Labels, Playback, Reader};
use hardnessd_core::references;
use hardnessd_core::sensor::Sensor;
use hardnessd_core::verdict::{
    Borders, Course, Hrn, Level, MOST_REFERENCES, Piece, ReferencePress, Tried,
};

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
    what: Option<What>,
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

/// What a user knows of a piece.
#[derive(Debug, Clone, Copy, PartialEq)]
enum What {
    Piece(Piece),
    Level(u8),
}

impl FromStr for What {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, &'static str> {
        What::named(text).ok_or(
            "expected flat:MM or ball:MM with 0.1 to 1000 mm, shore:OO with 0 to 100, level:N, or unknown",
        )
    }
}

impl What {
    fn named(text: &str) -> Option<Self> {
        if text.trim() == "unknown" {
            return Some(Self::Piece(Piece::UNKNOWN));
        }
        let (kind, value) = text.split_once(':')?;
        let within = |least: f32, most: f32| {
            let number = value.trim().parse().ok();
            number.filter(|number| (least..=most).contains(number))
        };
        Some(match kind.trim() {
            "flat" => Self::Piece(Piece::Flat {
                width_mm: within(0.1, 1000.0)?,
            }),
            "ball" => Self::Piece(Piece::Ball {
                radius_mm: within(0.1, 1000.0)?,
            }),
            "shore" => Self::Piece(Piece::Shore {
                range: [within(0.0, 100.0)?; 2],
            }),
            "level" => Self::Level(value.trim().parse().ok()?),
            _ => return None,
        })
    }
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

/// Makes the file from recordings, or from presses that are made now. Ends early, without a file, when
/// `shutdown` comes. `config` is the path of the configuration.
///
/// # Errors
///
/// Returns a [`Failure`] if there are no presses, nothing says what was pressed, or a file cannot be
/// used.
pub async fn run(
    args: Args,
    setup: Setup,
    config: &Path,
    shutdown: impl Future<Output = ()>,
) -> Result<(), Failure> {
    let sensor = setup.sensor_named(args.sensor.as_deref())?.clone();
    // A file that cannot be made or added to shows before anything is pressed.
    begin(&args)?;
    let levels = setup.hrn.card().levels.clone();
    let hrn = setup.hrn.clone();
    let file = if args.files.is_empty() {
        let Some(what) = args.what else {
            return Err(Failure::new(
                USAGE,
                "--as: found nothing, expected what will be pressed, such as flat:20 or ball:10",
            ));
        };
        let wanted = args.presses;
        let print_next = |seen: u64| match seen {
            0 => hardnessd_core::stderr_line!("press it {wanted} times, harder each time"),
            _ => hardnessd_core::stderr_line!("press {seen} of {wanted}"),
        };
        let hrn = setup.hrn.clone();
        let made = live::record(setup, sensor.name(), wanted, print_next, shutdown).await?;
        let Some(file) = made else {
            return Ok(());
        };
        let path = Path::new(live::RECORDED);
        let (mut courses, _) = of_recording(file, path, sensor.name(), hrn)?;
        // Something else may have been pressed before the recording ended.
        courses.truncate(wanted as usize);
        made_of(courses, piece(what, &levels)?, path, &sensor)?
    } else {
        let (args, hrn, sensor) = (args.clone(), setup.hrn.clone(), sensor.clone());
        let work = move || of_files(&args, &sensor, &hrn, &levels);
        let read = spawn_thread("identify", work)?;
        tokio::select! {
            read = read => read.expect("recordings are read without a panic")?,
            () = shutdown => return Ok(()),
        }
    };
    let all = write(&args, file)?;
    let tried = match all.len() <= hrn.most_references() {
        true => {
            hrn.identified_by(&all)
                .of(args.out.display().to_string(), FAILED)?
                .1
        }
        false => Tried::default(),
    };
    let text = account(&super::as_in(config, &args.out), &all, tried);
    print_apart(text.into_bytes()).await?;
    Ok(())
}

/// Begins the file, and reads the presses that it has already. Fails if there is a file that nothing is to
/// be added to.
fn begin(args: &Args) -> Result<(Vec<ReferencePress>, Part), Failure> {
    let out = &args.out;
    if !args.append {
        return match Part::new(out) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Err(Failure::new(
                IO,
                format!(
                    "{} exists already: add to it with --append, or name another file",
                    out.display()
                ),
            )),
            part => Ok((Vec::new(), part.of_file(out, IO)?)),
        };
    }
    // It refuses a pipe, whose reading might never end.
    let part = Part::over(out).of_file(out, IO)?;
    let mut bytes = Vec::new();
    let read = File::open(out).and_then(|file| {
        file.take(references::MAX_FILE_BYTES as u64 + 1)
            .read_to_end(&mut bytes)
    });
    match read {
        Ok(_) => {}
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok((Vec::new(), part)),
        Err(error) => return Err(cannot_read(out)(error)),
    }
    Ok((references::read(&bytes).of_file(out, FAILED)?, part))
}

/// What is known of a piece, with the model's levels.
fn piece(what: What, levels: &[Level]) -> Result<Piece, Failure> {
    let level = match what {
        What::Piece(piece) => return Ok(piece),
        What::Level(level) => level,
    };
    if !(1..=levels.len()).contains(&usize::from(level)) {
        let most = levels.len();
        let unknown = format!("level: found {level}, expected 1 to {most}, those of the model");
        return Err(Failure::new(FAILED, unknown));
    }
    let borders = Borders::of(levels).of("the model's levels", FAILED)?;
    let range = borders.part(usize::from(level) - 1);
    Ok(Piece::Shore { range })
}

/// The references of all files of the command line.
fn of_files(
    args: &Args,
    sensor: &Sensor,
    hrn: &Arc<Hrn>,
    levels: &[Level],
) -> Result<Vec<ReferencePress>, Failure> {
    let motion = match &args.motion {
        None => None,
        Some(path) => Some(replay::positions(path)?),
    };
    let mut all = Vec::new();
    for path in &args.files {
        let (kind, file) = FileKind::read(open(path)?).map_err(cannot_read(path))?;
        let (courses, labels) = match kind {
            FileKind::Recording if motion.is_some() => {
                return Err(replay::own_motion(path));
            }
            FileKind::Recording => {
                of_recording(BufReader::new(file), path, sensor.name(), hrn.clone())?
            }
            FileKind::Raw => {
                let courses = of_bytes(file, path, sensor, hrn.clone(), motion.clone())?;
                (courses, Labels::new())
            }
        };
        let what = match args.what {
            Some(what) => what,
            None => labelled(&labels, path)?,
        };
        let courses = spread(courses, args.presses as usize);
        all.extend(made_of(courses, piece(what, levels)?, path, sensor)?);
    }
    Ok(all)
}

/// The greatest force of a press, in newtons.
fn greatest_n(course: &Course) -> f64 {
    let forces = course.moments.iter().map(|moment| moment.frame.force_n());
    forces.fold(0.0, f64::max)
}

/// At most `most` of the presses, evenly up to the hardest: presses of unlike force tell most.
fn spread(mut courses: Vec<Course>, most: usize) -> Vec<Course> {
    courses.sort_by(|a, b| greatest_n(a).total_cmp(&greatest_n(b)));
    let (found, wanted) = (courses.len(), most.min(courses.len()));
    let places = (1..=wanted).map(|number| number * found / wanted - 1);
    places.map(|place| courses[place].clone()).collect()
}

/// What the labels of a recording say was pressed.
fn labelled(labels: &Labels, path: &Path) -> Result<What, Failure> {
    let kinds = [("reference", ""), ("shore", "shore:"), ("level", "level:")];
    let known = kinds
        .into_iter()
        .find_map(|(key, kind)| Some((key, kind, labels.get(key)?)));
    let Some((key, kind, found)) = known else {
        let unlabelled =
            "found no label `reference`, `shore` or `level`: say what was pressed with --as";
        return Err(Failure::new(
            FAILED,
            format!("{}: {unlabelled}", path.display()),
        ));
    };
    let what = format!("{kind}{found}").parse();
    what.map_err(|expected| {
        let path = path.display();
        Failure::new(
            FAILED,
            format!("{path}: label {key}: found {found:?}, {expected}"),
        )
    })
}

fn made_of(
    courses: Vec<Course>,
    piece: Piece,
    path: &Path,
    sensor: &Sensor,
) -> Result<Vec<ReferencePress>, Failure> {
    if courses.is_empty() {
        let (path, sensor) = (path.display(), sensor.name());
        let none = format!("{path}: found no press of sensor {sensor:?}, expected at least one");
        return Err(Failure::new(FAILED, none));
    }
    let press = |course| ReferencePress { course, piece };
    Ok(courses.into_iter().map(press).collect())
}

/// The courses of the presses in a recording, and its labels.
fn of_recording(
    file: impl Read,
    path: &Path,
    sensor: &str,
    hrn: Arc<Hrn>,
) -> Result<(Vec<Course>, Labels), Failure> {
    let read = || -> anyhow::Result<_> {
        let (mut playback, mut courses) = (Playback::new(hrn), Vec::new());
        playback.keep_courses();
        for found in Reader::new(file) {
            playback.feed(found?)?;
            courses.extend(playback.courses(sensor));
        }
        playback.end();
        courses.extend(playback.courses(sensor));
        for note in playback.left_out() {
            hardnessd_core::stderr_line!("warning: {}: {note}", path.display());
        }
        Ok((courses, playback.labels()))
    };
    read().map_err(unplayable(path))
}

/// The courses of the presses in raw bytes.
fn of_bytes(
    file: impl Read,
    path: &Path,
    sensor: &Sensor,
    hrn: Arc<Hrn>,
    motion: Option<Vec<Point>>,
) -> Result<Vec<Course>, Failure> {
    let mut pipeline = Pipeline::new(sensor.clone(), hrn, Clock::FrameRate);
    pipeline.keep_courses();
    let end = feed(path, file, motion, false, &mut pipeline, |_, _| Ok(true))?;
    match end.as_deref().and_then(|end| no_frame(path, end)) {
        Some(error) => Err(error),
        None => Ok(pipeline.courses()),
    }
}

/// Writes the file, and returns all its presses.
fn write(args: &Args, made: Vec<ReferencePress>) -> Result<Vec<ReferencePress>, Failure> {
    let out = &args.out;
    // Another call may have added to the file meanwhile.
    let (mut all, part) = begin(args)?;
    all.extend(made);
    if all.len() > MOST_REFERENCES {
        let found = all.len();
        let many = format!(
            "found {found} presses, expected at most {MOST_REFERENCES}: leave recordings out"
        );
        return Err(Failure::new(FAILED, many));
    }
    let bytes = references::write(&all).of_file(out, IO)?;
    part.write(&bytes).of_file(out, IO)?;
    Ok(all)
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
    let (least, most) = forces.fold((f64::INFINITY, 0.0), |(least, most), force_n| {
        (force_n.min(least), force_n.max(most))
    });
    text += &format!("greatest force of a press  {least:.1} to {most:.1} N\n");
    let without = references.iter().filter(|press| {
        let mut moments = press.course.moments.iter();
        moments.all(|moment| moment.approach_mm.is_none())
    });
    match without.count() {
        0 => {}
        without => {
            text += &format!(
                "without the arm's approach {without}: such a press does not show how deep the sensor gives way\n"
            );
        }
    }
    let Tried {
        presses,
        right: [with, without],
        ..
    } = tried;
    if presses > 0 {
        text +=
            &format!("judged rightly  {with} of {presses} with the others, {without} with none\n");
    }
    if tried.are_worse() {
        text += "these references make verdicts worse, so the daemon will not use them: check newtons with \
                 `calibrate force`, press from 5 N on, or leave `references` out\n";
    } else if flat + ball > 0 && (flat < 2 || ball < 2) {
        text += "a light and a hard press on a rigid flat piece and on a rigid ball tell most\n";
    }
    text + &format!("\n[[sensor]]\nreferences = {out:?}\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use hardnessd_core::verdict::{ModelFrame, Sample, TAXELS};

    fn press(newtons: f32) -> Course {
        Course {
            moments: vec![Sample {
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
        let parse = |text: &str| text.parse::<What>();
        let flat = Piece::Flat { width_mm: 20.0 };
        assert_eq!(parse("flat:20"), Ok(What::Piece(flat)));
        let ball = Piece::Ball { radius_mm: 7.5 };
        assert_eq!(parse("ball: 7.5"), Ok(What::Piece(ball)));
        let shore = Piece::Shore { range: [63.0; 2] };
        assert_eq!(parse("shore:63"), Ok(What::Piece(shore)));
        assert_eq!(parse("level:2"), Ok(What::Level(2)));
        assert_eq!(parse("unknown"), Ok(What::Piece(Piece::UNKNOWN)));
        for text in [
            "flat",
            "flat:",
            "flat:0",
            "ball:nan",
            "shore:101",
            "level:x",
            "egg:3",
        ] {
            assert!(parse(text).is_err(), "{text}");
        }
    }
}
