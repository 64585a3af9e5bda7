//! The command line of the trainer.

use std::path::PathBuf;

use clap::builder::RangedU64ValueParser;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use clap::{Parser, Subcommand, ValueEnum};
use hardnessd_core::wording::named;
use hardnessd_simulator::{
    DatasetSettings, LawName, Materials, SensorDesigns, SensorProfile, Shapes, Split,
};
use hrn_train::data::dataset::LabelChoice;
use hrn_train::methods::Method;
use hrn_train::settings::Profile;

/// Trains and evaluates the hardness recognition network.
#[derive(Debug, Parser)]
#[command(name = "hrn-train", version, after_long_help = EXIT_CODES)]
pub(super) struct Arguments {
    #[command(subcommand)]
    pub(super) command: Command,
}

const EXIT_CODES: &str = "Exit codes: 0 done; 1 failed or bad data; 2 wrong usage; 66 a file named \
    here is missing or unreadable; 69 no CUDA device; 74 I/O error; 78 bad settings, model or \
    configuration; 130 and 143 after SIGINT and SIGTERM.";

/// What `collect --help` says below the options.
const COLLECTED: &str = "\
    Of a directory it takes all recordings below it, sorted by path. The first bytes of a file, \
    not its name, decide what it is. Presses of a data set keep their level, object and split; \
    only objects that `collect` itself numbered get new numbers. With --skip-unusable, the most \
    frequent combination of pitch, material and shore decides, or the data set of --append.";

/// What `compare --help` says below the options.
const COMPARED: &str = "\
    The tables contain all finished runs of DIR with the same data and profile. `settings.toml`, \
    `revision`, `metrics.csv` and `compared.json` of a run are enough to keep. The controls of \
    --course are logistic regressions: on features of the best frame, on modulus and radius by \
    Hertz's law, and on features of the whole press without and with the arm's motion.";

/// What `check-model --help` says below the options.
const CHECKED: &str = "\
    Each line begins with ok; adopt: wrong or absent, and `adopt` corrects it; missing: wrong or \
    absent, and you must change the file; or unseen: another part is wrong, so this cannot be \
    checked. It also tries the memory and time of a verdict for a sensor of 5 frames/s. Exit \
    code 78: a line is not ok.";

#[derive(Debug, Subcommand)]
pub(super) enum Command {
    /// Simulate a labelled data set (default: the paper's 10,000 + 1,000 samples)
    Simulate(Simulate),
    /// Make a data set from recordings of known objects, with the daemon's own decoding and press selection
    Collect(Collect),
    /// Train one method
    Train(Train),
    /// Train every method under several seeds and make the paper's tables; run it again to continue
    Compare(Compare),
    /// Run an exported model on a data set
    Evaluate(Evaluate),
    /// Write one page that shows a run or a comparison
    Report {
        /// Directory of the run or the comparison
        directory: PathBuf,
        /// New file for the page
        #[arg(long, value_name = "R.html")]
        out: PathBuf,
    },
    /// Write the model of a finished run to a file of its own
    Export {
        /// Directory of the run
        run: PathBuf,
        /// New file for the model
        #[arg(long, value_name = "M.onnx")]
        out: PathBuf,
    },
    /// Check an ONNX file that was made elsewhere against the model format, line by line
    #[command(after_help = CHECKED)]
    CheckModel {
        /// The model file
        model: PathBuf,
    },
    /// Turn an ONNX file that was made elsewhere into a model that the daemon loads
    Adopt(Adopt),
    /// Check a model file as the daemon does and print its card
    Inspect {
        /// The model file
        model: PathBuf,
    },
}

/// The most objects of a material and presses of an object: more than fit in any memory, but few
/// enough that all presses can be counted.
const MOST: i64 = DatasetSettings::MOST as i64;

