//! `fit`: recordings in, the best model out.

use std::fs;
use std::sync::Arc;

use hardnessd_core::event::{Event, Note, Phase};
use hardnessd_core::frame::Array;
use hardnessd_core::pipeline::Input;
use hardnessd_core::recording::{Entry, Found, Playback};
use hardnessd_core::references;
use hardnessd_core::sensor::{self, Description, Sensor};
use hardnessd_core::tests::support::at;
use hardnessd_core::verdict::{Format, ModelFrame};
use hardnessd_simulator::Split;
use hrn_train::data::presses::{Layout, Press, Presses};
use serde_json::{Value, json};

use crate::Desk;

/// Five presses of each object on an array of 4x4 taxels. Each object is its level and the column of the array
/// that feels it, 0 to 3.
fn write(desk: &Desk, name: &str, objects: &[(u8, usize)], levels: &[&str]) {
    write_by("another program", desk, name, objects, levels);
}

/// The same, as this generator would say it.
fn write_by(generator: &str, desk: &Desk, name: &str, objects: &[(u8, usize)], levels: &[&str]) {
    let mut presses = Presses::default();
    for (object, &(level, col)) in (0..).zip(objects) {
        for number in 0..5_u8 {
            let press = Press {
                level,
                object: Some(object),
                material: Some(0),
                force_n: Some(f32::from(number)),
                best: 9,
                ..Press::default()
            };
            let moments = (0..10_u8).map(|moment| {
                let mut frame = ModelFrame::default();
                // No two presses are the same, and this tells no level.
                let own = 0.001 * f32::from((7 * object as u8 + 3 * number) % 11);
                let newtons = 0.1 * f32::from(moment + 1) * (1.0 + 0.2 * f32::from(number)) + own;
                for row in 12..16 {
                    frame.newtons[row * 28 + 12 + col] = newtons;
                }
                (0.1 * f32::from(moment), None, frame.newtons)
            });
            presses.push(press, moments);
        }
    }
    let level = |(number, label): (usize, &&str)| {
        json!({"level": number + 1, "label": label, "shore": if levels.len() == 4 {
            [">70", "61-70", "51-60", "<=50"][number]
        } else {
            "-"
        }})
    };
    let levels: Vec<Value> = levels.iter().enumerate().map(level).collect();
    let meta = json!({
        "grid": [4, 4], "pitch_mm": 3.5, "levels": levels, "generator": generator
    });
    desk.write_presses(name, Layout::OverTime, &presses, &meta);
}

const PAPERS: [&str; 4] = ["hard", "firm", "soft", "very-soft"];

#[test]
fn taxels_that_tell_the_level_become_a_model_of_the_array() {
    let desk = Desk::new();
    // What is pressed looks the same from every column, so only the taxels tell the level.
    let objects = [(1, 0), (1, 0), (2, 2), (2, 2), (2, 2)];
    write(&desk, "d.npz", &objects, &PAPERS);
    let report = desk.json("fit d.npz --out m.onnx --json");
    let found = |name: &str, by: &str| {
        let mut rows = report["candidates"].as_array().unwrap().iter();
        let row = rows.find(|row| row["name"] == name).unwrap();
        row[by]["balanced_accuracy"].as_f64().unwrap()
    };
    assert_eq!(found("taxels", "new_objects"), 1.0);
    assert_eq!(found("taxels", "later_presses"), 1.0);
    assert!(found("features", "new_objects") < 0.9);
    assert_eq!(
        [&report["best"], &report["chosen_by"], &report["writes"]],
        ["taxels", "new_objects", "model"]
    );
    assert_eq!(report["wrong"], json!([]));

    let hrn = desk.model("m.onnx");
    assert_eq!(hrn.format(), Format::Parts);
    assert_eq!(hrn.card().grid, Some(Array { rows: 4, cols: 4 }));
    let evaluation = desk.json("evaluate --json --split train --model m.onnx --data d.npz");
    assert_eq!(evaluation["accuracy"], 1.0);
    // The same through `train`, which takes no copies of presses.
    let objects = [(1, 0), (1, 1), (2, 2), (2, 3)];
    write(&desk, "e.npz", &objects, &PAPERS);
    desk.succeeds("train --method taxels --profile smoke --data e.npz --out run");
    assert_eq!(desk.model("run/hrn.onnx").card().grid, hrn.card().grid);
}

/// The configuration of a sensor with so many taxels a side.
fn config_of(side: usize) -> String {
    format!(
        "[[sensor]]\nname = \"wide\"\nport = \"/dev/null\"\nframe_rate_hz = 20\n[sensor.frame]\nsync = \"AA 55 C3 3C\"\n\
         length = \"none\"\nchecksum = \"none\"\ncell = \"u8\"\nrows = {side}\ncols = {side}\n[sensor.calibration]\n\
         newtons_per_count = 0.05\npitch_mm = 2.0\n"
    )
}

