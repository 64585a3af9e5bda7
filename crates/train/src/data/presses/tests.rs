//! Tests of reading files back, and of joining them.

use std::io::{Cursor, Write as _};

use serde_json::{Value, json};

use super::*;
use hardnessd_core::npy::Header;
use hardnessd_core::npz::Writer;
use hardnessd_core::verdict::{BUILT_IN_HRN, Model, TAXELS};
use hardnessd_simulator::{CourseSettings, DatasetSettings, Materials};

/// Single frames: 4 levels x 2 objects x 3 presses.
fn frames() -> Presses {
    let mut presses = Presses::default();
    for i in 0..24_u32 {
        let mut frame = ModelFrame::default();
        frame.newtons[(i / 6) as usize] = i as f32;
        frame.newtons[700] = -0.01;
        let press = Press {
            level: (i / 6) as u8 + 1,
            object: Some(i / 3),
            material: Some((i / 6) as u8),
            force_n: Some(2.5),
            shore: Some(70.0).filter(|_| i > 0),
            kind: [Kind::Simulated, Kind::Recorded][usize::from(i > 9)],
            ..Press::default()
        };
        presses.push(press, [(0.0, None, frame.newtons)]);
    }
    presses
}

/// Presses over time, two of them on rigid pieces.
fn courses() -> Presses {
    let settings = CourseSettings {
        objects: DatasetSettings {
            seed: 2,
            materials: Materials::Broad,
            objects: 1,
            test_objects: 0,
            presses: 2,
            ..DatasetSettings::default()
        },
        ..CourseSettings::default()
    };
    let courses = hardnessd_simulator::courses(&settings).into_iter();
    let courses = courses.flat_map(|make| make()).flatten();
    let mut presses = Presses::of_courses(courses);
    for (place, reference) in [
        (1, Piece::Flat { width_mm: 20.0 }),
        (3, Piece::Ball { radius_mm: 7.5 }),
    ] {
        let press = &mut presses.all[place];
        (press.level, press.reference) = (0, Some(reference));
        (press.shore, press.sensor) = (None, place as u32);
        // The robot reports nothing of these.
        presses.approach_mm[press.moments.clone()].fill(None);
    }
    presses
}

fn bytes_of(presses: &Presses, layout: Layout, meta: &Value) -> Vec<u8> {
    let npz = Writer::new(Cursor::new(Vec::new()));
    let out = write(npz, presses, layout, meta);
    out.unwrap().into_inner()
}

fn parse(bytes: &[u8]) -> anyhow::Result<Presses> {
    file::parse(bytes, Path::new("D.npz"))
}

#[track_caller]
fn assert_refused(bytes: &[u8], expected: &str) {
    let error = format!("{:#}", parse(bytes).unwrap_err());
    assert!(
        error.starts_with("D.npz: ") && error.contains(expected),
        "{error}\nshould contain\n{expected}"
    );
}

/// The same presses without their files.
fn without_files(presses: Presses) -> Presses {
    Presses {
        sources: Vec::new(),
        ..presses
    }
}

#[test]
fn a_file_gives_back_what_was_written() {
    for (presses, layout) in [(frames(), Layout::Frames), (courses(), Layout::OverTime)] {
        let bytes = bytes_of(&presses, layout, &json!({"seed": 7}));
        let read = parse(&bytes).unwrap();
        assert_eq!(read.sources[0].seed, Some(7));
        assert!(without_files(read) == presses, "{layout:?}");
        // Packed piece by piece, the arrays are the same.
        let npz = Writer::in_chunks(Cursor::new(Vec::new()));
        let packed = write(npz, &presses, layout, &json!({})).unwrap();
        let read = parse(&packed.into_inner()).unwrap();
        assert!(without_files(read) == presses, "{layout:?}");
        // The file holds no date: the same presses give the same bytes.
        assert_eq!(bytes, bytes_of(&presses, layout, &json!({"seed": 7})));
    }
}

#[test]
fn counts_below_a_millinewton_are_kept() {
    let mut presses = Presses::default();
    presses.push(Press::default(), [(0.0, None, [0.0004; TAXELS])]);
    let read = parse(&bytes_of(&presses, Layout::OverTime, &json!({}))).unwrap();
    assert!((read.frames.frame(0).newtons[0] - 0.0004).abs() < 1e-9);
}

/// A press of two frames on an array of its own.
fn of_grid(array: Array, pitch_mm: f64, press: Press, frames: [[f32; TAXELS]; 2]) -> Presses {
    let mut presses = Presses::default();
    let times_s = [0.0, 1.0].into_iter();
    let moments = times_s
        .zip(frames)
        .map(|(time_s, newtons)| (time_s, None, newtons));
    presses.push(press, moments);
    presses.sources.push(Source {
        grid: Some(Grid { array, pitch_mm }),
        ..Source::default()
    });
    presses
}