#[derive(Debug, clap::Args)]
pub(super) struct Simulate {
    /// New file for the data set
    #[arg(long, value_name = "D.npz")]
    pub(super) out: PathBuf,
    /// Seed of everything random
    #[arg(long, default_value_t = DatasetSettings::default().seed, value_parser = seed())]
    pub(super) seed: u64,
    /// Materials: named (the paper's eight) or broad (each object has a random one)
    #[arg(long, default_value = "named", value_parser = named::<Materials>)]
    pub(super) materials: Materials,
    /// Laws that broad materials are drawn from: solid, plastic, foam, layered [default: all]
    #[arg(long, hide_short_help = true, value_name = "LAW", value_delimiter = ',', num_args = 1.., value_parser = named::<LawName>)]
    pub(super) laws: Vec<LawName>,
    /// Leave the gaps between the levels that the paper's table has: no broad material has a Shore
    /// hardness of 50 to 51, 60 to 61 or 70 to 71
    #[arg(long, hide_short_help = true)]
    pub(super) gaps: bool,
    /// Objects of each training material; with broad materials, four times as many in all
    #[arg(long, default_value_t = DatasetSettings::default().objects,
          value_parser = clap::value_parser!(u32).range(0..=MOST))]
    pub(super) objects: u32,
    /// The same of each test material
    #[arg(long, default_value_t = DatasetSettings::default().test_objects,
          value_parser = clap::value_parser!(u32).range(0..=MOST))]
    pub(super) test_objects: u32,
    /// Presses of each object [default: 50, with --sequences 6]
    ///
    /// The first 48 are six postures under eight forces each; a smaller number takes some of these.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=MOST))]
    pub(super) presses: Option<u32>,
    /// Least nominal force in newtons; the greatest is 25
    #[arg(long, hide_short_help = true, value_name = "N", default_value_t = DatasetSettings::default().lowest_force_n,
          value_parser = lowest_force_n)]
    pub(super) lowest_force: f32,
    /// Distribution of shapes: matched (the same for all materials), wide (as matched, but radii from
    /// 8 to 60 mm, edges and points) or paper (rigid objects flat, soft ones round)
    #[arg(long, default_value = "matched", value_parser = named::<Shapes>)]
    pub(super) shapes: Shapes,
    /// Spread of the sensor's taxels: clean or raw
    #[arg(long, default_value = "clean", value_parser = named::<SensorProfile>)]
    pub(super) sensor_profile: SensorProfile,
    /// Press all objects on the same sensor, which is drawn with this seed
    #[arg(long, hide_short_help = true, value_name = "SEED", value_parser = seed())]
    pub(super) one_sensor: Option<u64>,
    /// Young's modulus of the sensor's cover in MPa, 0.05 to 100
    #[arg(long, hide_short_help = true, value_name = "MPA", default_value_t = DatasetSettings::default().cover_young_mpa,
          value_parser = cover_mpa)]
    pub(super) cover: f64,
    /// Calibrate each sensor with weights, so that the mean sum of its taxels is the force of the press
    #[arg(long, hide_short_help = true)]
    pub(super) calibrated: bool,
    /// Levels whose two materials change roles, such as 24
    #[arg(long, hide_short_help = true, value_name = "LEVELS", value_parser = swapped_levels)]
    pub(super) swapped_levels: Option<[bool; 4]>,
    /// Put all eight named materials into the test split
    #[arg(long, hide_short_help = true, conflicts_with = "swapped_levels")]
    pub(super) all_test: bool,
    /// Also draw samples of every material and a press of every level, to this new file
    #[arg(long, value_name = "S.png")]
    pub(super) sheet: Option<PathBuf>,
    /// Whole presses over time, with the arm's positions, in place of one frame a press
    #[arg(long)]
    pub(super) sequences: bool,
    /// Threads that simulate [default: as many as cores]
    #[arg(long, hide_short_help = true, value_name = "N", value_parser = RangedU64ValueParser::<usize>::new().range(1..=1024))]
    pub(super) jobs: Option<usize>,
    #[command(flatten)]
    pub(super) courses: Courses,
}

/// Sensors of `simulate --sequences` other than the usual ones.
fn sensors() -> impl TypedValueParser<Value = SensorDesigns> {
    PossibleValuesParser::new(["broad", "jx255n"]).try_map(|name| named(&name))
}

