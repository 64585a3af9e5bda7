//! Draws as much of a view as fits.
//!
//! The state of a sensor's link and the age of its frame come above all else. If the link is not
//! live, the last frame is shown without its colours and under the state of the link, the curve
//! ends, and no value is shown as present.

use std::collections::VecDeque;
use std::time::Duration;

use ratatui_core::buffer::Buffer;
use ratatui_core::layout::{Constraint, Layout, Rect};
use ratatui_core::style::{Color, Modifier, Style};
use ratatui_core::terminal::Frame;
use ratatui_core::text::{Line, Span, Text};
use serde_json::Value;

use super::view::{Link, Sensor, View, WINDOW, age};
use crate::tools::answer::{answer, items, with_shore};
use crate::tools::readable::number;
use hardnessd_core::colour::viridis;
use hardnessd_core::wording;

/// Pictures up to this width have no map.
const NARROW: u16 = 64;

/// The least width of the left part of a picture, and the blank columns after it.
const LEFT: u16 = 30;
const GAP: u16 = 2;

/// The least full scale of the map, in newtons a taxel: noise must not look like a touch.
const LEAST_SCALE_N: f32 = 1.0;

/// The totals of a status that are shown.
const COUNTS: [&str; 4] = [
    "frames",
    "frames_damaged",
    "frames_dropped",
    "bytes_skipped",
];

/// Greys from no pressure to the greatest, for a map that is no longer current.
const GREY: [u8; 13] = [
    234, 235, 236, 238, 240, 241, 243, 244, 246, 247, 249, 251, 253,
];

/// The symbols of a cell that is filled by 0 to 8 eighths.
const BLOCKS: [char; 9] = [
    ' ', '\u{2581}', '\u{2582}', '\u{2583}', '\u{2584}', '\u{2585}', '\u{2586}', '\u{2587}',
    '\u{2588}',
];

/// The reasons that mean that the device was unplugged. `page.html` repeats them and the words for
/// them, and a test compares the two.
pub(super) const UNPLUGGED: [&str; 4] = [
    "end of file",
    "Input/output error",
    "No such device",
    "no such device",
];
pub(super) const UNPLUGGED_WORDS: &str = "unplugged: plug it in again";

const HEADING: Style = Style::new().fg(Color::Indexed(75));
const ASIDE: Style = Style::new().fg(Color::Indexed(245));
const STRONG: Style = Style::new().add_modifier(Modifier::BOLD);
/// A count of damage stands out if it is not 0.
const DAMAGE: Style = Style::new().fg(Color::Indexed(214));

/// A heading, and a text beside it.
fn headed(heading: &str, text: &str, style: Style) -> Line<'static> {
    Line::from_iter([span(&format!("{heading} "), HEADING), span(text, style)])
}

/// The style of the word for a link. Other states must not look like live.
fn style_of(link: Link) -> Style {
    let (fg, bg) = match link {
        Link::Live => (16, 40),
        Link::Connecting => (16, 75),
        Link::NoZero | Link::Stale | Link::Silent => (16, 214),
        Link::Lost | Link::NoDaemon => (231, 160),
    };
    STRONG.fg(Color::Indexed(fg)).bg(Color::Indexed(bg))
}

/// Draws as much as there is room for.
pub(super) fn draw(frame: &mut Frame, view: &View, now: Duration) {
    let area = frame.area();
    let width = usize::from(area.width);
    let sensor = view.sensor();
    let (link, reason) = view.link(sensor, now);
    let mut head = wrapped(&title(view), width, ASIDE);
    // What follows matters more.
    head.truncate(if area.height < 20 { 1 } else { 3 });
    if view.sensors.len() > 1 {
        head.push(tabs(view, now, width));
    }
    let line = link_line(sensor, link, reason.as_deref(), now);
    head.extend(wrapped(&line, width, style_of(link)));
    // The keys have the last row.
    head.truncate(usize::from(area.height).saturating_sub(1).max(1));
    let [top, body, foot] = Layout::vertical([
        Constraint::Length(head.len() as u16),
        Constraint::Fill(1),
        Constraint::Length(1),
    ])
    .areas(area);
    frame.render_widget(Text::from(head), top);
    frame.render_widget(keys(view), foot);
    let Some(sensor) = sensor else { return };
    let mut right = body;
    if body.width > NARROW && body.height > 10 {
        let (cols, rows) = map_size(sensor, body.width / 2, body.height - 5);
        let wide = Constraint::Length(cols.max(LEFT) + GAP);
        let [left, rest] = Layout::horizontal([wide, Constraint::Fill(1)]).areas(body);
        right = rest;
        let [scale, map, counts] = Layout::vertical([
            Constraint::Length(1),
            Constraint::Length(rows),
            Constraint::Fill(1),
        ])
        .areas(left);
        let newtons = sensor.newtons();
        let top_n = newtons.iter().copied().fold(LEAST_SCALE_N, f32::max);
        let range = format!("0 to {top_n:.2} N a taxel");
        frame.render_widget(headed("pressure", &range, ASIDE), scale);
        let map = Rect { width: cols, ..map };
        if !newtons.is_empty() {
            let share = |n: f32| (n / top_n).min(1.0);
            let shares: Vec<f32> = newtons.into_iter().map(share).collect();
            draw_map(
                frame.buffer_mut(),
                map,
                (sensor.rows, sensor.cols),
                &shares,
                link,
            );
        }
        if link != Link::Live {
            let word = span(&format!(" {} ", link.name()), style_of(link));
            frame.render_widget(Line::from(word).centered(), map);
        }
        frame.render_widget(counters(sensor), counts);
    }
    let width = usize::from(right.width);
    let mut lines = vec![press_line(sensor, link, now)];
    if let Some(line) = sensor.count.line(&view.labels) {
        lines.extend(wrapped(&format!("pressing {line}"), width, Style::new()));
    }
    lines.push(force_line(sensor, link));
    let height = (right.height / 4).clamp(1, 10);
    lines.extend(curve(sensor, now, width, usize::from(height)));
    lines.extend(verdicts(view, sensor, link, now, width));
    frame.render_widget(Text::from(lines), right);
}

