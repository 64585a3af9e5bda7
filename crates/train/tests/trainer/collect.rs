//! Recordings become a data set: the frames that the daemon would judge, with labels.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use hardnessd_core::frame::Pitch;
use hardnessd_core::recording::Labels;
use hardnessd_core::sensor::Description;
use hardnessd_core::test_support::of_a_labelled_press;
use hardnessd_core::verdict::{Card, Hrn};
use hardnessd_simulator::{self, DatasetSettings, Reference, Split};
use hrn_train::data::presses::{Press, Presses, meta};
use hrn_train::data::simulated;
use hrn_train::data::source::Kind;
use hrn_train::run::disk;
use serde_json::{Value, json};

use crate::{errors, hrn_train, write_data};

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
    // Presses of level 0 are unlabelled: they do not count as presses of a level.
    let error = presses.some_labelled(Split::Train).unwrap_err().to_string();
    assert!(error.contains("bytes.npz"), "{error}");
}

#[test]
fn labels_are_those_of_the_recording_unless_options_give_others() {
    let desk = Desk::new();
    let labels = ["level=1", "object=7", "material=oak", "shore=95"];
    let capture = desk.recording("a.mcap", &labels);
    let capture = text(&capture);
    let out = desk.path("own.npz");
    let samples = collected(&out, &[capture]);
    let [sample] = &samples[..] else {
        panic!("one press");
    };
    assert_eq!((sample.level, sample.object), (1, Some(7)));
    assert_eq!((sample.split, sample.shore), (Split::Train, Some(95.0)));
    // The material is stored as its index among the names.
    assert_eq!(sample.material, Some(0));
    let collector = concat!("hrn-train collect ", env!("CARGO_PKG_VERSION"));
    let described = meta(&out).unwrap();
    assert_eq!(described["materials"], json!(["oak"]));
    assert_eq!(described["generator"], collector);
    assert_eq!(described["seed"], Value::Null);

    // Appending keeps the earlier samples.
    let more = ["--append", "--split", "test", "--level", "3"];
    let both = collected(&out, &[&more[..], &[capture]].concat());
    assert_eq!(both[0], samples[0]);
    assert_eq!((both[1].level, both[1].object), (3, Some(7)));
    assert_eq!(both[1].split, Split::Test);
    let described = meta(&out).unwrap();
    assert_eq!(described["captures"].as_array().unwrap().len(), 2);
    assert_eq!(described["generator"], collector);

    // Recordings of one call without a number are one new object, whatever comes after them.
    let nameless = desk.recording("b.mcap", &["level=1"]);
    let other = desk.recording("c.mcap", &["level=1", "note=again"]);
    let labelled = desk.recording("d.mcap", &["level=1", "object=7"]);
    let objects = desk.path("objects.npz");
    let samples = collected(&objects, &[text(&nameless), text(&other), text(&labelled)]);
    let found: Vec<_> = samples.iter().map(|sample| sample.object).collect();
    assert_eq!(found, [Some(8), Some(8), Some(7)]);
    let more = desk.recording("e.mcap", &["level=1", "note=more"]);
    let samples = collected(&objects, &["--append", text(&more)]);
    assert_eq!(samples[3].object, Some(9));
}

#[test]
fn recordings_can_be_added_to_simulated_samples() {
    let desk = Desk::new();
    let labels = ["level=1", "object=7", "material=oak", "shore=95"];
    let capture = desk.recording("a.mcap", &labels);
    let settings = DatasetSettings {
        objects: 1,
        test_objects: 1,
        presses: 1,
        ..DatasetSettings::default()
    };
    let samples = hardnessd_simulator::dataset(&settings, 1, |_| {});
    let out = desk.write("own.npz", simulated::to_bytes(&settings, samples).unwrap());
    let both = collected(&out, &["--append", text(&capture)]);
    // A material keeps its index, and a new one gets the next one.
    assert_eq!(both[0].material, Some(0));
    assert_eq!(both.last().unwrap().material, Some(8));
    assert_eq!(meta(&out).unwrap()["materials"][8], "oak");
    assert!(both[0].shore.is_some_and(|shore| shore != 95.0));
    // The data set has both sources.
    let both = presses_of(&out);
    assert_eq!(both.sources[0].kinds(), [Kind::Simulated, Kind::Recorded]);
    let card = trained(&desk, &out);
    // The recorded object was learnt, so it validates nothing.
    assert_eq!(card.validation, "simulated data only");
    assert_eq!(card.pitch_mm, 3.5);
}

