//! The known state, the ages shown, and what is drawn at each size.

use std::process::{Command, Stdio};
use std::time::Duration;

use ratatui_core::backend::TestBackend;
use ratatui_core::buffer::Buffer;
use ratatui_core::style::Color;
use ratatui_core::terminal::Terminal;
use ratatui_crossterm::crossterm::event::KeyCode;
use rustix::termios::LocalModes;
use serde_json::{Value, json};

use super::draw::{UNPLUGGED, UNPLUGGED_WORDS, draw};
use super::screen::Screen;
use super::view::{Link, Order, View};
use crate::tools::pty::pair::Pair;
use hardnessd_core::frame::Stamp;

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
    if event["type"] == "hello" {
        return view.meet(event, false, at(ms).mono);
    }
    if event["time"].is_null() {
        event["time"] = json!(at(ms).wall.to_string());
    }
    view.take(event, at(ms));
}

fn hello(run: &str, sensors: &[&str]) -> Value {
    let sensors: Vec<Value> = sensors
        .iter()
        .map(|name| json!({"name": name, "rows": 28, "cols": 28, "pitch_mm": 3.5}))
        .collect();
    json!({"type": "hello", "protocol": 1, "robot": "arm\u{202e}-7", "version": "0.1.0", "run": run,
        "sensors": sensors, "model": {"name": "built in", "validation": "simulated data only",
        "needs": "judges single frames, needs no arm",
        "levels": [{"level": 1, "label": "hard"}, {"level": 2, "label": "firm"}]}})
}

fn status(sensor: &str, state: &str) -> Value {
    json!({"type": "status", "sensor": sensor, "state": state, "reason": null, "frames": 120,
        "frames_damaged": 2, "bytes_skipped": 790, "frame_rate_hz": 5.0})
}

fn frame(sensor: &str, newtons: f32, taxels: usize) -> Value {
    let mut all = vec![0.0; 784];
    for taxel in 0..taxels {
        all[(14 * 28 + 10 + taxel) % 784] = newtons;
    }
    json!({"type": "frame", "sensor": sensor, "frame": 7, "newtons": all,
        "contact_area_taxels": taxels, "force_n": newtons * taxels as f32})
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
    let mut view = live_sensor();
    let begin = json!({"type": "press", "sensor": "forearm", "press": 3, "state": "begin"});
    take_event(&mut view, 0, begin);
    take_event(&mut view, 100, frame("forearm", 1.5, 8));
    take_event(&mut view, 200, verdict(3, Some(2), None));
    view
}

