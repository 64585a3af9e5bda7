//! Draws figures as SVG. Colours are classes of the page's style sheet, so that they follow its
//! dark and light modes. The SVG loads nothing.

use std::fmt::Write as _;

/// An SVG under construction. Lengths are in its own pixels.
#[derive(Debug)]
pub(super) struct Svg {
    /// The style class of the whole picture; may be empty.
    class: &'static str,
    width: f64,
    height: f64,
    body: String,
}

/// The anchor of a text.
#[derive(Debug, Clone, Copy)]
pub(super) enum Anchor {
    Start,
    Middle,
    End,
}

impl Svg {
    pub(super) fn new(width: f64, height: f64) -> Self {
        Self {
            class: "",
            width,
            height,
            body: String::new(),
        }
    }

    /// The same picture with a style class, which says how it fits on a narrow screen.
    pub(super) fn of_class(self, class: &'static str) -> Self {
        Self { class, ..self }
    }

    pub(super) fn line(&mut self, class: &str, from: (f64, f64), to: (f64, f64)) {
        let ((x1, y1), (x2, y2)) = (from, to);
        self.element(format_args!(
            r#"<line class="{class}" x1="{x1:.1}" y1="{y1:.1}" x2="{x2:.1}" y2="{y2:.1}"/>"#
        ));
    }

    pub(super) fn path(&mut self, class: &str, points: &[(f64, f64)]) {
        let mut list = String::new();
        for (x, y) in points {
            let _ = write!(list, "{x:.1},{y:.1} ");
        }
        let list = list.trim_end();
        self.element(format_args!(
            r#"<polyline class="{class}" points="{list}"/>"#
        ));
    }

    /// A dot that shows `tip` under the pointer.
    pub(super) fn dot(&mut self, class: &str, (x, y): (f64, f64), radius: f64, tip: &str) {
        let tip = escaped(tip);
        self.element(format_args!(
            r#"<circle class="{class}" cx="{x:.1}" cy="{y:.1}" r="{radius:.1}"><title>{tip}</title></circle>"#
        ));
    }

    /// A rectangle of this opacity.
    pub(super) fn rectangle(
        &mut self,
        class: &str,
        (x, y): (f64, f64),
        (width, height): (f64, f64),
        opacity: f64,
    ) {
        self.element(format_args!(
            r#"<rect class="{class}" x="{x:.1}" y="{y:.1}" width="{width:.1}" height="{height:.1}" fill-opacity="{opacity:.3}"/>"#
        ));
    }

    pub(super) fn text(&mut self, class: &str, (x, y): (f64, f64), anchor: Anchor, text: &str) {
        let anchor = match anchor {
            Anchor::Start => "start",
            Anchor::Middle => "middle",
            Anchor::End => "end",
        };
        let text = escaped(text);
        self.element(format_args!(
            r#"<text class="{class}" x="{x:.1}" y="{y:.1}" text-anchor="{anchor}">{text}</text>"#
        ));
    }

    fn element(&mut self, element: std::fmt::Arguments) {
        let _ = self.body.write_fmt(element);
        self.body.push('\n');
    }

    /// The complete element. `title` is its label for screen readers.
    pub(super) fn finish(self, title: &str) -> String {
        let Self {
            class,
            width,
            height,
            body,
        } = self;
        let title = escaped(title);
        let class = if class.is_empty() {
            String::new()
        } else {
            format!(r#" class="{class}""#)
        };
        format!(
            r#"<svg{class} viewBox="0 0 {width} {height}" width="{width}" height="{height}" role="img" aria-label="{title}">
{body}</svg>
"#
        )
    }
}

/// A scale from values to pixels.
#[derive(Debug, Clone, Copy)]
pub(super) struct Scale {
    values: (f64, f64),
    pixels: (f64, f64),
    logarithmic: bool,
}

impl Scale {
    pub(super) fn linear(values: (f64, f64), pixels: (f64, f64)) -> Self {
        Self {
            values,
            pixels,
            logarithmic: false,
        }
    }

    /// A logarithmic scale, for values above 0.
    pub(super) fn logarithmic(values: (f64, f64), pixels: (f64, f64)) -> Self {
        Self {
            values,
            pixels,
            logarithmic: true,
        }
    }

    pub(super) fn at(&self, value: f64) -> f64 {
        let place = |value: f64| if self.logarithmic { value.ln() } else { value };
        let (low, high) = (place(self.values.0), place(self.values.1));
        let part = if high > low {
            (place(value) - low) / (high - low)
        } else {
            0.5
        };
        self.pixels.0 + part * (self.pixels.1 - self.pixels.0)
    }

