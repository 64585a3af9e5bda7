//! What is known of a fleet, as a table or as JSON lines.
//!
//! In: the fleet and the time. Out: text that a terminal can show, whatever strangers sent.

use jiff::Timestamp;
use serde_json::{Value, json};

use super::robots::{Fleet, Robot, Sensor, read, time};
use crate::tools::answer::Answer;
use crate::tools::readable::json_escaped;
use hardnessd_core::event::round_3;
use hardnessd_core::frame::Stamp;
use hardnessd_core::wording::escaped;

/// Clears the terminal, so that a table takes the place of the last one.
pub(super) const CLEAR: &str = "\u{1b}[2J\u{1b}[H";

/// More characters of a cell are cut off.
const WIDEST: usize = 40;

/// A line for each sensor of which something is new, and for each such robot without sensors.
pub(super) fn lines(fleet: &mut Fleet, now: Stamp) -> String {
    let mut lines = String::new();
    for (site, sensors) in fleet.take_new() {
        let Some(robot) = fleet.robot(&site) else {
            continue;
        };
        if robot.sensors.is_empty() {
            lines += &line(&site, robot, None, now);
        }
        for name in sensors {
            if let Some(sensor) = robot.sensors.get(&name) {
                lines += &line(&site, robot, Some((&name, sensor)), now);
            }
        }
    }
    lines
}

fn line(site: &str, robot: &Robot, of: Option<(&str, &Sensor)>, now: Stamp) -> String {
    let hello = robot.hello.as_ref();
    let sensor = of.map(|(_, sensor)| sensor);
    let json =
        |text: fn(&Sensor) -> &String| sensor.map_or(Value::Null, |sensor| read(text(sensor)));
    let verdict = json(|sensor| &sensor.verdict);
    let line = json!({
        "robot": site,
        "there": robot.is_there,
        "gone_s": robot.gone.map(|gone| since(now, gone)),
        "run": hello.map(|hello| &hello.run),
        "version": hello.map(|hello| &hello.version),
        "model": hello.map(|hello| hello.model.sha256.chars().take(12).collect::<String>()),
        "received": robot.received,
        "missed": robot.missed(),
        "restarts": robot.restarts,
        "sensor": of.map(|(name, _)| name),
        "state": sensor.map(|sensor| robot.state(sensor, now)),
        "heard": sensor.map(|sensor| sensor.received_at.wall),
        "status": json(|sensor| &sensor.status),
        "verdict_age_s": time(&verdict).map(|then| aged(now, then)),
        "verdict_heard": sensor.and_then(|sensor| sensor.verdict_at),
        "verdict": verdict,
    });
    json_escaped(&line.to_string()) + "\n"
}

const HEAD: [&str; 9] = [
    "ROBOT",
    "SENSOR",
    "STATE",
    "HEARD",
    "FRAMES/S",
    "DAMAGED",
    "LAST VERDICT",
    "AGE",
    "MISSED",
];

/// Every sensor of every robot.
pub(super) fn table(fleet: &Fleet, now: Stamp) -> String {
    let mut rows = vec![HEAD.map(str::to_owned)];
    let (mut robots, mut there) = (0, 0);
    for (site, robot) in fleet.robots() {
        robots += 1;
        there += usize::from(robot.is_there);
        if robot.sensors.is_empty() {
            let state = match robot.gone {
                Some(gone) => format!("gone {}", age(since(now, gone))),
                None => "no answer".to_owned(),
            };
            let mut row = [const { String::new() }; 9];
            (row[0], row[2], row[8]) = (shown(site), state, missed(robot));
            rows.push(row);
        }
        for (name, sensor) in &robot.sensors {
            rows.push(row(site, robot, name, sensor, now));
        }
    }
    let mut text = aligned(&rows);
    let plural = if robots == 1 { "" } else { "s" };
    text += &format!(
        "{robots} robot{plural}, {there} there, {} not there",
        robots - there
    );
    if fleet.left_out() > 0 {
        text += &format!(", {} messages left out", fleet.left_out());
    }
    text + "\n"
}

