//! The command line of the trainer.

use std::path::PathBuf;

use clap::builder::RangedU64ValueParser;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use clap::{Parser, Subcommand, ValueEnum};
use hardnessd_core::wording::named;
use hardnessd_simulator::{
    DatasetSettings, Materials, SensorDesigns, SensorProfile, Shapes, Split,
};
use hrn_train::recipe::{self, Recipe};
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
    It calls `train` once for each method, number of labels and seed, and leaves out the runs that \
    have their model. `ours`, `nahrn` and `nihrn` share a stage, so they are one line of --plan. \
    Models that take references get two presses of each rigid piece.";

/// What `fit --help` says below the options.
const FITTED: &str = "\
    It compares the built-in model with these presses as references, regressions on features and on taxels, and from \
    1,500 presses on the paper's network, each on objects that it has not met. Where nothing is better than the \
    built-in model by more than chance, it writes references for it, in the place of M.onnx with the ending .npz. The \
    levels are those of the label `level`, a number or a name, or of the label `shore`. Exit code 1: nothing is better \
    than guessing.";

/// What `check-model --help` says below the options.
const CHECKED: &str = "\
    It prints what the daemon would refuse, with the memory and time of a verdict for a sensor of --fps. Exit code \
    78: it would refuse the file.";

#[derive(Debug, Subcommand)]
pub(super) enum Command {
    /// Simulate a labelled data set (default: the paper's 10,000 + 1,000 samples)
    Simulate(Simulate),
    /// Make a data set from recordings of known objects, with the daemon's own decoding and press selection
    Collect(Collect),
    /// Make the best model for your robot from recordings of known objects
    #[command(after_help = FITTED)]
    Fit(Fit),
    /// Train one method
    Train(Train),
    /// Train methods under several seeds and make the paper's tables; run it again to continue
    Compare(Compare),
    /// Run an exported model on a data set
    Evaluate(Evaluate),
    /// Write the model of a finished run to a file of its own
    Export {
        /// Directory of the run
        run: PathBuf,
        /// New file for the model
        #[arg(long, value_name = "M.onnx")]
        out: PathBuf,
    },
    /// Check an ONNX file that was made elsewhere against the model format
    #[command(after_help = CHECKED)]
    CheckModel {
        /// The model file
        model: PathBuf,
        /// Frames/s of the fastest sensor that it shall judge for
        #[arg(long, value_name = "FPS", default_value_t = 5.0, value_parser = frame_rate)]
        fps: f64,
    },
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
    /// 8 to 60 mm, edges and points), flat (plates, bars, boxes and discs) or paper (rigid objects flat,
    /// soft ones round). With --sequences, a third of the matched and wide objects is flat
    #[arg(long, default_value = "matched", value_parser = named::<Shapes>)]
    pub(super) shapes: Shapes,
    /// Spread of the sensor's taxels: clean or raw
    #[arg(long, default_value = "clean", value_parser = named::<SensorProfile>)]
    pub(super) sensor_profile: SensorProfile,
    /// Put all eight named materials into the test split
    #[arg(long, hide_short_help = true)]
    pub(super) all_test: bool,
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

/// Options of `--sequences`.
#[derive(Debug, clap::Args)]
#[group(requires = "sequences")]
pub(super) struct Courses {
    /// With --sequences, drawn for each press: frames a second, 1 to 200 [default: 5..100]
    #[arg(long, hide_short_help = true, value_name = "LOW..HIGH", value_parser = rates)]
    pub(super) fps: Option<[f64; 2]>,
    /// Sensors: broad (each has a design of its own) or jx255n (many of the JX255N), with presses of rigid pieces
    /// too [default: eight of one design in each split]
    #[arg(long, value_parser = sensors(), hide_possible_values = true,
          conflicts_with = "sensor_profile")]
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
}

#[derive(Debug, clap::Args)]
pub(super) struct Fit {
    /// Recordings of `record`, directories with recordings, or data sets
    #[arg(value_name = "DATA", required = true)]
    pub(super) data: Vec<PathBuf>,
    /// New file for the model
    #[arg(long, value_name = "M.onnx")]
    pub(super) out: PathBuf,
    /// Configuration whose `[[level]]` tables name the levels, and whose first sensor describes raw bytes
    #[arg(long, value_name = "F")]
    pub(super) config: Option<PathBuf>,
    /// Print the table as JSON
    #[arg(long)]
    pub(super) json: bool,
}