#[test]
fn shards_give_the_same_data_set_as_one_call() {
    for sequences in [&[][..], &["--sequences"]] {
        let desk = Desk::new();
        let captures = ["1", "2", "3"].map(|object| {
            let material = ["material=oak", "material=pine"][usize::from(object == "2")];
            let labels = ["level=2", &format!("object={object}"), material];
            desk.recording(&format!("{object}.mcap"), &labels)
        });
        let whole = desk.path("whole.npz");
        let arguments = [sequences, &captures.each_ref().map(|path| text(path))].concat();
        assert!(collect(&whole, &arguments).status.success());

        let shards = captures.each_ref().map(|path| path.with_extension("npz"));
        for (shard, capture) in shards.iter().zip(&captures) {
            let output = collect(shard, &[sequences, &[text(capture)]].concat());
            assert!(output.status.success(), "{output:?}");
        }
        let joined = desk.path("joined.npz");
        let shards = shards.each_ref().map(|path| text(path));
        for shards in [&shards[..2], &shards[2..]] {
            let output = collect(&joined, &[&["--append"], sequences, shards].concat());
            assert!(output.status.success(), "{output:?}");
        }
        assert!(fs::read(&joined).unwrap() == fs::read(&whole).unwrap());

        // A shard is not added twice, nor one of the other kind.
        let expected = "the same recording as 1.mcap";
        let again = [&["--append"], sequences, &shards[..1]].concat();
        assert_refused(&joined, &again, 1, expected);
        let (other, expected) = match sequences {
            [] => (&["--sequences"][..], "has single frames, not whole presses"),
            _ => (&[][..], "has whole presses, not single frames"),
        };
        let other = [other, &shards[..1]].concat();
        assert_refused(&desk.path("none.npz"), &other, 1, expected);
    }

    // Objects without a number of their own stay apart.
    let desk = Desk::new();
    let shards = ["x", "y"].map(|name| {
        let labels = ["level=2", &format!("note={name}")];
        let capture = desk.recording("nameless.mcap", &labels);
        let shard = desk.path(name).with_extension("npz");
        assert_eq!(collected(&shard, &[text(&capture)])[0].object, Some(0));
        shard
    });
    let both = desk.path("both.npz");
    let samples = collected(&both, &[text(&shards[0]), text(&shards[1])]);
    let found: Vec<_> = samples.iter().map(|sample| sample.object).collect();
    assert_eq!(found, [Some(0), Some(1)]);
    assert_eq!(meta(&both).unwrap()["captures"][1]["object"], 1);
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
    let expected = "1 press collected, 1 of them with the arm's approach, 0 left out";
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
    let rounded = |value: f32| (value * 1e3).round() as i64;
    let timed = presses.timed(0).moments.into_iter();
    let moments: Vec<_> = timed
        .map(|(time_s, mm)| (rounded(time_s), rounded(mm.unwrap())))
        .collect();
    let expected = [0, 1, 2, 3, 4].map(|step| (200 * step, 1000 * step));
    assert_eq!(moments, expected);

    // Append presses on another object, without positions of the arm.
    let more = ["--sequences", "--append", "--split", "test", "--level", "2"];
    let output = collect(&out, &[&more[..], &[FIXTURE]].concat());
    assert!(output.status.success(), "{output:?}");
    let both = presses_of(&out);
    let added = &both.all[1..];
    let is_new = |press: &Press| press.object == Some(8) && press.shore.is_none();
    assert!(!added.is_empty() && added.iter().all(is_new));
    assert_eq!(both.known(), 1);
    assert_eq!(meta(&out).unwrap()["materials"], json!(["unknown"]));

    let data = ["--model", COURSE_MODEL, "--data", text(&out)];
    let evaluated = hrn_train(&[&["evaluate", "--json"], &data[..]].concat());
    assert!(evaluated.status.success(), "{evaluated:?}");
    let figures: Value = serde_json::from_slice(&evaluated.stdout).unwrap();
    assert_eq!(figures["n"], both.all.len());

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
    let sequences = ["--sequences"];
    for captures in [&captures[..2], &captures[2..]] {
        let arguments = [&["--append"], &sequences[..], captures].concat();
        let output = collect(&out, &arguments);
        assert!(output.status.success(), "{output:?}");
    }
    let all = presses_of(&out).all;
    let found: Vec<_> = all
        .iter()
        .map(|press| (press.level, press.sensor, press.reference))
        .collect();
    let expected = [
        (1, 0, None),
        (2, 1, None),
        (0, 1, Some(Reference::Ball { radius_mm: 6.0 })),
        (0, 0, Some(Reference::Flat { width_mm: 20.0 })),
    ];
    assert_eq!(found, expected);
    assert_eq!(meta(&out).unwrap()["sensors"], json!(["left", "right"]));

    let strange = on("e.mcap", "left", &["reference=cube:3"]);
    let arguments = ["--append", "--sequences", text(&strange)];
    let expected = "label reference: found \"cube:3\"";
    assert_refused(&out, &arguments, 1, expected);
}