fn row(site: &str, robot: &Robot, name: &str, sensor: &Sensor, now: Stamp) -> [String; 9] {
    let state = robot.state(sensor, now);
    let is_current = !["gone", "no answer"].contains(&&*state);
    let (status, verdict) = (read(&sensor.status), read(&sensor.verdict));
    let rate = status["frame_rate_hz"].as_f64().filter(|_| is_current);
    let damaged = status["frames_damaged"].as_u64();
    [
        shown(site),
        shown(name),
        match robot.gone {
            Some(gone) => format!("gone {}", age(since(now, gone))),
            None => shown(&state),
        },
        age(since(now, sensor.received_at)),
        rate.map_or_else(String::new, |hz| format!("{hz:.1}")),
        damaged.map_or_else(String::new, |damaged| damaged.to_string()),
        judged(&verdict, robot),
        time(&verdict).map_or_else(String::new, |then| age(aged(now, then))),
        missed(robot),
    ]
}

/// The events of a robot that did not come. After a restart, nobody knows what its last run still sent.
fn missed(robot: &Robot) -> String {
    match robot.restarts {
        0 => robot.missed().to_string(),
        1 => format!("{}, 1 restart", robot.missed()),
        restarts => format!("{}, {restarts} restarts", robot.missed()),
    }
}

fn judged(verdict: &Value, robot: &Robot) -> String {
    let Some(press) = verdict["press"].as_u64() else {
        return String::new();
    };
    let sure = verdict["confidence"].as_f64().unwrap_or_default() * 100.0;
    let levels = robot.hello.iter().flat_map(|hello| &hello.model.levels);
    let labels: Vec<String> = levels.map(|level| level.label.clone()).collect();
    let answer = Answer::of(verdict, &labels);
    format!("#{press} {} {sure:.0} %", shown(&answer.text))
}

/// Seconds since `then`, by the clock of this machine that nobody sets.
fn since(now: Stamp, then: Stamp) -> f64 {
    round_3(now.mono.saturating_sub(then.mono).as_secs_f64())
}

/// Seconds since a robot's `then`. Clocks of two machines differ: what is of the future is new.
fn aged(now: Stamp, then: Timestamp) -> f64 {
    round_3(now.wall.duration_since(then).as_secs_f64().max(0.0))
}

fn age(seconds: f64) -> String {
    match seconds {
        s if s < 120.0 => format!("{s:.0} s"),
        s if s < 7200.0 => format!("{:.0} min", s / 60.0),
        s => format!("{:.0} h", s / 3600.0),
    }
}

/// Text from elsewhere, which must not speak to the terminal.
fn shown(text: &str) -> String {
    let text = escaped(text);
    match text.char_indices().nth(WIDEST) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text,
    }
}