/// A press of a bar of so many rows and columns on that sensor, so far to the right of its middle, as raw bytes.
fn pressed_at(side: usize, [rows, cols]: [usize; 2], hardest: u8, right: usize) -> Vec<u8> {
    let ramp = (1..=10).map(|step| hardest / 10 * step);
    let frame = |counts: u8| {
        let mut cells = vec![0; side * side];
        for row in (side - rows) / 2..(side + rows) / 2 {
            cells[row * side + (side - cols) / 2 + right..][..cols].fill(counts);
        }
        [&[0xAA, 0x55, 0xC3, 0x3C][..], &cells].concat()
    };
    let counts = [0; 6].into_iter().chain(ramp).chain([0; 4]);
    counts.flat_map(frame).collect()
}

fn pressed(side: usize, bar: [usize; 2], hardest: u8) -> Vec<u8> {
    pressed_at(side, bar, hardest, 0)
}

/// Collects presses of an object as its file. The first two objects are of level 1, the next two of level 2.
fn collect(desk: &Desk, object: u8, presses: &[Vec<u8>; 3]) {
    for (number, bytes) in presses.iter().enumerate() {
        desk.write(&format!("{object}{number}.bin"), bytes);
    }
    let level = object / 2 + 1;
    desk.succeeds(&format!(
        "collect --sequences --config wide.toml --level {level} --object {object} --out {object}.npz {object}0.bin \
         {object}1.bin {object}2.bin"
    ));
}

#[test]
fn an_array_larger_than_the_models_is_learnt_and_judged_as_it_is() {
    for side in [32, 64] {
        let desk = Desk::new();
        let config = config_of(side);
        desk.write("wide.toml", &config);
        // Features do not tell a bar along the rows from one along the columns.
        let bars = [[2, 8], [8, 2]];
        for (object, bar) in (0..).zip([bars[0], bars[0], bars[1], bars[1]]) {
            let hardest = [100, 130, 160].map(|hardest| hardest + 10 * object);
            let presses = hardest.map(|hardest| pressed(side, bar, hardest));
            collect(&desk, object, &presses);
        }
        let report =
            desk.json("fit 0.npz 1.npz 2.npz 3.npz --config wide.toml --out m.onnx --json");
        let written = [&report["best"], &report["writes"]];
        assert_eq!(written, ["taxels", "model"]);

        let hrn = desk.model("m.onnx");
        let [rows, cols] = [side; 2];
        let array = Array { rows, cols };
        assert_eq!((hrn.card().grid, hrn.card().pitch_mm), (Some(array), 2.0));
        let config: toml::Table = config.parse().unwrap();
        let sensor: sensor::Settings = config["sensor"][0].clone().try_into().unwrap();
        let sensor = Sensor::new(Description {
            sensor,
            ..Description::default()
        })
        .unwrap();
        let hrn = Arc::new(hrn);
        for (bar, level, hardest) in [(bars[0], 1, 100), (bars[0], 1, 145), (bars[1], 2, 190)] {
            let mut playback = Playback::of_bytes(sensor.clone(), hrn.clone());
            let found = Found {
                sensor: "wide".to_owned(),
                at: at(0),
                entry: Entry::Input(Input::Bytes(pressed(side, bar, hardest))),
            };
            let mut events = playback.feed(found).unwrap();
            events.extend(playback.end());
            // The least and the greatest force of the training are within its range.
            let verdicts = events.into_iter().filter_map(|event| match event {
                Event::Hardness(verdict) if verdict.phase == Phase::Final => Some(verdict),
                _ => None,
            });
            let verdicts: Vec<(Option<u8>, Vec<Note>)> =
                verdicts.map(|of| (of.level, of.notes)).collect();
            assert_eq!(verdicts, [(Some(level), vec![])], "{side}");
        }
        // The pitch is the model's.
        let evaluate = "evaluate --split train --model m.onnx --data 0.npz";
        let (code, _, errors) = desk.run(evaluate);
        assert_eq!((code, &*errors), (0, ""));
        // Presses of an array of another size have no parts of this one, and none are kept.
        desk.write("less.toml", config_of(side - 2));
        desk.write("less.bin", pressed(side - 2, bars[0], 100));
        let append = "collect --sequences --append --config less.toml --level 1 --object 9 --out 0.npz less.bin";
        let (_, _, errors) = desk.run(append);
        let warning = "warning: not all presses have parts of one array";
        assert!(errors.starts_with(warning), "{errors}");
        let meta = desk.meta("0.npz");
        let grid = (&meta["grid"], meta.get("grid_pitch_mm"));
        assert_eq!(grid, (&Value::Null, None));
        assert_eq!(desk.presses("0.npz").all.len(), 4);
    }
}