#[derive(Debug, clap::Args)]
#[command(after_long_help = COLLECTED)]
pub(super) struct Collect {
    /// Data set to write; a file that exists is left alone without --append
    #[arg(long, value_name = "D.npz")]
    pub(super) out: PathBuf,
    /// Hardness level, 1 (hard) to 16, or 0: unlabelled [default: the recording's label "level"]
    #[arg(long, value_name = "L", value_parser = clap::value_parser!(u8).range(0..=16))]
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

fn method() -> impl TypedValueParser<Value = &'static Recipe> {
    let value = |recipe: &'static Recipe| PossibleValue::new(&*recipe.name).help(&*recipe.about);
    PossibleValuesParser::new(recipe::all().iter().map(value))
        .map(|name| recipe::named(&name).expect("clap lets only these names pass"))
}

#[derive(Debug, clap::Args)]
pub(super) struct Train {
    /// What to train
    #[arg(long, value_parser = method())]
    pub(super) method: &'static Recipe,
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
    /// Settings that override the method's; config/hrn-train.toml has every key
    #[arg(long, value_name = "F.toml")]
    pub(super) config: Option<PathBuf>,
    /// Continue a run that was stopped
    #[arg(long)]
    pub(super) resume: bool,
    /// Reuse finished stages of another run where they are identical; may be repeated
    #[arg(long, hide_short_help = true, value_name = "RUN")]
    pub(super) from: Vec<PathBuf>,
    /// Number of labels to use, of whole objects [default: the method's share]
    #[arg(long, value_name = "N")]
    pub(super) labels: Option<usize>,
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
    /// Data to learn from; several files may be named [default: none, only make the tables of DIR again]
    #[arg(long, value_name = "D.npz", num_args = 1..)]
    pub(super) data: Vec<PathBuf>,
    /// Directory of the comparison
    #[arg(long, value_name = "DIR")]
    pub(super) out: PathBuf,
    /// Methods to run [default: all but hrn; course only on whole presses]
    #[arg(long, value_name = "M", value_delimiter = ',', num_args = 1.., hide_possible_values = true, value_parser = method())]
    pub(super) methods: Vec<&'static Recipe>,
    /// Also run every method with each of these numbers of labels
    #[arg(long, value_name = "N", value_delimiter = ',', num_args = 1..)]
    pub(super) labels: Vec<usize>,
    /// Train with the seeds 1 to N
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=MOST as u64))]
    pub(super) seeds: u64,
    /// Length of each training run
    #[arg(long, default_value = "paper")]
    pub(super) profile: Profile,
    /// Run nothing: print a command line for each run that is not done, for GNU parallel, Slurm or Ray
    #[arg(long, requires = "data")]
    pub(super) plan: bool,
    /// Runs at a time, each on one thread [default: as many as there are cores]
    #[arg(long, value_name = "J")]
    pub(super) jobs: Option<std::num::NonZeroUsize>,
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

/// Parses frames a second.
fn rates(text: &str) -> Result<[f64; 2], String> {
    let (low, high) = text.split_once("..").unwrap_or((text, text));
    let bounds = 1.0..=200.0;
    match (low.parse::<f64>(), high.parse::<f64>()) {
        (Ok(low), Ok(high)) if bounds.contains(&low) && bounds.contains(&high) && low <= high => {
            Ok([low, high])
        }
        _ => Err("expected a number or LOW..HIGH, from 1 to 200".to_owned()),
    }
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub(super) enum DeviceName {
    Cpu,
    /// The first CUDA device; needs a build with `--features cuda`
    Cuda,
}

#[derive(Debug, clap::Args)]
pub(super) struct Evaluate {
    /// The model file. Given twice, the two are compared press by press
    #[arg(long, value_name = "M.onnx", required = true)]
    pub(super) model: Vec<PathBuf>,
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
    /// Give the model up to this many presses of other objects on the same sensor, of which it knows nothing
    #[arg(long, hide_short_help = true, value_name = "N", default_value_t = 0)]
    pub(super) own: usize,
    /// Also write every verdict to this new file, as a line of CSV
    ///
    /// The columns are object, level, the verdict's level, probabilities and Shore hardness with its interval, true
    /// Shore hardness.
    #[arg(long, value_name = "V.csv")]
    pub(super) verdicts: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    pub(super) json: bool,
}

fn frame_rate(text: &str) -> Result<f64, String> {
    let found = text.parse().ok();
    found
        .filter(|hz| (0.01..=10_000.0).contains(hz))
        .ok_or_else(|| "expected frames/s, 0.01 to 10000".to_owned())
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
