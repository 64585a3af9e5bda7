//! Recordings become a data set: the frames that the daemon would judge, with labels.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use crate::bench::{BINARY, Bench, hardnessd};
use hardnessd_core::verdict::{Card, Hrn};
use hardnessd_simulator::{self, DatasetSettings, Split};
use hrn_train::data::courses::Courses;
use hrn_train::data::dataset::{self, Dataset, Kind, Sample, meta};
use hrn_train::data::simulated;
use hrn_train::model::course::course_of;
use serde_json::Value;

fn collect(out: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_hrn-train"))
        .args(["collect", "--out"])
        .arg(out)
        .args(arguments)
        .output()
        .unwrap()
}

fn collected(out: &Path, arguments: &[&str]) -> Vec<Sample> {
    let output = collect(out, arguments);
    assert!(output.status.success(), "{arguments:?}: {output:?}");
    Dataset::read(out).unwrap().samples
}

/// The area and the force of each final verdict in a replay.
fn judged(capture: &Path) -> Vec<(u64, f64)> {
    let replay = hardnessd(&["replay", capture.to_str().unwrap()]);
    let text = String::from_utf8(replay.stdout).unwrap();
    let events = text
        .lines()
        .map(|line| serde_json::from_str::<Value>(line).unwrap());
    events
        .filter(|event| event["phase"] == "final")
        .map(|event| {
            let area = event["contact_area_taxels"].as_u64().unwrap();
            (area, event["force_n"].as_f64().unwrap())
        })
        .collect()
}