/// Options of `--sequences`. Each press draws its own value between two numbers, or takes the one number.
#[derive(Debug, clap::Args)]
#[group(requires = "sequences")]
pub(super) struct Courses {
    /// With --sequences, drawn for each press: frames a second, 1 to 200 [default: 5..100]
    #[arg(long, hide_short_help = true, value_name = "LOW..HIGH", value_parser = range::<1, 200>)]
    pub(super) fps: Option<[f64; 2]>,
    /// Speed of the arm in mm/s, 1 to 100 [default: 2..20]
    #[arg(long, hide_short_help = true, value_name = "LOW..HIGH", value_parser = range::<1, 100>)]
    pub(super) speed: Option<[f64; 2]>,
    /// Stiffness of the arm in N/mm, 1 to 1000 [default: 3..30]
    #[arg(long, hide_short_help = true, value_name = "LOW..HIGH", value_parser = range::<1, 1000>)]
    pub(super) arm: Option<[f64; 2]>,
    /// Seconds that the arm holds its position, 0 to 10, and three frames at least [default: 0.2..1.5]
    #[arg(long, hide_short_help = true, value_name = "LOW..HIGH", value_parser = range::<0, 10>)]
    pub(super) hold: Option<[f64; 2]>,
    /// Reported positions are off by up to this share, 0 to 0.5, constant within a press [default: 0]
    #[arg(long, hide_short_help = true, value_name = "SHARE", value_parser = part::<50>)]
    pub(super) position_error: Option<f64>,
    /// The reported stiffness of the arm is off by up to this share, 0 to 0.9 [default: 0; 0.15 with
    /// --sensors]
    #[arg(long, hide_short_help = true, value_name = "SHARE", value_parser = part::<90>)]
    pub(super) arm_error: Option<f64>,
    /// Times of positions are off by up to this many frames, 0 to 5, constant within a press [default: 0]
    #[arg(long, hide_short_help = true, value_name = "FRAMES", value_parser = part::<500>)]
    pub(super) clock_error: Option<f64>,
    /// Share of the presses in which the arm reports nothing, 0 to 1 [default: 0]
    #[arg(long, hide_short_help = true, value_name = "SHARE", value_parser = part::<100>)]
    pub(super) unknown: Option<f64>,
    /// Sensors: broad (each has a design of its own) or jx255n (many of the JX255N), with presses of rigid pieces
    /// too [default: eight of one design in each split]
    #[arg(long, value_parser = sensors(), hide_possible_values = true,
          conflicts_with_all = ["sensor_profile", "one_sensor", "cover", "calibrated"])]
    pub(super) sensors: Option<SensorDesigns>,
    /// With --sensors: covers that training objects are pressed on, at most one for each object of a material
    /// [default: 200]
    #[arg(long, hide_short_help = true, value_name = "N", requires = "sensors",
          value_parser = clap::value_parser!(u32).range(1..=MOST))]
    pub(super) covers: Option<u32>,
    /// The same for test objects [default: 20]
    #[arg(long, hide_short_help = true, value_name = "N", requires = "sensors",
          value_parser = clap::value_parser!(u32).range(1..=MOST))]
    pub(super) test_covers: Option<u32>,
    /// Sensors under each of these covers. All of them read each press on it [default: 8]
    #[arg(long, hide_short_help = true, value_name = "N", requires = "sensors",
          value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub(super) electronics: Option<u32>,
    /// Write this many files in place of one, each with other covers: D-0.npz, D-1.npz, ... [default: 1]
    #[arg(long, hide_short_help = true, value_name = "N", requires = "sensors",
          value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub(super) shards: Option<u32>,
}