#[test]
fn training_says_which_levels_it_cannot_learn() {
    let desk = Desk::new();
    let data = desk.path("one.npz");
    collected(&data, &["--level", "1", FIXTURE]);
    let errors = errors(&train(&desk, &data));
    for expected in [
        "no labelled training press is of level 2, 3 or 4: the model never learns to say it",
        "all training presses of level 1 are of one object",
    ] {
        assert!(errors.contains(expected), "{errors}");
    }
}

/// A configuration of a sensor with taxels every 2 mm.
fn narrow(desk: &Desk) -> PathBuf {
    desk.write(
        "narrow.toml",
        "[[sensor]]\nname = \"a\"\nport = \"b\"\n[sensor.calibration]\npitch_mm = 2.0\n",
    )
}

#[test]
fn a_model_is_of_the_pitch_of_its_recordings_and_pitches_do_not_mix() {
    let desk = Desk::new();
    let config = narrow(&desk);
    let capture = desk.recording_of("narrow.mcap", &[], |described| {
        described.sensor.calibration.pitch_mm = Pitch::square(2.0);
    });
    let capture = text(&capture);
    let out = desk.path("narrow.npz");
    collected(&out, &["--level", "1", capture]);
    assert_eq!(meta(&out).unwrap()["pitch_mm"], 2.0);
    // A .bin file belongs to the configuration's sensor.
    for level in ["1", "2", "3", "4"] {
        let config = ["--config", text(&config), FIXTURE];
        collected(
            &out,
            &[&["--append", "--level", level], &config[..]].concat(),
        );
    }
    assert_eq!(trained(&desk, &out).pitch_mm, 2.0);

    let wide = desk.path("wide.npz");
    collected(&wide, &["--level", "1", FIXTURE]);
    assert_eq!(meta(&wide).unwrap()["pitch_mm"], 3.5);
    let expected = format!(
        "narrow.mcap: taxel pitch: found 2 mm, expected 3.5 mm, that of {}",
        wide.display()
    );
    assert_refused(&wide, &["--append", "--level", "1", capture], 1, &expected);
    let expected = "foam.5hz.bin: taxel pitch: found 3.5 mm, expected 2 mm, that of";
    let mixed = ["--level", "1", capture, FIXTURE];
    assert_refused(&desk.path("mixed.npz"), &mixed, 1, expected);

    // A model can be evaluated on data of another pitch, with a warning.
    let warning = "wide.npz: taxel pitch: found 3.5 mm, expected 2 mm, that of the model\n";
    for (data, expected) in [(&out, ""), (&wide, warning)] {
        assert_warned(&desk.path("run/hrn.onnx"), data, expected);
    }
}

