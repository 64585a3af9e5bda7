//! The trainer: one subcommand a stage, from simulated presses to the file the daemon loads.

mod account;
mod arguments;
mod signals;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

use anyhow::Context as _;
use burn::tensor::Device;
use clap::Parser as _;
use hardnessd::daemon::config::{Config, Error as ConfigError, SensorTable, Setup};
use hardnessd::frame::RawFrame;
use hardnessd::simulator::{
    Borders, CourseSettings, DatasetSettings, Laws, Material, Materials, Sequence, SequenceSettings,
};
use hardnessd::tools::{self, exit};
use hardnessd::train::compare::courses::{CoursePlan, compare_courses};
use hardnessd::train::compare::report;
use hardnessd::train::compare::results::Comparison;
use hardnessd::train::compare::{self, Plan, tables};
use hardnessd::train::data::collect::{self, Capture, CollectError, Labelling};
use hardnessd::train::data::courses::Courses;
use hardnessd::train::data::dataset::{Dataset, DatasetError, LabelChoice};
use hardnessd::train::data::simulated;
use hardnessd::train::judge::metrics::Evaluation;
use hardnessd::train::judge::sheet;
use hardnessd::train::methods::frame::NoStart;
use hardnessd::train::methods::{self, LabelsError, Method, Request};
use hardnessd::train::model::adopt::{self, Foreign, Told};
use hardnessd::train::model::course::{self, CourseEvaluation};
use hardnessd::train::model::{export, review};
use hardnessd::train::run::Run;
use hardnessd::train::run::disk::write_whole;
use hardnessd::train::settings::{Profile, Settings, SettingsError, Told as Robot};
use hardnessd::trial;
use hardnessd::verdict::{BUILT_IN, Hrn, ModelError};

use self::arguments::{
    Adapt, Adopt, Arguments, Collect, Command, Compare, DeviceName, Evaluate, Simulate, Train,
};

/// A training step frees and asks for the same large buffers over and over. The system's allocator
/// gives them back to the kernel each time, which took 40 % of a step.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    if let Some(code) = trial::entry() {
        return code;
    }
    let arguments = match Arguments::try_parse() {
        Ok(arguments) => arguments,
        Err(error) => return tools::usage("hrn-train", &error),
    };
    let how_to_go_on = match arguments.command {
        Command::Train(_) | Command::Adapt(_) => Some(signals::resuming(std::env::args())),
        Command::Compare(_) => Some(signals::again(std::env::args())),
        _ => None,
    };
    if let Err(error) = signals::end_at_signals(how_to_go_on) {
        eprintln!("hrn-train: signals: {error}");
        return ExitCode::from(exit::IO);
    }
    let done = match arguments.command {
        Command::Simulate(arguments) => simulate(&arguments),
        Command::Collect(arguments) => collect(&arguments),
        // On a thread of the pool: from outside, every operation on several threads would first
        // wake one of them.
        Command::Train(arguments) => rayon::scope(|_| train(&arguments)),
        Command::Adapt(arguments) => rayon::scope(|_| adapt(&arguments)),
        Command::Compare(arguments) => compare(arguments),
        Command::Evaluate(arguments) => evaluate(&arguments),
        Command::Report { directory, out } => report_of(&directory, &out),
        Command::Export { run, out } => export_run(&run, &out),
        Command::CheckModel { model } => return check_model(&model),
        Command::Adopt(arguments) => adopt_model(&arguments),
        Command::Inspect { model } => inspect(&model),
    };
    match done.and_then(|account| Ok(tools::print(account.as_bytes())?)) {
        Ok(_) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("hrn-train: {}", tools::line(error.as_ref()));
            ExitCode::from(exit_code(&error))
        }
    }
}

/// A file named on the command line that cannot be read.
#[derive(Debug, thiserror::Error)]
#[error("{}: {source}", path.display())]
struct Unreadable {
    path: PathBuf,
    source: std::io::Error,
}

