//! The last 30 s of a number, as bars.

use ratatui_core::layout::Rect;
use ratatui_core::style::{Color, Modifier, Style};

use super::super::view::{Frame, Link, Load, Sensor, WINDOW};
use super::{Page, Rows};

impl Page<'_> {
    pub(super) fn force(&mut self, area: Rect, sensor: &Sensor, link: Link) {
        // A small negative sum is noise.
        let present = |load: &Frame| format!("{:.2} N", load.force_n.unwrap_or(0.0).max(0.0));
        self.curve(area, "force", sensor, link, present, |load| load.force_n);
    }

    pub(super) fn contact(&mut self, area: Rect, sensor: &Sensor, link: Link) {
        let present = |load: &Frame| format!("{} taxels", load.contact_area_taxels);
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
        present: impl Fn(&Frame) -> String,
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
        for (x, value) in (area.x..area.right()).zip(curve) {
            self.bar(x, rows.0, value.map(|value| value / most));
        }
    }

    /// Draws one column of `area`, filled up to `share` of its height. `None` if the value is
    /// unknown.
    fn bar(&mut self, x: u16, area: Rect, share: Option<f32>) {
        let blue = Style::new().fg(Color::Indexed(75));
        // If nothing was ever pressed, the share is NaN, and the cast makes it 0.
        let eighths = share.map(|share| (share * 8.0 * f32::from(area.height)) as usize);
        for (below, y) in (area.top()..area.bottom()).rev().enumerate() {
            let (symbol, style) = match eighths {
                Some(eighths) => (
                    BLOCKS[eighths.saturating_sub(8 * below).min(8)],
                    self.look.style(blue, Modifier::empty()),
                ),
                None => ("\u{b7}", self.look.aside()),
            };
            self.buffer[(x, y)].set_symbol(symbol).set_style(style);
        }
    }
}

/// The symbols of a cell that is filled by 0 to 8 eighths.
const BLOCKS: [&str; 9] = [
    " ", "\u{2581}", "\u{2582}", "\u{2583}", "\u{2584}", "\u{2585}", "\u{2586}", "\u{2587}",
    "\u{2588}",
];
