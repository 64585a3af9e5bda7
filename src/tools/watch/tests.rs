//! Tests of the known state, of the ages shown, and of what is drawn at each size.

use std::process::{Command, Stdio};
use std::time::Duration;

use ratatui_core::backend::TestBackend;
use ratatui_core::buffer::Buffer;
use ratatui_core::style::Color;
use ratatui_core::terminal::Terminal;
use ratatui_crossterm::crossterm::event::{Event, KeyCode, KeyEvent, KeyModifiers};
use rustix::termios::LocalModes;
use serde_json::{Value, json};

use super::draw::{UNPLUGGED, UNPLUGGED_WORDS, draw};
use super::look::Look;
use super::screen::{Screen, key};
use super::view::{Clock, Key, Link, Loss, View};
use crate::tools::pty::pair::Pair;
use hardnessd_core::frame::Stamp;

const COLOURS: Look = Look {
    colours: true,
    true_colours: false,
    attributes: true,
    unicode: true,
};
const PLAIN: Look = Look {
    colours: false,
    true_colours: false,
    attributes: false,
    unicode: false,
};

/// The stamp `ms` milliseconds after a moment at which the machine had been up for an hour.
fn at(ms: u64) -> Stamp {
    let since = Duration::from_millis(ms);
    Stamp {
        mono: Duration::from_secs(3600) + since,
        wall: jiff::Timestamp::from_second(1_700_000_000).unwrap() + since,
    }
}

/// A view that has received `events` without delay, each at its time in ms.
fn view_of(events: &[(u64, Value)]) -> View {
    let mut view = View::new();
    for (ms, event) in events {
        take_event(&mut view, *ms, event.clone());
    }
    view
}

fn take_event(view: &mut View, ms: u64, mut event: Value) {
    if event["sensor"].is_string() && event["time"].is_null() {
        event["time"] = json!(at(ms).wall.to_string());
    }
    view.take_line(&event.to_string(), at(ms));
}

fn hello(run: &str, sensors: &[&str]) -> Value {
    let sensors: Vec<Value> = sensors
        .iter()
        .map(|name| json!({"name": name, "rows": 28, "cols": 28, "pitch_mm": 3.5}))
        .collect();
    json!({"type": "hello", "protocol": 1, "robot": "arm-7", "version": "0.1.0", "run": run,
        "sensors": sensors, "model": {"name": "built in", "validation": "simulated data only",
        "needs": "judges single frames, needs no arm", "without_effect": [],
        "levels": [{"level": 1, "label": "hard"}, {"level": 2, "label": "firm"}]}})
}

fn status(sensor: &str, state: &str) -> Value {
    json!({"type": "status", "sensor": sensor, "state": state, "reason": null, "frames": 120,
        "frames_damaged": 2, "bytes_skipped": 790, "frame_rate_hz": 5.0})
}

fn frame(sensor: &str, newtons: f32, taxels: usize) -> Value {
    let mut all = vec![0.0; 784];
    for taxel in 0..taxels {
        all[14 * 28 + 10 + taxel] = newtons;
    }
    json!({"type": "frame", "sensor": sensor, "frame": 7, "newtons": all,
        "contact_area_taxels": taxels})
}

fn verdict(press: u64, level: Option<u8>, rejected: Option<&str>) -> Value {
    json!({"type": "hardness", "sensor": "forearm", "press": press, "phase": "final",
        "level": level, "label": "firm", "rejected": rejected, "probabilities": [0.07, 0.93],
        "confidence": 0.93,
        "force_n": 12.34, "shore": {"value": 65.2, "low": 58.8, "high": 71.0}, "notes": []})
}

/// A view of one sensor that is live.
fn live_sensor() -> View {
    view_of(&[
        (0, hello("a", &["forearm"])),
        (0, status("forearm", "live")),
    ])
}

/// A view of one sensor that is live and has been pressed.
fn pressed_sensor() -> View {
    view_of(&[
        (0, hello("a", &["forearm"])),
        (0, status("forearm", "live")),
        (
            0,
            json!({"type": "press", "sensor": "forearm", "press": 3, "state": "begin"}),
        ),
        (100, frame("forearm", 1.5, 8)),
        (200, verdict(3, Some(2), None)),
    ])
}

fn picture(view: &View, ms: u64, (width, height): (u16, u16), look: Look) -> Buffer {
    let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
    terminal
        .draw(|frame| draw(frame, view, at(ms).mono, look))
        .unwrap();
    terminal.backend().buffer().clone()
}