/// Asserts that a model is evaluated on the data with this warning, or with none.
fn assert_warned(model: &Path, data: &Path, expected: &str) {
    let of = ["--model", text(model), "--data", text(data)];
    let output = hrn_train(&[&["evaluate", "--split", "train"], &of[..]].concat());
    let errors = errors(&output);
    assert!(output.status.success(), "{errors}");
    assert_eq!(errors.is_empty(), expected.is_empty(), "{errors}");
    assert!(errors.ends_with(expected), "{errors}");
    assert_eq!(errors.starts_with("warning: "), !expected.is_empty());
}

#[test]
fn a_model_of_presses_is_of_the_pitch_of_its_recordings() {
    let desk = Desk::new();
    let narrow = narrow(&desk);
    let settings = desk.write("settings.toml", "[training]\nepochs = 1\n");
    let [fine, coarse] = ["fine.npz", "coarse.npz"].map(|name| desk.path(name));
    for (level, material) in [
        ("1", "hard-plastic"),
        ("2", "foam"),
        ("3", "soft-candy"),
        ("4", "yoga-mat"),
    ] {
        let capture = FIXTURE.replace("foam", material);
        for (out, config) in [(&fine, &["--config", text(&narrow)][..]), (&coarse, &[])] {
            let given = ["--append", "--sequences", "--level", level, &capture];
            let output = collect(out, &[config, &given].concat());
            assert!(output.status.success(), "{output:?}");
        }
    }
    let run = desk.path("course");
    let train = ["train", "--method", "course", "--config", text(&settings)];
    let whole = ["--out", text(&run), "--data", text(&fine)];
    let output = hrn_train(&[&train[..], &whole].concat());
    let expected = "no labelled training press has a measured Shore hardness";
    assert!(errors(&output).contains(expected), "{output:?}");
    let model = run.join("hrn.onnx");
    let hrn = Hrn::load(&fs::read(&model).unwrap()).unwrap();
    assert_eq!(hrn.card().pitch_mm, 2.0);

    let warning = "coarse.npz: taxel pitch: found 3.5 mm, expected 2 mm, that of the model\n";
    for (data, expected) in [(&fine, ""), (&coarse, warning)] {
        assert_warned(&model, data, expected);
    }
    // Single frames are no presses.
    let frames = desk.path("frames.npz");
    collected(&frames, &["--level", "1", FIXTURE]);
    let of = ["--model", text(&model), "--data", text(&frames)];
    let output = hrn_train(&[&["evaluate", "--split", "train"], &of[..]].concat());
    assert_eq!(output.status.code(), Some(1));
    assert!(errors(&output).contains("single frames"), "{output:?}");
}

#[test]
fn a_recording_is_not_collected_twice() {
    let desk = Desk::new();
    let copy = desk.write("copy.bin", fs::read(FIXTURE).unwrap());
    let copy = text(&copy);
    let out = desk.path("own.npz");
    let expected = format!("{copy}: the same recording as foam.5hz.bin");

    // Neither in one call,
    assert_refused(&out, &["--level", "1", FIXTURE, copy], 1, &expected);
    // nor in a later one.
    let labels = ["--level", "1", "--object", "3"];
    let samples = collected(&out, &[&labels[..], &[FIXTURE]].concat());
    let again = [&labels[..], &["--append", copy]].concat();
    assert_refused(&out, &again, 1, &expected);
    // It may be the recording of another object, because its labels may have been wrong.
    let other = ["--append", "--level", "1", "--object", "4", copy];
    assert_eq!(collected(&out, &other).len(), 2 * samples.len());
}