    /// Round values within the scale, about `count` of them.
    pub(super) fn ticks(&self, count: usize) -> Vec<f64> {
        if count == 0 {
            return Vec::new();
        }
        let (low, high) = self.values;
        if self.logarithmic {
            let decades = low.log10().ceil() as i32..=high.log10().floor() as i32;
            return decades.map(|decade| 10_f64.powi(decade)).collect();
        }
        let rough = (high - low) / count as f64;
        if rough <= 0.0 || !rough.is_finite() {
            return vec![low];
        }
        let decade = 10_f64.powf(rough.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0]
            .map(|factor| factor * decade)
            .into_iter()
            .find(|step| *step >= 0.999 * rough)
            .unwrap_or(10.0 * decade);
        let first = (low / step - 1e-9).ceil() as i64;
        let last = (high / step + 1e-9).floor() as i64;
        (first..=last).map(|k| k as f64 * step).collect()
    }
}

/// The label of a tick.
pub(super) fn label(value: f64) -> String {
    if value == 0.0 {
        return "0".to_owned();
    }
    let size = value.abs();
    if size >= 1e6 {
        format!("{}M", value / 1e6)
    } else if size >= 1e3 {
        format!("{}k", value / 1e3)
    } else {
        // Round to 6 decimals, which removes the noise of binary fractions.
        format!("{}", (value * 1e6).round() / 1e6)
    }
}

/// Draws two axes, each with its name and about `ticks` ticks, and a grid.
pub(super) fn axes(
    svg: &mut Svg,
    (x, x_name): (&Scale, &str),
    (y, y_name): (&Scale, &str),
    ticks: (usize, usize),
) {
    let ((left, right), (bottom, top)) = (x.pixels, y.pixels);
    for value in y.ticks(ticks.1) {
        let at = y.at(value);
        svg.line("grid", (left, at), (right, at));
        svg.text("tick", (left - 5.0, at + 3.5), Anchor::End, &label(value));
    }
    for value in x.ticks(ticks.0) {
        let at = x.at(value);
        svg.line("grid", (at, bottom), (at, top));
        svg.text("tick", (at, bottom + 14.0), Anchor::Middle, &label(value));
    }
    svg.line("axis", (left, bottom), (right, bottom));
    svg.line("axis", (left, bottom), (left, top));
    let middle = 0.5 * (left + right);
    svg.text("tick", (middle, bottom + 28.0), Anchor::Middle, x_name);
    svg.text("tick", (left, top - 9.0), Anchor::Start, y_name);
}

/// Escapes text for elements and attributes of HTML and SVG.
pub(super) fn escaped(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for letter in text.chars() {
        match letter {
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            '&' => safe.push_str("&amp;"),
            '"' => safe.push_str("&quot;"),
            other => safe.push(other),
        }
    }
    safe
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        let scale = |low, high| Scale::linear((low, high), (0.0, 100.0));
        assert_eq!(
            scale(0.0, 100.0).ticks(5),
            [0.0, 20.0, 40.0, 60.0, 80.0, 100.0]
        );
        assert_eq!(scale(0.32, 0.97).ticks(3), [0.5]);
        assert_eq!(scale(3.0, 3.0).ticks(3), [3.0]);
        let decades = Scale::logarithmic((30.0, 2e5), (0.0, 1.0)).ticks(3);
        assert_eq!(decades, [100.0, 1e3, 1e4, 1e5]);
        assert_eq!([0.3, 42_500.0, 2e6].map(label), ["0.3", "42.5k", "2M"]);
    }

    #[test]
    fn a_scale_puts_ends_on_ends() {
        let scale = Scale::logarithmic((10.0, 1000.0), (200.0, 0.0));
        for (value, pixel) in [(10.0, 200.0), (100.0, 100.0), (1000.0, 0.0)] {
            assert!(
                (scale.at(value) - pixel).abs() < 1e-9,
                "{value}: {}",
                scale.at(value)
            );
        }
        assert_eq!(Scale::linear((1.0, 1.0), (0.0, 10.0)).at(1.0), 5.0);
    }

    #[test]
    fn text_cannot_become_markup() {
        let mut svg = Svg::new(10.0, 10.0);
        svg.text("name", (0.0, 0.0), Anchor::Start, "<script>\"&");
        let text = svg.finish("a \"b\"");
        assert!(text.contains("&lt;script&gt;&quot;&amp;"), "{text}");
        assert!(text.contains("a &quot;b&quot;"), "{text}");
    }
}