fn rows(buffer: &Buffer) -> Vec<String> {
    let width = usize::from(buffer.area.width);
    let cells = buffer.content.chunks(width);
    cells
        .map(|row| row.iter().map(ratatui_core::buffer::Cell::symbol).collect())
        .collect()
}

fn shown(view: &View, ms: u64, size: (u16, u16), look: Look) -> String {
    rows(&picture(view, ms, size, look)).join("\n")
}

#[test]
fn the_model_is_named_with_its_needs_and_the_keys_that_change_no_verdict_of_it() {
    let mut hello = hello("a", &["forearm"]);
    let view = view_of(&[(0, hello.clone())]);
    let shows = |view: &View, text: &str| shown(view, 100, (120, 30), PLAIN).contains(text);
    assert!(shows(
        &view,
        "model built in (simulated data only): judges single frames, needs no arm"
    ));
    assert!(!shows(&view, "changes no verdict"));
    hello["model"]["without_effect"] =
        json!(["sensor.arm of \"forearm\"", "model.early_confidence"]);
    let view = view_of(&[(0, hello)]);
    assert!(shows(
        &view,
        "sensor.arm of \"forearm\", model.early_confidence: changes no verdict of this model"
    ));
}

#[test]
fn a_value_is_as_old_as_its_event_however_late_it_is_read() {
    let mut view = live_sensor();
    let mut late = frame("forearm", 1.0, 5);
    late["time"] = json!(at(1_000).wall.to_string());
    take_event(&mut view, 3_500, late);
    let frame = view.sensor().unwrap().frame.as_ref().unwrap();
    assert_eq!(frame.at, at(1_000).mono);
    let text = shown(&view, 3_600, (80, 24), PLAIN);
    assert!(text.contains("frame 2.6 s old"), "{text}");
}

#[test]
fn what_does_not_say_hello_is_silent_and_another_protocol_is_none() {
    let mut met = pressed_sensor();
    met.lose(Loss::Closed);
    for mut view in [View::new(), met] {
        view.wait("events.sock".to_owned(), Clock::Ours, at(0).mono);
        let text = |view: &View, ms| shown(view, ms, (80, 24), PLAIN);
        assert!(text(&view, 2_900).contains("NO DAEMON"));
        let silent = text(&view, 3_100);
        assert!(silent.contains("DAEMON SILENT"), "{silent}");
        assert!(silent.contains("no answer for 3.1 s"), "{silent}");
        let mut other = hello("b", &["forearm"]);
        other["protocol"] = json!(2);
        take_event(&mut view, 4_000, other);
        let refused = text(&view, 4_100);
        for part in ["NO DAEMON", "found protocol 2, expected 1"] {
            assert!(refused.contains(part), "{refused}");
        }
        view.take_line("HTTP/1.1 400 Bad Request", at(5_000));
        view.lose(Loss::Closed);
        let page = text(&view, 5_100);
        assert!(page.contains("a web server answers there"), "{page}");
    }
}

#[test]
fn what_is_not_live_is_not_shown_as_present() {
    let live = shown(&pressed_sensor(), 300, (80, 24), PLAIN);
    for part in [
        "LIVE",
        "force 12.00 N",
        "contact area 8 taxels",
        "3 in contact",
        "frame 0.2 s old",
    ] {
        assert!(live.contains(part), "{part:?} not in\n{live}");
    }
    let lost = |state: &str, word: &str| {
        let mut view = pressed_sensor();
        take_event(&mut view, 2_000, status("forearm", state));
        (view, word.to_owned())
    };
    let mut gone = pressed_sensor();
    gone.lose(Loss::Closed);
    let cases = [
        lost("stale", "STALE"),
        lost("lost", "LOST"),
        lost("connecting", "CONNECTING"),
        (gone, "NO DAEMON".to_owned()),
        // After four seconds, the daemon has answered none of three requests.
        (pressed_sensor(), "DAEMON SILENT".to_owned()),
    ];
    for (view, word) in cases {
        for size in [(80, 24), (40, 24), (120, 50)] {
            let buffer = picture(&view, 4_100, size, COLOURS);
            let text = rows(&buffer).join("\n");
            // The word comes at the top and on the map.
            assert!(
                text.matches(&word).count() >= 2,
                "{word:?} not twice in\n{text}"
            );
            assert!(text.contains("last frame 4.0 s ago"), "{text}");
            assert!(
                text.contains("force not known") || !text.contains("force"),
                "{text}"
            );
            for part in ["LIVE", "12.00 N", "8 taxels", "in contact for"] {
                assert!(!text.contains(part), "{part:?} in\n{text}");
            }
            let warm = buffer
                .content
                .iter()
                .any(|cell| cell.bg == Color::Indexed(220));
            assert!(!warm, "pressure in colours, though {word}");
        }
    }
}

