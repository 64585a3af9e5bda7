//! `hrn-train simulate`.

use std::time::Instant;

use anyhow::Context as _;
use hardnessd_core::exit::USAGE;
use hardnessd_simulator::{BroadSensors, CourseSettings, DatasetSettings};
use hrn_train::data::presses::Layout;
use hrn_train::data::simulated;
use hrn_train::exit::coded;
use hrn_train::run::disk::{check_new, read_text, write_new};

use super::arguments::Simulate;

/// The settings that the options name.
fn asked(arguments: &Simulate) -> CourseSettings {
    let (frames, usual) = (DatasetSettings::default(), CourseSettings::default());
    CourseSettings {
        objects: DatasetSettings {
            seed: arguments.seed,
            materials: arguments.materials,
            objects: arguments.objects,
            test_objects: arguments.test_objects,
            presses: arguments.presses.unwrap_or(match arguments.sequences {
                true => usual.objects.presses,
                false => frames.presses,
            }),
            lowest_force_n: arguments.lowest_force,
            shapes: arguments.shapes,
            profile: arguments.sensor_profile,
            ..frames
        },
        sensors: arguments.sensors.map(|designs| BroadSensors {
            designs,
            ..BroadSensors::default()
        }),
        ..usual
    }
}

pub(super) fn simulate(arguments: &Simulate) -> anyhow::Result<String> {
    let mut settings = asked(arguments);
    settings.check().map_err(|error| coded(USAGE, error))?;
    if let Some(path) = &arguments.config {
        let text = read_text(path)?;
        let configured = simulated::configured(&settings, &text);
        settings = configured.with_context(|| path.display().to_string())?;
        if settings.sensors.is_some() != arguments.sensors.is_some() {
            return Err(coded(USAGE, "[sensors] of --config: give --sensors too"));
        }
    }
    if settings.objects.objects == 0 && settings.objects.test_objects == 0 {
        let text = "--objects and --test-objects: found 0 and 0, expected one or more of either";
        return Err(coded(USAGE, text));
    }
    let layout = Layout::of(arguments.sequences);
    check_new(&arguments.out)?;
    let begun = Instant::now();
    let (presses, left_out) = simulated::simulate(&settings, layout);
    let seconds = begun.elapsed().as_secs_f64();
    let bytes = simulated::to_bytes(&settings, layout, &presses)?;
    write_new(&arguments.out, &bytes)?;
    let count = presses.all.len();
    let left_out = match layout {
        Layout::Frames => String::new(),
        Layout::OverTime => {
            format!("; {left_out} left out: no sensor saw them, or they lasted over 30 s")
        }
    };
    Ok(format!(
        "{}: {count} presses in {seconds:.1} s, {:.0} a second{left_out}\n",
        arguments.out.display(),
        count as f64 / seconds
    ))
}
