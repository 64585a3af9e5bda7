//! Frames, text and a colour scale as pixels of a PNG.

use ab_glyph::{Font as _, FontRef, ScaleFont as _, point};
use anyhow::Context as _;
use epaint_default_fonts::UBUNTU_LIGHT;

use hardnessd_core::colour::viridis;
use hardnessd_core::frame::{COLS, Frame, ROWS};

/// Pixels per taxel along each axis.
const ZOOM: usize = 4;
/// Rows and columns of a drawn frame, in pixels.
pub(super) const TILE: usize = COLS * ZOOM;
/// Pixels between frames.
pub(super) const GAP: usize = 8;
/// Height of a line of text.
pub(super) const TEXT: usize = 16;
/// Height of the letters.
const FONT_PIXELS: f32 = 14.0;
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
        let font = FontRef::try_from_slice(UBUNTU_LIGHT).expect("the crate's font is a font");
        let scaled = font.as_scaled(FONT_PIXELS);
        let baseline = y as f32 + scaled.ascent();
        let mut at = x as f32;
        for letter in text.chars() {
            let id = font.glyph_id(letter);
            let glyph = id.with_scale_and_position(FONT_PIXELS, point(at, baseline));
            at += scaled.h_advance(id);
            let Some(outline) = font.outline_glyph(glyph) else {
                continue;
            };
            let bounds = outline.px_bounds();
            outline.draw(|right, down, coverage| {
                let (x, y) = (bounds.min.x as usize, bounds.min.y as usize);
                self.blend(x + right as usize, y + down as usize, coverage);
            });
        }
    }

    /// Blends ink into a pixel; `coverage` is the share of the pixel that the ink covers.
    fn blend(&mut self, x: usize, y: usize, coverage: f32) {
        if x >= self.width || y >= self.height {
            return;
        }
        let at = 3 * (y * self.width + x);
        for (pixel, ink) in self.pixels[at..at + 3].iter_mut().zip(INK) {
            let under = f32::from(*pixel);
            *pixel = (under + coverage.min(1.0) * (f32::from(ink) - under)).round() as u8;
        }
    }

    pub(super) fn tile(&mut self, tile: usize, top: usize, frame: &Frame, caption: &str) {
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