#[test]
fn an_array_larger_than_the_frames_has_its_parts_beside_them() {
    let array = Array { rows: 64, cols: 32 };
    let parts: Vec<f32> = (0..8 * array.taxels()).map(|n| n as f32 / 7.0).collect();
    let press = Press {
        parts: Some(parts.clone()),
        contact_area_taxels: Some(40),
        force_n: Some(900.0),
        ..Press::default()
    };
    let mut presses = of_grid(array, 1.5, press, [[0.5; TAXELS]; 2]);
    let read = |presses: &Presses, grid: Value| bytes_of(presses, Layout::OverTime, &grid);
    let meta = json!({"grid": [64, 32], "grid_pitch_mm": 1.5});
    let found = parse(&read(&presses, meta.clone())).unwrap();
    assert_eq!((found.grid(), found.pitch_mm()), (presses.grid(), 3.5));
    assert_eq!(found.parts(0, array), parts);
    assert_eq!(found.all[0].contact_area_taxels, Some(40));
    assert_eq!(found.force_n(0), 900.0);
    // Without the distance the array says nothing.
    let found = parse(&read(&presses, json!({"grid": [64, 32]}))).unwrap();
    assert_eq!(found.grid(), None);
    // Parts of another array are not written as those of this one.
    presses.all[0].parts = Some(parts[1..].to_vec());
    assert_eq!(presses.grid(), None);
    let expected = "array `parts`: found none, expected f32 [1,8,64,32]";
    assert_refused(&read(&presses, meta), expected);
}

#[test]
fn the_array_and_what_it_reads_unloaded_come_back() {
    let array = Array { rows: 3, cols: 2 };
    let frames = [1.0, 2.0].map(|first| {
        let mut newtons = [0.0; TAXELS];
        // The array lies in the middle: its first taxel is at row 12 and column 13.
        newtons[12 * COLS + 13] = first;
        newtons[14 * COLS + 14] = -0.5;
        newtons
    });
    let press = Press {
        unloaded: Some(vec![0.0, 0.25, 0.0, 0.0, 0.0, 3.0]),
        ..Press::default()
    };
    let presses = of_grid(array, 5.0, press, frames);
    let meta = json!({"grid": [3, 2], "pitch_mm": 5.0});
    let read = parse(&bytes_of(&presses, Layout::OverTime, &meta)).unwrap();
    assert_eq!((read.grid(), read.pitch_mm()), (presses.grid(), 5.0));
    assert_eq!(read.all[0].unloaded, presses.all[0].unloaded);
    let parts = read.parts(0, array);
    assert_eq!(parts[..6], [1.0, 0.0, 0.0, 0.0, 0.0, -0.5]);
    assert_eq!(parts[42..], [2.0, 0.0, 0.0, 0.0, 0.0, -0.5]);

    // A model of another pitch gets what the daemon would give it.
    let own = |first: f32| Frame {
        array,
        newtons: [first, 0.0, 0.0, 0.0, 0.0, -0.5].into(),
    };
    let resampling = Resampling::new(&own(1.0), Pitch::square(5.0), 3.5);
    let mut model = Model::load(BUILT_IN_HRN).unwrap().card().clone();
    let course = read.course_for(0, &model).moments;
    let found: Vec<ModelFrame> = course.iter().map(|moment| moment.frame).collect();
    let expected = [1.0, 2.0].map(|first| resampling.apply(&own(first)));
    assert_eq!(found, expected);
    assert_eq!(read.frame_for(0, &model), expected[0]);
    assert_ne!(read.frame_for(0, &model), read.frame(0));
    model.pitch_mm = 5.0;
    assert_eq!(read.frame_for(0, &model), read.frame(0));
}

#[test]
fn presses_over_time_that_contradict_themselves_are_refused() {
    let check = |expected: &str, change: fn(&mut Presses)| {
        let mut bad = courses();
        change(&mut bad);
        assert_refused(&bytes_of(&bad, Layout::OverTime, &json!({})), expected);
    };
    let used = "expected 1 to 48 of these, and all ascending";
    check(used, |bad| bad.time_s[1] = -9.0);
    check("array `time_s`: found NaN", |bad| bad.time_s[1] = f32::NAN);
    // A press without a frame after its begin.
    check(used, |bad| {
        bad.time_s[bad.all[0].moments.clone()].fill(-1.0);
    });
    let best = "array `best`: found 99999 of press 0";
    check(best, |bad| bad.all[0].best = 99_999);
    check("array `level`: found 5", |bad| bad.all[0].level = 5);
    let reference = "`level`: found 2 of press 3, a reference, expected 0";
    check(reference, |bad| bad.all[3].level = 2);
    check("array `press`", |bad| bad.all[0].moments.end -= 1);
}

