//! A view as a picture, for whatever room there is.
//!
//! What a sensor's link is and how old its frame is stands above all else. Where the link is not
//! live, the last frame is shown without its colours and under the word for what it is, the curves
//! run out, and no number of it is called present.

use std::time::Duration;

use ratatui::Frame;
use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::style::{Color, Modifier, Style};
use ratatui::symbols::bar;
use ratatui::widgets::{Sparkline, Widget};

use super::view::{Link, Load, Sensor, Verdict, View, WINDOW, age};

/// What the terminal can show.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Look {
    /// 256 of them.
    pub(super) colours: bool,
    /// Bold and reversed.
    pub(super) attributes: bool,
    /// More than ASCII.
    pub(super) unicode: bool,
}

impl Look {
    /// By the variables `TERM`, `NO_COLOR` (<https://no-color.org>), and the first that is set of
    /// `LC_ALL`, `LC_CTYPE` and `LANG`.
    pub(super) fn new(term: &str, no_color: &str, locale: &str) -> Self {
        let is_plain = ["", "dumb", "unknown"].contains(&term);
        let is_old = term.starts_with("vt") || term.ends_with("-m") || term.ends_with("-mono");
        let locale = locale.to_ascii_lowercase();
        Self {
            colours: !is_plain && !is_old && no_color.is_empty(),
            attributes: !is_plain,
            unicode: !is_plain && !is_old && (locale.contains("utf-8") || locale.contains("utf8")),
        }
    }

    fn style(self, colour: Style, without: Modifier) -> Style {
        match (self.colours, self.attributes) {
            (true, _) => colour,
            (false, true) => Style::new().add_modifier(without),
            (false, false) => Style::new(),
        }
    }

    fn heading(self) -> Style {
        self.style(Style::new().fg(Color::Indexed(75)), Modifier::BOLD)
    }

    fn aside(self) -> Style {
        self.style(Style::new().fg(Color::Indexed(245)), Modifier::empty())
    }

    fn strong(self) -> Style {
        self.style(Style::new().add_modifier(Modifier::BOLD), Modifier::BOLD)
    }

    /// Of the word for a link: what is not live must not look like it.
    fn link(self, link: Link) -> Style {
        let (fg, bg) = match link {
            Link::Live => (16, 40),
            Link::Connecting => (16, 75),
            Link::Stale | Link::Silent => (16, 214),
            Link::Lost | Link::NoDaemon => (231, 160),
        };
        let without = match link {
            Link::Live => Modifier::BOLD,
            _ => Modifier::REVERSED.union(Modifier::BOLD),
        };
        let colour = Style::new()
            .fg(Color::Indexed(fg))
            .bg(Color::Indexed(bg))
            .add_modifier(Modifier::BOLD);
        self.style(colour, without)
    }

    fn separator(self) -> &'static str {
        if self.unicode { " · " } else { " | " }
    }
}

/// Widest picture that is one column.
const NARROW: u16 = 64;

/// Columns between two columns.
const GAP: u16 = 2;

/// Draws all there is room for.
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
    let Some(sensor) = view.sensor() else {
        if let Some(row) = rows.take(1) {
            let line = format!(" NO DAEMON  {}", view.absence());
            page.band(row, &line, look.link(Link::NoDaemon));
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
    if let Some(row) = rows.take(1) {
        page.link(row, sensor, link, reason.as_deref());
    }
    let body = rows.0;
    let side_by_side = body.width > NARROW && body.height > 10;
    if side_by_side {
        let map = page.map_size(sensor, body.width / 2, body.height.saturating_sub(5));
        let width = map.0.max(30);
        let left = Rect { width, ..body };
        let right = Rect {
            x: body.x + width + GAP,
            width: body.width - width - GAP,
            ..body
        };
        page.map_and_counters(left, map, view, sensor, link);
        page.curves_and_verdicts(right, view, sensor, link);
    } else {
        page.stack(body, view, sensor, link);
    }
    page.keys(foot, view);
}

/// What a picture is drawn with.
struct Page<'a> {
    buffer: &'a mut Buffer,
    look: Look,
    now: Duration,
}

/// Rows of an area, taken from the top.
struct Rows(Rect);

impl Rows {
    /// The next rows, if there are so many.
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
    fn text(&mut self, area: Rect, text: &str, style: Style) -> Rect {
        let width = usize::from(area.width);
        let (end, _) = self.buffer.set_stringn(area.x, area.y, text, width, style);
        Rect {
            x: end,
            width: area.right() - end,
            ..area
        }
    }