/// A text without hidden characters: a reason comes from the system and a label from a model file, and
/// neither may move the cursor.
fn span(text: &str, style: Style) -> Span<'static> {
    let plain: String = text.chars().filter(|&c| !wording::is_hidden(c)).collect();
    Span::styled(plain, style)
}

/// A text as lines of at most `width` columns, where its words allow it, with a blank column on each side.
fn wrapped(text: &str, width: usize, style: Style) -> Vec<Line<'static>> {
    let mut lines = vec![String::new()];
    let columns = |text: &str| text.chars().count();
    for word in text.split(' ') {
        let line = lines.last_mut().expect("there is a first line");
        if columns(line) + 1 + columns(word) < width || line.is_empty() {
            *line += &format!(" {word}");
        } else {
            lines.push(format!(" {word}"));
        }
    }
    let line = |line: String| Line::from(span(&line, style)).style(style);
    lines.into_iter().map(line).collect()
}

fn title(view: &View) -> String {
    let (hello, model) = (&view.hello, &view.hello["model"]);
    if hello.is_null() {
        return "hardnessd".to_owned();
    }
    let text = |of: &Value, key: &str| of[key].as_str().unwrap_or_default().to_owned();
    // Several sensors have tabs.
    let sensor = match &view.sensors[..] {
        [only] => format!(" · {}", only.name),
        _ => String::new(),
    };
    format!(
        "{}{sensor} · hardnessd {} · model {} ({}): {}",
        text(hello, "robot"),
        text(hello, "version"),
        text(model, "name"),
        text(model, "validation"),
        text(model, "needs")
    )
}

/// All sensors with their links. The chosen one is visible.
fn tabs(view: &View, now: Duration, width: usize) -> Line<'static> {
    let tab = |(index, sensor): (usize, &Sensor)| {
        let (link, _) = view.link(Some(sensor), now);
        let (mark, style) = match (index == view.chosen, link) {
            (true, _) => ('>', STRONG),
            (false, Link::Live) => (' ', ASIDE),
            (false, _) => (' ', style_of(link)),
        };
        let text = format!("{mark}{} {} {}  ", index + 1, sensor.name, link.name());
        span(&text, style)
    };
    let mut tabs: VecDeque<Span> = view.sensors.iter().enumerate().map(tab).collect();
    let up_to_chosen = tabs.iter().take(view.chosen + 1);
    let mut columns: usize = up_to_chosen.map(Span::width).sum();
    for _ in 0..view.chosen {
        if columns > width
            && let Some(first) = tabs.pop_front()
        {
            columns -= first.width();
        }
    }
    Line::from_iter(tabs)
}

/// The state of the link, the age of the last frame, and the frame rate.
fn link_line(sensor: Option<&Sensor>, link: Link, reason: Option<&str>, now: Duration) -> String {
    let mut line = format!("{} ", link.name());
    let is_unplugged = |reason: &str| UNPLUGGED.iter().any(|gone| reason.contains(gone));
    if link == Link::Lost && reason.is_some_and(is_unplugged) {
        line += &format!(" {UNPLUGGED_WORDS};");
    }
    if let Some((at, _)) = sensor.and_then(|sensor| sensor.frame.as_ref()) {
        let old = age(now.saturating_sub(*at));
        line += &match link {
            Link::Live | Link::NoZero => format!(" frame {old} old"),
            _ => format!(" last frame {old} ago"),
        };
    }
    let rate_hz = sensor.and_then(|sensor| sensor.status["frame_rate_hz"].as_f64());
    if let (Link::Live, Some(rate_hz)) = (link, rate_hz) {
        line += &format!(" · {rate_hz:.1} frames/s");
    }
    if let Some(reason) = reason {
        line += &format!("  ({reason})");
    }
    line
}

