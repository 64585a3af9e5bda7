//! Recordings become a data set: the frames that the daemon would judge, with labels.

use std::fs;

use hardnessd_core::frame::Pitch;
use hardnessd_core::recording::{Labels, MAGIC};
use hardnessd_core::sensor::Description;
use hardnessd_core::tests::support::of_a_labelled_press;
use hardnessd_core::verdict::{Card, Piece};
use hardnessd_simulator::Split;
use hrn_train::data::presses::{Layout, Press};
use hrn_train::data::source::Kind;
use hrn_train::run::disk;
use serde_json::{Value, json};

use crate::{Desk, FIXTURES, MODELS};

/// A desk with `foam.bin`, raw bytes of presses, which have no labels.
fn desk() -> Desk {
    let desk = Desk::new();
    fs::copy(format!("{FIXTURES}/foam.5hz.bin"), desk.path("foam.bin")).unwrap();
    desk
}

impl Desk {
    /// A recording of one press with these labels, such as `level=1 object=7`.
    fn recording(&self, name: &str, labels: &str) {
        self.recording_of(name, labels, |_| ());
    }

    /// A recording of one press on a sensor that `change` describes.
    fn recording_of(&self, name: &str, labels: &str, change: impl FnOnce(&mut Description)) {
        let labels = labels.split_whitespace().map(|label| {
            let (key, value) = label.split_once('=').unwrap();
            (key.to_owned(), value.to_owned())
        });
        let labels: Labels = labels.collect();
        let (bytes, _) = of_a_labelled_press(&labels, change, None, true);
        self.write(name, bytes);
    }

    /// The presses of the data set after they were collected.
    #[track_caller]
    fn collected(&self, out: &str, arguments: &str) -> Vec<Press> {
        self.succeeds(&format!("collect --out {out} {arguments}"));
        self.presses(out).all
    }

    /// Asserts that the command is refused with this exit code and a line that contains `part`, and that nothing is
    /// written.
    #[track_caller]
    fn assert_refused(&self, out: &str, arguments: &str, code: i32, part: &str) {
        let before = fs::read(self.path(out)).ok();
        self.fails(&format!("collect --out {out} {arguments}"), code, part);
        assert!(fs::read(self.path(out)).ok() == before);
    }

    /// The card of a model trained on the data.
    fn trained(&self, data: &str) -> Card {
        self.succeeds(&format!("train --method features --out run --data {data}"));
        self.model("run/hrn.onnx").card().clone()
    }
}

#[test]
fn samples_are_the_frames_that_the_daemon_judges() {
    let desk = desk();
    let samples = desk.collected("bytes.npz", "--level 0 --object 9 foam.bin");
    let events = fs::read_to_string(format!("{FIXTURES}/foam.5hz.jsonl")).unwrap();
    let events = events
        .lines()
        .map(|line| serde_json::from_str::<Value>(line).unwrap());
    let judged: Vec<Value> = events.filter(|event| event["phase"] == "final").collect();
    assert!(!samples.is_empty() && samples.len() == judged.len());
    let presses = desk.presses("bytes.npz");
    for ((place, sample), verdict) in samples.iter().enumerate().zip(&judged) {
        let frame = presses.frame(place);
        let area = frame.contact_area_taxels(0.07);
        assert_eq!(area, verdict["contact_area_taxels"]);
        let force_n = verdict["force_n"].as_f64().unwrap();
        assert!((frame.force_n() - force_n).abs() < 1e-3);
        assert_eq!((sample.level, sample.object), (0, Some(9)));
    }
}

#[test]
fn labels_are_those_of_the_recording_unless_options_give_others() {
    let desk = desk();
    desk.recording("a.mcap", "level=1 object=7 material=oak shore=95");
    let samples = desk.collected("own.npz", "a.mcap");
    let [sample] = &samples[..] else {
        panic!("one press");
    };
    assert_eq!((sample.level, sample.object), (1, Some(7)));
    assert_eq!((sample.split, sample.shore), (Split::Train, Some(95.0)));
    assert_eq!((sample.material, sample.kind), (Some(0), Kind::Recorded));
    let collector = concat!("hrn-train collect ", env!("CARGO_PKG_VERSION"));
    let described = desk.meta("own.npz");
    assert_eq!(described["materials"], json!(["oak"]));
    assert_eq!(described["generator"], collector);
    assert_eq!(described["seed"], Value::Null);

    // Appending keeps the earlier presses. What a recording does not say is unknown.
    desk.recording("b.mcap", "object=8");
    let both = desk.collected("own.npz", "--append --split test --level 3 b.mcap");
    assert_eq!(both[0], samples[0]);
    assert_eq!((both[1].level, both[1].object), (3, Some(8)));
    assert_eq!((both[1].split, both[1].shore), (Split::Test, None));
    let described = desk.meta("own.npz");
    assert_eq!(described["materials"], json!(["oak", "unknown"]));
    assert_eq!(described["captures"].as_array().unwrap().len(), 2);
    assert_eq!(described["generator"], collector);

    // Recordings of one call without a number are one new object, whatever comes after them.
    desk.recording("c.mcap", "level=1");
    desk.recording("d.mcap", "level=1 note=again");
    desk.recording("e.mcap", "level=1 object=7");
    let samples = desk.collected("objects.npz", "c.mcap d.mcap e.mcap");
    let new = samples[0].object;
    assert_eq!((samples[1].object, samples[2].object), (new, Some(7)));
    desk.recording("f.mcap", "level=1 note=more");
    let samples = desk.collected("objects.npz", "--append f.mcap");
    assert!(![new, Some(7)].contains(&samples[3].object));
}