#[test]
fn a_curve_has_holes_where_there_was_no_frame() {
    let mut view = live_sensor();
    for (ms, newtons) in [(5_050, 1.0), (10_050, 2.0), (10_150, 3.0)] {
        take_event(&mut view, ms, frame("forearm", newtons, 1));
    }
    let sensor = view.sensor().unwrap();
    // The spans are one second long, up to 30 s. A frame is current for 2.5 periods of 0.2 s.
    let curve = sensor.curve(at(30_000).mono, 30, |load| load.force_n);
    let there: Vec<(usize, f32)> = (0..)
        .zip(&curve)
        .filter_map(|(span, value)| value.map(|value| (span, value)))
        .collect();
    assert_eq!(there, [(5, 1.0), (10, 3.0)]);
    // The spans are shorter than a period. Each frame holds for its 2.5 periods, and no longer.
    let curve = sensor.curve(at(30_000).mono, 300, |load| load.force_n);
    let there: Vec<usize> = (0..300).filter(|&span| curve[span].is_some()).collect();
    assert_eq!(there, (50..55).chain(100..106).collect::<Vec<_>>());
    // At 36 s, the curve begins at 6 s, after the first frame.
    let curve = sensor.curve(at(36_000).mono, 30, |load| load.force_n);
    assert_eq!(curve.iter().flatten().count(), 1);
}

#[test]
fn a_bar_is_as_high_as_its_share_of_the_highest() {
    let mut view = live_sensor();
    for (ms, newtons) in [(10_000, 2.0), (20_000, 1.25), (29_950, 0.5)] {
        take_event(&mut view, ms, frame("forearm", newtons, 1));
    }
    // The bars of the force from left to right, each with its symbols from the lowest row to the
    // highest.
    let bars = |look| {
        let rows = rows(&picture(&view, 30_000, (150, 40), look));
        let heading = rows.iter().position(|row| row.contains("force ")).unwrap();
        let end = rows
            .iter()
            .position(|row| row.contains("contact area"))
            .unwrap();
        let start = rows[heading]
            .split("force ")
            .next()
            .unwrap()
            .chars()
            .count();
        let column = |x| -> String {
            let cells = rows[heading + 1..end].iter().rev();
            cells.map(|row| row.chars().nth(x).unwrap()).collect()
        };
        let mut bars: Vec<String> = (start..150).map(column).collect();
        bars.dedup();
        bars.retain(|bar| !bar.trim().is_empty() && !bar.starts_with('\u{b7}'));
        bars
    };
    // There are nine rows of eight eighths each.
    assert_eq!(
        bars(COLOURS),
        [
            "\u{2588}".repeat(9),
            "\u{2588}".repeat(5) + "\u{2585}   ",
            "\u{2588}".repeat(2) + "\u{2582}      "
        ]
    );
    assert_eq!(bars(PLAIN), ["#########", "#####+   ", "##-      "]);
}

#[test]
fn verdicts_stand_with_their_probabilities_newest_first_and_none_twice() {
    let mut view = pressed_sensor();
    take_event(&mut view, 9_000, verdict(4, None, Some("low_force")));
    // `get last` repeats the verdict after a break.
    take_event(&mut view, 9_100, verdict(4, None, Some("low_force")));
    take_event(&mut view, 9_100, status("forearm", "live"));
    let text = shown(&view, 10_200, (80, 24), PLAIN);
    let lines: Vec<&str> = text
        .lines()
        .map(|line| line.get(32..).unwrap_or("").trim_end())
        .collect();
    let first = lines
        .iter()
        .position(|line| line.starts_with("verdicts"))
        .unwrap();
    assert_eq!(lines[first], "verdicts % of hard, firm");
    assert_eq!(
        lines[first + 1],
        "  4 final low force      7  93  1.2 s   12.3 N"
    );
    assert_eq!(
        lines[first + 2],
        "  3 final firm           7  93   10 s   12.3 N"
    );
    assert_eq!(lines[first + 3], "");
    let text = shown(&view, 10_200, (120, 24), PLAIN);
    let whole = "  3 final firm           7  93   10 s   12.3 N  Shore 65 (59 to 71)";
    assert!(text.contains(whole), "{text}");
}