/// A directory named on the command line that has no model to take.
#[derive(Debug, thiserror::Error)]
#[error("{}: no finished run: {}", .0.display(), .1)]
struct NoRun(PathBuf, &'static str);

/// The exit code: 2 wrong usage, 66 unreadable input, 69 no such device, 78 bad configuration or model, 74
/// other I/O error, else 1.
fn exit_code(error: &anyhow::Error) -> u8 {
    let has = |test: fn(&(dyn std::error::Error + 'static)) -> bool| error.chain().any(test);
    if has(|e| {
        e.is::<NoObjects>()
            || e.is::<OtherMaterials>()
            || e.is::<WrongUsage>()
            || matches!(e.downcast_ref(), Some(LabelsError::Range { .. }))
            || matches!(e.downcast_ref(), Some(CollectError::NoLevel { .. }))
    }) {
        exit::USAGE
    } else if has(|e| {
        e.is::<Unreadable>()
            || e.is::<NoRun>()
            || matches!(e.downcast_ref(), Some(DatasetError::Unreadable { .. }))
            || matches!(e.downcast_ref(), Some(CollectError::Unreadable { .. }))
            || matches!(e.downcast_ref(), Some(ConfigError::Unreadable { .. }))
    }) {
        exit::NO_INPUT
    } else if has(<dyn std::error::Error>::is::<NoCuda>) {
        exit::UNAVAILABLE
    } else if has(|e| {
        e.is::<ModelError>()
            || e.is::<NoStart>()
            || e.is::<Foreign>()
            || e.is::<SettingsError>()
            || e.is::<ConfigError>()
    }) {
        exit::CONFIG
    } else if has(<dyn std::error::Error>::is::<std::io::Error>) {
        exit::IO
    } else {
        exit::FAILED
    }
}

fn read(path: &Path) -> Result<Vec<u8>, Unreadable> {
    std::fs::read(path).map_err(|source| Unreadable {
        path: path.to_owned(),
        source,
    })
}

/// Writes a file at once and as a whole. If it replaces a file, stderr says so.
fn write(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let is_replaced = path.is_file();
    write_whole(path, bytes)?;
    if is_replaced {
        eprintln!("{}: replaced what stood there", path.display());
    }
    Ok(())
}

fn load(path: &Path) -> anyhow::Result<Hrn> {
    trial::load(&read(path)?, None).with_context(|| path.display().to_string())
}

/// No objects at all were asked for.
#[derive(Debug, thiserror::Error)]
#[error("--objects and --test-objects: found 0 and 0, expected one or more of either")]
struct NoObjects;

/// An option that has no meaning for these materials.
#[derive(Debug, thiserror::Error)]
#[error("{0}: works with `--materials {1}` only")]
struct OtherMaterials(&'static str, &'static str);

/// What to simulate.
fn simulated_settings(arguments: &Simulate) -> Result<DatasetSettings, OtherMaterials> {
    let is_broad = arguments.materials == Materials::Broad;
    let of_named = [
        ("--swapped-levels", arguments.swapped_levels.is_some()),
        ("--all-test", arguments.all_test),
    ];
    let of_broad = [
        ("--laws", !arguments.laws.is_empty()),
        ("--gaps", arguments.gaps),
    ];
    let (strange, usual) = if is_broad {
        (of_named, "named")
    } else {
        (of_broad, "broad")
    };
    if let Some((option, _)) = strange.into_iter().find(|(_, is_given)| *is_given) {
        return Err(OtherMaterials(option, usual));
    }
    Ok(DatasetSettings {
        seed: arguments.seed,
        materials: arguments.materials,
        laws: Laws::try_from(arguments.laws.clone()).unwrap_or_default(),
        borders: if arguments.gaps {
            Borders::Gaps
        } else {
            Borders::Touching
        },
        all_test: arguments.all_test,
        objects: arguments.objects,
        test_objects: arguments.test_objects,
        presses: arguments.presses.unwrap_or(if arguments.sequences {
            CourseSettings::default().objects.presses
        } else {
            DatasetSettings::default().presses
        }),
        lowest_force_n: arguments.lowest_force,
        shapes: arguments.shapes,
        profile: arguments.sensor_profile,
        sensor_seed: arguments.one_sensor,
        one_sensor: arguments.one_sensor.is_some(),
        cover_young_mpa: arguments.cover,
        swapped_levels: arguments.swapped_levels.unwrap_or_default(),
    })
}

fn simulate(arguments: &Simulate) -> anyhow::Result<String> {
    let settings = simulated_settings(arguments)?;
    if settings.objects == 0 && settings.test_objects == 0 {
        return Err(NoObjects.into());
    }
    if arguments.sequences {
        return simulate_courses(arguments, settings);
    }
    let begun = Instant::now();
    let samples = simulated::simulate(&settings);
    let seconds = begun.elapsed().as_secs_f64();

    let count = samples.len();
    let sheet = match &arguments.sheet {
        Some(path) => {
            let presses = match settings.materials {
                Materials::Named => one_press_a_level(&settings),
                Materials::Broad => Vec::new(),
            };
            Some((path, sheet::sheet(&samples, &presses)?))
        }
        None => None,
    };
    // The data set comes first, so that a picture that cannot be written does not lose it.
    write(&arguments.out, &simulated::to_bytes(&settings, samples)?)?;
    if let Some((path, picture)) = sheet {
        write(path, &picture)?;
    }
    Ok(format!(
        "{}: {count} samples in {seconds:.1} s, {:.0} a second\n",
        arguments.out.display(),
        count as f64 / seconds
    ))
}

fn simulate_courses(arguments: &Simulate, objects: DatasetSettings) -> anyhow::Result<String> {
    let (told, usual) = (&arguments.courses, CourseSettings::default());
    let settings = CourseSettings {
        objects,
        frame_rate_hz: told.fps.unwrap_or(usual.frame_rate_hz),
        speed_mm_s: told.speed.unwrap_or(usual.speed_mm_s),
        arm_n_per_mm: told.arm.unwrap_or(usual.arm_n_per_mm),
        hold_s: told.hold.unwrap_or(usual.hold_s),
        position_error: told.position_error.unwrap_or(usual.position_error),
        arm_error: told.arm_error.unwrap_or(usual.arm_error),
        clock_error_frames: told.clock_error.unwrap_or(usual.clock_error_frames),
        unknown_share: told.unknown.unwrap_or(usual.unknown_share),
    };
    let begun = Instant::now();
    let courses = simulated::simulate_courses(&settings);
    let seconds = begun.elapsed().as_secs_f64();
    let sheet = match &arguments.sheet {
        Some(path) => Some((path, sheet::courses(&courses)?)),
        None => None,
    };
    write(
        &arguments.out,
        &simulated::courses_to_bytes(&settings, &courses)?,
    )?;
    if let Some((path, picture)) = sheet {
        write(path, &picture)?;
    }
    let (count, wanted) = (courses.len() as u64, settings.objects.samples());
    let frames: usize = courses.iter().map(|course| course.moments.len()).sum();
    Ok(format!(
        "{}: {count} presses, {frames} frames in {seconds:.1} s, {:.0} presses a minute; {} left out: \
         they never began, or lasted over 30 s\n",
        arguments.out.display(),
        60.0 * count as f64 / seconds,
        wanted - count
    ))
}

fn collect(arguments: &Collect) -> anyhow::Result<String> {
    let setup = match &arguments.config {
        Some(config) => Setup::load(config)?,
        None => {
            let defaults = Config::new(vec![SensorTable::new(PathBuf::new())]);
            Setup::of(defaults, Path::new("defaults"))?
        }
    };
    let sensor = setup.sensors.first();
    let sensor = sensor.context("the configuration has no sensor")?;
    let captures = arguments
        .captures
        .iter()
        .map(|path| Capture::read(path, sensor, &setup.hrn))
        .collect::<Result<Vec<_>, _>>()?;
    if arguments.sequences {
        return collect_courses(arguments, &captures);
    }
    let before = if arguments.append {
        collect::existing(&arguments.out)?
    } else {
        None
    };
    let presses: usize = captures.iter().map(Capture::presses).sum();
    let all = before
        .as_ref()
        .map_or(0, |(dataset, _)| dataset.samples.len())
        + presses;
    let is_added_to = before.is_some();
    let bytes = collect::to_bytes(&captures, labelling(arguments), before)?;
    if is_added_to {
        write_whole(&arguments.out, &bytes)?;
    } else {
        write(&arguments.out, &bytes)?;
    }
    let out = arguments.out.display();
    Ok(format!(
        "{out}: {presses} presses collected, {all} in all; an object's further presses must go into \
         this file, not another\n"
    ))
}

fn labelling(arguments: &Collect) -> Labelling {
    Labelling {
        level: arguments.level,
        object: arguments.object,
        split: arguments.split.into(),
    }
}

fn collect_courses(arguments: &Collect, captures: &[Capture]) -> anyhow::Result<String> {
    let before = if arguments.append {
        collect::existing_courses(&arguments.out)?
    } else {
        None
    };
    let is_added_to = before.is_some();
    let before_count = before
        .as_ref()
        .map_or(0, |(courses, ..)| courses.presses.len());
    let (mut whole, mut known) = (0, 0);
    for capture in captures {
        let of_capture = capture.courses();
        (whole, known) = (whole + of_capture.0, known + of_capture.1);
    }
    let left_out = captures.iter().map(Capture::presses).sum::<usize>() - whole;
    if whole == 0 {
        anyhow::bail!("found no press from its begin on, expected at least one: record longer");
    }
    let bytes = collect::courses_to_bytes(captures, labelling(arguments), before)?;
    if is_added_to {
        write_whole(&arguments.out, &bytes)?;
    } else {
        write(&arguments.out, &bytes)?;
    }
    Ok(format!(
        "{}: {whole} presses collected, {known} of them with the arm's approach, {left_out} left out \
         because the recording lacks their begin, {} in all; an object's further presses must go into this \
         file, not another\n",
        arguments.out.display(),
        before_count + whole
    ))
}

/// The training materials' presses as the sensor sees them over time.
fn one_press_a_level(settings: &DatasetSettings) -> Vec<(Material, Vec<RawFrame>)> {
    let press_of = |material| {
        let sequence = Sequence::new(SequenceSettings {
            seed: settings.seed,
            materials: vec![material],
            presses: Some(1),
            shapes: settings.shapes,
            profile: settings.profile,
            ..SequenceSettings::default()
        });
        (material, sequence.map(|frame| frame.raw).collect())
    };
    Material::ALL[..4].iter().copied().map(press_of).collect()
}

fn train(arguments: &Train) -> anyhow::Result<String> {
    if let Some(parent) = arguments.parent {
        end_with(parent)?;
    }
    if arguments.method == Method::Course {
        return train_course(arguments);
    }
    if arguments.one_robot {
        return Err(WrongUsage::NotOneRobot.into());
    }
    let settings = settings(
        arguments.method,
        arguments.profile,
        arguments.config.as_deref(),
    )?;
    let dataset = dataset_of(&arguments.data)?;
    for other in &arguments.from {
        let unreadable = |source| Unreadable {
            path: other.clone(),
            source,
        };
        std::fs::read_dir(other).map_err(unreadable)?;
    }
    let request = Request {
        method: arguments.method,
        profile: arguments.profile,
        seed: arguments.seed,
        labels: arguments.labels,
        label_choice: arguments.label_choice,
        settings,
    };
    let description = request.description(&dataset)?;
    methods::check(arguments.method, &dataset, &description)?;
    let device = device(arguments.device)?;
    let run = Run::open(&arguments.out, &description, arguments.resume)?
        .taking_from(arguments.from.clone());
    eprint!("{}", account::of_data(&dataset));
    if arguments.profile == Profile::Smoke {
        eprintln!("--profile smoke: tries the commands in seconds; too short to learn anything");
    }
    let begun = Instant::now();
    let evaluation = methods::train(arguments.method, &dataset, &description, &run, &device)?;
    Ok(account_of_run(begun, &run, evaluation.as_ref()))
}

/// The data of several files, joined.
fn dataset_of(paths: &[PathBuf]) -> anyhow::Result<Dataset> {
    let parts: Result<Vec<Dataset>, DatasetError> =
        paths.iter().map(|path| Dataset::read(path)).collect();
    let parts = parts?;
    for part in &parts {
        part.warn_of_object_in_both_splits();
    }
    Ok(Dataset::joined(parts)?)
}

fn adapt(arguments: &Adapt) -> anyhow::Result<String> {
    if Courses::is_at(&arguments.data[0])? {
        return adapt_course(arguments);
    }
    let (method, profile) = (Method::Adapt, Profile::Paper);
    let settings = settings(method, profile, arguments.config.as_deref())?;
    let device = device(arguments.device)?;
    let start = match &arguments.start {
        Some(path) => {
            let bytes = read(path)?;
            methods::frame::start(&load(path)?, &bytes, &device)
                .with_context(|| path.display().to_string())?
        }
        None => methods::frame::start(&Hrn::load(BUILT_IN)?, BUILT_IN, &device)
            .context("the built-in model")?,
    };
    let dataset = dataset_of(&arguments.data)?;
    let request = Request {
        method,
        profile,
        seed: arguments.seed,
        labels: None,
        label_choice: LabelChoice::Object,
        settings,
    };
    let description = request.description(&dataset)?;
    methods::check(method, &dataset, &description)?;
    let run = Run::open(&arguments.out, &description, arguments.resume)?;
    eprint!("{}", account::of_data(&dataset));
    let begun = Instant::now();
    let evaluation = methods::frame::adapt(&dataset, start, &description, &run, &device)?;
    Ok(account_of_run(begun, &run, evaluation.as_ref()))
}

/// How long it took, where the model is and what it is worth.
fn account_of_run(begun: Instant, run: &Run, evaluation: Option<&Evaluation>) -> String {
    let figures = evaluation.map_or_else(
        || "not evaluated: the data has no labelled test samples\n".to_owned(),
        account::of_evaluation,
    );
    format!(
        "trained in {:.1} s: {}\n{figures}",
        begun.elapsed().as_secs_f64(),
        run.path("hrn.onnx").display()
    )
}

fn train_course(arguments: &Train) -> anyhow::Result<String> {
    let mut settings = settings(
        arguments.method,
        arguments.profile,
        arguments.config.as_deref(),
    )?;
    if arguments.one_robot {
        settings.told = Robot::ONE_ROBOT;
    }
    let (courses, sources) = Courses::read_all(&arguments.data)?;
    let told = (arguments.profile, arguments.seed, settings);
    let description = methods::course::description(Method::Course, &courses, sources, told)?;
    let device = device(arguments.device)?;
    let run = Run::open(&arguments.out, &description, arguments.resume)?;
    let begun = Instant::now();
    let evaluation = methods::course::train(&courses, None, &description, &run, &device)?;
    Ok(account_of_course_run(begun, &run, evaluation.as_ref()))
}

/// How long it took, where the model is and what it is worth.
fn account_of_course_run(
    begun: Instant,
    run: &Run,
    evaluation: Option<&CourseEvaluation>,
) -> String {
    let figures = evaluation.map_or_else(
        || "not evaluated: the data has no labelled test presses\n".to_owned(),
        account::of_courses,
    );
    format!(
        "trained in {:.1} s: {}\n{figures}",
        begun.elapsed().as_secs_f64(),
        run.path("hrn.onnx").display()
    )
}

/// Goes on from a model of whole presses.
fn adapt_course(arguments: &Adapt) -> anyhow::Result<String> {
    let path = arguments.start.as_ref().ok_or(WrongUsage::NoStart)?;
    let (method, profile) = (Method::Adapt, Profile::Paper);
    let settings = settings(method, profile, arguments.config.as_deref())?;
    let device = device(arguments.device)?;
    let bytes = read(path)?;
    let start = methods::course::start(&load(path)?, &bytes, &device)
        .with_context(|| path.display().to_string())?;
    let (courses, sources) = Courses::read_all(&arguments.data)?;
    let told = (profile, arguments.seed, settings);
    let description = methods::course::description(method, &courses, sources, told)?;
    let run = Run::open(&arguments.out, &description, arguments.resume)?;
    let begun = Instant::now();
    let evaluation = methods::course::train(&courses, Some(start), &description, &run, &device)?;
    Ok(account_of_course_run(begun, &run, evaluation.as_ref()))
}

/// Those of the method, and what a file overrides.
fn settings(method: Method, profile: Profile, file: Option<&Path>) -> anyhow::Result<Settings> {
    let settings = method.settings(profile);
    let Some(path) = file else {
        return Ok(settings);
    };
    let text = String::from_utf8_lossy(&read(path)?).into_owned();
    let overridden = settings.overridden(&text);
    overridden.with_context(|| path.display().to_string())
}

/// A CUDA device was asked for.
#[derive(Debug, thiserror::Error)]
#[error(
    "--device cuda: no CUDA device found, expected a build with --features cuda, a device and its \
     driver"
)]
struct NoCuda;

fn device(name: DeviceName) -> Result<Device, NoCuda> {
    match name {
        DeviceName::Cpu => Ok(Device::flex()),
        #[cfg(feature = "cuda")]
        DeviceName::Cuda => Device::enumerate(burn::tensor::DeviceType::Cuda)
            .into_iter()
            .next()
            .ok_or(NoCuda),
        #[cfg(not(feature = "cuda"))]
        DeviceName::Cuda => Err(NoCuda),
    }
}

/// Asks the system to end this process when its parent ends, for whatever reason.
fn end_with(parent: i32) -> anyhow::Result<()> {
    rustix::process::set_parent_process_death_signal(Some(rustix::process::Signal::TERM))
        .map_err(std::io::Error::from)
        .context("end with the parent process")?;
    let actual = rustix::process::getppid().map(rustix::process::Pid::as_raw_nonzero);
    anyhow::ensure!(
        actual.is_some_and(|actual| actual.get() == parent),
        "the process that started this one, {parent}, has ended"
    );
    Ok(())
}

/// Options that do not go together.
#[derive(Debug, thiserror::Error)]
enum WrongUsage {
    #[error("--methods: found course, which judges presses, expected methods that judge a frame")]
    NotOfFrames,
    #[error("--data: found {0} files, expected 1 without --course")]
    ManyFiles(usize),
    #[error(
        "--start: found none, expected a model of whole presses, such as models/course.onnx, for such data"
    )]
    NoStart,
    #[error("--one-robot: found another method, expected course")]
    NotOneRobot,
}

