//! `hrn-train train`.

use std::path::Path;
use std::time::Instant;

use anyhow::Context as _;
use burn::tensor::Device;
use hardnessd_core::wording;
use hrn_train::data::dataset::LabelChoice;
use hrn_train::methods::task::Task;
use hrn_train::methods::{self, Request};
use hrn_train::run::Run;
use hrn_train::settings::{Profile, Settings};

use super::account;
use super::arguments::{DeviceName, Train, Trained};
use super::failure::{NoCuda, Unreadable, WrongUsage};
use super::files::read;

pub(super) fn train(arguments: &Train) -> anyhow::Result<String> {
    if let Some(parent) = arguments.parent {
        end_with(parent)?;
    }
    let profile = arguments.profile;
    let defaults = match arguments.method {
        Trained::Frames(method) => method.settings(profile),
        Trained::Courses => methods::course::settings(profile),
    };
    let settings = overridden(defaults, arguments.config.as_deref())?;
    let task = match arguments.method {
        Trained::Frames(method) => Task::frames(&arguments.data, method)?,
        Trained::Courses => {
            check_options_of_courses(arguments)?;
            Task::courses(&arguments.data)?
        }
    };
    for other in &arguments.from {
        let unreadable = |source| Unreadable {
            path: other.clone(),
            source,
        };
        std::fs::read_dir(other).map_err(unreadable)?;
    }
    let request = Request {
        profile,
        seed: arguments.seed,
        labels: arguments.labels,
        label_choice: arguments.label_choice,
        settings,
    };
    let description = task.description(&request)?;
    let device = device(arguments.device)?;
    let run = Run::open(&arguments.out, &description, arguments.resume)?
        .taking_from(arguments.from.clone());
    let presses = task.presses();
    hardnessd_core::stderr_part!("{}", wording::lines(&account::of_data(&presses)));
    hardnessd_core::stderr_part!("{}", account::of_levels(&presses));
    if profile == Profile::Smoke {
        hardnessd_core::stderr_line!(
            "--profile smoke: tries the commands in seconds; too short to learn anything"
        );
    }
    let begun = Instant::now();
    let evaluation = task.train(&description, &run, &device)?;
    let figures = evaluation.as_ref().map(account::of_evaluated);
    Ok(account_of_run(begun, &run, figures))
}

/// Refuses options that mean nothing for whole presses.
fn check_options_of_courses(arguments: &Train) -> Result<(), WrongUsage> {
    let of_frames = [
        ("--labels", arguments.labels.is_some()),
        (
            "--label-choice",
            arguments.label_choice != LabelChoice::Object,
        ),
        ("--from", !arguments.from.is_empty()),
    ];
    match of_frames.into_iter().find(|(_, is_given)| *is_given) {
        Some((option, _)) => Err(WrongUsage::OfFrames(option)),
        None => Ok(()),
    }
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

/// The settings with the values that a file overrides.
fn overridden(settings: Settings, file: Option<&Path>) -> anyhow::Result<Settings> {
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
