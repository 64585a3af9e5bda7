//! Frames, text and a colour scale as pixels of a PNG.

use std::convert::Infallible;

use anyhow::Context as _;
use embedded_graphics::Drawable as _;
use embedded_graphics::Pixel;
use embedded_graphics::draw_target::DrawTarget;
use embedded_graphics::geometry::{OriginDimensions, Point, Size};
use embedded_graphics::mono_font::MonoTextStyle;
use embedded_graphics::mono_font::ascii::FONT_7X14;
use embedded_graphics::pixelcolor::{Rgb888, RgbColor as _};
use embedded_graphics::text::{Baseline, Text};
use hardnessd_core::colour::viridis;
use hardnessd_core::verdict::{COLS, ModelFrame, ROWS};

/// Pixels per taxel along each axis.
const ZOOM: usize = 4;
/// Rows and columns of a drawn frame, in pixels.
pub(super) const TILE: usize = COLS * ZOOM;
/// Pixels between frames.
pub(super) const GAP: usize = 8;
/// Height of a line of text.
pub(super) const TEXT: usize = 16;
/// Width of the names to the left.
pub(super) const MARGIN: usize = 112;
/// Ends of the colour scale, N: one count, and an 8-bit taxel's full scale.
const SCALE_N: (f32, f32) = (0.04, 10.2);
const BACKGROUND: [u8; 3] = [250, 250, 250];
const INK: [u8; 3] = [30, 30, 30];

/// Pixels, `[height, width, 3]`.
pub(super) struct Canvas {
    width: usize,
    height: usize,
    pixels: Vec<u8>,
}

impl Canvas {
    pub(super) fn new(width: usize, height: usize) -> Self {
        Self {
            width,
            height,
            pixels: BACKGROUND.repeat(width * height),
        }
    }

    fn fill(&mut self, x: usize, y: usize, width: usize, height: usize, colour: [u8; 3]) {
        for y in y..y + height {
            let at = 3 * (y * self.width + x);
            self.pixels[at..at + 3 * width].copy_from_slice(&colour.repeat(width));
        }
    }

    /// Writes a line of text whose box begins at (x, y) and is [`TEXT`] high.
    pub(super) fn text(&mut self, x: usize, y: usize, text: &str) {
        let ink = Rgb888::new(INK[0], INK[1], INK[2]);
        let style = MonoTextStyle::new(&FONT_7X14, ink);
        let place = Point::new(x as i32, y as i32);
        let Ok(_) = Text::with_baseline(text, place, style, Baseline::Top).draw(self);
    }

    pub(super) fn tile(&mut self, tile: usize, top: usize, frame: &ModelFrame, caption: &str) {
        let left = MARGIN + tile * (TILE + GAP);
        for (k, &newtons) in frame.newtons.iter().enumerate() {
            let (x, y) = (left + k % COLS * ZOOM, top + k / COLS * ZOOM);
            self.fill(x, y, ZOOM, ZOOM, colour_of(newtons));
        }
        self.text(left, top + ROWS * ZOOM + 1, caption);
    }

    pub(super) fn colour_bar(&mut self, top: usize) {
        let (left, length) = (MARGIN, 6 * (TILE + GAP));
        let (low, high) = SCALE_N;
        let place = |newtons: f32| (newtons / low).ln() / (high / low).ln() * length as f32;
        for x in 0..length {
            let newtons = low * (high / low).powf(x as f32 / length as f32);
            self.fill(left + x, top, 1, 16, colour_of(newtons));
        }
        for newtons in [0.04, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0] {
            let x = left + place(newtons) as usize;
            self.fill(x, top + 16, 1, 4, INK);
            self.text(x.saturating_sub(8), top + 21, &format!("{newtons} N"));
        }
        self.text(
            left + length + 2 * GAP,
            top,
            "force on a taxel (0 N: darkest)",
        );
    }

    pub(super) fn png(&self) -> anyhow::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let mut writer = encoder.write_header().context("sheet: PNG header")?;
        writer
            .write_image_data(&self.pixels)
            .context("sheet: PNG pixels")?;
        writer.finish().context("sheet: PNG end")?;
        Ok(bytes)
    }
}

impl OriginDimensions for Canvas {
    fn size(&self) -> Size {
        Size::new(self.width as u32, self.height as u32)
    }
}

impl DrawTarget for Canvas {
    type Color = Rgb888;
    type Error = Infallible;

    /// Sets pixels. Those outside the picture are left out.
    fn draw_iter<I: IntoIterator<Item = Pixel<Rgb888>>>(
        &mut self,
        pixels: I,
    ) -> Result<(), Infallible> {
        for Pixel(Point { x, y }, colour) in pixels {
            let (Ok(x), Ok(y)) = (usize::try_from(x), usize::try_from(y)) else {
                continue;
            };
            if x < self.width && y < self.height {
                self.fill(x, y, 1, 1, [colour.r(), colour.g(), colour.b()]);
            }
        }
        Ok(())
    }
}

/// The colour of a taxel: viridis over the logarithm of the force.
fn colour_of(newtons: f32) -> [u8; 3] {
    let (low, high) = SCALE_N;
    let part = ((newtons.max(low) / low).ln() / (high / low).ln()).min(1.0);
    viridis(part)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_rise_with_the_force() {
        let green = |newtons| colour_of(newtons)[1];
        assert!(green(0.0) < green(0.1) && green(0.1) < green(1.0) && green(1.0) < green(10.0));
        assert_eq!(colour_of(0.0), viridis(0.0));
        assert_eq!(colour_of(99.0), viridis(1.0));
    }

    #[test]
    fn letters_are_drawn_and_end_at_the_edge() {
        let mut canvas = Canvas::new(40, TEXT);
        canvas.text(0, 0, "force, N: a line that is longer than the picture");
        let dark = canvas.pixels.iter().filter(|pixel| **pixel < 128).count();
        assert!((60..1500).contains(&dark), "{dark}");
    }
}
