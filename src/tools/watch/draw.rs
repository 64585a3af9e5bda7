//! Draws as much of a view as fits.
//!
//! The state of a sensor's link and the age of its frame come above all else. If the link is not
//! live, the last frame is shown without its colours and under the state of the link, the curves
//! end, and no value is shown as present.

mod curve;
mod map;

use std::time::Duration;

use ratatui_core::buffer::Buffer;
use ratatui_core::layout::Rect;
use ratatui_core::style::{Color, Modifier, Style};
use ratatui_core::terminal::Frame;
use serde_json::Value;

use self::map::MapSize;
use super::look::Look;
use super::view::{Link, Sensor, View, age};
use crate::tools::answer::{Answer, items, with_shore};
use crate::tools::readable::number;
use hardnessd_core::wording;

/// Pictures up to this width have no map.
const NARROW: u16 = 64;

/// The blank columns between the left and the right part of a picture.
const GAP: u16 = 2;

/// Draws as much as there is room for.
pub(super) fn draw(frame: &mut Frame, view: &View, now: Duration, look: Look) {
    let area = frame.area();
    let page = &mut Page {
        buffer: frame.buffer_mut(),
        look,
        now,
    };
    let mut rows = Rows(area);
    let foot = rows.take_last();
    if let Some(row) = rows.take(1) {
        page.title(row, view);
    }
    let keys = items(&view.hello["model"], "without_effect").filter_map(Value::as_str);
    let keys: Vec<&str> = keys.collect();
    if !keys.is_empty() {
        let line = format!("{}: changes no verdict of this model", keys.join(", "));
        page.wrapped(&mut rows, &line, look.aside());
    }
    let Some(sensor) = view.sensor() else {
        if let Some((link, reason)) = view.trouble(now) {
            let line = format!("{}  {reason}", link.name());
            page.wrapped(&mut rows, &line, look.link(link));
        }
        page.keys(foot, view);
        return;
    };
    let (link, reason) = view.link(sensor, now);
    if view.sensors.len() > 1
        && let Some(row) = rows.take(1)
    {
        page.tabs(row, view);
    }
    page.link(&mut rows, sensor, link, reason.as_deref());
    let mut body = rows.0;
    if body.width > NARROW && body.height > 10 {
        let map = page.map_size(sensor, body.width / 2, body.height.saturating_sub(4));
        let width = map.cols.max(30);
        page.map_and_counters(Rect { width, ..body }, map, sensor, link);
        body.x += width + GAP;
        body.width -= width + GAP;
    }
    page.curves_and_verdicts(body, view, sensor, link);
    page.keys(foot, view);
}

/// A picture that is being drawn.
struct Page<'a> {
    buffer: &'a mut Buffer,
    look: Look,
    now: Duration,
}

/// Rows of an area, taken from the top.
struct Rows(Rect);

impl Rows {
    /// The next `height` rows, if there are that many.
    fn take(&mut self, height: u16) -> Option<Rect> {
        if height == 0 || self.0.height < height {
            return None;
        }
        let taken = Rect { height, ..self.0 };
        self.0.y += height;
        self.0.height -= height;
        Some(taken)
    }

    /// The last row, if there is more than one.
    fn take_last(&mut self) -> Option<Rect> {
        if self.0.height < 2 {
            return None;
        }
        self.0.height -= 1;
        Some(Rect {
            y: self.0.y + self.0.height,
            height: 1,
            ..self.0
        })
    }
}

