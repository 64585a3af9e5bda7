//! Tests of reading files back, and of joining them.

use std::io::Cursor;
use std::path::Path;

use serde_json::json;

use super::*;
use hardnessd_core::npy::Header;
use hardnessd_core::npz::{Element, Writer};
use hardnessd_core::verdict::{COLS, ROWS, TAXELS, sha256_hex};
use hardnessd_simulator::{CourseSettings, DatasetSettings, Materials};

/// Single frames: 4 levels x 10 objects x 5 presses.
fn frames() -> Presses {
    let mut presses = Presses::default();
    for i in 0..200_u32 {
        let mut frame = ModelFrame::default();
        frame.newtons[(i / 50) as usize] = i as f32;
        frame.newtons[700] = -0.01;
        let press = Press {
            level: (i / 50) as u8 + 1,
            object: Some(i / 5),
            material: Some((i / 50) as u8),
            force_n: Some(2.5),
            shore: Some(70.0),
            ..Press::default()
        };
        presses.push(press, [(0.0, None, frame)].into_iter());
    }
    presses
}

/// Presses over time.
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
    let mut all = Presses::of_courses(&hardnessd_simulator::courses(&settings, 2, |_| ()));
    // Of every second press, the robot reports nothing.
    for press in all.all.iter_mut().step_by(2) {
        press.arm_n_per_mm = 0.0;
        all.approach_mm[press.moments.clone()].fill(None);
    }
    all
}

fn bytes_of(presses: &Presses, layout: Layout, meta: &serde_json::Value) -> Vec<u8> {
    let out = write(Cursor::new(Vec::new()), presses, layout, meta);
    out.unwrap().into_inner()
}

fn parse(bytes: &[u8]) -> Result<Presses, DatasetError> {
    file::parse(bytes, Path::new("D.npz"))
}

/// The same presses without their files.
fn without_files(presses: Presses) -> Presses {
    Presses {
        sources: Vec::new(),
        paths: Vec::new(),
        ..presses
    }
}

#[test]
fn a_file_gives_back_what_was_written() {
    for (presses, layout) in [(frames(), Layout::Frames), (courses(), Layout::OverTime)] {
        let bytes = bytes_of(&presses, layout, &json!({"seed": 7}));
        let read = parse(&bytes).unwrap();
        assert_eq!(read.sources[0].seed, Some(7));
        assert_eq!(read.sources[0].sha256, sha256_hex(&bytes));
        assert!(without_files(read) == presses, "{layout:?}");
        // The file holds no date: the same presses give the same bytes.
        assert_eq!(bytes, bytes_of(&presses, layout, &json!({"seed": 7})));
    }
}

#[test]
fn the_best_frame_has_the_largest_contact_area() {
    let presses = courses();
    assert!(presses.all.len() >= 6 && presses.are_over_time() && !frames().are_over_time());
    for place in 0..presses.all.len() {
        let area = |frame: &ModelFrame| frame.contact_area_taxels(0.07);
        let course = presses.course(place);
        let most = course
            .moments
            .iter()
            .map(|moment| area(&moment.frame))
            .max();
        assert_eq!(most, Some(area(&presses.frame(place))), "press {place}");
    }
}

#[test]
fn sensors_and_references_are_kept_and_checked() {
    let mut presses = courses();
    let pieces = [
        (1, Reference::Flat { width_mm: 20.0 }),
        (3, Reference::Ball { radius_mm: 7.5 }),
    ];
    for (place, reference) in pieces {
        let press = &mut presses.all[place];
        (press.level, press.reference) = (0, Some(reference));
        (press.shore, press.sensor) = (None, place as u32);
    }
    let read = |presses: &Presses| parse(&bytes_of(presses, Layout::OverTime, &json!({})));
    assert!(without_files(read(&presses).unwrap()) == presses);
    presses.all[3].level = 2;
    let error = read(&presses).unwrap_err().to_string();
    let expected = "`level`: found 2 of press 3, a reference, expected 0";
    assert!(error.contains(expected), "{error}");
}

