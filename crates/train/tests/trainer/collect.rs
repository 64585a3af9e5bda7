//! Recordings become a data set: the frames that the daemon would judge, with labels.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use hardnessd_core::frame::Pitch;
use hardnessd_core::recording::{Labels, MAGIC};
use hardnessd_core::sensor::Description;
use hardnessd_core::test_support::of_a_labelled_press;
use hardnessd_core::verdict::{Card, Hrn};
use hardnessd_simulator::{Reference, Split};
use hrn_train::data::presses::{Press, Presses, meta};
use hrn_train::data::source::Kind;
use hrn_train::run::disk;
use serde_json::{Value, json};

use crate::{errors, hrn_train, succeed, write_data};

/// Raw bytes of presses, which have no labels.
const FIXTURE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../fixtures/foam.5hz.bin");
/// The events that the daemon makes of them.
const EVENTS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../fixtures/foam.5hz.jsonl");
const COURSE_MODEL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/course.onnx");

/// A directory of recordings and data sets.
struct Desk(tempfile::TempDir);

impl Desk {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn write(&self, name: &str, content: impl AsRef<[u8]>) -> PathBuf {
        let path = self.path(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, content).unwrap();
        path
    }

    /// A recording of one press with these labels.
    fn recording(&self, name: &str, labels: &[&str]) -> PathBuf {
        self.recording_of(name, labels, |_| ())
    }

    /// A recording of one press on a sensor that `change` describes.
    fn recording_of(
        &self,
        name: &str,
        labels: &[&str],
        change: impl FnOnce(&mut Description),
    ) -> PathBuf {
        let labels = labels.iter().map(|label| label.split_once('=').unwrap());
        let labels: Labels = labels
            .map(|(key, value)| (key.to_owned(), value.to_owned()))
            .collect();
        let (bytes, _) = of_a_labelled_press(&labels, change, None, true);
        self.write(name, bytes)
    }
}

fn collect(out: &Path, arguments: &[&str]) -> Output {
    hrn_train(&[&["collect", "--out", text(out)], arguments].concat())
}

fn presses_of(path: &Path) -> Presses {
    Presses::read(&[path.to_owned()]).unwrap()
}

fn collected(out: &Path, arguments: &[&str]) -> Vec<Press> {
    let output = collect(out, arguments);
    assert!(output.status.success(), "{arguments:?}: {output:?}");
    presses_of(out).all
}

/// Asserts that the command is refused with this exit code and one line that contains `part`, and
/// that nothing is written.
#[track_caller]
fn assert_refused(out: &Path, arguments: &[&str], code: i32, part: &str) {
    let before = fs::read(out).ok();
    let output = collect(out, arguments);
    let errors = errors(&output);
    assert_eq!(output.status.code(), Some(code), "{errors}");
    assert!(errors.contains(part), "{errors}\nshould contain\n{part}");
    assert_eq!(errors.lines().count(), 1, "{errors}");
    assert!(fs::read(out).ok() == before);
}

fn train(desk: &Desk, data: &Path) -> Output {
    let (run, method) = (desk.path("run"), ["--method", "features"]);
    let paths = ["--out", text(&run), "--data", text(data)];
    hrn_train(&[&["train"], &method[..], &paths].concat())
}

