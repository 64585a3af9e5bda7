//! `hrn-train simulate`.

use std::time::Instant;

use hardnessd_simulator::{Borders, BroadSensors, CourseSettings, DatasetSettings, Materials};
use hrn_train::data::simulated;

use super::arguments::Simulate;
use super::failure::WrongUsage;
use super::files::{check_new, write};

/// The settings of the simulation.
fn simulated_settings(arguments: &Simulate) -> Result<DatasetSettings, WrongUsage> {
    let is_broad = arguments.materials == Materials::Broad;
    if is_broad && arguments.all_test {
        return Err(WrongUsage::OtherMaterials("--all-test", "named"));
    }
    if !is_broad && arguments.gaps {
        return Err(WrongUsage::OtherMaterials("--gaps", "broad"));
    }
    Ok(DatasetSettings {
        seed: arguments.seed,
        materials: arguments.materials,
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
    })
}

pub(super) fn simulate(arguments: &Simulate) -> anyhow::Result<String> {
    let settings = simulated_settings(arguments)?;
    if settings.objects == 0 && settings.test_objects == 0 {
        return Err(WrongUsage::NoObjects.into());
    }
    if arguments.sequences {
        return simulate_courses(arguments, settings);
    }
    check_new(&arguments.out)?;
    let begun = Instant::now();
    let samples = simulated::simulate(&settings, jobs(arguments));
    let seconds = begun.elapsed().as_secs_f64();

    let count = samples.len();
    write(&arguments.out, &simulated::to_bytes(&settings, samples)?)?;
    Ok(format!(
        "{}: {count} samples in {seconds:.1} s, {:.0} a second\n",
        arguments.out.display(),
        count as f64 / seconds
    ))
}

fn simulate_courses(arguments: &Simulate, objects: DatasetSettings) -> anyhow::Result<String> {
    check_new(&arguments.out)?;
    let asked = &arguments.courses;
    let (usual, many) = (CourseSettings::default(), BroadSensors::default());
    let settings = CourseSettings {
        objects,
        frame_rate_hz: asked.fps.unwrap_or(usual.frame_rate_hz),
        sensors: asked.sensors.map(|designs| BroadSensors {
            designs,
            covers: asked.covers.unwrap_or(many.covers),
            test_covers: asked.test_covers.unwrap_or(many.test_covers),
            electronics: asked.electronics.unwrap_or(many.electronics),
        }),
    };
    let begun = Instant::now();
    let courses = simulated::simulate_courses(&settings, jobs(arguments));
    let seconds = begun.elapsed().as_secs_f64();
    write(
        &arguments.out,
        &simulated::courses_to_bytes(&settings, &courses)?,
    )?;
    let (count, wanted) = (courses.len() as u64, settings.presses());
    let frames: usize = courses.iter().map(|course| course.moments.len()).sum();
    let unseen = if settings.sensors.is_some() {
        "their sensor did not see one press, or they lasted over 30 s"
    } else {
        "they never began, or lasted over 30 s"
    };
    Ok(format!(
        "{}: {count} presses, {frames} frames in {seconds:.1} s, {:.0} presses a minute; {} left out: \
         {unseen}\n",
        arguments.out.display(),
        60.0 * count as f64 / seconds,
        wanted - count
    ))
}

fn jobs(arguments: &Simulate) -> usize {
    arguments.jobs.unwrap_or_else(simulated::all_cores)
}