fn aligned<const N: usize>(rows: &[[String; N]]) -> String {
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max();
    let widths: [usize; N] = std::array::from_fn(|column| width(column).unwrap_or_default());
    let mut text = String::new();
    for row in rows {
        let cells = row.iter().zip(widths);
        let line: String = cells
            .map(|(cell, width)| format!("{cell:<width$}  "))
            .collect();
        text += line.trim_end();
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::super::session::{FleetEvent, Hello, Model, News, What};
    use super::*;
    use hardnessd_core::wording::named;

    fn at(second: u64) -> Stamp {
        Stamp {
            mono: Duration::from_secs(1000 + second),
            wall: Timestamp::UNIX_EPOCH + Duration::from_secs(1_795_255_200 + second),
        }
    }

    fn learn(fleet: &mut Fleet, what: What, second: u64) {
        let site = "hall/3".to_owned();
        let at = at(second);
        fleet.learn(News::Robot { site, what, at });
    }

    fn event(json: &Value) -> What {
        What::Event(FleetEvent {
            kind: named(json["type"].as_str().unwrap()).unwrap(),
            sensor: json["sensor"].as_str().unwrap().to_owned(),
            seq: json["seq"].as_u64(),
            is_final: json["phase"] == "final",
            is_answer: json["seq"].is_null(),
            text: json.to_string(),
        })
    }

    fn hello(run: &str, seq: u64) -> What {
        What::Hello(Hello {
            run: run.to_owned(),
            version: "0.1.0".to_owned(),
            seq,
            model: Model {
                sha256: "0123456789abcdef".to_owned(),
                levels: Vec::new(),
            },
        })
    }

    fn status(seq: Option<u64>) -> Value {
        json!({"type": "status", "sensor": "palm", "state": "live", "seq": seq,
            "frame_rate_hz": 20.04, "frames_damaged": 3})
    }

    fn fleet() -> Fleet {
        let mut fleet = Fleet::default();
        learn(&mut fleet, What::Came, 0);
        learn(&mut fleet, hello("a", 5), 0);
        let verdict = json!({"type": "hardness", "phase": "final", "sensor": "palm", "press": 7,
            "level": 2, "label": "fi\u{1b}r\u{202e}m", "confidence": 0.934, "time": (at(0).wall - Duration::from_secs(10)).to_string(), "seq": 7});
        let early = json!({"type": "hardness", "phase": "early", "sensor": "palm", "press": 8,
            "label": "soft", "seq": 8});
        for json in [&status(Some(6)), &verdict, &early] {
            learn(&mut fleet, event(json), 0);
        }
        fleet
    }

    fn squeezed(text: &str) -> String {
        text.split_whitespace().collect::<Vec<_>>().join(" ")
    }

    fn one_line(fleet: &mut Fleet, second: u64) -> Value {
        serde_json::from_str(&lines(fleet, at(second))).unwrap()
    }

    #[test]
    fn a_table_has_the_last_word_of_each_sensor() {
        let mut fleet = fleet();
        let found = table(&fleet, at(2));
        let expected = r"
ROBOT   SENSOR  STATE  HEARD  FRAMES/S  DAMAGED  LAST VERDICT                   AGE   MISSED
hall/3  palm    live   2 s    20.0      3        #7 fi\u{1b}r\u{202e}m 93 %  12 s  0
1 robot, 1 there, 0 not there";
        assert_eq!(squeezed(&found), squeezed(expected), "{found}");
        // A token that stays while the robot says nothing.
        let found = table(&fleet, at(30));
        assert!(
            found.contains("no answer") && !found.contains("20.0"),
            "{found}"
        );
        learn(&mut fleet, What::Gone, 3);
        let found = table(&fleet, at(8));
        assert!(
            found.contains("gone 5 s") && !found.contains("live"),
            "{found}"
        );
        learn(&mut fleet, What::Came, 9);
        learn(&mut fleet, event(&status(None)), 9);
        let found = table(&fleet, at(9));
        assert!(
            found.contains("live") && !found.contains("gone "),
            "{found}"
        );
    }

    #[test]
    fn a_line_comes_only_when_something_is_new_and_has_no_hidden_character() {
        let mut fleet = fleet();
        let text = lines(&mut fleet, at(2));
        assert!(text.contains(r"fi\u001br\u202em"), "{text}");
        let line: Value = serde_json::from_str(&text).unwrap();
        assert_eq!(
            (&line["robot"], &line["state"]),
            (&json!("hall/3"), &json!("live"))
        );
        assert_eq!(
            (&line["verdict"]["press"], &line["model"]),
            (&json!(7), &json!("0123456789ab"))
        );
        assert_eq!(line["verdict_age_s"], 12.0);
        assert_eq!(lines(&mut fleet, at(2)), "");
        learn(&mut fleet, What::Gone, 2);
        let line = one_line(&mut fleet, 2);
        assert_eq!(
            (&line["there"], &line["state"]),
            (&json!(false), &json!("gone"))
        );
    }

    #[test]
    fn what_a_robot_sent_while_it_was_cut_off_is_missed() {
        let mut fleet = fleet();
        learn(&mut fleet, What::Gone, 3);
        learn(&mut fleet, What::Came, 60);
        learn(&mut fleet, event(&status(Some(20))), 60);
        // The event of the number 22 is on its way.
        learn(&mut fleet, hello("a", 22), 60);
        assert_eq!(one_line(&mut fleet, 60)["missed"], 11);
        fleet.settle(at(61));
        assert_eq!(lines(&mut fleet, at(61)), "");
        learn(&mut fleet, event(&status(Some(21))), 61);
        fleet.settle(at(63));
        let line = one_line(&mut fleet, 63);
        let counts = ["missed", "received", "restarts"].map(|key| line[key].as_u64().unwrap());
        assert_eq!(counts, [12, 5, 0]);
    }

    #[test]
    fn a_daemon_that_starts_anew_counts_from_one_again() {
        let mut fleet = fleet();
        learn(&mut fleet, What::Gone, 3);
        learn(&mut fleet, What::Came, 4);
        for seq in [3, 4] {
            learn(&mut fleet, event(&status(Some(seq))), 4);
        }
        // It did not answer in time. The next question is answered.
        learn(&mut fleet, What::Asked, 4);
        learn(&mut fleet, hello("b", 4), 4);
        fleet.settle(at(7));
        let line = one_line(&mut fleet, 7);
        let counts = ["missed", "received", "restarts"].map(|key| line[key].as_u64().unwrap());
        assert_eq!(counts, [2, 5, 1]);
        assert!(table(&fleet, at(7)).contains("2, 1 restart"));
    }

    #[test]
    fn tokens_that_are_asked_for_mend_what_was_dropped() {
        let mut fleet = Fleet::default();
        let mut learn = |name: &str, what, second| {
            let (site, at) = (name.to_owned(), at(second));
            fleet.learn(News::Robot { site, what, at });
        };
        for name in ["stayed", "went", "was replaced"] {
            learn(name, What::Came, 0);
            learn(name, hello("a", 0), 0);
        }
        // The end of one and the beginning of another are dropped.
        learn("came", event(&status(Some(1))), 5);
        // Asked at 10. These are older and newer than the answers.
        learn("went before", What::Came, 8);
        learn("came since", What::Came, 11);
        for name in ["stayed", "came", "was replaced", "went since"] {
            learn(name, What::There, 10);
        }
        learn("went since", What::Gone, 11);
        learn("was replaced", What::Came, 12);
        learn("went since", What::There, 10);
        fleet.learn(News::Tokens(at(10)));
        let there: Vec<_> = fleet.robots().filter(|(_, robot)| robot.is_there).collect();
        let there: Vec<&str> = there.into_iter().map(|(name, _)| &**name).collect();
        assert_eq!(there, ["came", "came since", "stayed", "was replaced"]);
        let new: Value = lines(&mut fleet, at(13))
            .lines()
            .find(|line| line.contains(r#""went""#))
            .map(|line| serde_json::from_str(line).unwrap())
            .unwrap();
        assert_eq!(
            (&new["there"], &new["gone_s"]),
            (&json!(false), &json!(3.0))
        );
    }

    #[test]
    fn a_clock_that_is_set_changes_no_time_but_the_age_of_a_verdict() {
        let mut fleet = fleet();
        learn(&mut fleet, What::Gone, 3);
        for wall in [0, 1_795_300_000] {
            let wall = Timestamp::UNIX_EPOCH + Duration::from_secs(wall);
            let found = table(&fleet, Stamp { wall, ..at(8) });
            assert!(found.contains("gone 5 s  8 s "), "{found}");
        }
        learn(&mut fleet, What::Came, 9);
        let wall = Timestamp::UNIX_EPOCH;
        assert!(table(&fleet, Stamp { wall, ..at(30) }).contains("no answer"));
        learn(&mut fleet, hello("a", 20), 30);
        fleet.settle(Stamp { wall, ..at(33) });
        assert_eq!(one_line(&mut fleet, 33)["missed"], 12);
    }

    #[test]
    fn an_answer_that_is_older_than_what_is_known_changes_nothing() {
        let mut fleet = fleet();
        let with_status = |state: &str, second: u64, seq: Option<u64>| {
            json!({"type": "status", "sensor": "palm", "state": state, "seq": seq,
                "time": at(second).wall.to_string()})
        };
        learn(&mut fleet, event(&with_status("stale", 20, Some(9))), 20);
        learn(&mut fleet, event(&with_status("live", 10, None)), 40);
        let line = one_line(&mut fleet, 40);
        assert_eq!(
            (&line["state"], &line["heard"]),
            (&json!("stale"), &json!(at(20).wall.to_string()))
        );
        learn(&mut fleet, event(&with_status("stale", 20, None)), 41);
        assert_eq!(one_line(&mut fleet, 41)["heard"], at(41).wall.to_string());
    }

    #[test]
    fn a_crowd_of_strangers_is_bounded() {
        let mut fleet = Fleet::default();
        let stranger = |n: u32, what, second| News::Robot {
            site: format!("x{n}"),
            what,
            at: at(second),
        };
        for n in 0..5000 {
            fleet.learn(stranger(n, What::Came, 0));
            fleet.learn(stranger(n, event(&status(Some(1))), 0));
        }
        assert_eq!(fleet.robots().count(), 4096);
        assert!(table(&fleet, at(0)).ends_with(", 1808 messages left out\n"));
        // A robot that is gone makes room.
        fleet.learn(stranger(7, What::Gone, 1));
        fleet.learn(stranger(9999, What::Came, 2));
        assert!(fleet.robot("x9999").is_some() && fleet.robot("x7").is_none());
    }
}