#[test]
fn recordings_can_be_added_to_simulated_samples() {
    let desk = desk();
    desk.recording("a.mcap", "level=1 object=7 material=oak shore=95");
    let simulate = "simulate --out own.npz --objects 1 --test-objects 1 --presses 1";
    desk.succeeds(simulate);
    let both = desk.collected("own.npz", "--append a.mcap");
    let (first, last) = (&both[0], both.last().unwrap());
    // A material keeps its index, and a new one gets the next one.
    assert_eq!((first.material, last.material), (Some(0), Some(8)));
    assert_eq!(desk.meta("own.npz")["materials"][8], "oak");
    assert!(first.shore.is_some_and(|shore| shore != 95.0));
    assert_eq!((first.kind, last.kind), (Kind::Simulated, Kind::Recorded));
    // The recorded object was learnt, so it validates nothing.
    assert_eq!(desk.trained("own.npz").validation, "simulated data only");
}

#[test]
fn whole_presses_with_the_arms_approach_are_evaluated() {
    let desk = desk();
    desk.recording_of("a.mcap", "level=1 object=7 shore=95", |described| {
        described.sensor.arm.stiffness_n_per_mm = Some(10.0);
    });
    let account = desk.succeeds("collect --out courses.npz --sequences --split test a.mcap");
    let expected = "presses collected: 1, with the arm's approach: 1, in all: 1";
    assert!(account.contains(expected), "{account}");
    let presses = desk.presses("courses.npz");
    let [press] = &presses.all[..] else {
        panic!("one press");
    };
    let of_press = (press.level, press.object, press.shore);
    assert_eq!(of_press, (1, Some(7), Some(95.0)));
    assert_eq!((press.split, press.arm_n_per_mm), (Split::Test, 10.0));
    assert_eq!(press.best, 3);
    let moments = presses.course(0).moments.into_iter();
    let approach = moments.map(|moment| moment.approach_mm.unwrap().round());
    let approach: Vec<f32> = approach.collect();
    assert_eq!(approach, [0.0, 1.0, 2.0, 3.0, 4.0]);
    let force_n = f64::from(press.force_n.unwrap());
    assert!((presses.frame(0).force_n() - force_n).abs() < 0.01);

    // Append presses on another object, without positions of the arm.
    let more = "--sequences --append --split test --level 2 foam.bin";
    let all = desk.collected("courses.npz", more);
    let new = all[1].object;
    let is_new = |press: &Press| press.object == new && press.shore.is_none();
    assert!(new != Some(7) && all[1..].iter().all(is_new));
    let evaluate = format!("evaluate --json --data courses.npz --model {MODELS}/course.onnx");
    assert_eq!(desk.json(&evaluate)["n"], all.len());

    // One file cannot hold both single frames and presses over time.
    let expected = "has whole presses, not single frames";
    desk.assert_refused("courses.npz", "--append --level 1 a.mcap", 1, expected);
}

#[test]
fn the_sensor_and_the_rigid_piece_of_a_press_are_kept() {
    let desk = desk();
    for (name, sensor, labels) in [
        ("a.mcap", "left", "level=1 object=7"),
        ("b.mcap", "right", "level=2 object=8"),
        ("c.mcap", "right", "reference=ball:6 object=9"),
        ("d.mcap", "left", "reference=flat:20 object=10"),
        ("e.mcap", "left", "reference=cube:3"),
    ] {
        desk.recording_of(name, labels, |described| {
            described.sensor.name = sensor.into();
        });
    }
    desk.collected("presses.npz", "--append --sequences a.mcap b.mcap");
    let all = desk.collected("presses.npz", "--append --sequences c.mcap d.mcap");
    let found = all
        .iter()
        .map(|press| (press.level, press.sensor, press.reference));
    let expected = [
        (1, 0, None),
        (2, 1, None),
        (0, 1, Some(Piece::Ball { radius_mm: 6.0 })),
        (0, 0, Some(Piece::Flat { width_mm: 20.0 })),
    ];
    assert!(found.eq(expected), "{all:?}");
    let sensors = json!(["left", "right"]);
    assert_eq!(desk.meta("presses.npz")["sensors"], sensors);
    let expected = "label reference: found \"cube:3\"";
    desk.assert_refused("presses.npz", "--append --sequences e.mcap", 1, expected);
}

