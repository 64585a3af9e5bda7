//! An event as a line: JSON, or aligned text for people. The line holds nothing that is not in the
//! event.

use std::io::{self, IsTerminal};
use std::time::Duration;

use jiff::Timestamp;
use serde_json::Value;

use super::answer::{answer, items, with_shore};
use hardnessd_core::wording;

/// The line of an event on stdout, newline included. `json` is its line on the wire, and `labels` are those of the
/// model's levels.
pub(super) fn printed(json: &str, is_json: bool, labels: &[String]) -> String {
    let text = match (is_json, io::stdout().is_terminal()) {
        (false, _) => line(&serde_json::from_str(json).unwrap_or_default(), labels),
        (true, false) => json.to_owned(),
        (true, true) => wording::json_escaped(json),
    };
    text + "\n"
}

/// The line of one event, without its newline.
fn line(event: &Value, labels: &[String]) -> String {
    let text = |key: &str| event[key].as_str().unwrap_or_default();
    let kind = text("type");
    if kind == "gap" {
        let lost = event["lost"].as_u64();
        let lost = lost.map_or("an unknown number of".to_owned(), |lost| lost.to_string());
        return format!("-- gap: {lost} events lost --");
    }
    let time = clock(&published(event).unwrap_or_else(|| text("time").to_owned()));
    let said = match kind {
        "status" => status(event),
        "press" => press(event),
        "hardness" => hardness(event, labels),
        "frame" => frame(event),
        _ => event.to_string(),
    };
    let mut line = format!("{time}  {:<12}  {kind:<8}  {said}", text("sensor"));
    // A reason comes from the system and a label from a model file. Neither may move the cursor.
    line.retain(|c| !wording::is_hidden(c));
    line.truncate(line.trim_end().len());
    line
}

/// The time when a verdict was published: its age after the frame that it judges. A final verdict
/// judges a frame from the middle of the press, so its `time` alone would be before that of the
/// `end`.
fn published(event: &Value) -> Option<String> {
    let age_ms = event["age_at_publish_ms"].as_f64()?;
    let age = Duration::try_from_secs_f64(age_ms / 1000.0).ok()?;
    let frame: Timestamp = event["time"].as_str()?.parse().ok()?;
    Some(format!("{:.6}", frame.checked_add(age).ok()?))
}

/// The time of day in milliseconds, such as 10:00:00.123 of 2026-11-21T10:00:00.123456Z. People
/// know the day and do not read microseconds.
fn clock(time: &str) -> String {
    time.get(11..23).unwrap_or_default().to_owned()
}

/// A whole number of an event. Without one it is 0.
pub(super) fn number(event: &Value, key: &str) -> u64 {
    event[key].as_u64().unwrap_or_default()
}

fn status(event: &Value) -> String {
    let state = event["state"].as_str().unwrap_or_default();
    let (frames, damaged) = (number(event, "frames"), number(event, "frames_damaged"));
    let mut line = format!("{state:<10}  {frames} frames, {damaged} damaged");
    let dropped = number(event, "frames_dropped");
    if dropped > 0 {
        line += &format!(", {dropped} dropped");
    }
    if let Some(hz) = event["frame_rate_hz"].as_f64() {
        line += &format!(", {hz:.1} frames/s");
    }
    if let Some(reason) = event["reason"].as_str() {
        let detail = event["detail"].as_str().map(|detail| format!(": {detail}"));
        line += &format!("  ({reason}{})", detail.unwrap_or_default());
    }
    line
}

fn press(event: &Value) -> String {
    let state = event["state"].as_str().unwrap_or_default();
    let (press, frame) = (number(event, "press"), number(event, "frame"));
    let mut line = format!("#{press:<4} {state:<8}  frame {frame}");
    if state != "begin" {
        line += &format!(", {} in contact", number(event, "frames"));
    }
    if let Some(reason) = event["reason"].as_str() {
        line += &format!("  ({reason})");
    }
    line + &context(event)
}