type Npz = Writer<Cursor<Vec<u8>>>;

/// The bytes of a file with the arrays that `fill` adds.
fn npz(fill: impl FnOnce(&mut Npz)) -> Vec<u8> {
    let mut npz = Writer::new(Cursor::new(Vec::new()));
    fill(&mut npz);
    npz.finish().unwrap().into_inner()
}

/// Adds `n` frames whose taxels are all `newtons`.
fn add_frames(npz: &mut Npz, n: usize, newtons: f32) {
    let frames = vec![newtons; n * TAXELS];
    npz.add("frames", &[n, ROWS, COLS], &frames).unwrap();
}

/// Adds an array of a type that our own writer does not use to a file.
fn with_array(file: Vec<u8>, name: &str, descr: &str, shape: &[usize], bytes: &[u8]) -> Vec<u8> {
    let header = Header {
        descr: descr.to_owned(),
        fortran_order: false,
        shape: shape.to_vec(),
    };
    let mut zip = zip::ZipWriter::new_append(Cursor::new(file)).unwrap();
    let options = zip::write::SimpleFileOptions::default();
    zip.start_file(format!("{name}.npy"), options).unwrap();
    zip.write_all(&header.to_bytes()).unwrap();
    zip.write_all(bytes).unwrap();
    zip.finish().unwrap().into_inner()
}

#[test]
fn arrays_may_be_missing_or_of_the_types_that_numpy_makes() {
    let taxels = (0..3 * TAXELS).flat_map(|place| (place as f64).to_le_bytes());
    let levels = [0_i64, 1, 4].into_iter().flat_map(i64::to_le_bytes);
    let (taxels, levels): (Vec<u8>, Vec<u8>) = (taxels.collect(), levels.collect());
    let file = with_array(npz(|_| {}), "frames", "<f8", &[3, ROWS, COLS], &taxels);
    let file = with_array(file, "level", "<i8", &[3], &levels);
    let presses = parse(&file).unwrap();
    assert_eq!(presses.frame(2).newtons[3], (2 * TAXELS + 3) as f32);
    let mut all = presses.all.iter();
    assert!(all.all(|press| press.split == Split::Train && press.object.is_none()));
    assert_eq!(presses.some_labelled(Split::Train).unwrap(), [1, 2]);
}

#[test]
fn a_small_file_cannot_fill_the_memory() {
    let shape = [9_999_999_999_999, ROWS, COLS];
    let level = npz(|npz| npz.add_list("level", &[1_u8]).unwrap());
    let huge = with_array(level, "frames", "<f4", &shape, &[0; 4 * TAXELS]);
    assert_refused(&huge, "array `frames`: found");
    // 32 MB of spaces are JSON too.
    let spaces = npz(|npz| npz.add_list("meta", &vec![b' '; 32 << 20]).unwrap());
    assert!(spaces.len() < 64 << 10, "{}", spaces.len());
    assert_refused(
        &spaces,
        "array `meta`: found 33554432 bytes, where 16777216 are left",
    );
    // Each array may be there, and not both.
    let both = npz(|npz| {
        add_frames(npz, 3000, 0.0);
        npz.add_list("level", &[1_u8; 3000]).unwrap();
        let array = vec![0.0_f32; 3000 * TAXELS];
        npz.add("unloaded", &[3000, ROWS, COLS], &array).unwrap();
        let meta = json!({"grid": [ROWS, COLS]}).to_string();
        npz.add_list("meta", meta.as_bytes()).unwrap();
    });
    assert_refused(&both, "array `unloaded`: found 9408000 bytes, where ");
}

#[test]
fn what_is_too_large_for_memory_is_refused() {
    let mut full = Presses {
        bytes: MOST_BYTES,
        ..Presses::default()
    };
    let error = full.append(courses()).unwrap_err().to_string();
    let expected = "the presses take more than 8 GB of memory: use fewer at a time";
    assert_eq!(error, expected);
    let file = tempfile::NamedTempFile::new().unwrap();
    file.as_file().set_len(5 << 30).unwrap();
    let error = read_one(file.path()).unwrap_err();
    let expected = "found more than 4 GB, expected less: name several smaller files";
    assert!(format!("{error:#}").ends_with(expected), "{error:#}");
}

/// Asserts that a file is refused that has two levels and the arrays that `fill` adds.
#[track_caller]
fn check(expected: &str, fill: impl FnOnce(&mut Npz)) {
    let bytes = npz(|npz| {
        fill(npz);
        npz.add_list("level", &[1_u8, 1]).unwrap();
    });
    assert_refused(&bytes, expected);
}