#[derive(Debug, clap::Args)]
#[command(after_long_help = COLLECTED)]
pub(super) struct Collect {
    /// Data set to write; a file that exists is left alone without --append
    #[arg(long, value_name = "D.npz")]
    pub(super) out: PathBuf,
    /// Hardness level, 1 (hard) to 4, or 0: unlabelled [default: the recording's label "level"]
    #[arg(long, value_name = "L", value_parser = clap::value_parser!(u8).range(0..=4))]
    pub(super) level: Option<u8>,
    /// Number of the object that was pressed. All its presses must be in one split of one data set
    /// [default: the recording's label "object", else a new number]
    #[arg(long, value_name = "K")]
    pub(super) object: Option<u32>,
    /// For training or for test
    #[arg(long, default_value = "train", value_parser = split())]
    pub(super) split: Split,
    /// Collect whole presses over time, not single frames; with the arm's approach where the recording
    /// has it
    #[arg(long)]
    pub(super) sequences: bool,
    /// Add to the data set, if it is there
    #[arg(long)]
    pub(super) append: bool,
    /// Configuration whose first sensor describes raw bytes [default: a JX255N with default settings]
    #[arg(long, value_name = "F")]
    pub(super) config: Option<PathBuf>,
    /// Leave out recordings that cannot be used. D.npz.left-out.tsv names each with the reason
    #[arg(long)]
    pub(super) skip_unusable: bool,
    /// Recordings of `record`, directories with recordings, raw bytes back to back, or data sets of
    /// `collect` to put together
    ///
    /// If all have a label "material" or "shore", the data set has that array; all or none must have it.
    #[arg(value_name = "CAPTURE", required = true)]
    pub(super) captures: Vec<PathBuf>,
}

/// A value of `train --method`.
#[derive(Debug, Clone, Copy)]
pub(super) enum Trained {
    Frames(Method),
    Courses,
}

/// The name of [`Trained::Courses`].
const COURSE: &str = "course";

fn trained() -> impl TypedValueParser<Value = Trained> {
    let of_courses = PossibleValue::new(COURSE).help(
        "Judges the course of a press, with the arm's motion and references of the sensor, and gives its Shore \
         hardness. Takes data of `simulate --sequences`",
    );
    let methods = Method::all().iter();
    let of_frames = methods.filter_map(ValueEnum::to_possible_value);
    PossibleValuesParser::new(of_frames.chain([of_courses])).map(|name| {
        let method = Method::all().iter().find(|method| method.name() == name);
        method.map_or(Trained::Courses, |&method| Trained::Frames(method))
    })
}

#[derive(Debug, clap::Args)]
pub(super) struct Train {
    /// What to train
    #[arg(long, value_parser = trained())]
    pub(super) method: Trained,
    /// Data to learn from; several files may be named. All presses of an object must be in one file
    #[arg(long, value_name = "D.npz", required = true, num_args = 1..)]
    pub(super) data: Vec<PathBuf>,
    /// Directory of the run
    #[arg(long, value_name = "RUN")]
    pub(super) out: PathBuf,
    /// Seed of everything random
    #[arg(long, default_value_t = 1, value_parser = seed())]
    pub(super) seed: u64,
    /// Length of the training
    #[arg(long, default_value = "paper")]
    pub(super) profile: Profile,
    /// Settings that override the profile's; config/hrn-train.toml has every key
    #[arg(long, value_name = "F.toml")]
    pub(super) config: Option<PathBuf>,
    /// Continue a run that was stopped
    #[arg(long)]
    pub(super) resume: bool,
    /// Reuse finished stages of another run where they are identical; may be repeated
    #[arg(long, hide_short_help = true, value_name = "RUN")]
    pub(super) from: Vec<PathBuf>,
    /// Number of labels to use [default: the method's share]
    #[arg(long, value_name = "N")]
    pub(super) labels: Option<usize>,
    /// Which samples get their labels
    #[arg(long, hide_short_help = true, default_value = "object")]
    pub(super) label_choice: LabelChoice,
    /// Where to compute
    #[arg(long, default_value = "cpu")]
    pub(super) device: DeviceName,
    /// End when this process ends, the one that started this one
    #[arg(long, hide = true, value_name = "PID")]
    pub(super) parent: Option<i32>,
}