#[test]
fn presses_over_time_that_contradict_themselves_are_refused() {
    let good = courses();
    let check = |change: &dyn Fn(&mut Presses), part: &str| {
        let mut bad = good.clone();
        change(&mut bad);
        let error = parse(&bytes_of(&bad, Layout::OverTime, &json!({})))
            .unwrap_err()
            .to_string();
        assert!(error.contains(part), "{error}");
    };
    check(&|bad| bad.time_s[1] = -9.0, "array `time_s`: found times");
    check(&|bad| bad.time_s[1] = f32::NAN, "array `time_s`: found NaN");
    check(
        &|bad| {
            let rows = bad.all[0].moments.clone();
            let count = rows.len() as f32;
            rows.for_each(|row| bad.time_s[row] = row as f32 - count);
        },
        "array `time_s`: found 0 frames at 0 s or later in press 0, expected 1 to 48",
    );
    check(
        &|bad| {
            // All frames become those of one press, which are too many.
            bad.all[0].moments = 0..bad.frames.len();
            bad.all.truncate(1);
            (0..bad.frames.len()).for_each(|row| bad.time_s[row] = row as f32);
        },
        "frames at 0 s or later in press 0, expected 1 to 48",
    );
    check(
        &|bad| bad.all[0].best = 99_999,
        "array `best`: found 99999 of press 0",
    );
    check(&|bad| bad.all[0].level = 5, "array `level`: found 5");
    check(
        &|bad| {
            let first = bad.all[0].moments.clone();
            bad.all[0].moments = first.start..first.end - 1;
        },
        "array `press`",
    );
}

type Npz = Writer<Cursor<Vec<u8>>>;

/// The bytes of a file with the arrays that `fill` adds.
fn npz(fill: impl FnOnce(&mut Npz)) -> Vec<u8> {
    let mut npz = Writer::plain(Cursor::new(Vec::new()));
    fill(&mut npz);
    npz.finish().unwrap().into_inner()
}

/// Adds `n` frames whose taxels are all `newtons`.
fn add_frames(npz: &mut Npz, n: usize, newtons: f32) {
    let frames = vec![newtons; n * TAXELS];
    npz.add("frames", &[n, ROWS, COLS], &frames).unwrap();
}

#[test]
fn optional_arrays_may_be_missing() {
    let read = parse(&npz(|npz| {
        add_frames(npz, 3, 0.0);
        npz.add_list("level", &[0_u8, 1, 4]).unwrap();
    }));
    let read = read.unwrap();
    let mut all = read.all.iter();
    assert!(all.all(|press| press.split == Split::Train && press.object.is_none()));
    assert_eq!(read.some_labelled(Split::Train).unwrap(), [1, 2]);
    let error = read.some_labelled(Split::Test).unwrap_err().to_string();
    assert_eq!(
        error,
        "D.npz: no press of the test split has a level: add some with `collect --append --split \
         test --level L`"
    );
}

/// Adds an array of a type or an order that our own writer does not use.
fn add_as(npz: &mut Npz, name: &str, descr: &str, is_fortran: bool, shape: &[usize], bytes: &[u8]) {
    let header = Header {
        descr: descr.to_owned(),
        fortran_order: is_fortran,
        shape: shape.to_vec(),
    };
    npz.add_npy(name, &[&header.to_bytes(), bytes].concat())
        .unwrap();
}

#[test]
fn more_frames_than_fit_in_memory_are_an_error() {
    let shape = [9_999_999_999_999, ROWS, COLS];
    let bytes = npz(|npz| add_as(npz, "frames", "<f4", false, &shape, &[0; 4 * TAXELS]));
    let error = parse(&bytes).unwrap_err().to_string();
    assert!(error.contains("array `frames`: found"), "{error}");
}

