//! Tests of reading files back and of choosing samples.

use std::io::Cursor;

use super::*;
use hardnessd_core::npy::Header;
use hardnessd_core::npz::{Element, Writer};
use hardnessd_core::verdict::{COLS, ROWS, TAXELS, sha256_hex};

fn sample(level: u8, object: u32, split: Split) -> Sample {
    let mut frame = ModelFrame::default();
    frame.newtons[usize::from(level)] = object as f32;
    Sample {
        frame,
        level,
        object: Some(object),
        material: Some(level),
        force_n: Some(2.5),
        split,
        shore: Some(70.0),
        source: 0,
    }
}

/// 4 levels x 10 objects x 5 presses.
fn samples() -> Vec<Sample> {
    (0..200_u32)
        .map(|i| sample((i / 50) as u8 + 1, i / 5, Split::Train))
        .collect()
}

fn bytes_of(samples: &[Sample]) -> Vec<u8> {
    let meta = serde_json::json!({"seed": 7});
    write(Cursor::new(Vec::new()), samples, &meta)
        .unwrap()
        .into_inner()
}

fn parse(bytes: &[u8]) -> Result<Dataset, DatasetError> {
    file::parse(bytes, Path::new("D.npz"))
}

#[test]
fn a_file_reads_back_what_was_written() {
    let samples = samples();
    let bytes = bytes_of(&samples);
    let read = parse(&bytes).unwrap();
    assert_eq!(read.samples, samples);
    assert_eq!(read.sources[0].seed, Some(7));
    assert_eq!(read.sources[0].sha256, sha256_hex(&bytes));
    // The file holds no date: the same samples give the same bytes.
    assert_eq!(bytes, bytes_of(&samples));
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
    assert!(
        read.samples
            .iter()
            .all(|s| s.split == Split::Train && s.object.is_none())
    );
    assert_eq!(read.labelled(Split::Train).unwrap(), [1, 2]);
    let error = read.labelled(Split::Test).unwrap_err().to_string();
    assert_eq!(
        error,
        "D.npz: no sample of the test split has a level: add some with `collect --append --split \
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
    assert!(
        error.contains("array `meta`: found 33554432 bytes packed into"),
        "{error}"
    );
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
        parse(&file).unwrap().samples
    };
    assert_eq!(
        parse(true, in_fortran.collect()),
        parse(false, in_c.collect())
    );
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
    let samples = parse(&file).unwrap().samples;
    assert_eq!(samples[0].frame.newtons, [0.5; TAXELS]);
    let labels = samples.iter().map(|sample| (sample.level, sample.force_n));
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
        "array `frames`: found NaN at [0,0,0], expected newtons from 0 to 1e6",
    );
    check(
        |npz| {
            let mut frames = [0.0_f32; 2 * TAXELS];
            frames[TAXELS + 3 * COLS + 4] = 1e38;
            npz.add("frames", &[2, ROWS, COLS], &frames).unwrap();
        },
        "array `frames`: found 1e38 at [1,3,4], expected newtons from 0 to 1e6",
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

fn objects_of(dataset: &Dataset, indices: &[usize]) -> Vec<u32> {
    let mut objects: Vec<u32> = indices
        .iter()
        .map(|&index| dataset.samples[index].object.unwrap())
        .collect();
    objects.dedup();
    objects
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
        let of = |(split, object, material, level)| Sample {
            object,
            material,
            ..sample(level, 0, split)
        };
        let samples = pair.map(of);
        let samples = samples.iter();
        let presses = samples.filter_map(|sample| Some((sample.pressed()?, sample.split)));
        assert_eq!(object_in_both_splits(presses), expected, "{pair:?}");
    }
}

#[test]
fn held_out_objects_are_whole_and_of_every_level() {
    let dataset = parse(&bytes_of(&samples())).unwrap();
    let indices = dataset.labelled(Split::Train).unwrap();
    let (kept, held) = dataset.hold_out(&indices, 0.2, 1);
    assert_eq!((kept.len(), held.len()), (160, 40));
    let (kept, held) = (objects_of(&dataset, &kept), objects_of(&dataset, &held));
    assert_eq!((kept.len(), held.len()), (32, 8));
    assert!(held.iter().all(|object| !kept.contains(object)));
    let first_object: Vec<usize> = (0..5).collect();
    assert_eq!(
        dataset.hold_out(&first_object, 0.5, 1),
        (first_object, vec![])
    );
    assert_ne!(
        held,
        objects_of(&dataset, &dataset.hold_out(&indices, 0.2, 2).1)
    );
}

