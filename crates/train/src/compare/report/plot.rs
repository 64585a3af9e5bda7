//! Draws charts of lines and dots as SVG, all of one size. Colours are classes of the page's style
//! sheet, so that they follow its dark and light modes. The SVG loads nothing.

use std::fmt::Write as _;

/// Width and height of a chart, and the edges of its axes, in pixels.
const SIZE: (f64, f64) = (260.0, 181.0);
const LEFT: f64 = 48.0;
const RIGHT: f64 = 244.0;
const BOTTOM: f64 = 146.0;
const TOP: f64 = 40.0;

/// An axis: its name, and the values at its ends.
#[derive(Debug, Clone, Copy)]
pub(super) struct Axis<'a> {
    name: &'a str,
    low: f64,
    high: f64,
    is_logarithmic: bool,
}

impl<'a> Axis<'a> {
    pub(super) fn linear(name: &'a str, low: f64, high: f64) -> Self {
        Self {
            name,
            low,
            high,
            is_logarithmic: false,
        }
    }

    /// A logarithmic axis, for values above 0.
    pub(super) fn logarithmic(name: &'a str, low: f64, high: f64) -> Self {
        Self {
            is_logarithmic: true,
            ..Self::linear(name, low, high)
        }
    }

    /// The place of a value between two pixels.
    fn at(&self, value: f64, (first, last): (f64, f64)) -> f64 {
        let place = |value: f64| match self.is_logarithmic {
            true => value.ln(),
            false => value,
        };
        let (low, high) = (place(self.low), place(self.high));
        let part = if high > low {
            (place(value) - low) / (high - low)
        } else {
            0.5
        };
        first + part * (last - first)
    }

    /// Three to eight round values within the axis, or its decades.
    fn ticks(&self) -> Vec<f64> {
        if self.is_logarithmic {
            let decades = self.low.log10().ceil() as i32..=self.high.log10().floor() as i32;
            return decades.map(|decade| 10_f64.powi(decade)).collect();
        }
        let rough = (self.high - self.low) / 4.0;
        if rough <= 0.0 || !rough.is_finite() {
            return vec![self.low];
        }
        let decade = 10_f64.powf(rough.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0]
            .map(|factor| factor * decade)
            .into_iter()
            .find(|step| *step >= 0.999 * rough)
            .unwrap_or(10.0 * decade);
        let first = (self.low / step - 1e-9).ceil() as i64;
        let last = (self.high / step + 1e-9).floor() as i64;
        (first..=last).map(|k| k as f64 * step).collect()
    }
}

/// The label of a tick.
fn label(value: f64) -> String {
    match value.abs() {
        0.0 => "0".to_owned(),
        1e6.. => format!("{}M", value / 1e6),
        1e3.. => format!("{}k", value / 1e3),
        // Round to 6 decimals, which removes the noise of binary fractions.
        _ => format!("{}", (value * 1e6).round() / 1e6),
    }
}

/// A chart under construction.
#[derive(Debug)]
pub(super) struct Chart<'a> {
    title: &'a str,
    x: Axis<'a>,
    y: Axis<'a>,
    body: String,
}

impl<'a> Chart<'a> {
    pub(super) fn new(title: &'a str, x: Axis<'a>, y: Axis<'a>) -> Self {
        let mut chart = Self {
            title,
            x,
            y,
            body: String::new(),
        };
        chart.text("name", (0.0, 12.0), "start", title);
        for value in y.ticks() {
            let at = chart.place((x.low, value)).1;
            chart.path("grid", &[(LEFT, at), (RIGHT, at)]);
            chart.text("tick", (LEFT - 5.0, at + 3.5), "end", &label(value));
        }
        for value in x.ticks() {
            let at = chart.place((value, y.low)).0;
            chart.path("grid", &[(at, BOTTOM), (at, TOP)]);
            chart.text("tick", (at, BOTTOM + 14.0), "middle", &label(value));
        }
        chart.path("axis", &[(LEFT, TOP), (LEFT, BOTTOM), (RIGHT, BOTTOM)]);
        let middle = 0.5 * (LEFT + RIGHT);
        chart.text("tick", (middle, BOTTOM + 28.0), "middle", x.name);
        chart.text("tick", (LEFT, TOP - 9.0), "start", y.name);
        chart
    }