/// The columns and rows of the largest pressure map that fits. A taxel takes half as many rows as columns,
/// because a cell is twice as high as it is wide.
fn map_size(sensor: &Sensor, width: u16, height: u16) -> (u16, u16) {
    let (wide, high) = (usize::from(width), 2 * usize::from(height));
    let scale = (wide / sensor.cols).min(high / sensor.rows);
    // Several taxels share a place of a small map.
    let shared = sensor.cols.div_ceil(wide).max(sensor.rows.div_ceil(high));
    let places = |taxels: usize| match scale {
        0 => taxels.div_ceil(shared),
        _ => scale * taxels,
    };
    let halves = places(sensor.rows);
    (places(sensor.cols) as u16, halves.div_ceil(2) as u16)
}

/// The pressure map: in colours, or in greys if it is no longer current. `shares` of the full scale are
/// those of the taxels.
fn draw_map(
    buffer: &mut Buffer,
    area: Rect,
    (rows, cols): (usize, usize),
    shares: &[f32],
    link: Link,
) {
    let (wide, high) = (usize::from(area.width), 2 * usize::from(area.height));
    // The taxels of a place: a part of one, or several.
    let taxels = |place: usize, places: usize, taxels: usize| {
        place * taxels / places..((place + 1) * taxels).div_ceil(places)
    };
    // The greatest of the taxels that share a place, so that no touch vanishes. The square root
    // keeps a soft touch visible beside a hard one.
    let shade = |x: usize, y: usize| {
        let of_row = |row: usize| &shares[row * cols..][taxels(x, wide, cols)];
        let shared = taxels(y, high, rows).flat_map(of_row);
        shared.copied().fold(0.0, f32::max).sqrt()
    };
    let grey = |share: f32| ((share * GREY.len() as f32) as usize).min(GREY.len() - 1);
    let colour = |share: f32| match link {
        Link::Live => indexed(viridis(share)),
        _ => Color::Indexed(GREY[grey(share)]),
    };
    for (x, y) in (0..area.height).flat_map(|y| (0..area.width).map(move |x| (x, y))) {
        let half = |half: usize| shade(usize::from(x), 2 * usize::from(y) + half);
        let (upper, lower) = (half(0), half(1));
        let cell = &mut buffer[(area.x + x, area.y + y)];
        cell.set_char('\u{2580}').set_fg(colour(upper));
        cell.set_bg(colour(lower));
    }
}

/// The nearest of xterm's 256 colours. 216 of them are a cube with the levels 0, 95, 135, 175, 215
/// and 255 of red, green and blue.
fn indexed(colour: [u8; 3]) -> Color {
    let level = |value: u8| match value {
        0..48 => 0,
        48..115 => 1,
        _ => (value - 35) / 40,
    };
    let [red, green, blue] = colour.map(level);
    Color::Indexed(16 + 36 * red + 6 * green + blue)
}

fn counters(sensor: &Sensor) -> Text<'static> {
    let line = |key: &str| {
        let count = number(&sensor.status, key);
        let style = match key == "frames" || count == 0 {
            true => ASIDE,
            false => DAMAGE,
        };
        let name = key.replace('_', " ");
        Line::from(span(&format!("{name:<14} {count:>14}"), style))
    };
    let counts = COUNTS.into_iter();
    let counts = counts.filter(|_| !sensor.status.is_null());
    counts.map(line).collect()
}

fn press_line(sensor: &Sensor, link: Link, now: Duration) -> Line<'static> {
    let Some((at, press)) = &sensor.press else {
        return headed("press", "none yet", ASIDE);
    };
    let (old, number) = (age(now.saturating_sub(*at)), number(press, "press"));
    let (mut line, style) = match (press["state"].as_str().unwrap_or_default(), link) {
        ("begin", Link::Live) => (format!("{number} in contact for {old}"), STRONG),
        ("begin", _) => {
            let unknown = format!("{number} began {old} ago, its end is not known");
            (unknown, Style::new())
        }
        (state, _) => (format!("{number} {state} {old} ago"), Style::new()),
    };
    if let Some(reason) = press["reason"].as_str() {
        line += &format!(" ({reason})");
    }
    headed("press", &line, style)
}

/// The present force and contact area.
fn force_line(sensor: &Sensor, link: Link) -> Line<'static> {
    let Some((_, frame)) = sensor.frame.as_ref().filter(|_| link == Link::Live) else {
        return headed("force", "not known", ASIDE);
    };
    // A small negative sum is noise.
    let force_n = frame["force_n"].as_f64().unwrap_or(0.0).max(0.0);
    let taxels = number(frame, "contact_area_taxels");
    let present = format!("{force_n:.2} N on {taxels} taxels");
    headed("force", &present, STRONG)
}