fn assert_are_those(samples: &[Sample], judged: &[(u64, f64)]) {
    assert_eq!(samples.len(), judged.len());
    for (sample, (area, force_n)) in samples.iter().zip(judged) {
        let threshold_n = hardnessd_core::press::Settings::default().contact_threshold_n;
        assert_eq!(
            u64::from(sample.frame.contact_area_taxels(threshold_n)),
            *area
        );
        assert!((sample.frame.force_n() - force_n).abs() < 1e-3);
    }
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn presses_of_level_0_are_unlabelled() {
    let bench = Bench::new();
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .join("fixtures/foam.5hz.bin");
    let out = bench.path("unlabelled.npz");
    let samples = collected(&out, &["--level", "0", "--object", "9", text(&fixture)]);
    assert!(samples.iter().all(|s| s.level == 0 && s.object == Some(9)));
    assert_are_those(&samples, &judged(&fixture));
    // Such presses do not count as presses of a level.
    let dataset = Dataset::read(&out).unwrap();
    let error = dataset.labelled(Split::Train).unwrap_err().to_string();
    assert!(error.contains("unlabelled.npz"), "{error}");
}

#[test]
fn samples_are_the_frames_that_the_daemon_judges() {
    let bench = Bench::new();
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .join("fixtures/foam.5hz.bin");
    let out = bench.path("bytes.npz");
    let samples = collected(&out, &["--level", "2", "--object", "9", text(&fixture)]);
    assert!(!samples.is_empty());
    assert!(samples.iter().all(|s| s.level == 2 && s.object == Some(9)));
    assert_are_those(&samples, &judged(&fixture));

    // The same holds for a recording, whose own labels tell the pressed object.
    let config = bench.configure("record.toml", "events.sock", "");
    let capture = bench.path("a.mcap");
    let _sensor = bench.sensor(&[]);
    let labels = ["level=1", "object=7", "material=oak", "shore=95"];
    record(&config, &capture, &labels, &[]);
    let out = bench.path("own.npz");
    let samples = collected(&out, &[text(&capture)]);
    assert!(samples.iter().all(|s| s.level == 1 && s.object == Some(7)));
    assert!(samples.iter().all(|s| s.split == Split::Train));
    assert_are_those(&samples, &judged(&capture));
    // The material is stored too, as its index among the names.
    assert!(samples.iter().all(|s| s.material == Some(0)));
    assert_eq!(meta(&out).unwrap()["materials"], serde_json::json!(["oak"]));
    assert!(samples.iter().all(|s| s.shore == Some(95.0)));
    let collector = concat!("hrn-train collect ", env!("CARGO_PKG_VERSION"));
    assert_eq!(meta(&out).unwrap()["generator"], collector);

    // Appending keeps the earlier samples, and options override labels.
    let more = [
        "--append",
        "--split",
        "test",
        "--level",
        "3",
        text(&capture),
    ];
    let both = collected(&out, &more);
    assert_eq!(both[..samples.len()], samples);
    let added = &both[samples.len()..];
    assert_eq!(added.len(), samples.len());
    assert!(
        added
            .iter()
            .all(|s| (s.level, s.object) == (3, Some(7)) && s.split == Split::Test)
    );
    assert_eq!(meta(&out).unwrap()["captures"].as_array().unwrap().len(), 2);
    assert_eq!(meta(&out).unwrap()["generator"], collector);
    // An object without a number gets a new number.
    let bytes = bench.path("bytes.npz");
    let new = collected(&bytes, &["--append", "--level", "4", text(&fixture)]);
    assert_eq!(new.last().unwrap().object, Some(10));
    // That capture has no known material. A data set has materials for all samples or for none.
    let lost = ["--append", "--level", "4", text(&fixture)];
    let expected = format!(
        "{}: has no material, and {} has: record with --label material=..., or",
        fixture.display(),
        out.display()
    );
    assert_refused(&out, &lost, &expected);
    let both_ways = ["--level", "4", text(&fixture), text(&capture)];
    assert_refused(
        &bench.path("new.npz"),
        &both_ways,
        "foam.5hz.bin: has no material",
    );

    // Appended to simulated samples, a material keeps its index, and a new material gets the next
    // one.
    let settings = DatasetSettings {
        objects: 1,
        test_objects: 1,
        presses: 1,
        ..DatasetSettings::default()
    };
    let simulated = hardnessd_simulator::dataset(&settings, 1, |_| {});
    let simulated = simulated::to_bytes(&settings, simulated).unwrap();
    std::fs::write(&out, simulated).unwrap();
    let both = collected(&out, &["--append", text(&capture)]);
    assert_eq!(both[0].material, Some(0));
    assert_eq!(both.last().unwrap().material, Some(8));
    assert_eq!(meta(&out).unwrap()["materials"][8], "oak");
    assert_eq!(both.last().unwrap().shore, Some(95.0));
    assert!(both[0].shore.is_some_and(|shore| shore != 95.0));
    // The data set has both sources, and a model trained on it says so.
    let both = Dataset::read(&out).unwrap();
    assert_eq!(both.sources[0].kinds(), [Kind::Simulated, Kind::Recorded]);
    let card = trained(&bench, &[&out]);
    assert_eq!(card.validation, "simulated and recorded data");
    assert_eq!(card.pitch_mm, 3.5);
}

/// Records the sensor of `config` for 12 s.
fn record(config: &Path, out: &Path, labels: &[&str], more: &[&str]) {
    let recorded = Command::new(BINARY)
        .args(["record", "--config", text(config), "--out", text(out)])
        .args(["--seconds", "12"])
        .args(labels.iter().flat_map(|label| ["--label", label]))
        .args(more)
        .output()
        .unwrap();
    assert!(recorded.status.success(), "{recorded:?}");
}

#[test]
fn whole_presses_with_the_arms_approach_are_evaluated() {
    let bench = Bench::new();
    let arm = "[sensor.arm]\nstiffness_n_per_mm = 10.0\ndelay_ms = 40.0\n";
    let config = bench.configure("record.toml", "events.sock", arm);
    let control = bench.path("control.sock");
    let capture = bench.path("a.mcap");
    let _sensor = bench.sensor(&["--motion", text(&control)]);
    record(
        &config,
        &capture,
        &["level=1", "object=7", "shore=95"],
        &["--sockets"],
    );
    let judged = judged(&capture);
    let out = bench.path("courses.npz");
    let sequences = ["--sequences", "--split", "test", text(&capture)];
    let output = collect(&out, &sequences);
    assert!(output.status.success(), "{output:?}");
    let courses = Courses::read(&out).unwrap();
    assert_eq!(courses.presses.len(), judged.len());
    for (number, (press, (area, force_n))) in courses.presses.iter().zip(&judged).enumerate() {
        assert_eq!((press.level, press.object, press.shore), (1, 7, 95.0));
        assert_eq!((press.split, press.arm_n_per_mm), (Split::Test, 10.0));
        let best = courses.frame(press.best as usize);
        assert!(
            (best.force_n() - force_n).abs() < 0.5,
            "{force_n} N, to a millinewton a taxel"
        );
        assert_eq!(u64::from(best.contact_area_taxels(0.07)), *area);
        let rows = courses.rows(number);
        assert!(rows.len() >= 3 && courses.time_s[rows.start] == 0.0);
        assert!(courses.known[rows.clone()].iter().all(|&known| known == 1));
        // The simulated arm moves at 5 mm/s. On hard plastic it goes a millimetre or two.
        let way = &courses.approach_mm[rows.clone()];
        let most = way.iter().copied().fold(0.0, f32::max);
        assert!(way[0] == 0.0 && (0.5..8.0).contains(&most), "{way:?}");
        let (time_s, mm) = (courses.time_s[rows.start + 2], way[2]);
        assert!((mm / time_s - 5.0).abs() < 1.5, "{mm} mm in {time_s} s");
    }
    // Append a press on another object, without positions of the arm.
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .join("fixtures/foam.5hz.bin");
    let more = [
        "--sequences",
        "--append",
        "--split",
        "test",
        "--level",
        "2",
        text(&fixture),
    ];
    let output = collect(&out, &more);
    assert!(output.status.success(), "{output:?}");
    let both = Courses::read(&out).unwrap();
    let added = &both.presses[courses.presses.len()..];
    assert!(
        !added.is_empty()
            && added
                .iter()
                .all(|press| press.object == 8 && press.shore.is_nan())
    );
    assert_eq!(both.known[courses.known.len()..].iter().max(), Some(&0));
    assert_eq!(
        meta(&out).unwrap()["materials"],
        serde_json::json!(["unknown"])
    );

    let model = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .join("models/course.onnx");
    let evaluated = Command::new(env!("CARGO_BIN_EXE_hrn-train"))
        .args([
            "evaluate",
            "--json",
            "--model",
            text(&model),
            "--data",
            text(&out),
        ])
        .output()
        .unwrap();
    assert!(evaluated.status.success(), "{evaluated:?}");
    let figures: Value = serde_json::from_slice(&evaluated.stdout).unwrap();
    assert_eq!(figures["n"], both.presses.len());

    // One file cannot hold both single frames and presses over time.
    let bytes = std::fs::read(&out).unwrap();
    let output = collect(&out, &["--append", "--level", "1", text(&capture)]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    assert!(std::fs::read(&out).unwrap() == bytes);
}

/// Asserts that the command is refused with exit code 1 and one line that contains `part`, and that
/// nothing is written.
#[track_caller]
fn assert_refused(out: &Path, arguments: &[&str], part: &str) {
    let before = std::fs::read(out).ok();
    let output = collect(out, arguments);
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains(part), "{said}\nshould contain\n{part}");
    assert_eq!(said.lines().count(), 1, "{said}");
    assert!(std::fs::read(out).ok() == before);
}

fn train(bench: &Bench, data: &[&Path]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_hrn-train"))
        .args(["train", "--method", "features", "--out"])
        .arg(bench.path("run"))
        .args(data.iter().flat_map(|data| ["--data", text(data)]))
        .output()
        .unwrap()
}

/// The card of a model trained on the data.
fn trained(bench: &Bench, data: &[&Path]) -> Card {
    let output = train(bench, data);
    assert!(output.status.success(), "{output:?}");
    let model = std::fs::read(bench.path("run/hrn.onnx")).unwrap();
    Hrn::load(&model).unwrap().card().clone()
}

#[test]
fn training_says_which_levels_it_cannot_learn() {
    let bench = Bench::new();
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .join("fixtures/foam.5hz.bin");
    let data = bench.path("one.npz");
    collected(&data, &["--level", "1", text(&fixture)]);
    let output = train(&bench, &[&data]);
    let said = String::from_utf8(output.stderr).unwrap();
    for expected in [
        "no labelled training press is of level 2, 3 or 4: the model never learns to say it",
        "all training presses of level 1 are of one object",
    ] {
        assert!(said.contains(expected), "{said}");
    }
}

#[test]
fn a_model_is_of_the_pitch_of_its_recordings_and_pitches_do_not_mix() {
    const NARROW: &str = "[sensor.calibration]\npitch_mm = 2.0\n";
    let bench = Bench::new();
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .join("fixtures/foam.5hz.bin");
    let fixture = text(&fixture);
    let config = bench.configure("narrow.toml", "events.sock", NARROW);
    let capture = bench.path("narrow.mcap");
    let sensor = bench.sensor(&[]);
    record(&config, &capture, &[], &[]);
    drop(sensor);

    let out = bench.path("narrow.npz");
    collected(&out, &["--level", "1", text(&capture)]);
    assert_eq!(meta(&out).unwrap()["pitch_mm"], 2.0);
    // A .bin file belongs to the configuration's sensor.
    for level in ["1", "2", "3", "4"] {
        let arguments = [
            "--append",
            "--level",
            level,
            "--config",
            text(&config),
            fixture,
        ];
        collected(&out, &arguments);
    }
    assert_eq!(trained(&bench, &[&out]).pitch_mm, 2.0);

    let wide = bench.path("wide.npz");
    collected(&wide, &["--level", "1", fixture]);
    assert_eq!(meta(&wide).unwrap()["pitch_mm"], 3.5);
    assert_refused(
        &wide,
        &["--append", "--level", "1", text(&capture)],
        &format!(
            "narrow.mcap: taxel pitch: found 2 mm, expected 3.5 mm, that of {}",
            wide.display()
        ),
    );
    assert_refused(
        &bench.path("mixed.npz"),
        &["--level", "1", text(&capture), fixture],
        "foam.5hz.bin: taxel pitch: found 3.5 mm, expected 2 mm, that of",
    );
    // A model can be evaluated on data of another pitch, with a warning.
    let model = bench.path("run/hrn.onnx");
    for (data, said) in [
        (&out, ""),
        (
            &wide,
            "wide.npz: taxel pitch: found 3.5 mm, expected 2 mm, that of the model\n",
        ),
    ] {
        let output = Command::new(env!("CARGO_BIN_EXE_hrn-train"))
            .args(["evaluate", "--split", "train", "--model", text(&model)])
            .args(["--data", text(data)])
            .output()
            .unwrap();
        assert!(output.status.success(), "{output:?}");
        let errors = String::from_utf8(output.stderr).unwrap();
        assert!(
            errors.ends_with(said) && errors.starts_with("warning: ") != said.is_empty(),
            "{errors}"
        );
    }
    let output = train(&bench, &[&out, &wide]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(
        said.contains("wide.npz: taxel pitch: found 3.5 mm"),
        "{said}"
    );
}

#[test]
fn a_model_of_presses_is_of_the_pitch_of_its_recordings() {
    let bench = Bench::new();
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .join("fixtures/foam.5hz.bin");
    let narrow = "[sensor.calibration]\npitch_mm = 2.0\n";
    let narrow = bench.configure("narrow.toml", "events.sock", narrow);
    let settings = bench.path("settings.toml");
    std::fs::write(&settings, "[training]\nepochs = 1\n").unwrap();
    let [fine, coarse] = ["fine.npz", "coarse.npz"].map(|name| bench.path(name));
    for level in ["1", "2", "3", "4"] {
        for (out, config) in [(&fine, &["--config", text(&narrow)][..]), (&coarse, &[])] {
            let append: &[&str] = if out.exists() { &["--append"] } else { &[] };
            let told = ["--sequences", "--level", level, text(&fixture)];
            let output = collect(out, &[append, config, &told].concat());
            assert!(output.status.success(), "{output:?}");
        }
    }
    let course = |command: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_hrn-train"))
            .args(command)
            .output()
            .unwrap();
        let errors = String::from_utf8(output.stderr).unwrap();
        (output.status.code(), errors)
    };
    let run = bench.path("course");
    let train = ["train", "--method", "course", "--config", text(&settings)];
    let whole = ["--out", text(&run), "--data", text(&fine)];
    let (code, errors) = course(&[&train[..], &whole].concat());
    assert_eq!(code, Some(0), "{errors}");
    let model = run.join("hrn.onnx");
    let hrn = Hrn::load(&std::fs::read(&model).unwrap()).unwrap();
    assert_eq!(hrn.card().pitch_mm, 2.0);
    // Nothing says how hard the objects are, so the interval is the whole scale.
    assert!(
        errors.contains("no labelled training press has a measured Shore hardness"),
        "{errors}"
    );
    let courses = Courses::read(&fine).unwrap();
    let shore = hrn
        .judge_course(&course_of(&courses, 0))
        .unwrap()
        .shore
        .unwrap();
    assert_eq!((shore.low, shore.high), (0.0, 100.0));

    let evaluate = [
        "evaluate",
        "--split",
        "train",
        "--model",
        text(&model),
        "--data",
    ];
    let warning = "coarse.npz: taxel pitch: found 3.5 mm, expected 2 mm, that of the model\n";
    for (data, said) in [(&fine, ""), (&coarse, warning)] {
        let (code, errors) = course(&[&evaluate[..], &[text(data)]].concat());
        assert_eq!(code, Some(0), "{errors}");
        assert_eq!(errors.is_empty(), said.is_empty(), "{errors}");
        assert!(errors.ends_with(said), "{errors}");
    }
    let other = bench.path("mixed");
    let mixed = [
        "--out",
        text(&other),
        "--data",
        text(&fine),
        "--data",
        text(&coarse),
    ];
    let (code, errors) = course(&[&train[..], &mixed].concat());
    assert_eq!(code, Some(1), "{errors}");
    assert!(
        errors.contains("coarse.npz: taxel pitch: found 3.5 mm"),
        "{errors}"
    );
}

#[test]
fn a_recording_is_not_collected_twice() {
    let bench = Bench::new();
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .join("fixtures/foam.5hz.bin");
    let copy = bench.path("copy.bin");
    std::fs::copy(&fixture, &copy).unwrap();
    let (fixture, copy) = (text(&fixture), text(&copy));
    let out = bench.path("own.npz");
    let expected = format!("{copy}: the same recording as foam.5hz.bin");

    // Neither in one call,
    assert_refused(&out, &["--level", "1", fixture, copy], &expected);
    // nor in a later one.
    let labels = ["--level", "1", "--object", "3"];
    let samples = collected(&out, &[&labels[..], &[fixture]].concat());
    let again = [&labels[..], &["--append", copy]].concat();
    assert_refused(&out, &again, &expected);
    // It may be the recording of another object, because its labels may have been wrong.
    let other = ["--append", "--level", "1", "--object", "4", copy];
    assert_eq!(collected(&out, &other).len(), 2 * samples.len());
}

#[test]
fn nothing_of_a_data_set_is_lost_when_it_is_added_to() {
    let bench = Bench::new();
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .join("fixtures/foam.5hz.bin");
    let fixture = text(&fixture);
    let out = bench.path("own.npz");
    let append = ["--append", "--level", "1", fixture];

    let most = ["--object", "4294967295", "--level", "1", fixture];
    let samples = collected(&out, &most);
    assert_refused(
        &out,
        &append,
        "own.npz: array `object`: found 4294967295, expected a lower",
    );
    let both = collected(&out, &[&append[..], &["--object", "3"]].concat());
    assert_eq!(both.last().unwrap().object, Some(3));

    let write = |change: fn(&mut Sample)| {
        let mut samples = samples.clone();
        samples.iter_mut().for_each(change);
        let file = std::fs::File::create(&out).unwrap();
        dataset::write(file, &samples, &serde_json::json!({})).unwrap();
    };
    write(|sample| sample.object = None);
    let object = [&append[..], &["--object", "3"]].concat();
    assert_refused(&out, &object, "own.npz: has no object, and ");
    write(|sample| sample.force_n = None);
    assert_refused(&out, &object, "own.npz: has no force");
    write(|sample| sample.shore = Some(70.0));
    assert_refused(&out, &object, "foam.5hz.bin: has no shore");
    // A test object cannot become a training object either, or the other way round.
    write(|sample| sample.split = Split::Test);
    let expected = format!(
        "{fixture}: object 4294967295 is in the train split here, and in the test split in {}",
        out.display()
    );
    assert_refused(&out, &[&append[..], &most[..2]].concat(), &expected);
    collected(&out, &object);
    // The file does not say who made it, and that is kept too.
    write(|_| ());
    collected(&out, &object);
    let kinds = Dataset::read(&out).unwrap().sources[0].kinds();
    assert_eq!(kinds, [Kind::Unknown, Kind::Recorded]);
}

#[test]
fn what_cannot_be_collected_is_said_and_nothing_is_written() {
    let bench = Bench::new();
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .join("fixtures/foam.5hz.bin");
    let fixture = text(&fixture);
    let out = bench.path("own.npz");
    let none = bench.path("none.mcap");
    let empty = bench.path("empty.bin");
    std::fs::write(&empty, [0; 100]).unwrap();
    let noise: PathBuf = bench.path("noise.mcap");
    std::fs::write(&noise, [7; 1000]).unwrap();
    for (arguments, code, part) in [
        (
            &[fixture][..],
            2,
            "has no label `level`: give its level with --level",
        ),
        (&["--level", "5", fixture], 2, "5"),
        (&["--level", "1", text(&none)], 66, "none.mcap"),
        (&["--level", "1", text(&empty)], 1, "no press"),
        (&["--level", "1", text(&noise)], 1, "no press"),
        (
            &["--level", "1", "--config", text(&none), fixture],
            66,
            "none.mcap",
        ),
    ] {
        let output = collect(&out, arguments);
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(code), "{said}");
        assert!(said.contains(part), "{said}");
        assert!(!out.exists());
    }
}