#[test]
fn presses_scattered_on_a_large_array_are_no_model_of_its_taxels() {
    let desk = Desk::new();
    desk.write("wide.toml", config_of(64));
    for object in 0..4 {
        let presses = [0, 9, 18].map(|right| pressed_at(64, [4, 4], 100 + 20 * object, right));
        collect(&desk, object, &presses);
    }
    let (_, text, _) = desk.run("fit 0.npz 1.npz 2.npz 3.npz --config wide.toml --out m.onnx");
    let expected = "left out: presses fall on different places of a large array";
    assert!(text.contains(expected), "{text}");
}

#[test]
fn an_object_of_two_collected_files_is_one_and_a_copied_press_counts_once() {
    let monday = [(1, 0), (1, 1), (2, 2), (2, 3)];
    let tuesday = [(1, 1), (1, 0), (2, 3), (2, 2)];
    let of = |first: &str, second: &str, objects: &[(u8, usize)]| {
        let desk = Desk::new();
        write_by(first, &desk, "mon.npz", &monday, &PAPERS);
        write_by(second, &desk, "tue.npz", objects, &PAPERS);
        let report = desk.json("fit mon.npz tue.npz --out m.onnx --json");
        let remarks = report["remarks"].to_string();
        (
            report["levels"][0]["objects"].as_u64(),
            report["presses"].as_u64(),
            remarks,
        )
    };
    let (first, second) = ("hrn-train collect 1", "hrn-train collect 2");
    let (objects, presses, remarks) = of(first, second, &tuesday);
    assert_eq!((objects, presses), (Some(2), Some(40)), "{remarks}");
    let (objects, presses, remarks) = of(first, second, &monday);
    assert_eq!((objects, presses), (Some(2), Some(20)), "{remarks}");
    assert!(remarks.contains("20 presses are copies"), "{remarks}");
    let (objects, _, remarks) = of("another", "another", &tuesday);
    assert_eq!(objects, Some(4));
    let expected = "objects of different data sets";
    assert!(remarks.contains(expected), "{remarks}");
}

#[test]
fn presses_that_tell_nothing_become_references() {
    let desk = Desk::new();
    // Each column has every level.
    let objects = [(1, 0), (1, 2), (2, 0), (2, 2), (3, 0), (3, 2)];
    write(&desk, "d.npz", &objects, &PAPERS);
    desk.write("unpressed.bin", [0; 100]);
    let (_, text, errors) = desk.run("fit d.npz unpressed.bin --out m.onnx");
    let expected = "left out: unpressed.bin: no press found";
    assert!(errors.contains(expected), "{errors}");
    assert!(text.contains("these presses become references"), "{text}");
    assert!(!desk.path("m.onnx").exists());
    let references = references::read(&desk.read("m.npz")).unwrap();
    assert_eq!(references.len(), 30, "all presses");
    let line = format!("references = \"{}\"", desk.path("m.npz").display());
    assert!(text.contains(&line), "{text}");
}

#[test]
fn references_that_the_daemon_would_not_use_are_not_written() {
    let desk = Desk::new();
    let simulate =
        "simulate --sequences --objects 3 --test-objects 1 --presses 4 --shapes flat --out s.npz";
    desk.succeeds(simulate);
    let mut presses = desk.presses("s.npz");
    // Levels that have nothing to do with the hardness.
    for (number, press) in (0_u8..).zip(&mut presses.all) {
        let level = (u32::from(number) * 7 / 3 % 4) as u8 + 1;
        (press.level, press.shore, press.split) = (level, None, Split::Train);
    }
    desk.write_presses("d.npz", Layout::OverTime, &presses, &desk.meta("s.npz"));
    let (code, _, errors) = desk.run("fit d.npz --out m.onnx");
    assert_eq!(code, 1, "{errors}");
    assert!(!desk.path("m.npz").exists() && !desk.path("m.onnx").exists());
}

#[test]
fn what_cannot_be_fitted_is_said_in_one_line() {
    let desk = Desk::new();
    let refused = |data: &str, expected: &str| {
        desk.fails(&format!("fit {data} --out m.onnx"), 1, expected);
        assert!(!desk.path("m.onnx").exists() && !desk.path("m.npz").exists());
    };
    // The built-in model cannot say levels without ranges, and nothing else is better than guessing.
    let five = ["a", "b", "c", "d", "e"];
    write(&desk, "d.npz", &[(1, 0), (1, 2), (5, 0), (5, 2)], &five);
    let expected = "nothing was written, because no candidate is better than guessing";
    refused("d.npz", expected);
    write(&desk, "d.npz", &[(1, 0), (2, 2)], &five);
    refused("d.npz", "found 10 labelled presses of 2 objects");
    let expected = "d.npz and d.npz are the same file: name it once";
    refused("d.npz d.npz", expected);
    desk.fails(
        "fit d.npz missing.npz --out m.onnx",
        66,
        "missing.npz: No such file",
    );
    fs::copy(desk.path("d.npz"), desk.path("copy.npz")).unwrap();
    refused("d.npz copy.npz", "copy.npz and d.npz are the same file");
    write(&desk, "d.npz", &[(1, 0), (1, 2), (1, 3)], &five);
    refused("d.npz", "all presses are of one level");
}