impl Page<'_> {
    /// Writes a text without hidden characters: a reason comes from the system and a label from a model
    /// file, and neither may move the cursor. Returns the rest of the row.
    fn text(&mut self, area: Rect, text: &str, style: Style) -> Rect {
        let plain: String = text.chars().filter(|&c| !wording::is_hidden(c)).collect();
        let width = usize::from(area.width);
        let (end, _) = self.buffer.set_stringn(area.x, area.y, plain, width, style);
        Rect {
            x: end,
            width: area.right() - end,
            ..area
        }
    }

    /// Writes a text into as many rows as it needs, and gives these rows its style.
    fn wrapped(&mut self, rows: &mut Rows, text: &str, style: Style) {
        // A blank column on each side.
        for line in lines(text, usize::from(rows.0.width).saturating_sub(2)) {
            let Some(row) = rows.take(1) else { return };
            self.buffer.set_style(row, style);
            self.text(row, &format!(" {line}"), style);
        }
    }

    fn title(&mut self, row: Rect, view: &View) {
        let (hello, model) = (&view.hello, &view.hello["model"]);
        if hello.is_null() {
            self.text(row, "hardnessd", self.look.strong());
            return;
        }
        let text = |of: &Value, key: &str| of[key].as_str().unwrap_or_default().to_owned();
        let rest = self.text(row, &text(hello, "robot"), self.look.strong());
        // Several sensors have tabs.
        let sensor = match &view.sensors[..] {
            [only] => format!(" · {}", only.name),
            _ => String::new(),
        };
        let line = format!(
            "{sensor} · hardnessd {} · model {} ({}): {}",
            text(hello, "version"),
            text(model, "name"),
            text(model, "validation"),
            text(model, "needs")
        );
        self.text(rest, &line, self.look.aside());
    }

    fn tabs(&mut self, row: Rect, view: &View) {
        let tab = |(index, sensor): (usize, &Sensor)| {
            let (link, _) = view.link(sensor, self.now);
            let mark = if index == view.chosen { '>' } else { ' ' };
            (
                format!("{mark}{} {} {}", index + 1, sensor.name, link.name()),
                link,
            )
        };
        let tabs: Vec<(String, Link)> = view.sensors.iter().enumerate().map(tab).collect();
        // The chosen sensor must be visible.
        let mut first = 0;
        let width = |tabs: &[(String, Link)]| tabs.iter().map(|tab| tab.0.len() + 2).sum::<usize>();
        while first < view.chosen && width(&tabs[first..=view.chosen]) > usize::from(row.width) {
            first += 1;
        }
        let mut rest = row;
        for (index, (text, link)) in tabs.iter().enumerate().skip(first) {
            let style = match (index == view.chosen, link) {
                (true, _) => self.look.strong(),
                (false, Link::Live) => self.look.aside(),
                (false, _) => self.look.link(*link),
            };
            rest = self.text(rest, text, style);
            rest = self.text(rest, "  ", Style::new());
        }
    }

    /// The state of the link, the age of the last frame, and the frame rate.
    fn link(&mut self, rows: &mut Rows, sensor: &Sensor, link: Link, reason: Option<&str>) {
        let mut line = format!("{} ", link.name());
        if let Some(frame) = &sensor.frame {
            let old = age(self.now.saturating_sub(frame.at));
            line += &match link {
                Link::Live | Link::NoZero => format!(" frame {old} old"),
                _ => format!(" last frame {old} ago"),
            };
        }
        if link == Link::Lost && reason.is_some_and(is_unplugged) {
            line.insert_str("LOST ".len(), &format!(" {UNPLUGGED_WORDS};"));
        }
        let rate_hz = sensor.status["frame_rate_hz"].as_f64();
        if let (Link::Live, Some(rate_hz)) = (link, rate_hz) {
            line += &format!(" · {rate_hz:.1} frames/s");
        }
        if let Some(reason) = reason {
            line += &format!("  ({reason})");
        }
        self.wrapped(rows, &line, self.look.link(link));
    }

    fn map_and_counters(&mut self, area: Rect, map: MapSize, sensor: &Sensor, link: Link) {
        let mut rows = Rows(area);
        if map.rows > 0
            && let Some(area) = rows.take(map.rows + 1)
        {
            self.map(area, map, sensor, link);
        }
        if sensor.status.is_null() {
            return;
        }
        for (name, key) in [
            ("frames", "frames"),
            ("damaged", "frames_damaged"),
            ("dropped", "frames_dropped"),
            ("bytes skipped", "bytes_skipped"),
        ] {
            let count = number(&sensor.status, key);
            // A count of damage stands out if it is not 0.
            let style = if name == "frames" || count == 0 {
                self.look.aside()
            } else {
                let orange = Style::new().fg(Color::Indexed(214));
                self.look.style(orange, Modifier::BOLD)
            };
            if let Some(row) = rows.take(1) {
                self.text(row, &format!("{name:<14} {count:>14}"), style);
            }
        }
    }

    fn curves_and_verdicts(&mut self, area: Rect, view: &View, sensor: &Sensor, link: Link) {
        let mut rows = Rows(area);
        if let Some(row) = rows.take(1) {
            self.press(row, sensor, link);
        }
        if let Some(line) = sensor.score.line(&view.labels) {
            self.wrapped(&mut rows, &format!("pressing {line}"), Style::new());
        }
        // Verdicts get the rest, but at least 6 rows.
        let curve = (rows.0.height.saturating_sub(6) / 3).clamp(2, 12);
        if let Some(area) = rows.take(curve) {
            self.force(area, sensor, link);
        }
        if let Some(area) = rows.take(curve) {
            self.contact(area, sensor, link);
        }
        self.verdicts(rows.0, view, sensor, link);
    }

    fn press(&mut self, row: Rect, sensor: &Sensor, link: Link) {
        let rest = self.text(row, "press ", self.look.heading());
        let Some((at, press)) = &sensor.press else {
            self.text(rest, "none yet", self.look.aside());
            return;
        };
        let (old, number) = (age(self.now.saturating_sub(*at)), number(press, "press"));
        let (mut line, style) = match (press["state"].as_str(), link) {
            (Some("begin"), Link::Live) => {
                (format!("{number} in contact for {old}"), self.look.strong())
            }
            (Some("begin"), _) => {
                let unknown = format!("{number} began {old} ago, its end is not known");
                (unknown, Style::new())
            }
            (state, _) => {
                let state = state.unwrap_or_default();
                (format!("{number} {state} {old} ago"), Style::new())
            }
        };
        if let Some(reason) = press["reason"].as_str() {
            line += &format!(" ({reason})");
        }
        self.text(rest, &line, style);
    }

    fn verdicts(&mut self, area: Rect, view: &View, sensor: &Sensor, link: Link) {
        let mut rows = Rows(area);
        let Some(row) = rows.take(1) else { return };
        let rest = self.text(row, "verdicts ", self.look.heading());
        let of = format!("Shore OO, level, age; % of {}", view.labels.join(", "));
        self.text(rest, &of, self.look.aside());
        if sensor.verdicts.is_empty()
            && let Some(row) = rows.take(1)
        {
            self.text(row, "none yet", self.look.aside());
        }
        for (index, (at, verdict)) in sensor.verdicts.iter().enumerate() {
            let Some(row) = rows.take(1) else { return };
            let answer = Answer::of(verdict, &view.labels);
            let style = if answer.is_weak {
                self.look.aside()
            } else if index == 0 && link == Link::Live {
                self.look.strong()
            } else {
                Style::new()
            };
            let old = age(self.now.saturating_sub(*at));
            let line = verdict_line(verdict, &answer.text, &old, usize::from(row.width));
            self.text(row, &line, style);
        }
    }

    fn keys(&mut self, row: Option<Rect>, view: &View) {
        let Some(row) = row else { return };
        if let Some(text) = &view.entry {
            let ask = "pressing (a level, a name, or both; Enter): ";
            let rest = self.text(row, ask, self.look.heading());
            self.text(rest, &format!("{text}_"), self.look.strong());
            return;
        }
        if let Some(said) = &view.said {
            self.text(row, said, self.look.strong());
            return;
        }
        let line = if view.sensors.len() > 1 {
            "q quit   p what you press   Tab or 1-9 another sensor   Ctrl-L draw again"
        } else {
            "q quit   p what you press   Ctrl-L draw again"
        };
        let rest = self.text(row, line, self.look.aside());
        // Show the daemon's address if there is room for it.
        let columns = view.address.chars().count();
        if let Some(indent) = usize::from(rest.width).checked_sub(columns + 3) {
            let address = format!("{:indent$}   {}", "", view.address);
            self.text(rest, &address, self.look.aside());
        }
    }
}