#[derive(Debug, clap::Args)]
#[command(after_long_help = COMPARED)]
pub(super) struct Compare {
    /// The data set to learn from
    ///
    /// With --course, several may be named.
    #[arg(long, value_name = "D.npz", num_args = 1.., required = true)]
    pub(super) data: Vec<PathBuf>,
    /// Directory of the comparison
    #[arg(long, value_name = "DIR")]
    pub(super) out: PathBuf,
    /// Methods to run: those of `train` but course [default: all]
    #[arg(long, value_name = "M", value_delimiter = ',', num_args = 1.., hide_possible_values = true)]
    pub(super) methods: Vec<Method>,
    /// Also run every method with each of these numbers of labels, for a curve of accuracy against labels
    #[arg(long, hide_short_help = true, value_name = "N", value_delimiter = ',', num_args = 1..)]
    pub(super) labels: Vec<usize>,
    /// Train with the seeds 1 to N
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=MOST as u64))]
    pub(super) seeds: u64,
    /// Length of each training run
    #[arg(long, default_value = "paper")]
    pub(super) profile: Profile,
    /// Run nothing: print a command line for each run that is not finished, to spread over machines
    #[arg(long)]
    pub(super) plan: bool,
    /// Runs at a time, each on one thread [default: as many as there are cores]
    #[arg(long, value_name = "J")]
    pub(super) jobs: Option<std::num::NonZeroUsize>,
    /// Also swap the two materials of each level: 16 times features, hrn15-strong and hrn15-tuned, 4 times
    /// ours
    #[arg(long, hide_short_help = true)]
    pub(super) swaps: bool,
    /// Compare models of whole presses instead, with simpler controls that are fitted on --data. All data must
    /// have whole presses (`simulate --sequences`)
    #[arg(long, hide_short_help = true, requires = "test", requires = "model",
        conflicts_with_all = ["methods", "labels", "seeds", "profile", "plan", "jobs", "swaps"])]
    pub(super) course: bool,
    /// Test presses; may be given several times
    #[arg(long, hide_short_help = true, value_name = "T.npz", num_args = 1.., requires = "course")]
    pub(super) test: Vec<PathBuf>,
    /// Model files, of either format. The others are compared with the first
    #[arg(long, hide_short_help = true, value_name = "M.onnx", num_args = 1.., requires = "course")]
    pub(super) model: Vec<PathBuf>,
}

/// Parses a force in newtons, from the least of `hardnessd simulate --force` to the greatest
/// nominal force.
fn lowest_force_n(text: &str) -> Result<f32, String> {
    match text.parse() {
        Ok(force_n) if DatasetSettings::LOWEST_FORCES_N.contains(&force_n) => Ok(force_n),
        _ => Err("expected newtons from 0.01 to 25".to_owned()),
    }
}

/// A seed. TOML, which keeps it, has no larger numbers.
fn seed() -> RangedU64ValueParser {
    clap::value_parser!(u64).range(..=i64::MAX as u64)
}

/// Parses a Young's modulus in MPa, from that of a gel to that of a hard plastic.
fn cover_mpa(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(mpa) if DatasetSettings::COVERS_MPA.contains(&mpa) => Ok(mpa),
        _ => Err("expected MPa from 0.05 to 100".to_owned()),
    }
}

/// Parses `LOW..HIGH`, or one number for both, within bounds.
fn range<const LEAST: u32, const MOST: u32>(text: &str) -> Result<[f64; 2], String> {
    let (low, high) = text.split_once("..").unwrap_or((text, text));
    let bounds = f64::from(LEAST)..=f64::from(MOST);
    match (low.parse::<f64>(), high.parse::<f64>()) {
        (Ok(low), Ok(high)) if bounds.contains(&low) && bounds.contains(&high) && low <= high => {
            Ok([low, high])
        }
        _ => Err(format!(
            "expected a number or LOW..HIGH, from {LEAST} to {MOST}"
        )),
    }
}