#[test]
fn a_file_that_unpacks_to_far_more_than_it_has_is_an_error() {
    let mut npz = Writer::compressed(Cursor::new(Vec::new()));
    add_frames(&mut npz, 1, 0.0);
    npz.add_list("level", &[1_u8]).unwrap();
    // 32 MB of spaces around a null are JSON too.
    npz.add_list("meta", &vec![b' '; 32 << 20]).unwrap();
    let bytes = npz.finish().unwrap().into_inner();
    assert!(bytes.len() < 64 << 10, "{}", bytes.len());
    let error = parse(&bytes).unwrap_err().to_string();
    let expected = "array `meta`: found 33554432 bytes packed into";
    assert!(error.contains(expected), "{error}");
}

#[test]
fn an_array_in_fortran_order_is_the_same_array() {
    const N: usize = 3;
    let taxel = |n: usize, row: usize, col: usize| (n * 1000 + row * COLS + col) as f32;
    let in_c = (0..N * TAXELS).map(|k| taxel(k / TAXELS, k / COLS % ROWS, k % COLS));
    let in_fortran = (0..N * TAXELS).map(|k| taxel(k % N, k / N % ROWS, k / N / ROWS));
    let parse = |is_fortran, taxels: Vec<f32>| {
        let bytes: Vec<u8> = taxels
            .iter()
            .flat_map(|newtons| newtons.to_le_bytes())
            .collect();
        let file = npz(|npz| {
            add_as(npz, "frames", "<f4", is_fortran, &[N, ROWS, COLS], &bytes);
            npz.add_list("level", &[1_u8, 2, 3]).unwrap();
        });
        without_files(parse(&file).unwrap())
    };
    assert!(parse(true, in_fortran.collect()) == parse(false, in_c.collect()));
}

#[test]
fn numbers_of_the_types_that_numpy_makes_by_default_are_converted() {
    let frames = 0.5_f64.to_le_bytes().repeat(2 * TAXELS);
    let numbers = [1_i64.to_le_bytes(), 4_i64.to_le_bytes()].concat();
    let file = npz(|npz| {
        add_as(npz, "frames", "<f8", false, &[2, ROWS, COLS], &frames);
        add_as(npz, "level", "<i8", false, &[2], &numbers);
        add_as(npz, "force", "<i8", false, &[2], &numbers);
    });
    let presses = parse(&file).unwrap();
    assert_eq!(presses.frame(0).newtons, [0.5; TAXELS]);
    let labels = presses.all.iter().map(|press| (press.level, press.force_n));
    assert_eq!(labels.collect::<Vec<_>>(), [(1, Some(1.0)), (4, Some(4.0))]);
}