/// A text as lines of at most `width` columns, where its words allow it.
fn lines(text: &str, width: usize) -> Vec<String> {
    let mut lines = vec![String::new()];
    let columns = |text: &str| text.chars().count();
    for word in text.split(' ') {
        let line = lines.last_mut().expect("there is a first line");
        if line.is_empty() {
            *line = word.to_owned();
        } else if columns(line) + 1 + columns(word) <= width {
            *line += &format!(" {word}");
        } else {
            lines.push(word.to_owned());
        }
    }
    lines
}

/// The reasons that mean that the device was unplugged. `page.html` repeats them and the words for
/// them, and a test compares the two.
pub(super) const UNPLUGGED: [&str; 4] = [
    "end of file",
    "Input/output error",
    "No such device",
    "no such device",
];
pub(super) const UNPLUGGED_WORDS: &str = "unplugged: plug it in again";

/// Whether this reason means that the device was unplugged.
fn is_unplugged(reason: &str) -> bool {
    UNPLUGGED.iter().any(|gone| reason.contains(gone))
}

/// Press, answer with its Shore hardness, and age. What else is known follows as far as there is room.
fn verdict_line(verdict: &Value, answer: &str, old: &str, width: usize) -> String {
    let (press, answer) = (number(verdict, "press"), with_shore(answer, verdict));
    let mut line = format!("{press:>3} {answer:<27} {old:>6}");
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