fn compare(arguments: Compare) -> anyhow::Result<String> {
    if arguments.course {
        let table = compare_courses(&CoursePlan {
            data: arguments.data,
            tests: arguments.test,
            models: arguments.model,
            out: arguments.out.clone(),
        })?;
        let page = arguments.out.join("course.md");
        return Ok(format!("{table}\n{}\n", page.display()));
    }
    let [data] =
        <[PathBuf; 1]>::try_from(arguments.data).map_err(|all| WrongUsage::ManyFiles(all.len()))?;
    if arguments.methods.contains(&Method::Course) {
        return Err(WrongUsage::NotOfFrames.into());
    }
    let methods = if arguments.methods.is_empty() {
        Method::of_frames().collect()
    } else {
        arguments.methods
    };
    let jobs = arguments.jobs.map(std::num::NonZeroUsize::get);
    let plan = Plan {
        data,
        out: arguments.out.clone(),
        methods,
        labels: arguments.labels,
        seeds: arguments.seeds,
        profile: arguments.profile,
        jobs: jobs.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from)),
        swaps: arguments.swaps,
    };
    if arguments.plan {
        return compare::plan(&plan);
    }
    compare::compare(&plan)?;
    let page = arguments.out.join("report.html");
    let found = Comparison::read(&arguments.out)?;
    let table = found.map_or_else(String::new, |found| {
        tables::headline(&found.rows()).text() + "\n"
    });
    Ok(format!("{table}{}\n", page.display()))
}