#[test]
fn every_sensor_has_its_link_in_view_and_its_picture_by_a_key() {
    let mut view = view_of(&[
        (0, hello("a", &["forearm", "wrist", "palm"])),
        (0, status("forearm", "live")),
        (0, status("wrist", "lost")),
        (0, status("palm", "live")),
        (0, frame("palm", 2.0, 3)),
    ]);
    let text = shown(&view, 100, (80, 24), PLAIN);
    assert!(
        text.contains(">1 forearm LIVE   2 wrist LOST   3 palm LIVE"),
        "{text}"
    );
    view.press(Key::Previous);
    assert_eq!(view.sensor().unwrap().name, "palm");
    let text = shown(&view, 100, (80, 24), PLAIN);
    assert!(text.contains("force 6.00 N"), "{text}");
    // If not all sensors fit, the chosen one must be visible.
    assert!(shown(&view, 100, (30, 24), PLAIN).contains(">3 palm LIVE"));
    view.press(Key::Next);
    assert_eq!(view.sensor().unwrap().name, "forearm");
    view.press(Key::Sensor(1));
    view.press(Key::Sensor(7));
    assert_eq!(view.sensor().unwrap().name, "wrist");
}

#[test]
fn another_run_begins_from_nothing_and_the_same_goes_on() {
    let mut view = pressed_sensor();
    view.lose(Loss::Unreachable("events.sock: no such file".to_owned()));
    let text = shown(&view, 400, (80, 24), PLAIN);
    assert!(
        text.contains("NO DAEMON") && text.contains("no such file"),
        "{text}"
    );
    take_event(&mut view, 500, hello("a", &["forearm"]));
    assert_eq!(view.sensor().unwrap().verdicts.len(), 1);
    view.lose(Loss::Closed);
    take_event(&mut view, 600, hello("b", &["wrist", "forearm"]));
    assert_eq!(
        (view.sensors.len(), view.chosen),
        (2, 1),
        "the chosen one stays so"
    );
    let sensor = view.sensor().unwrap();
    assert!(sensor.verdicts.is_empty() && sensor.frame.is_none());
    assert_eq!(view.link(sensor, at(700).mono).0, Link::Connecting);
}

#[test]
fn a_daemon_without_room_is_quoted() {
    let mut view = View::new();
    take_event(
        &mut view,
        0,
        json!({"type": "error", "message": "too many subscribers (256)"}),
    );
    view.lose(Loss::Closed);
    let text = shown(&view, 100, (80, 24), PLAIN);
    assert!(
        text.contains("NO DAEMON  too many subscribers (256)"),
        "{text}"
    );
}

#[test]
fn missed_events_are_counted_until_their_number_is_unknown() {
    let mut view = pressed_sensor();
    take_event(&mut view, 300, json!({"type": "gap", "lost": 4}));
    take_event(&mut view, 300, json!({"type": "gap", "lost": 3}));
    assert_eq!(view.missed, Some(7));
    take_event(&mut view, 300, json!({"type": "gap", "lost": null}));
    take_event(&mut view, 300, json!({"type": "gap", "lost": 1}));
    assert_eq!(view.missed, None);
}

#[test]
fn without_colours_pressure_is_told_by_characters_and_nothing_but_ascii_is_written() {
    let buffer = picture(&pressed_sensor(), 300, (80, 24), PLAIN);
    let text = rows(&buffer).join("\n");
    assert!(text.is_ascii(), "{text}");
    assert!(text.contains("@@@@@@@@"), "{text}");
    let mut named = hello("a", &["forearm"]);
    named["robot"] = json!("b\u{e4}r-7");
    let named = view_of(&[(0, named)]);
    assert!(shown(&named, 0, (80, 24), PLAIN).starts_with("b?r-7 "));
    assert!(shown(&named, 0, (80, 24), COLOURS).starts_with("b\u{e4}r-7 "));
    let mut turned = hello("a", &["forearm"]);
    turned["robot"] = json!("b\u{202e}r-7");
    let turned = view_of(&[(0, turned)]);
    assert!(shown(&turned, 0, (80, 24), COLOURS).starts_with("br-7 "));
}

