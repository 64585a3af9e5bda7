//! An arm that a controller moves: the real simulator and the real daemon, over a pty and sockets.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::process::Stdio;
use std::time::Duration;

use crate::bench::{Bench, Daemon, PATIENCE, Process, by_terminal, fails, wait_for};
use rustix::process::Signal;
use serde_json::{Value, json};

/// A controller of the arm.
struct Controller(BufReader<UnixStream>);

impl Controller {
    fn connect(bench: &Bench) -> Self {
        let stream = UnixStream::connect(bench.path("arm.sock")).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        Self(BufReader::new(stream))
    }

    fn order(&mut self, line: &str) -> Value {
        self.0
            .get_mut()
            .write_all(format!("{line}\n").as_bytes())
            .unwrap();
        let mut answer = String::new();
        self.0.read_line(&mut answer).unwrap();
        serde_json::from_str(&answer).unwrap()
    }

    /// Waits until the arm is where it should go. Returns the state then.
    fn arrive(&mut self) -> Value {
        let mut state = Value::Null;
        wait_for("the arm", || {
            state = self.order("{}");
            state["at_mm"] == state["to_mm"]
        });
        state
    }
}

fn simulator(bench: &Bench, more: &[&str]) -> Process {
    let mut command = by_terminal();
    let options = "simulate --fps 20 --material wood --material foam";
    command
        .args(options.split(' '))
        .arg("--link")
        .arg(bench.path("port"))
        .arg("--arm")
        .arg(bench.path("arm.sock"))
        .args(more)
        .stdout(Stdio::null())
        .stderr(Stdio::null());
    let simulator = Process(command.spawn().unwrap());
    wait_for("the arm's socket", || {
        UnixStream::connect(bench.path("arm.sock")).is_ok()
    });
    simulator
}

#[test]
fn a_controller_that_withdraws_at_the_early_verdict_ends_the_press() {
    let bench = Bench::new();
    let model = "[model]\nearly_confidence = 0.5\n";
    let config = bench.configure("hardnessd.toml", "events.sock", model);
    let text = fs::read_to_string(&config).unwrap();
    // The line takes 68.6 ms, the scan 10.
    let arm = "frame_rate_hz = 20.0\narm = { stiffness_n_per_mm = 10.0, delay_ms = 78.6 }";
    fs::write(&config, text.replace("frame_rate_hz = 20.0", arm)).unwrap();
    let control = bench.path("control.sock");
    let _simulator = simulator(&bench, &["--motion", control.to_str().unwrap()]);
    let _daemon = Daemon::start(&config);
    let mut events = bench.subscriber();
    events.until(&json!({"type": "status", "state": "live"}));
    // The tare takes five frames.
    std::thread::sleep(Duration::from_millis(600));

    let mut controller = Controller::connect(&bench);
    let state = controller.order(r#"{"to_mm": 15}"#);
    assert_eq!(state["to_mm"], 15.0);
    let early = events.until(&json!({"type": "hardness"}));
    assert_eq!(early["phase"], "early", "{early}");
    assert_eq!(early["course"], "positions", "{early}");
    controller.order(r#"{"to_mm": 0, "speed_mm_s": 20}"#);
    events.until(&json!({"type": "press", "state": "end"}));
    let last = events.until(&json!({"type": "hardness"}));
    assert_eq!(
        (&last["phase"], &last["course"]),
        (&json!("final"), &json!("positions"))
    );

    let state = controller.arrive();
    let truth = &state["truth"];
    assert_eq!(truth["material"], "wood");
    assert_eq!(
        (&truth["level"], &truth["force_n"]),
        (&json!(1), &json!(0.0))
    );
    let greatest_n = truth["greatest_n"].as_f64().unwrap();
    let read_n = last["force_n"].as_f64().unwrap();
    assert!(
        (0.3..49.0).contains(&greatest_n) && read_n < 1.4 * greatest_n,
        "{read_n} N read of {greatest_n} N"
    );
    let state = controller.order(r#"{"object": 2}"#);
    assert_eq!(state["truth"]["material"], "foam");
    assert_eq!(state["truth"]["greatest_n"], 0.0);
}

#[test]
fn an_arm_stops_without_its_controller_and_at_a_force_and_refuses_what_it_cannot_do() {
    let bench = Bench::new();
    let mut simulator = simulator(&bench, &[]);
    let mut controller = Controller::connect(&bench);
    for (line, expected) in [
        (r#"{"to_mm": 31}"#, "to_mm: found 31"),
        (r#"{"object": 0}"#, "object: found 0"),
        (r#"{"to": 1}"#, "unknown field `to`"),
        ("no json", "expected ident"),
    ] {
        let answer = controller.order(line);
        let error = answer["error"].as_str().unwrap_or_default();
        assert!(error.starts_with(expected), "{line}: {answer}");
    }
    controller.order(r#"{"object": 1, "to_mm": 30, "speed_mm_s": 2}"#);
    wait_for("the arm", || {
        controller.order("{}")["at_mm"].as_f64() > Some(0.1)
    });
    let answer = controller.order(r#"{"object": 2}"#)["error"].clone();
    let expected = "withdraw it first";
    assert!(answer.as_str().unwrap().ends_with(expected), "{answer}");
    drop(controller);
    let mut controller = Controller::connect(&bench);
    let state = controller.order("{}");
    assert_eq!(state["at_mm"], state["to_mm"], "the arm waits: {state}");
    // 30 mm would be 250 N on wood.
    controller.order(r#"{"to_mm": 30, "speed_mm_s": 20}"#);
    let state = controller.arrive();
    let force_n = state["truth"]["greatest_n"].as_f64().unwrap();
    assert!((50.0..80.0).contains(&force_n), "{state}");
    let arm = bench.path("arm.sock");
    let again = ["simulate", "--arm", arm.to_str().unwrap()];
    fails(&again, 74, &["a daemon serves ", "stop it"]);
    simulator.signal(Signal::TERM);
    assert_eq!(simulator.exit_code(), Some(0));
    assert!(!arm.exists());
}