/// The card of a model trained on the data.
fn trained(desk: &Desk, data: &Path) -> Card {
    let output = train(desk, data);
    assert!(output.status.success(), "{output:?}");
    let model = fs::read(desk.path("run/hrn.onnx")).unwrap();
    Hrn::load(&model).unwrap().card().clone()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn samples_are_the_frames_that_the_daemon_judges() {
    let desk = Desk::new();
    let out = desk.path("bytes.npz");
    let samples = collected(&out, &["--level", "0", "--object", "9", FIXTURE]);
    let events = fs::read_to_string(EVENTS).unwrap();
    let events = events
        .lines()
        .map(|line| serde_json::from_str::<Value>(line).unwrap());
    let judged: Vec<Value> = events.filter(|event| event["phase"] == "final").collect();
    assert!(!samples.is_empty() && samples.len() == judged.len());
    let presses = presses_of(&out);
    for ((place, sample), verdict) in samples.iter().enumerate().zip(&judged) {
        let frame = presses.frame(place);
        assert_eq!(
            frame.contact_area_taxels(0.07),
            verdict["contact_area_taxels"]
        );
        let force_n = verdict["force_n"].as_f64().unwrap();
        assert!((frame.force_n() - force_n).abs() < 1e-3);
        assert_eq!((sample.level, sample.object), (0, Some(9)));
    }
}

#[test]
fn labels_are_those_of_the_recording_unless_options_give_others() {
    let desk = Desk::new();
    let labels = ["level=1", "object=7", "material=oak", "shore=95"];
    let capture = desk.recording("a.mcap", &labels);
    let out = desk.path("own.npz");
    let samples = collected(&out, &[text(&capture)]);
    let [sample] = &samples[..] else {
        panic!("one press");
    };
    assert_eq!((sample.level, sample.object), (1, Some(7)));
    assert_eq!((sample.split, sample.shore), (Split::Train, Some(95.0)));
    assert_eq!((sample.material, sample.kind), (Some(0), Kind::Recorded));
    let collector = concat!("hrn-train collect ", env!("CARGO_PKG_VERSION"));
    let described = meta(&out).unwrap();
    assert_eq!(described["materials"], json!(["oak"]));
    assert_eq!(described["generator"], collector);
    assert_eq!(described["seed"], Value::Null);

    // Appending keeps the earlier presses. What a recording does not say is unknown.
    let other = desk.recording("b.mcap", &["object=8"]);
    let more = ["--append", "--split", "test", "--level", "3", text(&other)];
    let both = collected(&out, &more);
    assert_eq!(both[0], samples[0]);
    assert_eq!((both[1].level, both[1].object), (3, Some(8)));
    assert_eq!((both[1].split, both[1].shore), (Split::Test, None));
    let described = meta(&out).unwrap();
    assert_eq!(described["materials"], json!(["oak", "unknown"]));
    assert_eq!(described["captures"].as_array().unwrap().len(), 2);
    assert_eq!(described["generator"], collector);

    // Recordings of one call without a number are one new object, whatever comes after them.
    let nameless = desk.recording("c.mcap", &["level=1"]);
    let other = desk.recording("d.mcap", &["level=1", "note=again"]);
    let labelled = desk.recording("e.mcap", &["level=1", "object=7"]);
    let objects = desk.path("objects.npz");
    let samples = collected(&objects, &[text(&nameless), text(&other), text(&labelled)]);
    let found: Vec<_> = samples.iter().map(|sample| sample.object).collect();
    assert_eq!(found, [Some(8), Some(8), Some(7)]);
    let more = desk.recording("f.mcap", &["level=1", "note=more"]);
    let samples = collected(&objects, &["--append", text(&more)]);
    assert_eq!(samples[3].object, Some(9));
}

#[test]
fn recordings_can_be_added_to_simulated_samples() {
    let desk = Desk::new();
    let labels = ["level=1", "object=7", "material=oak", "shore=95"];
    let capture = desk.recording("a.mcap", &labels);
    let out = desk.path("own.npz");
    let few = ["--objects", "1", "--test-objects", "1", "--presses", "1"];
    succeed(&[&["simulate", "--out", text(&out)], &few[..]].concat());
    let both = collected(&out, &["--append", text(&capture)]);
    // A material keeps its index, and a new one gets the next one.
    assert_eq!(both[0].material, Some(0));
    assert_eq!(both.last().unwrap().material, Some(8));
    assert_eq!(meta(&out).unwrap()["materials"][8], "oak");
    assert!(both[0].shore.is_some_and(|shore| shore != 95.0));
    let kinds = [&both[0], &both[both.len() - 1]].map(|press| press.kind);
    assert_eq!(kinds, [Kind::Simulated, Kind::Recorded]);
    // The recorded object was learnt, so it validates nothing.
    assert_eq!(trained(&desk, &out).validation, "simulated data only");
}

#[test]
fn whole_presses_with_the_arms_approach_are_evaluated() {
    let desk = Desk::new();
    let labels = ["level=1", "object=7", "shore=95"];
    let capture = desk.recording_of("a.mcap", &labels, |described| {
        described.sensor.arm.stiffness_n_per_mm = Some(10.0);
    });
    let out = desk.path("courses.npz");
    let sequences = ["--sequences", "--split", "test", text(&capture)];
    let output = collect(&out, &sequences);
    let account = String::from_utf8(output.stdout).unwrap();
    let expected = "presses collected: 1, with the arm's approach: 1, in all: 1";
    assert!(account.contains(expected), "{account}");
    let presses = presses_of(&out);
    let [press] = &presses.all[..] else {
        panic!("one press");
    };
    let of_press = (press.level, press.object, press.shore);
    assert_eq!(of_press, (1, Some(7), Some(95.0)));
    assert_eq!((press.split, press.arm_n_per_mm), (Split::Test, 10.0));
    assert_eq!(press.best, 3);
    let force_n = f64::from(press.force_n.unwrap());
    assert!((presses.frame(0).force_n() - force_n).abs() < 0.01);

    // Append presses on another object, without positions of the arm.
    let more = ["--sequences", "--append", "--split", "test", "--level", "2"];
    let all = collected(&out, &[&more[..], &[FIXTURE]].concat());
    let is_new = |press: &Press| press.object == Some(8) && press.shore.is_none();
    assert!(all.len() > 1 && all[1..].iter().all(is_new));
    let data = ["--model", COURSE_MODEL, "--data", text(&out)];
    let figures = succeed(&[&["evaluate", "--json"], &data[..]].concat());
    let figures: Value = serde_json::from_str(&figures).unwrap();
    assert_eq!(figures["n"], all.len());

    // One file cannot hold both single frames and presses over time.
    let single = ["--append", "--level", "1", text(&capture)];
    assert_refused(&out, &single, 1, "has whole presses, not single frames");
}

#[test]
fn the_sensor_and_the_rigid_piece_of_a_press_are_kept() {
    let desk = Desk::new();
    let on = |name: &str, sensor: &'static str, labels: &[&str]| {
        desk.recording_of(name, labels, |described| {
            described.sensor.name = sensor.into();
        })
    };
    let captures = [
        on("a.mcap", "left", &["level=1", "object=7"]),
        on("b.mcap", "right", &["level=2", "object=8"]),
        on("c.mcap", "right", &["reference=ball:6", "object=9"]),
        on("d.mcap", "left", &["reference=flat:20", "object=10"]),
    ];
    let captures = captures.each_ref().map(|path| text(path));
    let out = desk.path("presses.npz");
    let append = ["--append", "--sequences"];
    collected(&out, &[&append, &captures[..2]].concat());
    let all = collected(&out, &[&append, &captures[2..]].concat());
    let found = all
        .iter()
        .map(|press| (press.level, press.sensor, press.reference));
    let expected = [
        (1, 0, None),
        (2, 1, None),
        (0, 1, Some(Reference::Ball { radius_mm: 6.0 })),
        (0, 0, Some(Reference::Flat { width_mm: 20.0 })),
    ];
    assert!(found.eq(expected), "{all:?}");
    assert_eq!(meta(&out).unwrap()["sensors"], json!(["left", "right"]));
    let strange = on("e.mcap", "left", &["reference=cube:3"]);
    let expected = "label reference: found \"cube:3\"";
    assert_refused(
        &out,
        &[&append[..], &[text(&strange)]].concat(),
        1,
        expected,
    );
}

