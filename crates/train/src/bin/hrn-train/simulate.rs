//! `hrn-train simulate`.

use std::time::Instant;

use hardnessd_core::frame::RawFrame;
use hardnessd_simulator::{
    Borders, CourseSettings, DatasetSettings, Laws, Material, Materials, Sequence, SequenceSettings,
};
use hrn_train::data::simulated;
use hrn_train::judge::sheet;

use super::arguments::Simulate;
use super::failure::{NoObjects, OtherMaterials};
use super::files::{apart, write};

/// The settings of the simulation.
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

pub(super) fn simulate(arguments: &Simulate) -> anyhow::Result<String> {
    let settings = simulated_settings(arguments)?;
    if settings.objects == 0 && settings.test_objects == 0 {
        return Err(NoObjects.into());
    }
    if let Some(sheet) = &arguments.sheet {
        apart("--sheet", sheet, [arguments.out.as_path()])?;
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
    let (asked, usual) = (&arguments.courses, CourseSettings::default());
    let settings = CourseSettings {
        objects,
        frame_rate_hz: asked.fps.unwrap_or(usual.frame_rate_hz),
        speed_mm_s: asked.speed.unwrap_or(usual.speed_mm_s),
        arm_n_per_mm: asked.arm.unwrap_or(usual.arm_n_per_mm),
        hold_s: asked.hold.unwrap_or(usual.hold_s),
        position_error: asked.position_error.unwrap_or(usual.position_error),
        arm_error: asked.arm_error.unwrap_or(usual.arm_error),
        clock_error_frames: asked.clock_error.unwrap_or(usual.clock_error_frames),
        unknown_share: asked.unknown.unwrap_or(usual.unknown_share),
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

/// One press of each training material, as the frames that the sensor sends over time.
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