#[test]
fn what_is_not_as_agreed_is_named_with_what_was_found_and_expected() {
    assert_refused(&npz(|_| {}), "array `level`: found none, expected u8 [N]");
    assert_refused(b"PK no zip", "not an .npz file");
    check("array `frames`: found none, expected f32 [2,28,28]", |_| {});
    let expected = "array `frames`: found an array of shape [1, 28, 28], expected f32 [2,28,28]";
    check(expected, |npz| add_frames(npz, 1, 0.0));
    let expected = "array `frames`: found NaN at 0, expected -1000000 to 1000000";
    check(expected, |npz| add_frames(npz, 2, f32::NAN));
    check("array `shore`: found inf at 1, expected 0 to 100", |npz| {
        add_frames(npz, 2, 0.0);
        npz.add_list("shore", &[1.0, f32::INFINITY]).unwrap();
    });
    for (meta, expected) in [
        (&b"{"[..], "found EOF"),
        (b"{\"pitch_mm\":-1}", "found pitch_mm -1, expected milli"),
        (b"{\"grid_pitch_mm\":0}", "found grid_pitch_mm 0, expected"),
    ] {
        let expected = format!("array `meta`: {expected}");
        check(&expected, |npz| npz.add_list("meta", meta).unwrap());
    }
    for (level, expected) in [
        (0.5, "found 0.5 at 1, expected u8 [N]"),
        (-1.0, "found -1.0 at 1, expected u8 [N]"),
        (5.0, "found 5 at 1, expected 0 to 4"),
    ] {
        let bytes = npz(|npz| npz.add_list("level", &[1.0_f32, level]).unwrap());
        assert_refused(&bytes, &format!("array `level`: {expected}"));
    }
}

#[test]
fn a_file_may_have_up_to_sixteen_levels_of_its_own() {
    let file = |count: u8, level: u8| {
        let of = |level| json!({"level": level, "label": format!("L{level}"), "shore": "-"});
        let levels: Vec<Value> = (1..=count).map(of).collect();
        let mut presses = frames();
        presses.all.iter_mut().for_each(|press| press.level = level);
        bytes_of(&presses, Layout::Frames, &json!({"levels": levels}))
    };
    assert_eq!(parse(&file(16, 16)).unwrap().levels()[15].label, "L16");
    assert_refused(&file(3, 4), "found 4 at 0, expected 0 to 3");
    assert_refused(&file(17, 1), "2 to 16 levels");
}

#[test]
fn objects_of_one_number_and_two_materials_are_two() {
    let press = |material, object| Press {
        level: 1,
        object,
        material,
        ..Press::default()
    };
    let (oak, pine) = (Some(0), Some(1));
    let all = [
        (pine, Some(0)),
        (oak, Some(0)),
        (oak, Some(1)),
        (oak, Some(0)),
        (oak, None),
        (oak, None),
    ];
    let presses = Presses {
        all: all.map(|(material, object)| press(material, object)).into(),
        ..Presses::default()
    };
    let objects = presses.by_object(&[0, 1, 2, 3, 4, 5]);
    let objects: Vec<Vec<usize>> = objects.into_values().collect();
    assert_eq!(objects, [vec![1, 3], vec![0], vec![2], vec![5], vec![4]]);
}

#[test]
fn joined_files_keep_objects_and_sensors_apart_and_have_one_pitch() {
    let part = |last: u32, pitch_mm: f64| {
        let mut presses = frames();
        presses.all.truncate(2);
        (presses.all[0].object, presses.all[1].object) = (Some(0), Some(last));
        presses.sources = vec![Source {
            pitch_mm: Some(pitch_mm),
            ..Source::default()
        }];
        presses
    };
    let mut all = part(4, 3.5);
    all.join(part(9, 3.5)).unwrap();
    let found = all.all.iter().map(|press| (press.object, press.sensor));
    let expected = [(0, 0), (4, 0), (5, 1), (6, 1)].map(|(object, sensor)| (Some(object), sensor));
    assert!(found.eq(expected), "{all:?}");
    for (first, second, expected) in [
        (u32::MAX, 3.5, "no numbers are left"),
        (4, 2.0, "taxel pitch: found 2 mm, expected 3.5 mm, that of"),
    ] {
        let refused = part(first, 3.5).join(part(4, second));
        let error = refused.unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
}

#[test]
fn the_pitches_of_a_model_are_those_of_its_training_presses() {
    let mut presses = frames();
    let pitches_mm = [Some([2.0, 5.0]), None, Some([1.0, 9.0])];
    presses.sources = pitches_mm
        .map(|pitches_mm| Source {
            pitches_mm,
            ..Source::default()
        })
        .into();
    for (source, press) in presses.all.iter_mut().take(3).enumerate() {
        press.source = source;
    }
    assert_eq!(presses.pitches_mm(&[0, 1]), Some([2.0, 5.0]));
    assert_eq!(presses.pitches_mm(&[1]), None);
    assert_eq!(presses.pitches_mm(&[0, 2]), Some([1.0, 9.0]));
}