#[test]
fn nothing_of_a_data_set_is_lost_when_it_is_added_to() {
    let desk = Desk::new();
    let out = desk.path("own.npz");
    let append = ["--append", "--level", "1", FIXTURE];

    let most = ["--object", "4294967295", "--level", "1", FIXTURE];
    let samples = collected(&out, &most);
    let expected = "no number is left for a new object";
    assert_refused(&out, &append, 1, expected);
    let object = [&append[..], &["--object", "3"]].concat();
    let both = collected(&out, &object);
    assert_eq!(both.last().unwrap().object, Some(3));

    // Another call may be writing the same data set.
    let locked = disk::lock(&out).unwrap();
    assert_refused(&out, &object, 1, "another process is at work here");
    drop(locked);

    // A data set has an array for all samples or for none.
    let own = presses_of(&out);
    let write = |change: fn(&mut Press)| {
        let mut presses = own.clone();
        presses.all.truncate(samples.len());
        presses.all.iter_mut().for_each(change);
        write_data(&out, &presses, &json!({}));
    };
    let shown = out.display();
    write(|sample| sample.object = None);
    let expected = format!("{FIXTURE}: has object, and {shown} has not: make it a data set");
    assert_refused(&out, &object, 1, &expected);
    write(|sample| sample.force_n = None);
    assert_refused(&out, &object, 1, "has force, and ");
    write(|sample| sample.shore = Some(70.0));
    let expected = format!("{FIXTURE}: has no shore, and {shown} has: record with --label shore=");
    assert_refused(&out, &object, 1, &expected);
    write(|sample| sample.material = Some(1));
    assert_refused(&out, &object, 1, "has no material, and ");
    // Its materials have no names there. They stay apart from those of a recording.
    let oak = desk.recording("oak.mcap", &["level=1", "material=oak"]);
    collected(&out, &["--append", "--object", "3", text(&oak)]);
    let expected = json!(["material 0", "material 1", "oak"]);
    assert_eq!(meta(&out).unwrap()["materials"], expected);

    // A test object cannot become a training object either, or the other way round.
    write(|sample| sample.split = Split::Test);
    let expected = format!(
        "{FIXTURE}: object 4294967295 is in the train split here, and in the test split before"
    );
    let same = [&append[..], &most[..2]].concat();
    assert_refused(&out, &same, 1, &expected);
    collected(&out, &object);
    // The file does not say who made it, and that is kept too.
    let kinds = presses_of(&out).sources[0].kinds();
    assert_eq!(kinds, [Kind::Unknown, Kind::Recorded]);
}