/// Parses a number from 0 to `HUNDREDTHS` / 100.
fn part<const HUNDREDTHS: u32>(text: &str) -> Result<f64, String> {
    let most = f64::from(HUNDREDTHS) / 100.0;
    match text.parse() {
        Ok(part) if (0.0..=most).contains(&part) => Ok(part),
        _ => Err(format!("expected a number from 0 to {most}")),
    }
}

/// Parses the digits of levels, in any order.
fn swapped_levels(text: &str) -> Result<[bool; 4], String> {
    let mut swapped = [false; 4];
    for digit in text.chars() {
        let place = digit.to_digit(10).and_then(|level| level.checked_sub(1));
        match place.and_then(|place| swapped.get_mut(place as usize)) {
            Some(level) => *level = true,
            None => return Err("expected levels from 1 to 4, such as 24".to_owned()),
        }
    }
    Ok(swapped)
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub(super) enum DeviceName {
    Cpu,
    /// The first CUDA device; needs a build with `--features cuda`
    Cuda,
}

#[derive(Debug, clap::Args)]
pub(super) struct Evaluate {
    /// The model file
    #[arg(long, value_name = "M.onnx")]
    pub(super) model: PathBuf,
    /// The data set. Of whole presses, a model of single frames judges the frame of maximal contact area
    #[arg(long, value_name = "D.npz")]
    pub(super) data: PathBuf,
    /// Split to evaluate
    #[arg(long, default_value = "test", value_parser = split())]
    pub(super) split: Split,
    /// Give the model this many presses of each rigid piece as references of each sensor
    #[arg(long, hide_short_help = true, value_name = "N", default_value_t = 0)]
    pub(super) rigid: usize,
    /// Give the model a press of this many objects of each level as references of each sensor; the
    /// objects are not judged
    #[arg(long, hide_short_help = true, value_name = "N", default_value_t = 0)]
    pub(super) labelled: usize,
    /// Also write every verdict to this new file, as a line of CSV
    ///
    /// The columns are object, level, the verdict's level, probabilities and Shore hardness with its interval, true
    /// Shore hardness.
    #[arg(long, value_name = "V.csv")]
    pub(super) verdicts: Option<PathBuf>,
    /// Also write the input `features` of every press of the data to this new file, as CSV
    #[arg(long, hide_short_help = true, value_name = "F.csv")]
    pub(super) features: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    pub(super) json: bool,
}

#[derive(Debug, clap::Args)]
pub(super) struct Adopt {
    /// The ONNX file
    pub(super) model: PathBuf,
    /// The data set that it learnt from
    #[arg(long, value_name = "D.npz")]
    pub(super) data: PathBuf,
    /// New file for the model
    #[arg(long, value_name = "H.onnx")]
    pub(super) out: PathBuf,
    /// How it was made, in a few words [default: adopted from MODEL]
    #[arg(long, value_name = "TEXT")]
    pub(super) method: Option<String>,
    /// What it was tried on, in a few words [default: by the origin of the data]
    #[arg(long, value_name = "TEXT")]
    pub(super) validation: Option<String>,
}

fn split() -> impl TypedValueParser<Value = Split> {
    let splits = [Split::Train, Split::Test];
    PossibleValuesParser::new(splits.map(Split::name)).map(move |name| {
        let found = splits.into_iter().find(|split| split.name() == name);
        found.expect("clap lets only these names pass")
    })
}

#[cfg(test)]
#[path = "../../../../../tests/pages/commands.rs"]
mod pages;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_command_of_the_trainer_in_the_pages_is_a_valid_one() {
        let calls = pages::calls_of("hrn-train");
        assert!(calls.len() > 25, "found {} commands", calls.len());
        let wrong = pages::wrong_calls::<Arguments>(&calls);
        assert!(wrong.is_empty(), "{wrong:#?}");
    }

    #[test]
    fn every_option_of_the_trainer_in_a_sentence_exists() {
        let names = pages::names_of("hrn-train");
        assert!(names.len() > 15, "found {} commands", names.len());
        let wrong = pages::unknown_names::<Arguments>(&names);
        assert!(wrong.is_empty(), "{wrong:#?}");
    }
}