/// Raw recordings that differ only in the noise after the last frame.
fn fleet(bench: &Bench, count: usize) -> Vec<PathBuf> {
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .join("fixtures/foam.5hz.bin");
    let bytes = std::fs::read(fixture).unwrap();
    let one = |noise: usize| {
        let path = bench.path(&format!("{noise:02}.bin"));
        std::fs::write(&path, [&bytes[..], &vec![0; noise]].concat()).unwrap();
        path
    };
    (0..count).map(one).collect()
}

/// The parts in a directory, and when they were written.
fn parts(directory: &Path) -> Vec<(PathBuf, std::time::SystemTime)> {
    let entries = std::fs::read_dir(directory).into_iter().flatten();
    let paths = entries.map(|entry| entry.unwrap().path());
    let parts = paths.filter(|path| path.extension().is_some_and(|name| name == "npz"));
    let mut parts: Vec<_> = parts
        .map(|path| (path.clone(), path.metadata().unwrap().modified().unwrap()))
        .collect();
    parts.sort();
    parts
}

#[test]
fn a_fleet_gives_the_same_bytes_in_parallel_and_after_a_kill() {
    const COUNT: usize = 8;
    let bench = Bench::new();
    let captures = fleet(&bench, COUNT);
    for sequences in [&[][..], &["--sequences"]] {
        let mut arguments = [sequences, &["--level", "2", "--jobs", "1"]].concat();
        arguments.extend(captures.iter().map(|path| text(path)));
        let out = bench.path("serial.npz");
        assert!(collect(&out, &arguments).status.success());
        let expected = std::fs::read(&out).unwrap();
        assert!(!bench.path("serial.npz.collecting").exists());
        // Such a small data set has the same bytes as if it had been in memory as a whole.
        let (meta, memory) = (meta(&out).unwrap(), std::io::Cursor::new(Vec::new()));
        let whole = match sequences {
            [] => dataset::write(memory, &Dataset::read(&out).unwrap().samples, &meta),
            _ => Courses::read(&out).unwrap().write(memory, &meta),
        };
        assert!(whole.unwrap().into_inner() == expected);
        assert_eq!(meta["captures"].as_array().unwrap().len(), COUNT);

        let parallel = bench.path("parallel.npz");
        arguments[sequences.len() + 3] = "4";
        assert!(collect(&parallel, &arguments).status.success());
        assert!(std::fs::read(&parallel).unwrap() == expected);

        // A killed call leaves whole parts, and the next one continues with them.
        arguments[sequences.len() + 3] = "1";
        let directory = bench.path(&format!("parts{}", sequences.len()));
        arguments.splice(0..0, ["--parts", text(&directory)]);
        let killed = bench.path("killed.npz");
        let _ = std::fs::remove_file(&killed);
        let mut child = Command::new(env!("CARGO_BIN_EXE_hrn-train"))
            .args(["collect", "--out", text(&killed)])
            .args(&arguments)
            .spawn()
            .unwrap();
        crate::bench::wait_for("two parts", || parts(&directory).len() >= 2);
        child.kill().unwrap();
        child.wait().unwrap();
        let left = parts(&directory);
        assert!(left.len() < COUNT && !killed.exists(), "{left:?}");
        assert!(collect(&killed, &arguments).status.success());
        assert!(std::fs::read(&killed).unwrap() == expected);
        let all = parts(&directory);
        assert_eq!(all.len(), COUNT);
        assert!(left.iter().all(|part| all.contains(part)));
        // A part is not made again, except a damaged one.
        std::fs::write(&all[0].0, "damaged").unwrap();
        assert!(collect(&killed, &arguments).status.success());
        assert!(std::fs::read(&killed).unwrap() == expected);
        assert_eq!(parts(&directory)[1..], all[1..]);
    }
}