fn hardness(event: &Value, labels: &[String]) -> String {
    let (press, phase) = (number(event, "press"), event["phase"].as_str());
    let answer = with_shore(&answer(event, labels).0, event);
    let percent = |value: &Value| format!("{:.0}", 100.0 * value.as_f64().unwrap_or_default());
    let probabilities: Vec<String> = items(event, "probabilities").map(percent).collect();
    let mut line = format!(
        "#{press:<4} {:<8}  {answer:<37} {:>3} % [{}]  {:>3} taxels  {:>6.2} N",
        phase.unwrap_or_default(),
        percent(&event["confidence"]),
        probabilities.join(" "),
        number(event, "contact_area_taxels"),
        event["force_n"].as_f64().unwrap_or_default(),
    );
    if let Some(advice) = event["advice"].as_str() {
        line += &format!("  {}", advice.replace('_', " "));
    }
    let object = &event["object"];
    if let (Some(name), presses @ 2..) = (object["name"].as_str(), number(object, "presses")) {
        let level = number(object, "level");
        let probabilities = items(object, "probabilities").filter_map(Value::as_f64);
        let most = 100.0 * probabilities.fold(0.0, f64::max);
        line += &format!("  {name}: {level} by {presses} presses, {most:.0} %");
    }
    if let (Some(_), Some(time)) = (published(event), event["time"].as_str()) {
        let frame = number(event, "frame");
        line += &format!("  frame {frame} at {}", clock(time));
    }
    let notes: Vec<&str> = items(event, "notes").filter_map(Value::as_str).collect();
    if !notes.is_empty() {
        line += &format!("  ({})", notes.join(", "));
    }
    line + &context(event)
}

fn frame(event: &Value) -> String {
    let newtons = items(event, "newtons").filter_map(Value::as_f64);
    let highest_n = newtons.fold(0.0, f64::max);
    let number = number(event, "frame");
    match event["force_n"].as_f64() {
        Some(force_n) => {
            format!("#{number:<13}  {force_n:>6.2} N, highest taxel {highest_n:.2} N")
        }
        None => format!("#{number:<13}  no zero yet"),
    }
}

fn context(event: &Value) -> String {
    match &event["context"] {
        Value::Null => String::new(),
        context => format!("  {context}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn events_are_one_aligned_line_each() {
        let labels = ["hard", "firm"].map(str::to_owned);
        let check = |event: Value, expected: &str| assert_eq!(line(&event, &labels), expected);
        let time = "2026-11-21T10:00:00.123456Z";
        check(
            json!({"type": "status", "sensor": "forearm", "time": time, "state": "lost",
                   "reason": "end\u{1b} of\u{202e} file", "frames": 120, "frames_damaged": 2,
                   "frames_dropped": 7, "frame_rate_hz": 4.96}),
            "10:00:00.123  forearm       status    lost        120 frames, 2 damaged, 7 dropped, \
             5.0 frames/s  (end of file)",
        );
        check(
            json!({"type": "status", "sensor": "forearm", "time": time, "state": "live",
                   "reason": "tare: contact", "detail": "3 taxels varied", "frames": 5,
                   "frames_damaged": 0, "frame_rate_hz": null}),
            "10:00:00.123  forearm       status    live        5 frames, 0 damaged  \
             (tare: contact: 3 taxels varied)",
        );
        check(
            json!({"type": "press", "sensor": "forearm", "time": time, "press": 3,
                   "state": "end", "frame": 44, "reason": null, "frames": 9, "context": null}),
            "10:00:00.123  forearm       press     #3    end       frame 44, 9 in contact",
        );
        check(
            json!({"type": "hardness", "sensor": "wrist", "time": time, "press": 3,
                   "phase": "final", "level": 2, "label": "firm", "rejected": null,
                   "notes": ["at_edge"], "probabilities": [0.01, 0.93, 0.05, 0.01],
                   "confidence": 0.93, "contact_area_taxels": 52, "force_n": 12.345,
                   "frame": 41, "age_at_publish_ms": 1400.5, "context": {"tag": "pick-17"},
                   "advice": "press_again", "shore": {"value": 63.6, "low": 58.2, "high": 70.0}}),
            "10:00:01.523  wrist         hardness  #3    final     64 +- 6 OO, firm                       \
             93 % [1 93 5 1]   52 taxels   12.35 N  press again  frame 41 at 10:00:00.123  \
             (at_edge)  \
             {\"tag\":\"pick-17\"}",
        );
        check(
            json!({"type": "frame", "sensor": "wrist", "time": time, "frame": 7,
                   "newtons": [0.5, 0.25, -0.01], "force_n": 0.74}),
            "10:00:00.123  wrist         frame     #7                0.74 N, highest taxel 0.50 N",
        );
        check(
            json!({"type": "frame", "sensor": "wrist", "time": time, "frame": 7,
                   "newtons": [300.5, 308.25], "force_n": null}),
            "10:00:00.123  wrist         frame     #7              no zero yet",
        );
        check(
            json!({"type": "gap", "lost": 4}),
            "-- gap: 4 events lost --",
        );
    }
}