#[test]
fn labels_are_chosen_by_object_and_equally_from_each_level() {
    let dataset = parse(&bytes_of(&samples())).unwrap();
    let indices = dataset.labelled(Split::Train).unwrap();
    let chosen = dataset.choose_labelled(&indices, 48, LabelChoice::Object, 1);
    for level in 1..=4 {
        let of_level = chosen
            .iter()
            .filter(|&&i| dataset.samples[i].level == level)
            .count();
        assert_eq!(of_level, 12, "level {level}");
    }
    // Each level has two whole objects and two presses of a third.
    assert_eq!(objects_of(&dataset, &chosen).len(), 12);
    // A choice of more labels includes the smaller choice, so methods of one seed share labels.
    let more = dataset.choose_labelled(&indices, 100, LabelChoice::Object, 1);
    assert!(chosen.iter().all(|index| more.contains(index)));

    // A level with too few samples gives all, and the others give more, so that the number is
    // right.
    let few: Vec<usize> = (0..10).chain(50..200).collect();
    for choice in [LabelChoice::Object, LabelChoice::Random] {
        let chosen = dataset.choose_labelled(&few, 101, choice, 1);
        let of_level = [1, 2, 3, 4].map(|level| {
            let levels = chosen.iter().map(|&i| dataset.samples[i].level);
            levels.filter(|&found| found == level).count()
        });
        assert_eq!(of_level, [10, 31, 30, 30], "{choice:?}");
    }
    assert_eq!(
        dataset.choose_labelled(&few, 160, LabelChoice::Object, 1),
        few
    );

    let random = dataset.choose_labelled(&indices, 48, LabelChoice::Random, 1);
    assert_eq!(random.len(), 48);
    let objects = objects_of(&dataset, &random).len();
    assert!(objects > 24, "{objects} of 40 objects");
}

#[test]
fn objects_of_one_number_are_several_if_their_levels_differ() {
    let sample = |level, object| Sample {
        object,
        material: None,
        ..sample(level, 0, Split::Train)
    };
    let (known, unknown) = (Some(7), None);
    let samples = [
        (1, known),
        (2, known),
        (1, known),
        (1, unknown),
        (1, unknown),
    ];
    let dataset = Dataset {
        samples: samples
            .map(|(level, object)| sample(level, object))
            .to_vec(),
        sources: Vec::new(),
        paths: Vec::new(),
    };
    assert_eq!(dataset.object_numbers(&[0, 1, 2, 3, 4]), [0, 1, 0, 2, 3]);
}

#[test]
fn a_model_states_the_levels_of_its_data() {
    let stated = |shore: &str| {
        let mut levels = levels();
        levels[0].shore = shore.to_owned();
        Some(levels)
    };
    let source = |levels| Source {
        levels,
        ..Source::default()
    };
    assert_eq!(levels_of(&[source(None)]), levels());
    // The second file states other levels than a model that is trained here can have.
    let several = [
        source(None),
        source(Some(levels()[..3].to_vec())),
        source(stated("70-90")),
        source(stated("60-90")),
    ];
    assert_eq!(levels_of(&several), stated("70-90").unwrap());
}

#[test]
fn joined_files_keep_their_objects_apart() {
    let part = parse(&bytes_of(&samples())).unwrap();
    let all = Dataset::joined(vec![part.clone(), part]).unwrap();
    assert_eq!(all.sources.len(), 2);
    let indices: Vec<usize> = (0..400).collect();
    assert_eq!(objects_of(&all, &indices), (0..80).collect::<Vec<u32>>());
}

#[test]
fn files_are_joined_while_their_objects_can_be_counted_and_their_pitch_is_one() {
    let part = |last: u32, pitch_mm: Option<f64>, path: &str| {
        let samples = [0, last].map(|object| Sample {
            object: Some(object),
            ..sample(1, 0, Split::Train)
        });
        let mut meta = serde_json::json!({});
        if let Some(pitch_mm) = pitch_mm {
            meta["pitch_mm"] = pitch_mm.into();
        }
        let bytes = write(Cursor::new(Vec::new()), &samples, &meta).unwrap();
        file::parse(bytes.get_ref(), Path::new(path)).unwrap()
    };
    let joined = |parts: [Dataset; 2]| Dataset::joined(parts.to_vec());
    let most = joined([part(2, None, "a"), part(u32::MAX - 3, None, "b")]).unwrap();
    assert_eq!(most.samples[3].object, Some(u32::MAX));
    assert_eq!(most.pitch_mm(), 3.5);
    for (parts, expected) in [
        (
            [part(2, None, "a"), part(u32::MAX - 2, None, "d/b")],
            "d/b: array `object`: found 4294967293, expected no number that, after 3",
        ),
        (
            [part(u32::MAX, None, "a"), part(0, None, "d/b")],
            "d/b: array `object`: found 0, expected no number that, after 4294967296",
        ),
        (
            [part(1, None, "a"), part(1, Some(2.0), "d/b")],
            "d/b: taxel pitch: found 2 mm, expected 3.5 mm, that of a",
        ),
    ] {
        let error = joined(parts).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
    let narrow = [part(1, Some(2.0), "a"), part(1, Some(2.0), "b")];
    assert_eq!(joined(narrow).unwrap().pitch_mm(), 2.0);
}
