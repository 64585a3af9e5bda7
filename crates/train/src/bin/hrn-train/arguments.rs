//! The command line of the trainer.

use std::path::PathBuf;

use clap::{Parser, Subcommand};
use hardnessd_core::wording::{named, within};
use hardnessd_simulator::{
    DatasetSettings, Materials, SensorDesigns, SensorProfile, Shapes, Split,
};
use hrn_train::compare::Plan;
use hrn_train::model::verdicts::Given;
use hrn_train::train::Train;

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
    not its name, decide what it is. All recordings without a number of the object are one new object.";

/// What `fit --help` says below the options.
const FITTED: &str = "\
    It compares the built-in model with these presses as references, regressions on features and on taxels, and from \
    1,500 presses on the paper's network, each on objects that it has not met. Where nothing is better than the \
    built-in model by more than chance, it writes references for it, in the place of M.onnx with the ending .npz. The \
    levels are those of the label `level`, a number or a name, or of the label `shore`. Exit code 1: nothing is better \
    than guessing, and the daemon would not use these references.";

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
    Compare(Plan),
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
        #[arg(long, value_name = "FPS", default_value_t = 5.0, value_parser = within(0.01, 10_000.0))]
        fps: f64,
    },
    /// Check a model file as the daemon does and print its card
    Inspect {
        /// The model file
        model: PathBuf,
    },
}

#[derive(Debug, clap::Args)]
pub(super) struct Simulate {
    /// New file for the data set
    #[arg(long, value_name = "D.npz")]
    pub(super) out: PathBuf,
    /// Seed of everything random
    // TOML, in which a run keeps it, has no larger numbers.
    #[arg(long, default_value_t = DatasetSettings::default().seed,
          value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    pub(super) seed: u64,
    /// Materials: named (the paper's eight) or broad (each object has a random one)
    #[arg(long, default_value = "named", value_parser = named::<Materials>)]
    pub(super) materials: Materials,
    /// Objects of each training material; with broad materials, four times as many in all
    #[arg(long, default_value_t = DatasetSettings::default().objects)]
    pub(super) objects: u32,
    /// The same of each test material
    #[arg(long, default_value_t = DatasetSettings::default().test_objects)]
    pub(super) test_objects: u32,
    /// Presses of each object [default: 50, with --sequences 6]
    ///
    /// The first 48 are six postures under eight forces each; a smaller number takes some of these.
    #[arg(long)]
    pub(super) presses: Option<u32>,
    /// Least nominal force in newtons; the greatest is 25
    #[arg(long, hide_short_help = true, value_name = "N", default_value_t = DatasetSettings::default().lowest_force_n)]
    pub(super) lowest_force: f32,
    /// Distribution of shapes: matched (the same for all materials), wide (as matched, but radii from
    /// 8 to 60 mm, edges and points), flat (plates, bars, boxes and discs) or paper (rigid objects flat,
    /// soft ones round). With --sequences, a third of the matched and wide objects is flat
    #[arg(long, default_value = "matched", value_parser = named::<Shapes>)]
    pub(super) shapes: Shapes,
    /// Spread of the sensor's taxels: clean or raw
    #[arg(long, default_value = "clean", value_parser = named::<SensorProfile>)]
    pub(super) sensor_profile: SensorProfile,
    /// Whole presses over time, with the arm's positions, in place of one frame a press
    #[arg(long)]
    pub(super) sequences: bool,
    /// With --sequences: sensors that are broad (each has a design of its own) or jx255n (many of the JX255N),
    /// with presses of rigid pieces too [default: eight of one design in each split]
    #[arg(long, requires = "sequences", value_parser = named::<SensorDesigns>)]
    pub(super) sensors: Option<SensorDesigns>,
    /// Settings that override those of the options; results/simulator.md has the keys
    #[arg(long, value_name = "F.toml")]
    pub(super) config: Option<PathBuf>,
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
    /// What the presses are for: train or test
    #[arg(long, default_value = "train", value_parser = named::<Split>)]
    pub(super) split: Split,
    /// Collect whole presses over time, not single frames; with the arm's approach where the recording
    /// has it
    #[arg(long)]
    pub(super) sequences: bool,
    /// Add to the data set, if it is there
    #[arg(long)]
    pub(super) append: bool,
    /// Configuration whose `[[level]]` tables name the levels, and whose first sensor describes raw bytes
    /// [default: a JX255N with default settings]
    #[arg(long, value_name = "F")]
    pub(super) config: Option<PathBuf>,
    /// Leave out recordings that cannot be used, and say why of each
    #[arg(long)]
    pub(super) skip_unusable: bool,
    /// Recordings of `record`, directories with recordings, or raw bytes back to back
    #[arg(value_name = "CAPTURE", required = true)]
    pub(super) captures: Vec<PathBuf>,
}

#[derive(Debug, clap::Args)]
pub(super) struct Evaluate {
    /// The model file. Given twice, the two are compared press by press
    #[arg(long, value_name = "M.onnx", required = true)]
    pub(super) model: Vec<PathBuf>,
    /// The data set. Of whole presses, a model of single frames judges the frame of maximal contact area
    #[arg(long, value_name = "D.npz")]
    pub(super) data: PathBuf,
    /// Split to evaluate: train or test
    #[arg(long, default_value = "test", value_parser = named::<Split>)]
    pub(super) split: Split,
    #[command(flatten)]
    pub(super) given: Given,
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

#[cfg(test)]
#[path = "../../../../../tests/pages/commands.rs"]
mod pages;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_command_and_option_of_the_trainer_in_the_pages_exists() {
        pages::assert_known::<Arguments>("hrn-train", 40);
    }
}