fn picture(view: &View, ms: u64, (width, height): (u16, u16)) -> Buffer {
    let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
    terminal
        .draw(|frame| draw(frame, view, at(ms).mono))
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

fn shown(view: &View, ms: u64, size: (u16, u16)) -> String {
    rows(&picture(view, ms, size)).join("\n")
}

/// Asserts that all `parts` are shown on 24 rows.
fn assert_shown(view: &View, ms: u64, width: u16, parts: &[&str]) {
    let text = shown(view, ms, (width, 24));
    for part in parts {
        assert!(text.contains(part), "{part:?} not in\n{text}");
    }
}

#[test]
fn a_value_is_as_old_as_its_event_however_late_it_is_read() {
    let mut view = live_sensor();
    let mut late = frame("forearm", 1.0, 5);
    late["time"] = json!(at(1_000).wall.to_string());
    take_event(&mut view, 3_500, late);
    let (moment, _) = view.sensor().unwrap().frame.as_ref().unwrap();
    assert_eq!(*moment, at(1_000).mono);
    assert_shown(&view, 3_600, 80, &["frame 2.6 s old"]);
}

#[test]
fn a_soft_touch_is_seen_after_a_hard_one() {
    let mut view = live_sensor();
    take_event(&mut view, 100, frame("forearm", 4.6, 12));
    let mut colours = [0.0, 0.08].map(|newtons| {
        take_event(&mut view, 200, frame("forearm", newtons, 12));
        let cells = picture(&view, 300, (80, 24)).content;
        let mut colours: Vec<String> = cells
            .iter()
            .map(|cell| format!("{:?}", [cell.fg, cell.bg]))
            .collect();
        colours.sort_unstable();
        colours.dedup();
        colours
    });
    // Little more than the usual contact threshold.
    let [free, touched] = &mut colours;
    touched.retain(|colour| !free.contains(colour));
    assert!(!touched.is_empty(), "{free:?}");
}

#[test]
fn what_is_not_live_is_not_shown_as_present() {
    let live = [
        // Without what turns the line.
        " arm-7 ",
        "LIVE",
        "force 12.00 N on 8 taxels",
        "model built in (simulated data only)",
        "3 in contact",
        "frame 0.2 s old",
    ];
    assert_shown(&pressed_sensor(), 300, 80, &live);
    let lost = |state: &str, word: &str| {
        let mut view = pressed_sensor();
        take_event(&mut view, 2_000, status("forearm", state));
        (view, word.to_owned())
    };
    let mut gone = pressed_sensor();
    gone.absence = Some("it closed the connection".to_owned());
    let cases = [
        lost("stale", "STALE"),
        lost("lost", "LOST"),
        lost("connecting", "CONNECTING"),
        (gone, "NO DAEMON".to_owned()),
        // After four seconds, the daemon has answered none of three requests.
        (pressed_sensor(), "DAEMON SILENT".to_owned()),
    ];
    for (view, word) in cases {
        for size in [(80, 24), (120, 50)] {
            let buffer = picture(&view, 4_100, size);
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
fn a_sensor_without_a_zero_shows_no_force_and_says_why() {
    let mut status = status("forearm", "live");
    status["reason"] = json!("tare: contact");
    status["detail"] = json!("512 taxels varied by 0.07 N or more");
    let mut raw = frame("forearm", 1.2, 500);
    raw["force_n"] = json!(null);
    let view = view_of(&[(0, hello("a", &["forearm"])), (0, status), (100, raw)]);
    let said = "(tare: contact: 512 taxels varied by 0.07 N or more)";
    assert_shown(&view, 200, 140, &[" NO ZERO YET ", said, "force not known"]);
    let text = shown(&view, 200, (140, 24));
    assert!(!text.contains("LIVE") && !text.contains("600"), "{text}");
}

#[test]
fn verdicts_stand_with_their_probabilities_newest_first() {
    let mut view = pressed_sensor();
    take_event(&mut view, 9_000, verdict(4, None, Some("low_force")));
    take_event(&mut view, 9_100, status("forearm", "live"));
    let text = shown(&view, 10_200, (80, 24));
    let right = |line: &str| line.chars().skip(32).collect::<String>();
    let lines = text.lines().map(|line| right(line).trim_end().to_owned());
    let lines: Vec<String> = lines
        .skip_while(|line| !line.starts_with("verdicts"))
        .collect();
    let expected = [
        "verdicts Shore OO, level, age",
        "  4 65 +- 6 OO, low force        1.2 s   12.3 N",
        "  3 65 +- 6 OO, firm              10 s   12.3 N",
        "",
    ];
    assert_eq!(lines[..4], expected);
    let whole = "  3 65 +- 6 OO, firm              10 s   12.3 N    7  93";
    assert_shown(&view, 10_200, 120, &[whole]);
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
    assert_shown(
        &view,
        100,
        80,
        &[">1 forearm LIVE   2 wrist LOST   3 palm LIVE"],
    );
    view.press(KeyCode::BackTab.into());
    assert_shown(&view, 100, 80, &[">3 palm", "force 6.00 N"]);
    // If not all sensors fit, the chosen one must be visible.
    assert_shown(&view, 100, 30, &[">3 palm LIVE"]);
    view.press(KeyCode::Tab.into());
    assert_eq!(view.sensor().unwrap().name, "forearm");
    view.press(KeyCode::Char('2').into());
    view.press(KeyCode::Char('8').into());
    assert_eq!(view.sensor().unwrap().name, "wrist");
}

#[test]
fn each_connection_begins_anew_and_shows_the_chosen_sensor() {
    let mut view = pressed_sensor();
    let again = hello("b", &["wrist", "forearm"]);
    take_event(&mut view, 600, again);
    let sensor = view.sensor().unwrap();
    assert_eq!(sensor.name, "forearm");
    assert!(sensor.verdicts.is_empty() && sensor.frame.is_none());
    assert_eq!(view.link(Some(sensor), at(700).mono).0, Link::Connecting);
}

#[test]
fn every_size_is_drawn_and_says_what_holds() {
    let mut view = pressed_sensor();
    take_event(&mut view, 2_000, status("forearm", "stale"));
    for width in 1..=130 {
        for height in 1..=50 {
            let text = shown(&view, 2_100, (width, height));
            let is_readable = width >= 8 && height >= 3;
            assert!(
                !is_readable || text.contains("STALE"),
                "{width}x{height}\n{text}"
            );
        }
    }
}

#[test]
fn a_person_says_what_is_pressed_and_sees_how_many_verdicts_are_right() {
    let mut view = pressed_sensor();
    let press =
        |view: &mut View, keys: &[KeyCode]| keys.iter().find_map(|&key| view.press(key.into()));
    let typed = "pcup firx".chars().map(KeyCode::Char);
    let keys: Vec<KeyCode> = typed
        .chain([KeyCode::Backspace, KeyCode::Char('m')])
        .collect();
    assert_eq!(press(&mut view, &keys), None);
    let asked = "pressing (a level, a name, or both; Enter): cup firm_";
    assert_shown(&view, 300, 80, &[asked]);
    let context = json!({"sensor": "forearm", "object": "cup", "level": 2});
    assert_eq!(
        press(&mut view, &[KeyCode::Enter]),
        Some(Order::Merge(context.clone()))
    );
    assert_shown(&view, 300, 80, &["pressing cup (firm): no verdict yet"]);
    for (number, level) in [(4, 2), (5, 1)] {
        let mut event = verdict(number, Some(level), None);
        event["context"] = context.clone();
        take_event(&mut view, 400, event);
    }
    let counted = "pressing cup (firm): 1 of 2 right, 1 wrong";
    assert_shown(&view, 500, 80, &[counted]);
    let keys = ['p', 'q'].map(KeyCode::Char);
    assert_eq!(press(&mut view, &[keys[0], keys[1], KeyCode::Esc]), None);
    assert_eq!(press(&mut view, &keys[1..]), Some(Order::Quit));
}

#[test]
fn a_long_reason_is_wrapped_and_not_cut() {
    let mut status = status("forearm", "connecting");
    let words = "permission denied: join the group dialout with `sudo usermod -aG dialout robot`, log in again, and \
                 then start the daemon";
    status["reason"] = json!(words);
    let view = view_of(&[(0, hello("a", &["forearm"])), (0, status)]);
    let text = shown(&view, 200, (80, 24));
    let joined = text.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(joined.contains(words), "{text}");
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
fn lost_says_unplugged_where_it_is() {
    let lost = |reason: &str| {
        let mut view = pressed_sensor();
        let mut status = status("forearm", "lost");
        status["reason"] = json!(reason);
        take_event(&mut view, 1_000, status);
        shown(&view, 1_100, (120, 24))
    };
    let text = lost("Input/output error (os error 5)");
    let words = " LOST  unplugged: plug it in again; last frame";
    assert!(text.contains(words), "{text}");
    assert!(text.contains("(Input/output error (os error 5))"), "{text}");
    assert!(lost("permission denied").contains(" LOST  last frame"));
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
fn a_frame_of_a_machine_with_another_clock_is_new() {
    let mut view = View::new();
    view.meet(hello("a", &["forearm"]), true, at(0).mono);
    take_event(&mut view, 0, status("forearm", "live"));
    // The other clock is an hour behind. The frames take 10 and 30 ms.
    for (ms, delay) in [(200, 10), (400, 30)] {
        let mut event = frame("forearm", 1.0, 5);
        let there = at(ms - delay).wall - jiff::SignedDuration::from_hours(1);
        event["time"] = json!(there.to_string());
        take_event(&mut view, ms, event);
    }
    let (moment, _) = view.sensor().unwrap().frame.as_ref().unwrap();
    assert_eq!(*moment, at(380).mono);
}