fn report_of(directory: &Path, out: &Path) -> anyhow::Result<String> {
    std::fs::read_dir(directory).map_err(|source| Unreadable {
        path: directory.to_owned(),
        source,
    })?;
    write(out, report::of(directory)?.as_bytes())?;
    Ok(format!("{}\n", out.display()))
}

fn evaluate(arguments: &Evaluate) -> anyhow::Result<String> {
    let hrn = load(&arguments.model)?;
    if Courses::is_at(&arguments.data)? {
        return evaluate_courses(arguments, &hrn);
    }
    let dataset = Dataset::read(&arguments.data)?;
    let (of_model, of_data) = (hrn.card().pitch_mm, dataset.pitch_mm() as f32);
    if of_model != of_data {
        eprintln!(
            "warning: {}: taxel pitch: found {of_data} mm, expected {of_model} mm, that of the model",
            arguments.data.display()
        );
    }
    dataset.warn_of_object_in_both_splits();
    let indices = dataset.labelled(arguments.split.into())?;
    let evaluation = export::evaluate(&hrn, &dataset, &indices)?;
    if let Some(path) = &arguments.verdicts {
        let samples = indices.iter().map(|&index| &dataset.samples[index]);
        let verdicts = samples.map(|sample| Ok((sample, hrn.judge(&sample.frame)?)));
        let verdicts: Vec<_> = verdicts.collect::<anyhow::Result<_>>()?;
        let rows = verdicts
            .iter()
            .map(|(sample, verdict)| (sample.object, sample.level, verdict));
        write(path, account::csv(rows).as_bytes())?;
    }
    Ok(if arguments.json {
        serde_json::to_string(&evaluation)? + "\n"
    } else {
        account::of_evaluation(&evaluation)
    })
}

