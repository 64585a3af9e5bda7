//! `hrn-train train` and `hrn-train adapt`.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context as _;
use burn::tensor::Device;
use hardnessd_core::verdict::{BUILT_IN, Hrn, sha256_hex};
use hardnessd_core::wording;
use hardnessd_simulator::Split;
use hrn_train::data::courses::{self, Courses};
use hrn_train::data::dataset::{Dataset, DatasetError, LabelChoice};
use hrn_train::methods::{self, Method, Request};
use hrn_train::model::evaluated::Evaluated;
use hrn_train::model::{course, export};
use hrn_train::run::{Description, Run};
use hrn_train::settings::{Profile, Settings};

use super::account;
use super::arguments::{Adapt, DeviceName, Train};
use super::failure::{NoCuda, Unreadable, WrongUsage};
use super::files::{load_with_bytes, read};

pub(super) fn train(arguments: &Train) -> anyhow::Result<String> {
    if let Some(parent) = arguments.parent {
        end_with(parent)?;
    }
    if arguments.method == Method::Course {
        return train_course(arguments);
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
    hardnessd_core::say_part!("{}", wording::lines(&account::of_data(&dataset)));
    let labelled = dataset
        .samples
        .iter()
        .filter(|sample| sample.split == Split::Train && sample.level > 0);
    let labelled = labelled.map(|sample| (sample.level, sample.object));
    hardnessd_core::say_part!("{}", account::of_levels(labelled));
    if arguments.profile == Profile::Smoke {
        hardnessd_core::say!(
            "--profile smoke: tries the commands in seconds; too short to learn anything"
        );
    }
    let begun = Instant::now();
    let evaluation = methods::train(arguments.method, &dataset, &description, &run, &device)?;
    Ok(account_of_run(
        begun,
        &run,
        evaluation.as_ref().map(account::of_evaluated),
    ))
}

fn train_course(arguments: &Train) -> anyhow::Result<String> {
    let of_frames = [
        ("--labels", arguments.labels.is_some()),
        (
            "--label-choice",
            arguments.label_choice != LabelChoice::Object,
        ),
        ("--from", !arguments.from.is_empty()),
    ];
    if let Some((option, _)) = of_frames.into_iter().find(|(_, is_given)| *is_given) {
        return Err(WrongUsage::OfFrames(option).into());
    }
    let settings = settings(
        arguments.method,
        arguments.profile,
        arguments.config.as_deref(),
    )?;
    let (courses, sources) = Courses::read_all(&arguments.data)?;
    let choices = (arguments.profile, arguments.seed, settings);
    let description = methods::course::description(Method::Course, &courses, sources, choices)?;
    let device = device(arguments.device)?;
    let run = Run::open(&arguments.out, &description, arguments.resume)?;
    let labelled = courses.labelled(Split::Train);
    let labelled = labelled.map(|place| &courses.presses[place]);
    let labelled = labelled.map(|press| (press.level, Some(press.object)));
    hardnessd_core::say_part!("{}", account::of_levels(labelled));
    let begun = Instant::now();
    let evaluation = methods::course::train(&courses, None, &description, &run, &device)?;
    Ok(account_of_run(
        begun,
        &run,
        evaluation.as_ref().map(account::of_evaluated),
    ))
}

pub(super) fn adapt(arguments: &Adapt) -> anyhow::Result<String> {
    if Courses::is_at(&arguments.data[0])? {
        return adapt_course(arguments);
    }
    let (method, profile) = (Method::Adapt, Profile::Paper);
    let settings = settings(method, profile, arguments.config.as_deref())?;
    let device = device(arguments.device)?;
    let (model, bytes, name) = match &arguments.start {
        Some(path) => {
            let (model, bytes) = load_with_bytes(path)?;
            (model, bytes, path.display().to_string())
        }
        None => {
            let name = "the built-in model".to_owned();
            (Hrn::load(BUILT_IN)?, BUILT_IN.to_vec(), name)
        }
    };
    let start = methods::adapt::Start::read(&model, &bytes, &device).context(name)?;
    let dataset = dataset_of(&arguments.data)?;
    let request = Request {
        method,
        profile,
        seed: arguments.seed,
        labels: None,
        label_choice: LabelChoice::Object,
        settings: start.settings(settings)?,
    };
    let description = Description {
        start: Some(sha256_hex(&bytes)),
        ..request.description(&dataset)?
    };
    methods::check(method, &dataset, &description)?;
    let run = Run::open(&arguments.out, &description, arguments.resume)?;
    hardnessd_core::say_part!("{}", wording::lines(&account::of_data(&dataset)));
    let begun = Instant::now();
    let evaluation = methods::adapt::train(&dataset, start, &description, &run, &device)?;
    let beside_start = |evaluation: &Evaluated| {
        let cases = export::cases(&model, &dataset, &dataset.labelled(Split::Test)?)?;
        Ok(account::of_adapted(evaluation, &model, &cases))
    };
    let figures: anyhow::Result<Option<String>> = evaluation.as_ref().map(beside_start).transpose();
    Ok(account_of_run(begun, &run, figures?))
}

/// Continues to train a model of whole presses.
fn adapt_course(arguments: &Adapt) -> anyhow::Result<String> {
    let path = arguments.start.as_ref().ok_or(WrongUsage::NoStart)?;
    let (method, profile) = (Method::Adapt, Profile::Paper);
    let settings = settings(method, profile, arguments.config.as_deref())?;
    let device = device(arguments.device)?;
    let (model, bytes) = load_with_bytes(path)?;
    let start = methods::course::start(&model, &bytes, &device)
        .with_context(|| path.display().to_string())?;
    let (courses, sources) = Courses::read_all(&arguments.data)?;
    let choices = (profile, arguments.seed, settings);
    let description = Description {
        start: Some(sha256_hex(&bytes)),
        ..methods::course::description(method, &courses, sources, choices)?
    };
    let run = Run::open(&arguments.out, &description, arguments.resume)?;
    let begun = Instant::now();
    let evaluation = methods::course::train(&courses, Some(start), &description, &run, &device)?;
    let beside_start = |evaluation: &Evaluated| {
        let verdicts = course::verdicts(&model, &courses, Split::Test, |course| course)?;
        Ok(account::of_adapted(
            evaluation,
            &model,
            &course::cases(&verdicts),
        ))
    };
    let figures: anyhow::Result<Option<String>> = evaluation.as_ref().map(beside_start).transpose();
    Ok(account_of_run(begun, &run, figures?))
}

/// The data of several files, joined.
fn dataset_of(paths: &[PathBuf]) -> anyhow::Result<Dataset> {
    let parts: Result<Vec<Dataset>, DatasetError> = paths
        .iter()
        .map(|path| courses::single_frames(path))
        .collect();
    let parts = parts?;
    for part in &parts {
        part.warn_of_object_in_both_splits();
    }
    Ok(Dataset::joined(parts)?)
}

/// The duration of the training, the path of the model, and its figures on the data's test presses,
/// if there are any.
fn account_of_run(begun: Instant, run: &Run, figures: Option<String>) -> String {
    format!(
        "trained in {:.1} s: {}\n{}",
        begun.elapsed().as_secs_f64(),
        run.path("hrn.onnx").display(),
        figures.unwrap_or_else(|| {
            "not evaluated: the data has no labelled test presses\n".to_owned()
        })
    )
}

/// The settings of the method, with the values that a file overrides.
fn settings(method: Method, profile: Profile, file: Option<&Path>) -> anyhow::Result<Settings> {
    let settings = method.settings(profile);
    let Some(path) = file else {
        return Ok(settings);
    };
    let text = String::from_utf8_lossy(&read(path)?).into_owned();
    let overridden = settings.overridden(&text);
    overridden.with_context(|| path.display().to_string())
}

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