/// The force of the last 30 s, as bars, and its scale.
fn curve(sensor: &Sensor, now: Duration, width: usize, height: usize) -> Vec<Line<'static>> {
    let curve = sensor.curve(now, width);
    let most = curve.iter().flatten().copied().fold(0.0, f32::max);
    let symbol = |force_n: &Option<f32>, below: usize| match force_n {
        // If nothing was ever pressed, the share is NaN, and the cast makes it 0.
        Some(force_n) => {
            let eighths = (force_n / most * 8.0 * height as f32) as usize;
            BLOCKS[eighths.saturating_sub(8 * below).min(8)]
        }
        None => '\u{b7}',
    };
    let row = |below: usize| -> String { curve.iter().map(|one| symbol(one, below)).collect() };
    let rows = (0..height).rev().map(row);
    let mut lines: Vec<Line> = rows.map(|row| span(&row, HEADING).into()).collect();
    let scale = format!("{} s, to {most:.0} N", WINDOW.as_secs());
    lines.push(span(&scale, ASIDE).into());
    lines
}

/// The least columns of an answer with its Shore hardness.
const LEAST_ANSWER: usize = 27;
/// The columns of a verdict up to its force, which the shares of the levels follow.
const VERDICT_COLUMNS: usize = 48;

fn verdicts(
    view: &View,
    sensor: &Sensor,
    link: Link,
    now: Duration,
    width: usize,
) -> Vec<Line<'static>> {
    let room_for_shares = VERDICT_COLUMNS + 4 * view.labels.len();
    let of = match width >= room_for_shares {
        true => format!("Shore OO, level, age; % of {}", view.labels.join(", ")),
        false => "Shore OO, level, age".to_owned(),
    };
    let mut lines = vec![headed("verdicts", &of, ASIDE)];
    if sensor.verdicts.is_empty() {
        lines.push(span("none yet", ASIDE).into());
    }
    let answers = sensor.verdicts.iter().map(|(_, verdict)| {
        let (answer, is_weak) = answer(verdict, &view.labels);
        (with_shore(&answer, verdict), is_weak)
    });
    let answers: Vec<(String, bool)> = answers.collect();
    let longest = answers
        .iter()
        .map(|(answer, _)| answer.chars().count())
        .max();
    // The force of most presses should find room.
    let room = LEAST_ANSWER + width.saturating_sub(VERDICT_COLUMNS);
    let longest = longest.unwrap_or(0).clamp(LEAST_ANSWER, room);
    for (index, ((at, verdict), (answer, is_weak))) in
        sensor.verdicts.iter().zip(&answers).enumerate()
    {
        let style = match *is_weak {
            true => ASIDE,
            false if index == 0 && link == Link::Live => STRONG,
            false => Style::new(),
        };
        let old = age(now.saturating_sub(*at));
        let line = verdict_line(verdict, &format!("{answer:<longest$} {old:>6}"), width);
        lines.push(span(&line, style).into());
    }
    lines
}

/// Press, and answer with its age. What else is known follows as far as there is room.
fn verdict_line(verdict: &Value, answer: &str, width: usize) -> String {
    let mut line = format!("{:>3} {answer}", number(verdict, "press"));
    let early = (verdict["phase"] == "early").then(|| "  early".to_owned());
    let force_n = verdict["force_n"].as_f64().unwrap_or_default();
    let shares = items(verdict, "probabilities").filter_map(Value::as_f64);
    let shares = shares.map(|share| format!(" {:>3.0}", 100.0 * share));
    let shares = format!(" {}", shares.collect::<String>());
    let notes = [&verdict["advice"]]
        .into_iter()
        .chain(items(verdict, "notes"));
    let notes = notes.filter_map(Value::as_str);
    let notes = notes.map(|note| format!("  {}", note.replace('_', " ")));
    let force = format!("  {force_n:>5.1} N");
    for more in early.into_iter().chain([force, shares]).chain(notes) {
        if line.chars().count() + more.len() > width {
            break;
        }
        line += &more;
    }
    line
}

/// The keys, what a person types, or the outcome of the last command.
fn keys(view: &View) -> Line<'static> {
    if let Some(text) = &view.entry {
        let ask = "pressing (a level, a name, or both; Enter):";
        return headed(ask, &format!("{text}_"), STRONG);
    }
    if let Some(said) = &view.said {
        return span(said, STRONG).into();
    }
    let more = match view.sensors.len() {
        0 | 1 => "",
        _ => "Tab or 1-9 another sensor   ",
    };
    let line = format!("q quit   p what you press   {more}Ctrl-L draw again");
    span(&line, ASIDE).into()
}