fn evaluate_courses(arguments: &Evaluate, hrn: &Hrn) -> anyhow::Result<String> {
    let courses = Courses::read(&arguments.data)?;
    let verdicts = course::verdicts(hrn, &courses, arguments.split.into(), |course| course)?;
    anyhow::ensure!(
        !verdicts.is_empty(),
        "{}: no labelled presses in this split: found 0, expected 1 or more",
        arguments.data.display()
    );
    if let Some(path) = &arguments.verdicts {
        let rows = verdicts.iter();
        let rows = rows.map(|(press, verdict)| (Some(press.object), press.level, verdict));
        write(path, account::csv(rows).as_bytes())?;
    }
    let evaluation = CourseEvaluation::of(&verdicts, hrn.card().levels.len());
    Ok(if arguments.json {
        serde_json::to_string(&evaluation)? + "\n"
    } else {
        account::of_courses(&evaluation)
    })
}

fn export_run(run: &Path, out: &Path) -> anyhow::Result<String> {
    let model = run.join("hrn.onnx");
    if run.is_dir() && !model.exists() {
        let hint = if run.join("settings.toml").exists() {
            "it was stopped: `hrn-train train --resume` with its options finishes it"
        } else {
            "it has no hrn.onnx"
        };
        return Err(NoRun(run.to_owned(), hint).into());
    }
    let hrn = load(&model)?;
    write(out, &read(&model)?)?;
    Ok(format!("{}: sha256 {}\n", out.display(), hrn.sha256()))
}