    /// Adds a line through `points`, thinned to a few hundred, because no more can be distinguished.
    pub(super) fn line(mut self, class: &str, points: &[(f64, f64)]) -> Self {
        let every = points.len().div_ceil(300).max(1);
        let last = points.last().filter(|_| points.len() % every != 1);
        let thinned = points.iter().step_by(every).chain(last);
        let places: Vec<_> = thinned.map(|&point| self.place(point)).collect();
        self.path(class, &places);
        self
    }

    /// Adds a dot that shows `tip` under the pointer.
    pub(super) fn dot(mut self, point: (f64, f64), radius: f64, tip: &str) -> Self {
        let (x, y) = self.place(point);
        let tip = escaped(tip);
        let _ = writeln!(
            self.body,
            r#"<circle class="mark" cx="{x:.1}" cy="{y:.1}" r="{radius:.1}"><title>{tip}</title></circle>"#
        );
        self
    }

    fn place(&self, (x, y): (f64, f64)) -> (f64, f64) {
        (self.x.at(x, (LEFT, RIGHT)), self.y.at(y, (BOTTOM, TOP)))
    }

    fn path(&mut self, class: &str, places: &[(f64, f64)]) {
        let places: Vec<String> = places
            .iter()
            .map(|(x, y)| format!("{x:.1},{y:.1}"))
            .collect();
        let list = places.join(" ");
        let _ = writeln!(self.body, r#"<polyline class="{class}" points="{list}"/>"#);
    }

    fn text(&mut self, class: &str, (x, y): (f64, f64), anchor: &str, text: &str) {
        let text = escaped(text);
        let _ = writeln!(
            self.body,
            r#"<text class="{class}" x="{x:.1}" y="{y:.1}" text-anchor="{anchor}">{text}</text>"#
        );
    }

    /// The complete element. The title is its label for screen readers, too.
    pub(super) fn svg(self) -> String {
        let (width, height) = SIZE;
        let (title, body) = (escaped(self.title), self.body);
        format!(
            "<svg viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" role=\"img\" \
             aria-label=\"{title}\">\n{body}</svg>\n"
        )
    }
}

/// Escapes text for elements and attributes of HTML and SVG.
pub(super) fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        let ticks = |low, high| Axis::linear("", low, high).ticks();
        assert_eq!(ticks(0.0, 100.0), [0.0, 50.0, 100.0]);
        assert_eq!(ticks(0.32, 0.97), [0.4, 0.6000000000000001, 0.8]);
        assert_eq!(ticks(3.0, 3.0), [3.0]);
        let decades = Axis::logarithmic("", 30.0, 2e5).ticks();
        assert_eq!(decades, [100.0, 1e3, 1e4, 1e5]);
        assert_eq!([0.3, 42_500.0, 2e6].map(label), ["0.3", "42.5k", "2M"]);
    }

    #[test]
    fn an_axis_puts_ends_on_ends() {
        let axis = Axis::logarithmic("", 10.0, 1000.0);
        for (value, pixel) in [(10.0, 200.0), (100.0, 100.0), (1000.0, 0.0)] {
            let found = axis.at(value, (200.0, 0.0));
            assert!((found - pixel).abs() < 1e-9, "{value}: {found}");
        }
        assert_eq!(Axis::linear("", 1.0, 1.0).at(1.0, (0.0, 10.0)), 5.0);
    }

    #[test]
    fn text_cannot_become_markup() {
        let axis = Axis::linear("<script>\"&", 0.0, 1.0);
        let text = Chart::new("a \"b\"", axis, axis).svg();
        assert!(text.contains("&lt;script&gt;&quot;&amp;"), "{text}");
        assert!(text.contains("a &quot;b&quot;"), "{text}");
    }
}
