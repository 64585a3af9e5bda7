//! The arm's positions beside raw bytes: a CSV file with the columns `time_s` and `approach_mm`.

use std::path::Path;

use crate::tools::exit::{FAILED, Failure};
use crate::tools::read_text;
use hardnessd_core::motion::{FURTHEST_MM, Point};

/// The most bytes of a file: more than a day of positions, 100 a second.
const MOST_BYTES: u64 = 256 << 20;
/// The greatest time in a file: 30 years, longer than any recording.
const LONGEST_S: f64 = 1e9;

/// Reads all positions of a file of the command line, in its order.
pub(in crate::tools) fn load(path: &Path) -> Result<Vec<Point>, Failure> {
    let points = parse(&read_text(path, MOST_BYTES)?);
    points.map_err(|why| Failure::new(FAILED, format!("--motion {}:{why}", path.display())))
}

/// Reads positions from the text of a file.
///
/// # Errors
///
/// Fails if the first line does not name the columns, or another line has no number in one of them. The
/// error begins with the number of the line.
pub fn parse(text: &str) -> Result<Vec<Point>, String> {
    let shown = |text: &str| text.chars().take(60).collect::<String>();
    let mut lines = (1..).zip(text.lines());
    let (_, names) = lines.next().unwrap_or((1, ""));
    // A spreadsheet may have written a byte order mark.
    let names = names.trim_start_matches('\u{feff}');
    let place = |name: &str| names.split(',').position(|found| found.trim() == name);
    let (Some(time), Some(approach)) = (place("time_s"), place("approach_mm")) else {
        return Err(format!(
            "1: found {:?}, expected the names of the columns, time_s and approach_mm among them",
            shown(names)
        ));
    };
    let mut points: Vec<Point> = Vec::new();
    for (line, text) in lines.filter(|(_, text)| !text.trim().is_empty()) {
        let cells: Vec<&str> = text.split(',').map(str::trim).collect();
        let number = |key, column: usize, most: f64, expected| {
            let found = cells.get(column).copied().unwrap_or_default();
            let number = found.parse().ok().filter(|n: &f64| n.abs() <= most);
            let found = shown(found);
            number.ok_or_else(|| format!("{line}: {key}: found {found:?}, expected {expected}"))
        };
        let time_s = number("time_s", time, LONGEST_S, "seconds")?;
        let mm = number("approach_mm", approach, FURTHEST_MM, "millimetres")?;
        let at_ns = (time_s * 1e9).round() as i64;
        if points.last().is_some_and(|last| last.at_ns > at_ns) {
            return Err(format!(
                "{line}: time_s: found {time_s}, expected no less than on the line before"
            ));
        }
        points.push(Point { at_ns, mm });
    }
    Ok(points)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_found_by_their_names() {
        let text = "\u{feff}press, approach_mm ,time_s\r\n1,-2.5,-1\r\n\n1,1e1,0.25\n";
        let points = parse(text).unwrap();
        let points: Vec<(i64, f64)> = points.into_iter().map(Into::into).collect();
        assert_eq!(points, [(-1_000_000_000, -2.5), (250_000_000, 10.0)]);
    }

    #[test]
    fn what_is_no_position_is_named_with_its_line() {
        let check = |text: &str, expected: &str| {
            let error = parse(text).unwrap_err();
            assert!(error.starts_with(expected), "{error}");
        };
        check("", "1: found \"\", expected the names of the columns");
        let names = "time_s,approach_mm\n1,2\n";
        check(
            &format!("{names}2"),
            "3: approach_mm: found \"\", expected millimetres",
        );
        check(&format!("{names}\n1,nan"), "4: approach_mm: found \"nan\"");
        check(&format!("{names}inf,1"), "3: time_s: found \"inf\"");
        check(
            &format!("{names}0,2"),
            "3: time_s: found 0, expected no less",
        );
    }
}