#[test]
fn training_says_which_levels_it_cannot_learn() {
    let desk = Desk::new();
    let data = desk.path("one.npz");
    collected(&data, &["--level", "1", FIXTURE]);
    let errors = errors(&train(&desk, &data));
    for expected in [
        "level 1: all training presses are of one object",
        "level 4: no labelled training press: the model never learns to say it",
    ] {
        assert!(errors.contains(expected), "{errors}");
    }
}

#[test]
fn a_model_is_of_the_pitch_of_its_recordings_and_pitches_do_not_mix() {
    let desk = Desk::new();
    let calibration =
        "[[sensor]]\nname = \"a\"\nport = \"b\"\n[sensor.calibration]\npitch_mm = 2.0\n";
    let config = desk.write("narrow.toml", calibration);
    let capture = desk.recording_of("narrow.mcap", &[], |described| {
        described.sensor.calibration.pitch_mm = Pitch::square(2.0);
    });
    let capture = text(&capture);
    let out = desk.path("narrow.npz");
    collected(&out, &["--level", "1", capture]);
    assert_eq!(meta(&out).unwrap()["pitch_mm"], 2.0);
    // A .bin file belongs to the configuration's sensor.
    let append = [
        "--append",
        "--level",
        "2",
        "--config",
        text(&config),
        FIXTURE,
    ];
    collected(&out, &append);
    assert_eq!(trained(&desk, &out).pitch_mm, 2.0);

    let wide = desk.path("wide.npz");
    collected(&wide, &["--level", "1", FIXTURE]);
    let expected = format!(
        "narrow.mcap: taxel pitch: found 2 mm, expected 3.5 mm, that of {}",
        wide.display()
    );
    assert_refused(&wide, &["--append", "--level", "1", capture], 1, &expected);

    // A model can be evaluated on data of another pitch, with a warning.
    let model = desk.path("run/hrn.onnx");
    for (data, is_warned) in [(&out, false), (&wide, true)] {
        let of = ["--model", text(&model), "--data", text(data)];
        let output = hrn_train(&[&["evaluate", "--split", "train"], &of[..]].concat());
        let errors = errors(&output);
        assert!(output.status.success(), "{errors}");
        let warning = "wide.npz: taxel pitch: found 3.5 mm, expected 2 mm, that of the model";
        assert_eq!(errors.contains(warning), is_warned, "{errors}");
    }
}

