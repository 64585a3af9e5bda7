//! The abilities of a terminal, and the styles that follow from them.

use ratatui_core::style::{Color, Modifier, Style};

use super::view::Link;
use hardnessd_core::colour::viridis;

/// The abilities of the terminal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Look {
    /// Whether the terminal has 256 colours.
    pub(super) colours: bool,
    /// Whether the terminal has 24 bits of colour.
    pub(super) true_colours: bool,
    /// Whether the terminal has bold and reversed text.
    pub(super) attributes: bool,
    /// Whether the terminal shows more than ASCII.
    pub(super) unicode: bool,
}

impl Look {
    /// Derives the abilities from the values of `TERM`, `COLORTERM`, `NO_COLOR`
    /// (<https://no-color.org>), and the first of `LC_ALL`, `LC_CTYPE` and `LANG` that is set.
    pub(super) fn new(term: &str, color_term: &str, no_color: &str, locale: &str) -> Self {
        let is_plain = ["", "dumb", "unknown"].contains(&term);
        let is_old = term.starts_with("vt") || term.ends_with("-m") || term.ends_with("-mono");
        let locale = locale.to_ascii_lowercase();
        let colours = !is_plain && !is_old && no_color.is_empty();
        Self {
            colours,
            true_colours: colours && ["truecolor", "24bit"].contains(&color_term),
            attributes: !is_plain,
            unicode: !is_plain && !is_old && (locale.contains("utf-8") || locale.contains("utf8")),
        }
    }

    pub(super) fn style(self, colour: Style, without: Modifier) -> Style {
        match (self.colours, self.attributes) {
            (true, _) => colour,
            (false, true) => Style::new().add_modifier(without),
            (false, false) => Style::new(),
        }
    }

    /// The colour of a share of the greatest pressure.
    pub(super) fn heat(self, share: f32) -> Color {
        let [red, green, blue] = viridis(share);
        match self.true_colours {
            true => Color::Rgb(red, green, blue),
            false => indexed([red, green, blue]),
        }
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

    pub(super) fn separator(self) -> &'static str {
        if self.unicode { " · " } else { " | " }
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