#[test]
fn what_is_not_as_agreed_is_named_with_what_was_found_and_expected() {
    fn check(fill: impl FnOnce(&mut Npz), expected: &str) {
        let error = parse(&npz(fill)).unwrap_err().to_string();
        assert!(error.starts_with("D.npz: "), "{error}");
        assert!(
            error.contains(expected),
            "{error}\nshould contain\n{expected}"
        );
    }
    /// Two frames of level 1, and one more array.
    fn check_with<T: Element>(name: &str, elements: &[T], expected: &str) {
        let fill = |npz: &mut Npz| {
            add_frames(npz, 2, 0.0);
            if name != "level" {
                npz.add_list("level", &[1_u8, 1]).unwrap();
            }
            npz.add_list(name, elements).unwrap();
        };
        check(fill, expected);
    }
    check(|_| {}, "array `frames`: found none, expected f32 [N,28,28]");
    check(
        |npz| {
            npz.add("frames", &[1, 27, COLS], &[0.0_f32; 27 * COLS])
                .unwrap();
        },
        "array `frames`: found f32 [1, 27, 28], expected f32 [N,28,28]",
    );
    check(
        |npz| add_frames(npz, 0, 0.0),
        "array `frames`: found no frame, expected at least one",
    );
    check(
        |npz| add_frames(npz, 2, f32::NAN),
        "array `frames`: found NaN at [0,0,0], expected newtons from -1e6 to 1e6",
    );
    check(
        |npz| add_frames(npz, 2, 0.0),
        "array `level`: found none, expected u8 [2]",
    );
    for (array, expected) in [("force", "-1000000 to 1000000"), ("shore", "0 to 100")] {
        let expected = format!("array `{array}`: found inf at 1, expected {expected}");
        check_with(array, &[1.0, f32::INFINITY], &expected);
    }
    for (level, expected) in [
        (0.5, "found 0.5 at 1, expected u8 [2]"),
        (-1.0, "found -1.0 at 1, expected u8 [2]"),
        (5.0, "found 5 at 1, expected 0 (unlabelled) to 4"),
    ] {
        check_with(
            "level",
            &[1.0_f32, level],
            &format!("array `level`: {expected}"),
        );
    }
    check_with(
        "object",
        &[1_u32],
        "array `object`: found u32 [1], expected u32 [2]",
    );
    check_with("meta", b"{", "array `meta`: found EOF");
    check_with(
        "meta",
        br#"{"pitch_mm":-1}"#,
        "array `meta`: found pitch_mm -1, expected millimetres from 0.01 to 1000",
    );
    let error = parse(b"PK no zip").unwrap_err().to_string();
    assert!(error.starts_with("D.npz: not an .npz file"), "{error}");
}

#[test]
fn a_file_may_have_up_to_sixteen_levels_of_its_own() {
    let levels = |count: u8| {
        let level = |level| json!({"level": level, "label": format!("L{level}"), "shore": "-"});
        (1..=count).map(level).collect::<Vec<_>>()
    };
    let read = |count, level| {
        parse(&npz(|npz| {
            add_frames(npz, 1, 0.0);
            npz.add_list("level", &[level]).unwrap();
            let meta = json!({"levels": levels(count)}).to_string();
            npz.add_list("meta", meta.as_bytes()).unwrap();
        }))
    };
    assert_eq!(read(2, 2_u8).unwrap().levels().len(), 2);
    assert_eq!(read(16, 16).unwrap().levels()[15].label, "L16");
    let error = read(3, 4).unwrap_err().to_string();
    assert!(
        error.contains("found 4 at 0, expected 0 (unlabelled) to 3"),
        "{error}"
    );
    assert!(
        read(17, 1)
            .unwrap_err()
            .to_string()
            .contains("2 to 16 levels")
    );
}

#[test]
fn an_object_in_both_splits_is_found() {
    let (train, test, three) = (Split::Train, Split::Test, Some(3));
    for (pair, expected) in [
        ([(train, three, None, 1), (test, three, None, 1)], three),
        ([(test, three, None, 0), (train, three, None, 1)], three),
        ([(train, three, None, 0), (test, three, None, 1)], three),
        ([(test, three, None, 1), (test, three, None, 1)], None),
        ([(train, three, None, 1), (test, Some(4), None, 1)], None),
        ([(train, None, None, 1), (test, None, None, 1)], None),
        // Object numbers begin anew for each level, or for each material.
        ([(train, three, None, 1), (test, three, None, 2)], None),
        (
            [(train, three, Some(5), 1), (test, three, Some(6), 1)],
            None,
        ),
    ] {
        let of = |(split, object, material, level)| Press {
            level,
            object,
            material,
            split,
            ..Press::default()
        };
        let presses = pair.map(of);
        let presses = presses.iter();
        let presses = presses.filter_map(|press| Some((press.pressed()?, press.split)));
        assert_eq!(source::object_in_both_splits(presses), expected, "{pair:?}");
    }
}