#[test]
fn every_size_is_drawn_and_says_what_holds() {
    let mut view = pressed_sensor();
    take_event(&mut view, 2_000, status("forearm", "stale"));
    for width in 1..=130 {
        for height in 1..=50 {
            for look in [COLOURS, PLAIN] {
                let text = shown(&view, 2_100, (width, height), look);
                let is_readable = width >= 8 && height >= 3;
                assert!(
                    !is_readable || text.contains("STALE"),
                    "{width}x{height}\n{text}"
                );
            }
        }
    }
}

#[test]
fn a_small_array_is_drawn_alone() {
    let mut hello = hello("a", &["forearm"]);
    hello["sensors"][0]["rows"] = json!(4);
    hello["sensors"][0]["cols"] = json!(6);
    let mut newtons = vec![0.0; 24];
    newtons[23] = 1.0;
    let view = view_of(&[
        (0, hello),
        (0, status("forearm", "live")),
        (
            0,
            json!({"type": "frame", "sensor": "forearm", "newtons": newtons}),
        ),
    ]);
    let sensor = view.sensor().unwrap();
    assert_eq!(sensor.newtons(3, 5), Some(1.0));
    assert_eq!((sensor.newtons(4, 0), sensor.newtons(0, 6)), (None, None));
}

#[test]
fn keys_mean_what_the_last_row_says() {
    let check = |code, modifiers, expected| {
        let event = Event::Key(KeyEvent::new(code, modifiers));
        assert_eq!(key(&event), expected, "{event:?}");
    };
    let none = KeyModifiers::NONE;
    check(KeyCode::Char('q'), none, Some(Key::Quit));
    check(KeyCode::Char('c'), KeyModifiers::CONTROL, Some(Key::Quit));
    check(KeyCode::Char('c'), none, None);
    check(KeyCode::Char('l'), KeyModifiers::CONTROL, Some(Key::Redraw));
    check(KeyCode::Char('2'), none, Some(Key::Sensor(1)));
    check(KeyCode::Char('0'), none, None);
    for code in [KeyCode::Tab, KeyCode::Right, KeyCode::Down] {
        check(code, none, Some(Key::Next));
        check(code, KeyModifiers::CONTROL, None);
    }
    check(KeyCode::BackTab, KeyModifiers::SHIFT, Some(Key::Previous));
    check(KeyCode::Left, none, Some(Key::Previous));
    check(KeyCode::Esc, none, None);
    assert_eq!(key(&Event::Resize(80, 24)), None);
}

#[test]
fn the_look_follows_the_terminal() {
    let check = |term, no_color, locale, expected: (bool, bool, bool)| {
        let look = Look::new(term, "truecolor", no_color, locale);
        assert_eq!(look.true_colours, look.colours);
        assert!(!Look::new(term, "", no_color, locale).true_colours);
        let found = (look.colours, look.attributes, look.unicode);
        assert_eq!(found, expected, "{term} {no_color} {locale}");
    };
    check("xterm-256color", "", "en_US.UTF-8", (true, true, true));
    check("xterm-256color", "1", "en_US.UTF-8", (false, true, true));
    check("screen", "", "C", (true, true, false));
    check("vt100", "", "C.UTF-8", (false, true, false));
    check("dumb", "", "C.UTF-8", (false, false, false));
    check("", "", "", (false, false, false));
}

#[test]
#[ignore = "a part of the next, on a terminal of its own"]
fn a_panic_with_the_screen_open() {
    let _screen = Screen::open().unwrap();
    panic!("on purpose");
}

#[test]
fn a_panic_gives_the_terminal_back() {
    let Pair { master, device, .. } = Pair::open().unwrap();
    let end = || Stdio::from(device.try_clone().unwrap());
    let ended = Command::new(std::env::current_exe().unwrap())
        .args([
            "a_panic_with_the_screen_open",
            "--include-ignored",
            "--nocapture",
        ])
        .stdin(end())
        .stdout(end())
        .stderr(end())
        .status()
        .unwrap();
    assert!(!ended.success());
    let mut written = [0; 16_384];
    let length = rustix::io::read(&master, &mut written).unwrap();
    let written = String::from_utf8_lossy(&written[..length]);
    let given_back = written.find("\x1b[?1049l").unwrap();
    let view_of = written.find("on purpose").unwrap();
    assert!(
        given_back < view_of,
        "the message vanishes with the screen: {written:?}"
    );
    let modes = rustix::termios::tcgetattr(&device).unwrap();
    assert!(
        modes
            .local_modes
            .contains(LocalModes::ECHO | LocalModes::ICANON)
    );
}

