//! The pressure map: in colours, in greys if it is no longer current, or in characters.

use ratatui_core::layout::Rect;
use ratatui_core::style::Color;

use super::super::look::Look;
use super::super::view::{Link, Sensor};
use super::Page;

/// The size of a pressure map on the terminal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct MapSize {
    pub(super) cols: u16,
    /// 0 if no map fits.
    pub(super) rows: u16,
    /// Columns of a taxel.
    scale: usize,
    /// Taxels of a column, if the terminal is too small to show each.
    taxels: usize,
}

impl Page<'_> {
    /// The largest pressure map that fits. A taxel takes half as many rows as columns, because a
    /// cell is twice as high as it is wide.
    pub(super) fn map_size(&self, sensor: &Sensor, width: u16, height: u16) -> MapSize {
        let (width, height) = (usize::from(width), 2 * usize::from(height));
        let scale = (width / sensor.cols).min(height / sensor.rows);
        let each = |taxels: usize, places: usize| taxels.div_ceil(places.max(1));
        let taxels = each(sensor.cols, width).max(each(sensor.rows, height));
        if (2..=MOST_SHARED).contains(&taxels) {
            return MapSize {
                cols: sensor.cols.div_ceil(taxels) as u16,
                rows: sensor.rows.div_ceil(2 * taxels) as u16,
                scale: 1,
                taxels,
            };
        }
        MapSize {
            cols: (scale * sensor.cols) as u16,
            rows: (scale * sensor.rows).div_ceil(2) as u16,
            scale,
            taxels: 1,
        }
    }

    pub(super) fn map(&mut self, area: Rect, size: MapSize, sensor: &Sensor, link: Link) {
        let top = sensor.highest_n().max(LEAST_SCALE_N);
        let rest = self.text(area, "pressure ", self.look.heading());
        self.text(rest, &format!("0 to {top:.2} N a taxel"), self.look.aside());
        let area = Rect {
            y: area.y + 1,
            width: size.cols.min(area.width),
            height: size.rows.min(area.height - 1),
            ..area
        };
        let MapSize { scale, taxels, .. } = size;
        // The greatest of the taxels that share a place, so that no touch vanishes. The square root
        // keeps a soft touch visible beside a hard one.
        let shade = |row: usize, col: usize| {
            let rows = row * taxels..(row + 1) * taxels;
            let places = rows.flat_map(|row| (0..taxels).map(move |n| (row, col * taxels + n)));
            let newtons = places.filter_map(|(row, col)| sensor.newtons(row, col));
            newtons
                .reduce(f32::max)
                .map(|n| (n / top).clamp(0.0, 1.0).sqrt())
        };
        for y in 0..area.height {
            for x in 0..area.width {
                let (x_of, y_of) = (usize::from(x), usize::from(y));
                let half = |half: usize| shade((2 * y_of + half) / scale, x_of / scale);
                let (upper, lower) = (half(0), half(1));
                let cell = &mut self.buffer[(area.x + x, area.y + y)];
                if self.look.colours {
                    let colour = |share: Option<f32>| match share {
                        Some(share) if link == Link::Live => Look::heat(share),
                        Some(share) => Color::Indexed(GREY[step(share, GREY.len())]),
                        None => Color::Indexed(GREY[0]),
                    };
                    cell.set_char('\u{2580}').set_fg(colour(upper));
                    cell.set_bg(colour(lower));
                } else {
                    let share = upper.into_iter().chain(lower).reduce(f32::max);
                    let step = share.map_or(0, |share| step(share, CHARACTERS.len()));
                    cell.set_char(char::from(CHARACTERS[step]));
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
}

/// The index of the step that a share of 0 to 1 falls into, of `steps` equal ones.
fn step(share: f32, steps: usize) -> usize {
    ((share * steps as f32) as usize).min(steps - 1)
}

/// The most taxels along each side that share a place of the map. With more, the map shows no form.
const MOST_SHARED: usize = 3;

/// The least full scale of the map, in newtons a taxel: noise must not look like a touch.
const LEAST_SCALE_N: f32 = 1.0;

/// Greys from no pressure to the greatest, for a map that is no longer current.
const GREY: [u8; 13] = [
    234, 235, 236, 238, 240, 241, 243, 244, 246, 247, 249, 251, 253,
];

/// Characters from no pressure to the greatest, for a terminal without colours.
const CHARACTERS: &[u8; 10] = b" .:-=+*#%@";
