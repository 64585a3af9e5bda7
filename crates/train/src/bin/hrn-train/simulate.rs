//! `hrn-train simulate`.

use std::path::{Path, PathBuf};
use std::time::Instant;

use hardnessd_simulator::{
    Borders, BroadSensors, CourseSettings, DatasetSettings, Materials, SensorDesigns,
};
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
        sensor_seed: arguments.one_sensor,
        one_sensor: arguments.one_sensor.is_some(),
        cover_young_mpa: arguments.cover,
        calibrated: arguments.calibrated,
        ..DatasetSettings::default()
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
    let (asked, usual) = (&arguments.courses, CourseSettings::default());
    let usual = CourseSettings {
        arm_error: match asked.sensors {
            Some(_) => BROAD_ARM_ERROR,
            None => usual.arm_error,
        },
        ..usual
    };
    let settings = CourseSettings {
        objects,
        flat_share: usual.flat_share,
        highest_force_n: match asked.sensors {
            Some(SensorDesigns::Broad) => BROAD_FORCE_N,
            Some(SensorDesigns::Jx255n) | None => usual.highest_force_n,
        },
        frame_rate_hz: asked.fps.unwrap_or(usual.frame_rate_hz),
        speed_mm_s: asked.speed.unwrap_or(usual.speed_mm_s),
        arm_n_per_mm: asked.arm.unwrap_or(usual.arm_n_per_mm),
        hold_s: asked.hold.unwrap_or(usual.hold_s),
        position_error: asked.position_error.unwrap_or(usual.position_error),
        arm_error: asked.arm_error.unwrap_or(usual.arm_error),
        clock_error_frames: asked.clock_error.unwrap_or(usual.clock_error_frames),
        unknown_share: asked.unknown.unwrap_or(usual.unknown_share),
        sensors: None,
    };
    let Some(designs) = asked.sensors else {
        check_new(&arguments.out)?;
        return write_courses(arguments, &settings, &arguments.out);
    };
    let usual = BroadSensors::default();
    let shards = asked.shards.unwrap_or(usual.shards);
    let out = |shard| match shards {
        1 => arguments.out.clone(),
        _ => numbered(&arguments.out, shard),
    };
    (0..shards).try_for_each(|shard| check_new(&out(shard)))?;
    let mut message = String::new();
    for shard in 0..shards {
        let sensors = BroadSensors {
            designs,
            covers: asked.covers.unwrap_or(usual.covers),
            test_covers: asked.test_covers.unwrap_or(usual.test_covers),
            electronics: asked.electronics.unwrap_or(usual.electronics),
            shard,
            shards,
        };
        let settings = CourseSettings {
            sensors: Some(sensors),
            ..settings
        };
        message += &write_courses(arguments, &settings, &out(shard))?;
    }
    Ok(message)
}

/// Error of the stiffness that a robot reports, where each sensor has a number.
const BROAD_ARM_ERROR: f64 = 0.15;

/// The greatest force on broad sensors.
const BROAD_FORCE_N: f32 = 40.0;

/// `D-3.npz` for part 3 of `D.npz`.
fn numbered(path: &Path, part: u32) -> PathBuf {
    let mut name = path.file_stem().unwrap_or_default().to_owned();
    name.push(format!("-{part}"));
    if let Some(extension) = path.extension() {
        name.push(".");
        name.push(extension);
    }
    path.with_file_name(name)
}

/// Simulates and writes one file of whole presses.
fn write_courses(
    arguments: &Simulate,
    settings: &CourseSettings,
    out: &Path,
) -> anyhow::Result<String> {
    let begun = Instant::now();
    let courses = simulated::simulate_courses(settings, jobs(arguments));
    let seconds = begun.elapsed().as_secs_f64();
    let shard = settings.sensors.map(|sensors| sensors.shard);
    write(out, &simulated::courses_to_bytes(settings, &courses)?)?;
    let (count, wanted) = (courses.len() as u64, settings.presses());
    let frames: usize = courses.iter().map(|course| course.moments.len()).sum();
    let unseen = if shard.is_some() {
        "their sensor did not see one press, or they lasted over 30 s"
    } else {
        "they never began, or lasted over 30 s"
    };
    Ok(format!(
        "{}: {count} presses, {frames} frames in {seconds:.1} s, {:.0} presses a minute; {} left out: \
         {unseen}\n",
        out.display(),
        60.0 * count as f64 / seconds,
        wanted - count
    ))
}

fn jobs(arguments: &Simulate) -> usize {
    arguments.jobs.unwrap_or_else(simulated::all_cores)
}