#[test]
fn a_soft_touch_is_seen_after_a_hard_one() {
    let mut view = pressed_sensor();
    take_event(&mut view, 200, frame("forearm", 4.6, 3));
    // The force is little more than the usual contact threshold.
    take_event(&mut view, 300, frame("forearm", 0.08, 12));
    let text = shown(&view, 400, (80, 24), PLAIN);
    assert!(text.contains("::::::::::::"), "{text}");
}

#[test]
fn curves_begin_with_what_was_before_the_connection() {
    let history = json!({"type": "history", "sensor": "forearm", "time": null,
        "points": [[2.0, 10.0, 20], [1.0, 5.0, 9], [0.0, 8.0, 15]]});
    let view = view_of(&[
        (0, hello("a", &["forearm"])),
        (0, status("forearm", "live")),
        (9_000, frame("forearm", 1.5, 8)),
        (10_000, history),
    ]);
    // The point of 9 s is known better by its frame, and that of 10 s is after it.
    let sensor = view.sensor().unwrap();
    let forces = sensor.curve(at(10_000).mono, 30, |load| load.force_n);
    assert_eq!(forces[27..], [None, Some(10.0), Some(12.0)]);
}

#[test]
fn what_was_before_is_asked_for_and_stands_in_order() {
    let mut view = View::new();
    let mut first = hello("a", &["forearm"]);
    first["seq"] = json!(40);
    let asked = view.take_line(&first.to_string(), at(0)).unwrap();
    let asked: Vec<Value> = asked
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    assert_eq!(asked[0], json!({"get": "last"}));
    assert_eq!(asked[1]["since"], "a:0");
    assert_eq!(asked[2], json!({"get": {"history": "forearm"}}));
    assert!(
        asked[1]["subscribe"]
            .as_array()
            .unwrap()
            .contains(&json!("frame"))
    );
    // The last verdict comes first, then a gap for the events that are too old, then the rest in
    // order.
    let numbered = |mut event: Value, seq: u64| {
        event["seq"] = json!(seq);
        event
    };
    let press = |press: u64, state: &str| json!({"type": "press", "sensor": "forearm", "press": press, "state": state});
    for event in [
        numbered(verdict(9, Some(2), None), 38),
        json!({"type": "gap", "lost": 30}),
        numbered(verdict(8, Some(2), None), 33),
        numbered(press(9, "begin"), 34),
        numbered(press(9, "end"), 37),
        numbered(verdict(9, Some(2), None), 38),
    ] {
        take_event(&mut view, 100, event);
    }
    let sensor = view.sensor().unwrap();
    let presses: Vec<u64> = sensor.verdicts.iter().map(|one| one.press).collect();
    assert_eq!(presses, [9, 8]);
    assert_eq!(sensor.press.as_ref().unwrap().state, "end");
    assert_eq!(view.missed, Some(0), "nobody was there to miss it");
    // After that, a gap counts as missed. After a break, the view asks from its last event on.
    take_event(&mut view, 200, numbered(press(10, "begin"), 41));
    take_event(&mut view, 200, json!({"type": "gap", "lost": 2}));
    assert_eq!(view.missed, Some(2));
    let asked = view.take_line(&first.to_string(), at(300)).unwrap();
    assert!(asked.contains("\"since\":\"a:41\""), "{asked}");
}

#[test]
fn lost_says_unplugged_where_it_is() {
    let lost = |reason: &str| {
        let mut view = pressed_sensor();
        let mut status = status("forearm", "lost");
        status["reason"] = json!(reason);
        take_event(&mut view, 1_000, status);
        shown(&view, 1_100, (120, 24), PLAIN)
    };
    for reason in [
        "end of file",
        "Input/output error (os error 5)",
        "no such device",
    ] {
        let text = lost(reason);
        assert!(
            text.contains(" LOST  unplugged: plug it in again; last frame"),
            "{text}"
        );
        assert!(text.contains(reason), "{text}");
    }
    let text = lost("permission denied");
    assert!(
        text.contains(" LOST  last frame") && !text.contains("unplugged"),
        "{text}"
    );
}

