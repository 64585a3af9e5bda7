//! An arm that a controller moves. The guide to the arm's motion has a controller that withdraws at the early
//! verdict of the daemon.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;

use crate::bench::{Bench, PATIENCE, wait_for};
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
        writeln!(self.0.get_mut(), "{line}").unwrap();
        let mut answer = String::new();
        self.0.read_line(&mut answer).unwrap();
        serde_json::from_str(&answer).unwrap()
    }

    /// Waits until the arm is where it should go. Returns what is true then.
    fn arrive(&mut self) -> Value {
        let mut state = Value::Null;
        wait_for("the arm", || {
            state = self.order("{}");
            state["at_mm"] == state["to_mm"]
        });
        state["truth"].clone()
    }
}

#[test]
fn an_arm_stops_without_its_controller_and_at_a_force_and_refuses_what_it_cannot_do() {
    let bench = Bench::new();
    let options = "--fps 20 --material wood --material foam --link port --arm arm.sock";
    let mut simulator = bench.start(&format!("simulate {options}"));
    let arm = bench.path("arm.sock");
    wait_for("the arm's socket", || UnixStream::connect(&arm).is_ok());
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
    let truth = controller.arrive();
    let force_n = truth["greatest_n"].as_f64().unwrap();
    assert!((50.0..80.0).contains(&force_n), "{truth}");
    assert_eq!(
        (&truth["material"], &truth["level"]),
        (&json!("wood"), &json!(1))
    );
    controller.order(r#"{"to_mm": 0, "speed_mm_s": 20}"#);
    assert_eq!(controller.arrive()["force_n"], 0.0);
    let truth = controller.order(r#"{"object": 2}"#)["truth"].clone();
    assert_eq!(
        (&truth["material"], &truth["greatest_n"]),
        (&json!("foam"), &json!(0.0))
    );
    bench.fails(
        "simulate --arm arm.sock",
        74,
        &["name a new path", "in use"],
    );
    simulator.ends_at(Signal::TERM, 0);
    assert!(!arm.exists());
}