#[test]
fn a_changed_program_without_a_commit_of_its_own_takes_no_parts_of_another() {
    let bench = Bench::new();
    // Bytes after its last section change nothing but the file.
    let changed = bench.path("hrn-train");
    let mut copy = Command::new("sh");
    copy.args(["-c", r#"cp "$1" "$2" && echo changed >> "$2""#, "sh"]);
    copy.args([env!("CARGO_BIN_EXE_hrn-train"), text(&changed)]);
    assert!(copy.status().unwrap().success());
    let captures = fleet(&bench, 2);
    let [directory, out] = ["parts", "out.npz"].map(|name| bench.path(name));
    let mut arguments = vec!["--level", "2", "--parts", text(&directory)];
    arguments.extend(captures.iter().map(|path| text(path)));
    let with = |program: &Path| {
        let mut command = Command::new(program);
        let done = command
            .args(["collect", "--out", text(&out)])
            .args(&arguments);
        assert!(done.status().unwrap().success());
        parts(&directory)
    };
    let first = with(Path::new(env!("CARGO_BIN_EXE_hrn-train")));
    assert_eq!(first, with(Path::new(env!("CARGO_BIN_EXE_hrn-train"))));
    let of_both = with(&changed);
    assert!(first.iter().all(|part| of_both.contains(part)));
    let commit = env!("HARDNESSD_REVISION");
    let is_of_commit = !commit.ends_with("-dirty") && commit != "no checkout";
    let expected = if is_of_commit { 2 } else { 4 };
    assert_eq!((first.len(), of_both.len()), (2, expected), "{commit}");
}

#[test]
fn what_cannot_be_used_is_left_out_with_its_reason() {
    let bench = Bench::new();
    let config = bench.configure("record.toml", "events.sock", "");
    let [near, far, damaged] =
        ["b.mcap", "a/deep/a.mcap", "a/cut.mcap"].map(|name| bench.path("fleet").join(name));
    std::fs::create_dir_all(far.parent().unwrap()).unwrap();
    let _sensor = bench.sensor(&[]);
    record(&config, &near, &["level=1", "object=7"], &[]);
    record(&config, &far, &["level=1", "object=7"], &[]);
    let mut bytes = std::fs::read(&near).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle..middle + 200].fill(0xff);
    std::fs::write(&damaged, &bytes).unwrap();
    // Neither of these is a recording.
    std::fs::write(bench.path("fleet/a/notes.txt"), "pressed by hand").unwrap();
    std::fs::write(bench.path("fleet/empty.mcap"), "").unwrap();
    let fleet = bench.path("fleet");
    let label_less = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .join("fixtures/foam.5hz.bin");
    let none = bench.path("none.mcap");
    let all = [text(&label_less), text(&fleet), text(&none)];

    let out = bench.path("fleet.npz");
    let list = bench.path("fleet.npz.left-out.tsv");
    let expected = "give its level with --level (to leave out such recordings: --skip-unusable)";
    let output = collect(&out, &all);
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(
        said.contains(expected) && said.lines().count() == 1,
        "{said}"
    );
    assert!(!out.exists() && !list.exists());

    let output = collect(&out, &[&["--skip-unusable"], &all[..]].concat());
    assert!(output.status.success(), "{output:?}");
    let account = String::from_utf8(output.stdout).unwrap();
    let count = format!("{}: 3 recordings left out\n", list.display());
    assert!(account.ends_with(&count), "{account}");
    let lines = std::fs::read_to_string(&list).unwrap();
    let lines: Vec<(&str, &str)> = lines
        .lines()
        .map(|line| line.split_once('\t').unwrap())
        .collect();
    assert_eq!(lines.len(), 3, "{lines:?}");
    for ((path, reason), (expected, part)) in lines.into_iter().zip([
        (&label_less, "the recording has no label `level`"),
        (&damaged, "damaged"),
        (&none, "No such file"),
    ]) {
        assert_eq!(path, text(expected));
        assert!(reason.contains(part) && !reason.contains(path), "{reason}");
    }
    // In the order of the paths.
    let meta = meta(&out).unwrap();
    let names = meta["captures"].as_array().unwrap().iter();
    let names: Vec<&Value> = names.map(|capture| &capture["name"]).collect();
    assert_eq!(names, ["a.mcap", "b.mcap"]);
    let only = bench.path("only.npz");
    collected(&only, &[text(&far), text(&near)]);
    assert!(std::fs::read(&only).unwrap() == std::fs::read(&out).unwrap());

    // A data set needs one recording at least.
    let before = std::fs::read(&out).unwrap();
    let output = collect(&out, &["--skip-unusable", text(&none), text(&label_less)]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("no recording can be used: "), "{said}");
    assert!(std::fs::read(&out).unwrap() == before);
    assert_eq!(std::fs::read_to_string(&list).unwrap().lines().count(), 2);
    let empty = bench.path("nothing");
    std::fs::create_dir(&empty).unwrap();
    let output = collect(&out, &["--skip-unusable", text(&empty)]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(
        said.contains("nothing: no recording is in this directory"),
        "{said}"
    );
}

#[test]
fn the_most_recordings_decide_what_a_data_set_has() {
    let bench = Bench::new();
    let config = bench.configure(
        "narrow.toml",
        "events.sock",
        "[sensor.calibration]\npitch_mm = 2.0\n",
    );
    let captures = fleet(&bench, 3);
    let [stray, capture] = ["stray.mcap", "named.mcap"].map(|name| bench.path(name));
    let sensor = bench.sensor(&[]);
    record(&config, &stray, &[], &[]);
    drop(sensor);
    let _sensor = bench.sensor(&[]);
    record(
        &bench.configure("wide.toml", "events.sock", ""),
        &capture,
        &["material=oak"],
        &[],
    );
    let mut arguments = vec![
        "--skip-unusable",
        "--level",
        "2",
        text(&stray),
        text(&capture),
    ];
    arguments.extend(captures.iter().map(|path| text(path)));
    let out = bench.path("most.npz");
    let samples = collected(&out, &arguments);
    assert!(samples.iter().all(|sample| sample.material.is_none()));
    assert_eq!(meta(&out).unwrap()["captures"].as_array().unwrap().len(), 3);
    let list = std::fs::read_to_string(bench.path("most.npz.left-out.tsv")).unwrap();
    let first = text(&captures[0]);
    let expected = format!(
        "{}\ttaxel pitch: found 2 mm, expected 3.5 mm, that of {first}\n{}\t",
        stray.display(),
        capture.display()
    );
    assert!(list.starts_with(&expected), "{list}");
    assert!(list.contains("00.bin: has no material, and "), "{list}");
}
