//! `hrn-train train`.

use std::time::Instant;

use anyhow::Context as _;
use burn::tensor::Device;
use hardnessd_core::wording;
use hrn_train::data::presses::Presses;
use hrn_train::settings::{self, Profile};
use hrn_train::train::{self, Request};

use super::account;
use super::arguments::{DeviceName, Train};
use super::failure::{NoCuda, Unreadable};
use super::files::read;

pub(super) fn train(arguments: &Train) -> anyhow::Result<String> {
    if let Some(parent) = arguments.parent {
        end_with(parent)?;
    }
    for other in &arguments.from {
        let unreadable = |source| Unreadable {
            path: other.clone(),
            source,
        };
        std::fs::read_dir(other).map_err(unreadable)?;
    }
    let given = match &arguments.config {
        Some(path) => {
            let text = String::from_utf8_lossy(&read(path)?).into_owned();
            settings::parse(&text).with_context(|| path.display().to_string())?
        }
        None => toml::Table::new(),
    };
    let request = Request {
        recipe: arguments.method,
        data: arguments.data.clone(),
        out: arguments.out.clone(),
        profile: arguments.profile,
        seed: arguments.seed,
        labels: arguments.labels,
        given,
        resume: arguments.resume,
        from: arguments.from.clone(),
        device: device(arguments.device)?,
    };
    let begun = Instant::now();
    let evaluation = train::train(&request, |presses| say(presses, arguments.profile));
    let evaluation = match &arguments.config {
        // An error of a value names its file.
        Some(path) => evaluation.map_err(|error| match error.is::<settings::SettingsError>() {
            true => error.context(path.display().to_string()),
            false => error,
        }),
        None => evaluation,
    };
    let figures = evaluation?.as_ref().map(account::of_evaluated);
    Ok(format!(
        "trained in {:.1} s: {}\n{}",
        begun.elapsed().as_secs_f64(),
        arguments.out.join("hrn.onnx").display(),
        figures.unwrap_or_else(|| {
            "not evaluated: the data has no labelled test presses\n".to_owned()
        })
    ))
}

/// Says what the data are.
fn say(presses: &Presses, profile: Profile) {
    hardnessd_core::stderr_part!("{}", wording::lines(&account::of_data(presses)));
    hardnessd_core::stderr_part!("{}", account::of_levels(presses));
    if profile == Profile::Smoke {
        hardnessd_core::stderr_line!(
            "--profile smoke: tries the commands in seconds; too short to learn anything"
        );
    }
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
