//! What a parser says of a settings file, in words for whoever wrote the file.

/// Why `text` is not the TOML it should be: the line and what was found and expected.
pub fn of_toml(text: &str, error: &toml::de::Error) -> String {
    let before = &text[..error.span().map_or(0, |span| span.start).min(text.len())];
    let line = before.matches('\n').count() + 1;
    format!("line {line}: {}", plain(error.message()))
}

/// `message` on one line, and without the names that Rust has for types.
pub fn plain(message: &str) -> String {
    let message = message.trim().replace('\n', ": ");
    let mut parts = message.split(EXPECTED);
    let first = parts.next().unwrap_or_default().to_owned();
    parts.fold(first, |text, part| {
        let (word, rest) = word_of(part);
        let (words, rest) = match word {
            "u8" | "u16" | "u32" | "u64" | "usize" => ("a whole number from 0", rest),
            "i8" | "i16" | "i32" | "i64" | "isize" => ("a whole number", rest),
            "f32" | "f64" => ("a number", rest),
            "struct" => ("a table", word_of(rest.trim_start()).1),
            word => (word, rest),
        };
        text + EXPECTED + words + rest
    })
}

/// What stands before a type.
const EXPECTED: &str = "expected ";

fn word_of(text: &str) -> (&str, &str) {
    let end = text.find(|c: char| !c.is_ascii_alphanumeric() && c != '_');
    text.split_at(end.unwrap_or(text.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn types_are_told_in_plain_words() {
        for (message, expected) in [
            (
                "invalid value: integer `-1`, expected usize",
                "invalid value: integer `-1`, expected a whole number from 0",
            ),
            (
                "invalid type: string \"3\", expected f32\n",
                "invalid type: string \"3\", expected a number",
            ),
            (
                "invalid type: integer `3`, expected struct Table",
                "invalid type: integer `3`, expected a table",
            ),
            (
                "unknown field `bit`, expected one of `at_s`, `kind`",
                "unknown field `bit`, expected one of `at_s`, `kind`",
            ),
            (
                "expected newline\nfound `u8`",
                "expected newline: found `u8`",
            ),
        ] {
            assert_eq!(plain(message), expected);
        }
    }
}