#[test]
fn nothing_of_a_data_set_is_lost_when_it_is_added_to() {
    let desk = Desk::new();
    let out = desk.path("own.npz");
    let most = ["--object", "4294967295", "--level", "1", FIXTURE];
    collected(&out, &most);
    let capture = desk.recording("a.mcap", &["level=1"]);
    let append = ["--append", text(&capture)];
    assert_refused(&out, &append, 1, "no number is left for a new object");
    // The same recording once more, and another call that may be writing the same data set.
    let copy = desk.write("copy.bin", fs::read(FIXTURE).unwrap());
    let again = ["--append", "--level", "1", text(&copy)];
    assert_refused(
        &out,
        &again,
        1,
        "copy.bin: the same recording as foam.5hz.bin",
    );
    let object = [&append[..], &["--object", "3"]].concat();
    let locked = disk::lock(&out).unwrap();
    assert_refused(&out, &object, 1, "another process is at work here");
    drop(locked);

    // A data set that somebody made, without names of its materials.
    let own = presses_of(&out);
    let write = |change: fn(&mut Press)| {
        let mut presses = own.clone();
        presses.all.iter_mut().for_each(change);
        write_data(&out, &presses, &json!({}));
    };
    write(|press| press.object = None);
    assert_refused(&out, &object, 1, "own.npz: has no array `object`");
    write(|press| (press.material, press.force_n) = (Some(1), None));
    let both = collected(&out, &[&object[..], &["--split", "test"]].concat());
    let last = both.last().unwrap();
    assert_eq!((last.object, last.material), (Some(3), Some(2)));
    assert!(last.force_n.is_some() && both[0].force_n.is_none());
    assert_eq!((both[0].kind, last.kind), (Kind::Unknown, Kind::Recorded));
    // An object in both splits is said.
    let other = desk.recording("b.mcap", &["level=1", "object=3"]);
    let output = collect(&out, &["--append", text(&other)]);
    assert!(
        errors(&output).contains("object 3 is in both splits"),
        "{output:?}"
    );
}