#[test]
fn a_model_is_of_the_pitch_of_its_recordings_and_pitches_do_not_mix() {
    let desk = desk();
    let calibration =
        "[[sensor]]\nname = \"a\"\nport = \"b\"\n[sensor.calibration]\npitch_mm = 2.0\n";
    desk.write("narrow.toml", calibration);
    desk.recording_of("narrow.mcap", "material=cork", |described| {
        described.sensor.calibration.pitch_mm = Pitch::square(2.0);
    });
    desk.collected("narrow.npz", "--level 1 narrow.mcap");
    assert_eq!(desk.meta("narrow.npz")["pitch_mm"], 2.0);
    // A .bin file belongs to the configuration's sensor.
    let append = "--append --level 2 --config narrow.toml foam.bin";
    desk.collected("narrow.npz", append);
    assert_eq!(desk.trained("narrow.npz").pitch_mm, 2.0);

    desk.collected("wide.npz", "--level 1 foam.bin");
    let expected = "narrow.mcap: taxel pitch: found 2 mm, expected 3.5 mm, that of wide.npz";
    desk.assert_refused("wide.npz", "--append --level 1 narrow.mcap", 1, expected);
    // Nothing of a recording that is left out stays, not even the name of its material.
    desk.recording("usual.mcap", "level=1 material=oak");
    let skip = "--append --skip-unusable --level 1 narrow.mcap usual.mcap";
    desk.collected("wide.npz", skip);
    let named = json!(["unknown", "oak"]);
    assert_eq!(desk.meta("wide.npz")["materials"], named);

    // A model can be evaluated on data of another pitch.
    for data in ["narrow.npz", "wide.npz"] {
        let evaluate = format!("evaluate --split train --model run/hrn.onnx --data {data}");
        desk.succeeds(&evaluate);
    }
}

#[test]
fn the_levels_of_a_configuration_are_those_of_the_labels_and_of_the_data_set() {
    let desk = desk();
    let sensor = "[[sensor]]\nname = \"a\"\nport = \"b\"\n";
    let level = |label, shore| format!("[[level]]\nlabel = \"{label}\"\nshore = {shore}\n");
    let levels = level("stiff", "[50.0, 100.0]") + &level("limp", "[0.0, 50.0]");
    desk.write("own.toml", format!("{sensor}{levels}"));
    desk.recording("a.mcap", "level=limp");
    let all = desk.collected("own.npz", "--config own.toml a.mcap");
    assert!(all.iter().all(|press| press.level == 2), "{all:?}");
    assert_eq!(desk.meta("own.npz")["levels"][1]["label"], "limp");
    // What is added has the same levels, also without the configuration: the softest is the second.
    desk.recording("b.mcap", "shore=45");
    let all = desk.collected("own.npz", "--append b.mcap");
    assert!(all.iter().all(|press| press.level == 2), "{all:?}");
    assert_eq!(desk.meta("own.npz")["levels"][1]["label"], "limp");
    // Others are refused.
    let other = level("stiff", "[70.0, 100.0]") + &level("limp", "[0.0, 70.0]");
    desk.write("other.toml", format!("{sensor}{other}"));
    let expected = "its levels are not those of --config";
    let append = "--append --config other.toml b.mcap";
    desk.assert_refused("own.npz", append, 1, expected);
}

