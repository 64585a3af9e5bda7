//! The cells of a picture as escape sequences, which wait until somebody takes them.
//!
//! A cell without a style costs no escape sequence but the one that places it, so a picture without
//! styles suits a terminal that knows no more than that (ECMA-48: CUP, ED, SGR).

use std::convert::Infallible;
use std::fmt::Write;

use ratatui_core::backend::{Backend, ClearType, WindowSize};
use ratatui_core::buffer::Cell;
use ratatui_core::layout::{Position, Size};
use ratatui_core::style::{Color, Modifier};

/// Takes over the terminal: alternate screen, no cursor. A terminal that knows neither passes over
/// both.
pub(super) const ENTER: &str = "\x1b[?1049h\x1b[?25l\x1b[2J";
/// Gives it back.
pub(super) const LEAVE: &str = "\x1b[0m\x1b[2J\x1b[H\x1b[?25h\x1b[?1049l";

/// What is to be written.
#[derive(Debug, Default)]
pub(super) struct Ansi {
    written: String,
    size: Size,
}

impl Ansi {
    pub(super) fn new(size: Size) -> Self {
        let written = String::new();
        Self { written, size }
    }

    /// The terminal has this size now.
    pub(super) fn resize(&mut self, size: Size) {
        self.size = size;
    }

    /// What has been drawn since it was last taken.
    pub(super) fn take(&mut self) -> String {
        std::mem::take(&mut self.written)
    }

    fn write(&mut self, arguments: std::fmt::Arguments) {
        self.written
            .write_fmt(arguments)
            .expect("writing to a string cannot fail");
    }

    fn style(&mut self, cell: &Cell) {
        self.write(format_args!("\x1b[0"));
        if cell.modifier.contains(Modifier::BOLD) {
            self.write(format_args!(";1"));
        }
        if cell.modifier.contains(Modifier::REVERSED) {
            self.write(format_args!(";7"));
        }
        for (plane, colour) in [(38, cell.fg), (48, cell.bg)] {
            if let Color::Indexed(index) = colour {
                self.write(format_args!(";{plane};5;{index}"));
            }
        }
        self.write(format_args!("m"));
    }
}

impl Backend for Ansi {
    type Error = Infallible;

    fn draw<'a, I>(&mut self, content: I) -> Result<(), Infallible>
    where
        I: Iterator<Item = (u16, u16, &'a Cell)>,
    {
        let blank = Cell::default();
        let mut before = &blank;
        let mut next = None;
        for (x, y, cell) in content {
            if next != Some((x, y)) {
                self.write(format_args!("\x1b[{};{}H", y + 1, x + 1));
            }
            if (cell.fg, cell.bg, cell.modifier) != (before.fg, before.bg, before.modifier) {
                self.style(cell);
            }
            before = cell;
            self.written += cell.symbol();
            next = Some((x + 1, y));
        }
        if (before.fg, before.bg, before.modifier) != (blank.fg, blank.bg, blank.modifier) {
            self.style(&blank);
        }
        Ok(())
    }

    fn hide_cursor(&mut self) -> Result<(), Infallible> {
        Ok(())
    }

    fn show_cursor(&mut self) -> Result<(), Infallible> {
        Ok(())
    }

    fn get_cursor_position(&mut self) -> Result<Position, Infallible> {
        Ok(Position::ORIGIN)
    }

    fn set_cursor_position<P: Into<Position>>(&mut self, _: P) -> Result<(), Infallible> {
        Ok(())
    }

    fn clear(&mut self) -> Result<(), Infallible> {
        self.write(format_args!("\x1b[2J"));
        Ok(())
    }

    fn clear_region(&mut self, _: ClearType) -> Result<(), Infallible> {
        self.clear()
    }

    fn size(&self) -> Result<Size, Infallible> {
        Ok(self.size)
    }

    fn window_size(&mut self) -> Result<WindowSize, Infallible> {
        Ok(WindowSize {
            columns_rows: self.size,
            pixels: Size::ZERO,
        })
    }

    fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}