#[test]
fn what_cannot_be_collected_is_said_and_nothing_is_written() {
    let desk = Desk::new();
    let out = desk.path("own.npz");
    let none = desk.path("none.mcap");
    let zeros = desk.write("zeros.bin", [0; 100]);
    // An MCAP file of another program: a header, the end of its data and a footer.
    let (header, end, footer) = ([1, 8], [15, 4], [2, 20]);
    let records = [header, end, footer].map(|[kind, length]| {
        let length_bytes = u64::from(length).to_le_bytes();
        [&[kind][..], &length_bytes, &vec![0; usize::from(length)]].concat()
    });
    let foreign = desk.write("foreign.mcap", [MAGIC, &records.concat(), MAGIC].concat());
    let empty = desk.write("empty/notes.txt", "pressed by hand");
    let archive = desk.write("archive.npz", "PK\x03\x04");
    let wrong = desk.recording("wrong.mcap", &["level=99"]);
    let taken = desk.write("taken.npz", "somebody's");
    for (out, arguments, code, part) in [
        (
            &out,
            &[FIXTURE][..],
            2,
            "has no label `level`: give its level with --level",
        ),
        (&out, &["--level", "17", FIXTURE], 2, "17"),
        (&out, &["--level", "1", text(&none)], 66, "none.mcap"),
        (&out, &["--level", "1", text(&zeros)], 1, "no press"),
        (
            &out,
            &["--level", "1", text(&foreign)],
            1,
            "found no state of a sensor",
        ),
        (&out, &[text(&archive)], 1, "is a data set, not a recording"),
        (
            &out,
            &[text(&wrong)],
            1,
            "label level: found \"99\", expected the name",
        ),
        (
            &out,
            &[text(empty.parent().unwrap())],
            1,
            "empty: no recording is in this directory",
        ),
        (
            &out,
            &["--level", "1", "--config", text(&none), FIXTURE],
            66,
            "none.mcap",
        ),
        (
            &taken,
            &["--level", "1", FIXTURE],
            74,
            "taken.npz: exists already: add to it with --append",
        ),
        (
            &PathBuf::from("/dev/null"),
            &["--level", "1", FIXTURE],
            74,
            "/dev/null: is no file",
        ),
    ] {
        assert_refused(out, arguments, code, part);
    }
}

#[test]
fn what_cannot_be_used_is_left_out_with_its_reason() {
    let desk = Desk::new();
    let near = desk.recording("fleet/b.mcap", &["level=1", "object=7", "note=near"]);
    let far = desk.recording("fleet/a/deep/a.mcap", &["level=1", "object=7"]);
    // The length of the first record becomes larger than any.
    let mut bytes = fs::read(&near).unwrap();
    bytes[9..17].fill(0xff);
    let damaged = desk.write("fleet/a/damaged.mcap", bytes);
    // Neither of these is a recording.
    desk.write("fleet/a/notes.txt", "pressed by hand");
    desk.write("fleet/empty.mcap", "");
    let (fleet, none) = (desk.path("fleet"), desk.path("none.mcap"));
    let out = desk.path("fleet.npz");
    let skip = ["--skip-unusable", FIXTURE, text(&fleet), text(&none)];
    let output = collect(&out, &skip);
    let errors = errors(&output);
    assert!(output.status.success(), "{errors}");
    let lines: Vec<&str> = errors.lines().collect();
    assert_eq!(lines.len(), 3, "{errors}");
    for (line, (path, reason)) in lines.into_iter().zip([
        (FIXTURE, "the recording has no label `level`"),
        (text(&damaged), "damaged"),
        (text(&none), "No such file"),
    ]) {
        assert!(line.starts_with(&format!("left out: {path}: ")), "{line}");
        assert!(line.contains(reason), "{line}");
    }
    // The others are there, in the order of the paths.
    let only = desk.path("only.npz");
    collected(&only, &[text(&far), text(&near)]);
    assert!(fs::read(&only).unwrap() == fs::read(&out).unwrap());
    // A data set needs one recording at least.
    let output = collect(
        &desk.path("unusable.npz"),
        &["--skip-unusable", text(&none), FIXTURE],
    );
    assert_eq!(output.status.code(), Some(1), "{output:?}");
}
