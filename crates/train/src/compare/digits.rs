//! Formats numbers for people.

/// Formats a number with `decimals` decimals, or none for an integer.
pub(super) fn number(value: f64, decimals: usize) -> String {
    rounded(value, if value.fract() == 0.0 { 0 } else { decimals })
}

/// Formats a number with `decimals` decimals. A number that rounds to zero has no sign.
pub fn rounded(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    match text.strip_prefix('-') {
        Some(zero) if zero.bytes().all(|byte| matches!(byte, b'0' | b'.')) => zero.to_owned(),
        _ => text,
    }
}

/// Formats an integer with commas between thousands.
pub fn thousands(value: u64) -> String {
    let digits = value.to_string();
    let mut text = String::new();
    for (place, digit) in digits.chars().enumerate() {
        if place > 0 && (digits.len() - place).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_readable() {
        assert_eq!(thousands(93_000), "93,000");
        assert_eq!(thousands(7), "7");
        assert_eq!(
            (number(12.0, 1), number(12.25, 1)),
            ("12".to_owned(), "12.2".to_owned())
        );
        for (value, expected) in [(-4e-5, "0.0000"), (-6e-5, "-0.0001"), (4e-5, "0.0000")] {
            assert_eq!(rounded(value, 4), expected);
        }
        assert_eq!(number(-0.0, 1), "0");
    }
}