#[test]
fn joined_files_keep_objects_and_sensors_apart_while_they_can_be_counted_and_their_pitch_is_one() {
    let directory = tempfile::tempdir().unwrap();
    let joined = |parts: [(u32, Option<f64>); 2]| {
        let paths: Vec<PathBuf> = ["a", "b"].map(|name| directory.path().join(name)).into();
        for ((last, pitch_mm), path) in parts.into_iter().zip(&paths) {
            let mut presses = Presses::default();
            for object in [0, last] {
                let press = Press {
                    level: 1,
                    object: Some(object),
                    ..Press::default()
                };
                presses.push(press, [(0.0, None, ModelFrame::default())].into_iter());
            }
            let meta = pitch_mm.map_or(json!({}), |mm| json!({ "pitch_mm": mm }));
            std::fs::write(path, bytes_of(&presses, Layout::Frames, &meta)).unwrap();
        }
        Presses::read(&paths)
    };
    let two = joined([(4, None), (4, None)]).unwrap();
    let found: Vec<_> = two
        .all
        .iter()
        .map(|press| (press.object, press.sensor))
        .collect();
    assert_eq!(
        found,
        [(0, 0), (4, 0), (5, 1), (9, 1)].map(|(object, s)| (Some(object), s))
    );
    let most = joined([(2, None), (u32::MAX - 3, None)]).unwrap();
    assert_eq!(most.all[3].object, Some(u32::MAX));
    for (parts, expected) in [
        (
            [(2, None), (u32::MAX - 2, None)],
            "b: array `object`: found 4294967293, expected no number that, after 3",
        ),
        (
            [(u32::MAX, None), (0, None)],
            "b: array `object`: found 0, expected no number that, after 4294967296",
        ),
        (
            [(1, None), (1, Some(2.0))],
            "b: taxel pitch: found 2 mm, expected 3.5 mm, that of",
        ),
    ] {
        let error = joined(parts).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
    assert_eq!(
        joined([(1, Some(2.0)), (1, Some(2.0))]).unwrap().pitch_mm(),
        2.0
    );
}

#[test]
fn the_pitches_of_a_model_are_those_of_its_training_presses() {
    let source = |pitches_mm| Source {
        pitches_mm,
        ..Source::default()
    };
    let of_source = |source| Press {
        source,
        ..Press::default()
    };
    let presses = Presses {
        all: [0, 1, 2].map(of_source).into(),
        sources: vec![
            source(Some([2.0, 5.0])),
            source(None),
            source(Some([1.0, 9.0])),
        ],
        ..Presses::default()
    };
    // The last file has test presses only.
    assert_eq!(presses.pitches_mm(&[0, 1]), Some([2.0, 5.0]));
    assert_eq!(presses.pitches_mm(&[1]), None);
    assert_eq!(presses.pitches_mm(&[0, 2]), Some([1.0, 9.0]));
}

#[test]
fn the_array_and_what_it_reads_unloaded_come_back() {
    let array = Array { rows: 3, cols: 2 };
    let mut presses = Presses::default();
    let moments = [0.0, 1.0].map(|time_s| {
        let mut frame = ModelFrame::default();
        // The array lies in the middle: its first taxel is at row 12 and column 13.
        frame.newtons[12 * COLS + 13] = 1.0 + time_s;
        frame.newtons[14 * COLS + 14] = -0.5;
        (time_s, None, frame)
    });
    let press = Press {
        unloaded: Some(vec![0.0, 0.25, 0.0, 0.0, 0.0, 3.0]),
        ..Press::default()
    };
    presses.push(press, moments.into_iter());
    let meta = json!({"grid": [3, 2], "pitch_mm": 5.0});
    let read = parse(&bytes_of(&presses, Layout::OverTime, &meta)).unwrap();
    assert_eq!(read.grid(), Some(array));
    assert_eq!(read.all[0].unloaded, presses.all[0].unloaded);
    let parts = read.parts(0, array);
    assert_eq!(parts[..6], [1.0, 0.0, 0.0, 0.0, 0.0, -0.5]);
    assert_eq!(parts[42..], [2.0, 0.0, 0.0, 0.0, 0.0, -0.5]);
}