#[test]
fn what_cannot_be_collected_is_said_and_nothing_is_written() {
    let desk = Desk::new();
    let out = desk.path("own.npz");
    let none = desk.path("none.mcap");
    let zeros = desk.write("zeros.bin", [0; 100]);
    let noise = desk.write("noise.mcap", [7; 1000]);
    let empty = desk.write("empty/notes.txt", "pressed by hand");
    let archive = desk.write("archive.npz", "PK\x03\x04");
    let wrong = desk.recording("wrong.mcap", &["level=99"]);
    for (arguments, code, part) in [
        (
            &[FIXTURE][..],
            2,
            "has no label `level`: give its level with --level",
        ),
        (&["--level", "17", FIXTURE], 2, "17"),
        (&["--level", "1", text(&none)], 66, "none.mcap"),
        (&["--level", "1", text(&zeros)], 1, "no press"),
        (&["--level", "1", text(&noise)], 1, "no press"),
        (&[text(&archive)], 1, "not an .npz file"),
        (
            &[text(&wrong)],
            1,
            "label level: found \"99\", expected the name",
        ),
        (
            &[text(empty.parent().unwrap())],
            1,
            "empty: no recording is in this directory",
        ),
        (
            &["--level", "1", "--config", text(&none), FIXTURE],
            66,
            "none.mcap",
        ),
    ] {
        assert_refused(&out, arguments, code, part);
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
    let fleet = desk.path("fleet");
    let none = desk.path("none.mcap");
    let all = [FIXTURE, text(&fleet), text(&none)];

    let out = desk.path("fleet.npz");
    let list = desk.path("fleet.npz.left-out.tsv");
    let expected = "give its level with --level (to leave out such recordings: --skip-unusable)";
    assert_refused(&out, &all, 2, expected);
    assert!(!list.exists());

    let output = collect(&out, &[&["--skip-unusable"], &all[..]].concat());
    assert!(output.status.success(), "{output:?}");
    let account = String::from_utf8(output.stdout).unwrap();
    let count = format!("{}: 3 recordings left out\n", list.display());
    assert!(account.ends_with(&count), "{account}");
    let lines = fs::read_to_string(&list).unwrap();
    let lines: Vec<_> = lines
        .lines()
        .map(|line| line.split_once('\t').unwrap())
        .collect();
    assert_eq!(lines.len(), 3, "{lines:?}");
    for ((path, reason), (expected, part)) in lines.into_iter().zip([
        (FIXTURE, "the recording has no label `level`"),
        (text(&damaged), "damaged"),
        (text(&none), "No such file"),
    ]) {
        assert_eq!(path, expected);
        assert!(reason.contains(part) && !reason.contains(path), "{reason}");
    }
    // The others are there, in the order of the paths.
    let only = desk.path("only.npz");
    collected(&only, &[text(&far), text(&near)]);
    assert!(fs::read(&only).unwrap() == fs::read(&out).unwrap());

    // A data set needs one recording at least.
    let nothing = ["--skip-unusable", text(&none), FIXTURE];
    let unusable = desk.path("unusable.npz");
    assert_refused(&unusable, &nothing, 1, "no recording can be used: ");
    let list = desk.path("unusable.npz.left-out.tsv");
    assert_eq!(fs::read_to_string(&list).unwrap().lines().count(), 2);
}

#[test]
fn a_data_set_and_its_list_are_added_to_and_never_replaced() {
    let desk = Desk::new();
    let capture = desk.recording("a.mcap", &["level=1", "object=7"]);
    let other = desk.recording("b.mcap", &["level=2", "object=8"]);
    let (out, list) = (desk.path("own.npz"), desk.path("own.npz.left-out.tsv"));
    let (capture, other) = (text(&capture), text(&other));
    let theirs = desk.write("own.npz.part", "theirs");
    collected(&out, &[capture]);
    assert_eq!(fs::read(theirs).unwrap(), b"theirs");
    let expected = "own.npz: exists already: add to it with --append, or name another --out";
    assert_refused(&out, &[other], 74, expected);
    assert_eq!(collected(&out, &["--append", other]).len(), 2);

    fs::remove_file(&out).unwrap();
    fs::write(&list, "theirs\n").unwrap();
    let skipping = ["--skip-unusable", capture, FIXTURE];
    let expected = "own.npz.left-out.tsv: exists already: ";
    assert_refused(&out, &skipping, 74, expected);
    assert_eq!(fs::read_to_string(&list).unwrap(), "theirs\n");
    collected(&out, &[&["--append"], &skipping[..]].concat());
    let lines = fs::read_to_string(&list).unwrap();
    assert!(
        lines.starts_with(&format!("theirs\n{FIXTURE}\t")),
        "{lines}"
    );

    // A pipe takes no data set.
    let expected = "/dev/null: is no file";
    assert_refused(Path::new("/dev/null"), &[other], 74, expected);
}

#[test]
fn the_most_recordings_decide_what_a_data_set_has() {
    let desk = Desk::new();
    let stray = desk.recording_of("stray.mcap", &[], |described| {
        described.sensor.calibration.pitch_mm = Pitch::square(2.0);
    });
    let named = desk.recording("named.mcap", &["material=oak"]);
    let usual = ["1", "2", "3"].map(|n| desk.recording(&format!("{n}.mcap"), &[&format!("n={n}")]));
    let mut arguments = vec![
        "--skip-unusable",
        "--level",
        "2",
        text(&stray),
        text(&named),
    ];
    arguments.extend(usual.iter().map(|path| text(path)));
    let out = desk.path("most.npz");
    let samples = collected(&out, &arguments);
    assert!(samples.len() == 3 && samples.iter().all(|sample| sample.material.is_none()));
    let list = fs::read_to_string(desk.path("most.npz.left-out.tsv")).unwrap();
    let first = usual[0].display();
    let expected = format!(
        "{}\ttaxel pitch: found 2 mm, expected 3.5 mm, that of {first}\n{}\thas material, and {first} \
         has not: ",
        stray.display(),
        named.display()
    );
    assert!(list.starts_with(&expected), "{list}");
}
