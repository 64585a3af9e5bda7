//! `hardnessd record --session` on a real pty, with a simulated sensor: its questions and files.

use std::fs;

use hardnessd_core::recording::{Entry, object_of};
use serde_json::json;

use crate::bench::{Bench, Terminal};

/// Starts a session in the directory `own`, with a sensor.
fn session(bench: &Bench, options: &str) -> Terminal {
    let [config, own] = ["hardnessd.toml", "own"].map(|name| bench.text_path(name));
    Terminal::start(&format!(
        "record --config {config} --session {own} {options}"
    ))
}

/// Waits for each of the questions, and answers it.
fn talk(session: &mut Terminal, exchange: &[(&str, &str)]) {
    for (question, answer) in exchange {
        session.sees(question);
        session.types(&format!("{answer}\n"));
    }
}

fn files(bench: &Bench) -> usize {
    fs::read_dir(bench.path("own")).unwrap().count()
}

#[test]
fn a_session_asks_for_each_object_and_labels_its_recording() {
    let bench = Bench::new();
    bench.configure_forearm("");
    let _sensor = bench.sensor("");

    let mut session = session(&bench, "");
    talk(
        &mut session,
        &[
            ("object 1: its name: ", ""),
            ("the name is empty", "Yoga mat"),
            ("its level (hard, firm, soft, very-soft)", "7x"),
            ("found \"7x\", expected a Shore OO reading", "Very-Soft"),
        ],
    );
    session.sees("the zero is taken: press now");
    session.sees("verdict 1: ");
    session.sees(", you said very-soft; ");
    session.sees(" of 1 right");
    let answers = [
        ("verdict 2: ", ""),
        ("object 2: its name: ", "a \"b\", c"),
        ("its level", ""),
        ("verdict 1: ", "q"),
    ];
    talk(&mut session, &answers);
    session.sees("recorded 2 objects");
    session.sees(" right");
    let fit = format!("hrn-train fit {} --out own.onnx", bench.text_path("own"));
    session.sees(&fit);
    session.ends();
    assert_eq!(files(&bench), 2);
    assert!(bench.path("own/002-a--b---c.mcap").exists());
    let Entry::State(state) = &bench.entries("own/001-yoga-mat.mcap")[0].entry else {
        panic!("a recording begins with a state");
    };
    let labels = ["object", "name", "level"].map(|key| state.labels[key].as_str());
    let object = object_of("Yoga mat").to_string();
    assert_eq!(labels, [object.as_str(), "Yoga mat", "4"]);

    // The next session continues, and a session without a press leaves no file.
    let mut session = self::session(&bench, "");
    talk(&mut session, &[("object 3: its name: ", "q")]);
    session.sees("recorded 0 objects");
    session.ends();
    assert_eq!(files(&bench), 2);
}

#[test]
fn a_reading_gives_the_level_and_no_line_of_the_log_cuts_through_a_question() {
    let bench = Bench::new();
    // A verdict is never that sure.
    bench.configure_forearm("[model]\nmin_confidence = 1.0");
    let _sensor = bench.sensor("");

    let mut session = session(&bench, "--sockets");
    talk(
        &mut session,
        &[
            ("object 1: its name: ", "foam"),
            ("its Shore OO reading, ", "65.5"),
        ],
    );
    session.sees("level 2 (firm)");
    session.sees("press now");
    let mut subscriber = bench.subscriber();
    session.sees("verdict 1: no level, you said firm; 0 of 1 right, 0 wrong, 1 without a level");
    subscriber.until(&json!({"type": "press", "state": "begin", "press": 2}));
    // The recording ends in the middle of a press, and the log warns of that, or of a slow machine.
    session.types("\n");
    let before = session.sees("object 2: its name: ");
    assert!(before.contains("WARN"), "{before:?}");
    session.types("sponge\n");
    let between = session.sees("its Shore OO reading, ");
    assert!(!between.contains("WARN"), "{between:?}");
    session.types("q\n");
    session.sees("recorded 1 object in");
    session.ends();
    assert!(bench.path("own/001-foam.mcap").exists());
}

#[test]
fn a_session_needs_its_sensor_before_the_first_question_and_then_waits_for_it() {
    let bench = Bench::new();
    let mut daemon = bench.daemon();
    let mut sensor = bench.sensor("");
    bench.subscriber().state("live");
    let mut refused = session(&bench, "");
    let before = refused.sees("held by process");
    assert_eq!(refused.process.exit_code(), Some(69));
    assert!(!before.contains("object 1"), "{before:?}");
    daemon.end();

    let mut session = session(&bench, "--sockets");
    talk(
        &mut session,
        &[
            ("object 1: its name: ", "foam"),
            ("its Shore OO reading, ", ""),
        ],
    );
    session.sees("press now");
    let mut subscriber = bench.subscriber();
    session.sees("verdict 1: ");
    subscriber.until(&json!({"type": "press", "state": "begin", "press": 2}));
    bench.unplug(&mut sensor);
    for line in ["waiting for it", "press again"] {
        session.sees(line);
    }
    let _sensor = bench.sensor("");
    session.sees("the sensor is back");
    talk(&mut session, &[("verdict 2: ", "q")]);
    session.sees("recorded 1 object in");
    session.ends();
}

#[test]
fn a_session_needs_a_terminal_and_asks_for_its_labels_itself() {
    let bench = Bench::new();
    bench.configure_forearm("");
    for (more, part) in [
        ("", "needs a terminal"),
        ("--label level=2", "--session asks for it"),
        ("--out x.mcap", "cannot be used with"),
    ] {
        let line = format!("record --config hardnessd.toml --session own {more}");
        bench.fails(&line, 2, &[part]);
    }
    assert!(!bench.path("own").exists());
}