    /// The text in a row that has the style to its end.
    fn band(&mut self, row: Rect, text: &str, style: Style) {
        self.buffer.set_style(row, style);
        self.text(row, text, style);
    }

    fn title(&mut self, row: Rect, view: &View) {
        let Some(hello) = &view.hello else {
            self.text(row, "hardnessd", self.look.strong());
            return;
        };
        let rest = self.text(row, &hello.robot, self.look.strong());
        let dot = self.look.separator();
        let line = format!(
            "{dot}hardnessd {}{dot}model {} ({})",
            hello.version, hello.model, hello.validation
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
        // The chosen one must be among those there is room for.
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

    /// One row: what the link is, how old the frame, how many a second.
    fn link(&mut self, row: Rect, sensor: &Sensor, link: Link, reason: Option<&str>) {
        let mut line = format!(" {} ", link.name());
        if let Some(frame) = &sensor.frame {
            let old = age(self.now.saturating_sub(frame.at));
            line += &match link {
                Link::Live => format!(" frame {old} old"),
                _ => format!(" last frame {old} ago"),
            };
        }
        let rate_hz = sensor.status.as_ref().and_then(|one| one.frame_rate_hz);
        if let (Link::Live, Some(rate_hz)) = (link, rate_hz) {
            line += &format!("{}{rate_hz:.1} frames/s", self.look.separator());
        }
        if let Some(reason) = reason {
            line += &format!("  ({reason})");
        }
        self.band(row, &line, self.look.link(link));
    }

    /// Columns and rows of the pressure map: the largest form that fits; `(0, 0)`: none does.
    fn map_size(&self, sensor: &Sensor, width: u16, height: u16) -> (u16, u16) {
        let cols = u16::try_from(sensor.cols).unwrap_or_default();
        let rows = u16::try_from(sensor.rows).unwrap_or_default();
        let forms = [(2 * cols, rows), (cols, rows.div_ceil(2))];
        let fitting = forms
            .into_iter()
            .find(|form| form.0 <= width && form.1 <= height);
        fitting.unwrap_or_default()
    }

    /// One column: what matters most first, the rest as far as there is room.
    fn stack(&mut self, body: Rect, view: &View, sensor: &Sensor, link: Link) {
        let mut rows = Rows(body);
        if let Some(row) = rows.take(1) {
            self.press(row, sensor, link);
        }
        let spare = rows.0.height.saturating_sub(4);
        let map = self.map_size(sensor, body.width, spare.saturating_sub(1));
        let verdicts = if map.1 == 0 { 4 } else { spare - map.1 + 3 };
        let curves = verdicts >= 14;
        if let Some(area) = rows.take(if curves {
            5
        } else {
            verdicts.min(rows.0.height)
        }) {
            self.verdicts(area, view, sensor, link);
        }
        if map.1 > 0
            && let Some(area) = rows.take(map.1 + 1)
        {
            self.map(area, map, sensor, link);
        }
        let (force, contact) = halves(rows.0);
        self.force(force, sensor, link);
        self.contact(contact, sensor, link);
    }

    fn map_and_counters(
        &mut self,
        area: Rect,
        map: (u16, u16),
        view: &View,
        sensor: &Sensor,
        link: Link,
    ) {
        let mut rows = Rows(area);
        if map.1 > 0
            && let Some(area) = rows.take(map.1 + 1)
        {
            self.map(area, map, sensor, link);
        }
        let Some(status) = &sensor.status else { return };
        let missed = view
            .missed
            .map_or("?".to_owned(), |missed| missed.to_string());
        // Damage is to be seen; that there is none is not.
        let plain = self.look.aside();
        let alarm = |count: u64| match count {
            0 => plain,
            _ => self
                .look
                .style(Style::new().fg(Color::Indexed(214)), Modifier::BOLD),
        };
        for (name, count, style) in [
            ("frames", status.frames.to_string(), plain),
            (
                "damaged",
                status.frames_damaged.to_string(),
                alarm(status.frames_damaged),
            ),
            (
                "bytes skipped",
                status.bytes_skipped.to_string(),
                alarm(status.bytes_skipped),
            ),
            ("events missed", missed, alarm(view.missed.unwrap_or(1))),
        ] {
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
        // Verdicts get what is left, but not less than 6 rows.
        let curve = (rows.0.height.saturating_sub(6) / 3).clamp(2, 8);
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
        let Some(press) = &sensor.press else {
            self.text(rest, "none yet", self.look.aside());
            return;
        };
        let old = age(self.now.saturating_sub(press.at));
        let mut line = match (press.state.as_str(), link) {
            ("begin", Link::Live) => format!("{} in contact for {old}", press.number),
            ("begin", _) => format!("{} began {old} ago, its end is not known", press.number),
            (state, _) => format!("{} {state} {old} ago", press.number),
        };
        if let Some(reason) = &press.reason {
            line += &format!(" ({reason})");
        }
        let style = match (press.state.as_str(), link) {
            ("begin", Link::Live) => self.look.strong(),
            _ => Style::new(),
        };
        self.text(rest, &line, style);
    }

    fn map(&mut self, area: Rect, (cols, rows): (u16, u16), sensor: &Sensor, link: Link) {
        let top = sensor.highest_n().max(LEAST_SCALE_N);
        let rest = self.text(area, "pressure ", self.look.heading());
        self.text(rest, &format!("0 to {top:.2} N a taxel"), self.look.aside());
        let area = Rect {
            y: area.y + 1,
            width: cols.min(area.width),
            height: rows.min(area.height - 1),
            ..area
        };
        // Two cells a taxel, or two taxels a cell: a cell is twice as high as it is wide.
        let is_large = usize::from(cols) > sensor.cols;
        let (taxel_cells, cell_taxels) = if is_large { (2, 1) } else { (1, 2) };
        // By its root, or a soft touch would vanish beside a hard one.
        let shade = |row, col| sensor.newtons(row, col).map(|n| (n / top).min(1.0).sqrt());
        for y in 0..area.height {
            for x in 0..area.width {
                let col = usize::from(x) / taxel_cells;
                let row = usize::from(y) * cell_taxels;
                let upper = shade(row, col);
                let lower = if is_large { upper } else { shade(row + 1, col) };
                let cell = &mut self.buffer[(area.x + x, area.y + y)];
                if self.look.colours {
                    let ramp = if link == Link::Live { &HEAT } else { &GREY };
                    let colour = |share: Option<f32>| match share {
                        Some(share) => Color::Indexed(ramp[step(share, ramp.len())]),
                        None => Color::Indexed(GREY[0]),
                    };
                    if self.look.unicode {
                        cell.set_char('\u{2580}').set_fg(colour(upper));
                        cell.set_bg(colour(lower));
                    } else {
                        // The greater of the two: a touch must not vanish.
                        cell.set_char(' ').set_bg(colour(max(upper, lower)));
                    }
                } else {
                    let share = max(upper, lower);
                    let step = share.map_or(0, |share| step(share, CHARACTERS.len()));
                    // Where nothing is pressed, the corners say how far the array goes.
                    let is_corner =
                        (x == 0 || x + 1 == area.width) && (y == 0 || y + 1 == area.height);
                    let character = if step == 0 && is_corner {
                        b'+'
                    } else {
                        CHARACTERS[step]
                    };
                    cell.set_char(char::from(character));
                }
            }
        }
        if link != Link::Live && area.height > 0 {
            let word = format!(" {} ", link.name());
            let width = u16::try_from(word.len())
                .unwrap_or_default()
                .min(area.width);
            let place = Rect {
                x: area.x + (area.width - width) / 2,
                y: area.y,
                width,
                height: 1,
            };
            self.text(place, &word, self.look.link(link));
        }
    }

    fn force(&mut self, area: Rect, sensor: &Sensor, link: Link) {
        let present = |load: &super::view::Frame| format!("{:.2} N", load.force_n);
        self.curve(area, "force", sensor, link, present, |load| load.force_n);
    }

    fn contact(&mut self, area: Rect, sensor: &Sensor, link: Link) {
        let present = |load: &super::view::Frame| format!("{} taxels", load.contact_area_taxels);
        let area_taxels = |load: &Load| load.contact_area_taxels as f32;
        self.curve(area, "contact area", sensor, link, present, area_taxels);
    }

    /// A heading with the present value, if there is one, and the last 30 s.
    fn curve(
        &mut self,
        area: Rect,
        name: &str,
        sensor: &Sensor,
        link: Link,
        present: impl Fn(&super::view::Frame) -> String,
        value: impl Fn(&Load) -> f32,
    ) {
        let mut rows = Rows(area);
        let Some(row) = rows.take(1) else { return };
        let curve = sensor.curve(self.now, usize::from(area.width), value);
        let most = curve.iter().flatten().copied().fold(0.0, f32::max);
        let rest = self.text(row, &format!("{name} "), self.look.heading());
        let rest = match (&sensor.frame, link) {
            (Some(frame), Link::Live) => self.text(rest, &present(frame), self.look.strong()),
            _ => self.text(rest, "not known", self.look.aside()),
        };
        let seconds = WINDOW.as_secs();
        let scale = format!("  {seconds} s, to {most:.0}");
        self.text(rest, &scale, self.look.aside());
        let bars: Vec<Option<u64>> = curve
            .iter()
            .map(|value| value.map(|value| (value * FINE).round() as u64))
            .collect();
        let set = if self.look.unicode {
            bar::NINE_LEVELS
        } else {
            ASCII_BARS
        };
        let absent = if self.look.unicode { "\u{b7}" } else { " " };
        Sparkline::default()
            .data(bars)
            .max(((most * FINE).round() as u64).max(1))
            .bar_set(set)
            .absent_value_symbol(absent)
            .absent_value_style(self.look.aside())
            .style(
                self.look
                    .style(Style::new().fg(Color::Indexed(75)), Modifier::empty()),
            )
            .render(rows.0, self.buffer);
    }

    fn verdicts(&mut self, area: Rect, view: &View, sensor: &Sensor, link: Link) {
        let mut rows = Rows(area);
        let Some(row) = rows.take(1) else { return };
        let rest = self.text(row, "verdicts ", self.look.heading());
        let labels = view.hello.as_ref().map_or(&[][..], |hello| &hello.labels);
        let of = format!("% of {}", labels.join(", "));
        self.text(rest, &of, self.look.aside());
        if sensor.verdicts.is_empty()
            && let Some(row) = rows.take(1)
        {
            self.text(row, "none yet", self.look.aside());
        }
        for (index, verdict) in sensor.verdicts.iter().enumerate() {
            let Some(row) = rows.take(1) else { return };
            let style = if index == 0 && link == Link::Live {
                self.look.strong()
            } else {
                Style::new()
            };
            let old = age(self.now.saturating_sub(verdict.at));
            let line = verdict_line(verdict, &old, usize::from(row.width));
            self.text(row, &line, style);
        }
    }

    fn keys(&mut self, row: Option<Rect>, view: &View) {
        let Some(row) = row else { return };
        let line = if view.sensors.len() > 1 {
            "q quit   Tab or 1-9 another sensor   Ctrl-L draw again"
        } else {
            "q quit   Ctrl-L draw again"
        };
        self.text(row, line, self.look.aside());
    }
}

/// Press, phase, verdict, probabilities in percent and age; force and notes where they have room.
fn verdict_line(verdict: &Verdict, old: &str, width: usize) -> String {
    let level = match &verdict.level {
        Ok((level, label)) => format!("{level} {label}"),
        Err(why) => format!("- {why}"),
    };
    let shares = verdict
        .probabilities
        .iter()
        .map(|share| format!("{:>3.0}", 100.0 * share));
    let shares = shares.collect::<Vec<_>>().join(" ");
    let mut line = format!(
        "{:>3} {:<5} {level:<11} {shares} {old:>6}",
        verdict.press, verdict.phase
    );
    let force = format!("  {:>5.1} N", verdict.force_n);
    let notes = verdict.notes.iter().map(|note| format!("  {note}"));
    for more in std::iter::once(force).chain(notes) {
        if line.len() + more.len() > width {
            break;
        }
        line += &more;
    }
    line
}

fn halves(area: Rect) -> (Rect, Rect) {
    let height = area.height / 2;
    let lower = Rect {
        y: area.y + height,
        height,
        ..area
    };
    (Rect { height, ..area }, lower)
}

fn max(one: Option<f32>, other: Option<f32>) -> Option<f32> {
    one.into_iter().chain(other).reduce(f32::max)
}

/// Which of so many steps a share of 0 to 1 is.
fn step(share: f32, steps: usize) -> usize {
    ((share * steps as f32) as usize).min(steps - 1)
}

/// The map's scale reaches at least so far, in newtons a taxel: noise must not look like a touch.
const LEAST_SCALE_N: f32 = 1.0;

/// Steps of a newton or a taxel that a curve tells apart.
const FINE: f32 = 1000.0;

/// From nothing to the greatest pressure, of the 256 colours of xterm: dark, violet, red, yellow.
const HEAT: [u8; 13] = [234, 53, 54, 90, 126, 161, 197, 203, 209, 215, 221, 227, 230];

/// The same for what is no longer true.
const GREY: [u8; 13] = [
    234, 235, 236, 238, 240, 241, 243, 244, 246, 247, 249, 251, 253,
];

/// The same without colours.
const CHARACTERS: &[u8; 10] = b" .:-=+*#%@";

const ASCII_BARS: bar::Set<'static> = bar::Set {
    full: "#",
    seven_eighths: "#",
    three_quarters: "+",
    five_eighths: "+",
    half: "=",
    three_eighths: "-",
    one_quarter: "-",
    one_eighth: ".",
    empty: " ",
};