#[test]
fn the_live_page_has_the_same_words_for_an_unplugged_device() {
    let page = include_str!("../../daemon/page.html");
    let reasons = format!("const UNPLUGGED = {UNPLUGGED:?};\n");
    let words = format!("const UNPLUGGED_WORDS = {UNPLUGGED_WORDS:?};\n");
    assert!(page.contains(&reasons), "{reasons}");
    assert!(page.contains(&words), "{words}");
}

#[test]
fn a_large_terminal_is_used() {
    let view = pressed_sensor();
    let columns_of_map = |size| {
        let buffer = picture(&view, 300, size, COLOURS);
        let heading = rows(&buffer)
            .iter()
            .position(|row| row.contains("pressure "))
            .unwrap();
        let width = usize::from(size.0);
        let row = &buffer.content[(heading + 1) * width..(heading + 2) * width];
        row.iter()
            .take_while(|cell| cell.symbol() == "\u{2580}")
            .count()
    };
    assert_eq!(columns_of_map((80, 24)), 28);
    assert_eq!(columns_of_map((120, 50)), 56);
    assert_eq!(columns_of_map((200, 60)), 84);
    assert_eq!(columns_of_map((300, 90)), 140);
}

#[test]
fn a_frame_of_a_machine_with_another_clock_is_new() {
    let mut view = View::new();
    view.wait("robot:8255".to_owned(), Clock::Theirs, at(0).mono);
    take_event(&mut view, 0, hello("a", &["forearm"]));
    take_event(&mut view, 0, status("forearm", "live"));
    // The other clock is an hour behind. The frames take 10 and 30 ms.
    for (ms, delay) in [(200, 10), (400, 30)] {
        let mut event = frame("forearm", 1.0, 5);
        let there = at(ms - delay).wall - jiff::SignedDuration::from_hours(1);
        event["time"] = json!(there.to_string());
        take_event(&mut view, ms, event);
    }
    let frame = view.sensor().unwrap().frame.as_ref().unwrap();
    assert_eq!(frame.at, at(380).mono);
}

#[test]
fn force_stands_against_approach_where_the_robot_tells_it() {
    let mut view = live_sensor();
    let press = |state| json!({"type": "press", "sensor": "forearm", "press": 1, "state": state, "reason": null});
    let at_mm = |newtons, mm: Value| {
        let mut event = frame("forearm", newtons, 9);
        event["approach_mm"] = mm;
        event
    };
    let size = (100, 40);
    take_event(&mut view, 200, at_mm(0.5, json!(null)));
    assert!(!shown(&view, 200, size, COLOURS).contains("approach"));
    take_event(&mut view, 400, at_mm(0.5, json!(0.0)));
    take_event(&mut view, 400, press("begin"));
    take_event(&mut view, 600, at_mm(1.0, json!(1.2)));
    take_event(&mut view, 800, at_mm(2.0, json!(2.4)));
    take_event(&mut view, 900, press("end"));
    let expected = "force against approach  to 2.4 mm, to 18 N";
    let text = shown(&view, 900, size, COLOURS);
    assert!(text.contains(expected), "{text}");
    // The curve of the last press stays until another press begins.
    take_event(&mut view, 3000, at_mm(0.5, json!(null)));
    assert!(shown(&view, 3000, size, PLAIN).contains(expected));
    take_event(&mut view, 3200, at_mm(0.1, json!(0.0)));
    take_event(&mut view, 3200, press("begin"));
    take_event(&mut view, 3400, at_mm(0.2, json!(0.5)));
    assert!(shown(&view, 3400, size, PLAIN).contains("to 0.5 mm, to 2 N"));
    take_event(&mut view, 3500, press("end"));
    // Usually, the approach of a press's first frame is not known yet.
    take_event(&mut view, 5000, at_mm(0.1, json!(null)));
    take_event(&mut view, 5000, press("begin"));
    take_event(&mut view, 5200, at_mm(0.1, json!(0.2)));
    take_event(&mut view, 5400, at_mm(0.1, json!(0.3)));
    let text = shown(&view, 5400, size, PLAIN);
    assert!(text.contains("to 0.3 mm, to 1 N"), "{text}");
    every_size_of(&view);
}

/// Draws a view in every size.
fn every_size_of(view: &View) {
    for width in [1, 20, 64, 65, 80, 200] {
        for height in [1, 5, 11, 24, 60] {
            shown(view, 3400, (width, height), COLOURS);
        }
    }
}