#[test]
fn nothing_of_a_data_set_is_lost_when_it_is_added_to() {
    let desk = desk();
    desk.collected("own.npz", "--object 1 --level 1 foam.bin");
    desk.recording("a.mcap", "level=1");
    // The same recording once more, and another call that may be writing the same data set.
    fs::copy(desk.path("foam.bin"), desk.path("copy.bin")).unwrap();
    let expected = "copy.bin: the same recording as foam.bin";
    desk.assert_refused("own.npz", "--append --level 1 copy.bin", 1, expected);
    let append = "--append --object 3 a.mcap";
    let locked = disk::lock(&desk.path("own.npz")).unwrap();
    desk.assert_refused("own.npz", append, 1, "another process is at work here");
    drop(locked);

    // A data set that somebody made, with a number in place of a material's name.
    let own = desk.presses("own.npz");
    let write = |change: fn(&mut Press)| {
        let mut presses = own.clone();
        presses.all.iter_mut().for_each(change);
        let meta = json!({"materials": ["oak", 7]});
        desk.write_presses("own.npz", Layout::Frames, &presses, &meta);
    };
    write(|press| press.object = None);
    desk.assert_refused("own.npz", append, 1, "own.npz: has no array `object`");
    write(|press| (press.material, press.force_n) = (Some(1), None));
    let both = desk.collected("own.npz", &format!("{append} --split test"));
    let last = both.last().unwrap();
    assert_eq!((last.object, last.material), (Some(3), Some(2)));
    let named = json!(["oak", "", "unknown"]);
    assert_eq!(desk.meta("own.npz")["materials"], named);
    assert!(last.force_n.is_some() && both[0].force_n.is_none());
    assert_eq!((both[0].kind, last.kind), (Kind::Unknown, Kind::Recorded));
}

#[test]
fn what_cannot_be_collected_is_said_and_nothing_is_written() {
    let desk = desk();
    // An MCAP file of another program: a header, the end of its data and a footer.
    let (header, end, footer) = ([1, 8], [15, 4], [2, 20]);
    let records = [header, end, footer].map(|[kind, length]| {
        let length_bytes = u64::from(length).to_le_bytes();
        [&[kind][..], &length_bytes, &vec![0; usize::from(length)]].concat()
    });
    desk.write("foreign.mcap", [MAGIC, &records.concat(), MAGIC].concat());
    desk.write("empty/notes.txt", "pressed by hand");
    desk.write("archive.npz", "PK\x03\x04");
    desk.recording("wrong.mcap", "level=99");
    desk.write("taken.npz", "somebody's");
    desk.fails_each(
        "
        collect --out own.npz foam.bin | 2 | has no label `level`: give its level with --level
        collect --out own.npz --level 17 foam.bin | 2 | 17
        collect --out own.npz --level 1 none.mcap | 66 | none.mcap
        collect --out own.npz --level 1 foreign.mcap | 1 | found no state of a sensor
        collect --out own.npz archive.npz | 1 | is a data set, not a recording
        collect --out own.npz wrong.mcap | 1 | label level: found \"99\", expected the name
        collect --out own.npz empty | 1 | empty: no recording is in this directory
        collect --out own.npz --level 1 --config none.toml foam.bin | 66 | none.toml
        collect --out taken.npz --level 1 foam.bin | 74 | --append adds to a data set:
        collect --out /dev/null --append --level 1 foam.bin | 66 | /dev/null: found a device",
    );
    assert!(!desk.path("own.npz").exists());
    assert_eq!(desk.read("taken.npz"), b"somebody's");
}

#[test]
fn what_cannot_be_used_is_left_out_with_its_reason() {
    let desk = desk();
    desk.recording("fleet/b.mcap", "level=1 object=7 note=near");
    desk.recording("fleet/a/deep/a.mcap", "level=1 object=7");
    // The length of the first record becomes larger than any.
    let mut bytes = desk.read("fleet/b.mcap");
    bytes[9..17].fill(0xff);
    desk.write("fleet/a/damaged.mcap", bytes);
    // Neither of these is a recording.
    desk.write("fleet/a/notes.txt", "pressed by hand");
    desk.write("fleet/empty.mcap", "");
    desk.write("zeros.bin", [0; 100]);
    let skip = "--skip-unusable foam.bin zeros.bin fleet none.mcap";
    let (code, _, errors) = desk.run(&format!("collect --out fleet.npz {skip}"));
    assert_eq!(code, 0, "{errors}");
    let lines: Vec<&str> = errors.lines().collect();
    assert_eq!(lines.len(), 4, "{errors}");
    for (line, (path, reason)) in lines.into_iter().zip([
        ("foam.bin", "the recording has no label `level`"),
        ("zeros.bin", "no press found"),
        ("fleet/a/damaged.mcap", "damaged"),
        ("none.mcap", "No such file"),
    ]) {
        assert!(line.starts_with(&format!("left out: {path}: ")), "{line}");
        assert!(line.contains(reason), "{line}");
    }
    // The others are there, in the order of the paths.
    desk.collected("only.npz", "fleet/a/deep/a.mcap fleet/b.mcap");
    assert!(desk.read("only.npz") == desk.read("fleet.npz"));
    // A data set needs one recording at least.
    let unusable = "collect --out unusable.npz --skip-unusable none.mcap foam.bin";
    desk.fails(unusable, 1, "no recording can be used");
}