fn inspect(path: &Path) -> anyhow::Result<String> {
    Ok(account::of_model(path, &load(path)?))
}

/// The time that a sensor of 5 frames/s leaves for a verdict.
const SLOWEST_HZ: f64 = 5.0;

/// Its lines are what was asked for, so they go to stdout even if the model does not pass.
fn check_model(path: &Path) -> ExitCode {
    let checked = read(path).map_err(anyhow::Error::from).and_then(|bytes| {
        let findings = review::review(&bytes);
        let mut lines = format!("{}: {}\n", path.display(), review::wanted());
        for finding in &findings {
            lines += &format!("{finding}\n");
        }
        let mut passes = findings.iter().all(|finding| finding.problem.is_none());
        if passes {
            // Memory and time, as the daemon tries them.
            let most = trial::verdict_most(SLOWEST_HZ);
            match trial::load(&bytes, Some(most)) {
                Ok(_) => lines += "ok       memory and time of a verdict\n",
                Err(error) => {
                    passes = false;
                    lines += &format!("missing  memory and time of a verdict: {error}\n");
                }
            }
        } else if findings.iter().all(|f| f.problem.is_none() || f.is_mended) {
            lines += &format!(
                "`hrn-train adopt {} --data D.npz --out H.onnx` adds what is missing\n",
                path.display()
            );
        }
        tools::print(lines.as_bytes())?;
        Ok(passes)
    });
    match checked {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(exit::CONFIG),
        Err(error) => {
            eprintln!("hrn-train: {}", tools::line(error.as_ref()));
            ExitCode::from(exit_code(&error))
        }
    }
}

fn adopt_model(arguments: &Adopt) -> anyhow::Result<String> {
    let bytes = read(&arguments.model)?;
    let dataset = Dataset::read(&arguments.data)?;
    let name = arguments.model.file_name().unwrap_or_default();
    let told = Told {
        method: arguments
            .method
            .clone()
            .unwrap_or_else(|| format!("adopted from {}", name.display())),
        validation: arguments.validation.clone(),
    };
    let adopted = adopt::adopt(&bytes, &dataset, &told);
    let (model, done, evaluation) =
        adopted.with_context(|| arguments.model.display().to_string())?;
    write(&arguments.out, &model)?;
    let hrn = load(&arguments.out)?;
    let mut account = String::new();
    for change in done {
        account += &format!("changed  {change}\n");
    }
    account += &format!("{}: sha256 {}\n", arguments.out.display(), hrn.sha256());
    if let Some(evaluation) = evaluation {
        account += &account::of_evaluation(&evaluation);
    }
    Ok(account)
}
