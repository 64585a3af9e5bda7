//! The abilities of a terminal, and the styles that follow from them.

use ratatui_core::style::{Color, Modifier, Style};

use super::view::Link;
use hardnessd_core::colour::viridis;

/// The abilities of the terminal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Look {
    /// Whether the terminal has 256 colours.
    pub(super) colours: bool,
}

impl Look {
    /// Derives the abilities from the values of `TERM` and `NO_COLOR` (<https://no-color.org>).
    pub(super) fn new(term: &str, no_color: &str) -> Self {
        let is_plain = ["", "dumb", "unknown"].contains(&term);
        let is_old = term.starts_with("vt") || term.ends_with("-m") || term.ends_with("-mono");
        Self {
            colours: !is_plain && !is_old && no_color.is_empty(),
        }
    }

    pub(super) fn style(self, colour: Style, without: Modifier) -> Style {
        match self.colours {
            true => colour,
            false => Style::new().add_modifier(without),
        }
    }

    /// The colour of a share of the greatest pressure.
    pub(super) fn heat(share: f32) -> Color {
        indexed(viridis(share))
    }

    pub(super) fn heading(self) -> Style {
        self.style(Style::new().fg(Color::Indexed(75)), Modifier::BOLD)
    }

    pub(super) fn aside(self) -> Style {
        self.style(Style::new().fg(Color::Indexed(245)), Modifier::empty())
    }

    pub(super) fn strong(self) -> Style {
        self.style(Style::new().add_modifier(Modifier::BOLD), Modifier::BOLD)
    }

    /// The style of the word for a link. Other states must not look like live.
    pub(super) fn link(self, link: Link) -> Style {
        let (fg, bg) = match link {
            Link::Live => (16, 40),
            Link::Connecting => (16, 75),
            Link::NoZero | Link::Stale | Link::Silent => (16, 214),
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
