//! Words for people: errors on one line, and a check for text that is safe to show.

use std::error::Error;

/// Writes a line to stderr, like `eprintln!`, but goes on if nobody can read it: the disk is full, or the
/// terminal has gone. `eprintln!` panics then, and a panic ends the process.
#[macro_export]
macro_rules! say {
    ($($text:tt)*) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stderr(), $($text)*);
    }};
}

/// Like [`say!`], without the end of the line.
#[macro_export]
macro_rules! say_part {
    ($($text:tt)*) => {{
        use std::io::Write as _;
        let _ = write!(std::io::stderr(), $($text)*);
    }};
}

/// The text of an error on one line, with every cause that the text does not contain already.
pub fn line(error: &(dyn Error + 'static)) -> String {
    let mut line = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        let text = error.to_string();
        if !line.contains(&text) {
            line = format!("{line}: {text}");
        }
        cause = error.source();
    }
    escaped(&without_numbers(&line))
}

/// Removes the numbers of the system's errors, such as ` (os error 2)`: the system's words are
/// there already.
fn without_numbers(text: &str) -> String {
    let mut parts = text.split(" (os error ");
    let mut told = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        match part.split_once(')') {
            Some((number, rest)) if number.bytes().all(|digit| digit.is_ascii_digit()) => {
                told += rest;
            }
            _ => told = told + " (os error " + part,
        }
    }
    told
}

/// Escapes the hidden characters of each line. Without this, the name of a file could control the
/// terminal.
pub fn lines(text: &str) -> String {
    let lines: Vec<String> = text.split('\n').map(escaped).collect();
    lines.join("\n")
}

/// The error of a command line, as clap renders it, on one line.
pub fn of_usage(rendered: &str) -> String {
    let error = rendered.split("\n\nUsage:").next().unwrap_or_default();
    let error = error.split("\n\nFor more").next().unwrap_or_default();
    let words: Vec<&str> = error.split_whitespace().collect();
    let words = words.join(" ");
    escaped(words.trim_start_matches("error: "))
}

/// The error of a TOML text in plain words: the line, and what was found and expected.
pub fn of_toml(text: &str, error: &toml::de::Error) -> String {
    let before = &text[..error.span().map_or(0, |span| span.start).min(text.len())];
    let line = before.matches('\n').count() + 1;
    format!("line {line}: {}", plain(error.message()))
}

/// Whether `text` looks the same wherever it is shown. It then has no control characters, and no
/// characters that end a line or change the direction of the following text.
pub fn is_plain(text: &str) -> bool {
    !text.chars().any(is_hidden)
}

/// Whether a character is invisible, but changes how other characters look.
pub fn is_hidden(c: char) -> bool {
    // Unicode's Bidi_Control (PropList.txt), its line separator and its paragraph separator.
    let bidi = matches!(c, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    c.is_control() || bidi || matches!(c, '\u{2028}' | '\u{2029}')
}

/// Escapes hidden characters. Without this, the name of a file or a process could break the line or
/// control the terminal.
pub fn escaped(text: &str) -> String {
    let shown = |c: char| {
        let escaped = is_hidden(c).then(|| c.escape_default());
        let plain = escaped.is_none().then_some(c);
        escaped.into_iter().flatten().chain(plain)
    };
    text.chars().flat_map(shown).collect()
}

/// The text, or its beginning if it is long. A stranger's file must not fill the log with one line.
pub fn brief(text: &str) -> String {
    const MOST_CHARS: usize = 300;
    match text.char_indices().nth(MOST_CHARS) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text.to_owned(),
    }
}

/// The number as it was written, for example 0.1, and not the f64 that equals the f32.
pub fn as_written(value: f32) -> f64 {
    let text = format!("{value:?}");
    text.parse()
        .expect("a number's own text is a number's text")
}

/// The error of an option's value in plain words. The command line's parser words it for
/// programmers.
pub fn of_argument(message: &str) -> String {
    if message == "invalid digit found in string" {
        return "expected a whole number".to_owned();
    }
    // The caller's message already has the value before this text.
    if let Some((_, expected)) = message
        .strip_prefix("unknown variant ")
        .and_then(|rest| rest.split_once(", "))
    {
        return expected.to_owned();
    }
    let Some((_, range)) = message.split_once(" is not in ") else {
        return plain(message);
    };
    match range.split_once("..") {
        Some((least, most)) => match most.trim_start_matches('=').parse::<u64>() {
            Ok(u64::MAX) | Err(_) => format!("expected a whole number from {least}"),
            Ok(most) => format!("expected a whole number from {least} to {most}"),
        },
        None => message.to_owned(),
    }
}

/// `message` on one line, without Rust's names of types.
pub fn plain(message: &str) -> String {
    let message = message.trim().replace('\n', ": ");
    match message.as_str() {
        "duplicate key" => return "found it twice, expected it once".to_owned(),
        "invalid socket address syntax" => {
            return "found no address and port, expected such as 127.0.0.1:8255".to_owned();
        }
        "invalid IP address syntax" => {
            return "found no address, expected such as 192.0.2.7".to_owned();
        }
        // This comes from a name that has to be one of several.
        "wanted string or table" => {
            return "found a value that is no text, expected a name in quotes".to_owned();
        }
        _ => {}
    }
    // The author of a settings file knows an unknown field as a key, and an unknown variant as a
    // value.
    let message = message.replace("unknown field ", "unknown key ");
    let message = message.replace("unknown variant ", "found ");
    let Some((found, expected)) = message.rsplit_once(", expected ") else {
        return message;
    };
    let expected = match expected {
        "u8" => "a whole number from 0 to 255",
        "u16" => "a whole number from 0 to 65535",
        "u32" => "a whole number from 0 to 4294967295",
        "a nonzero u32" => "a whole number from 1 to 4294967295",
        "u64" | "usize" => "a whole number from 0",
        "i8" | "i16" | "i32" | "i64" | "isize" => "a whole number",
        "f32" | "f64" => "a number",
        "a boolean" => "true or false",
        "a sequence" => "a list",
        "an array of length 2" => "a list of two",
        "path string" => "a path",
        table if table.starts_with("struct ") => "a table",
        other => other,
    };
    let found = match found.split_once(": ") {
        Some(("invalid type" | "invalid value", "sequence")) => "found a list".to_owned(),
        Some(("invalid type" | "invalid value", "map")) => "found a table".to_owned(),
        Some(("invalid type" | "invalid value", value)) => format!("found {value}"),
        _ => found.replace("invalid length ", "found a list of "),
    };
    format!("{found}, expected {expected}")
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;

    #[derive(Debug, thiserror::Error)]
    enum Told {
        #[error("x: cannot read: {0}")]
        Whole(#[source] io::Error),
        #[error("x: cannot read")]
        Bare(#[source] io::Error),
        #[error("x: {0}, expected a new file")]
        Within(#[source] io::Error),
    }

    #[test]
    fn a_cause_is_told_once() {
        let cause = || io::Error::other("no such file");
        for told in [Told::Whole(cause()), Told::Bare(cause())] {
            assert_eq!(line(&told), "x: cannot read: no such file");
        }
        let told = Told::Within(cause());
        assert_eq!(line(&told), "x: no such file, expected a new file");
    }

    #[test]
    fn the_number_of_an_error_is_not_told() {
        let cause = |errno| io::Error::from_raw_os_error(errno);
        assert_eq!(
            line(&Told::Bare(cause(2))),
            "x: cannot read: No such file or directory"
        );
        let two = format!("{}, then {}", cause(2), cause(13));
        assert_eq!(
            without_numbers(&two),
            "No such file or directory, then Permission denied"
        );
        for other in ["a (os error x) b", "a (os error 2"] {
            assert_eq!(without_numbers(other), other);
        }
    }

    #[test]
    fn an_error_is_one_line_whatever_a_file_is_called() {
        let told = io::Error::other("a\nb\u{1b}[2J\t\u{e9}\u{202e}: cannot read");
        assert_eq!(
            line(&told),
            "a\\nb\\u{1b}[2J\\t\u{e9}\\u{202e}: cannot read"
        );
    }

    #[test]
    fn text_is_plain_unless_a_character_of_it_is_hidden() {
        for text in ["arm-7", "Arm Nº 7", "рука", "手", "ذراع", "é", ""] {
            assert!(is_plain(text), "{text:?}");
        }
        for hidden in [
            "\n",
            "\u{1b}[2J",
            "\u{7f}",
            "\u{85}",
            "\u{202e}",
            "\u{2066}",
            "\u{2028}",
        ] {
            assert!(!is_plain(&format!("arm{hidden}7")), "{hidden:?}");
        }
    }

    #[test]
    fn hidden_characters_are_escaped_and_long_texts_cut() {
        assert_eq!(escaped("a\u{202e}b\u{9b}é"), "a\\u{202e}b\\u{9b}é");
        assert_eq!(brief("short"), "short");
        assert_eq!(brief(&"é".repeat(400)), "é".repeat(300) + "...");
    }

    #[test]
    fn the_range_of_an_option_is_told_in_plain_words() {
        for (message, expected) in [
            (
                "0 is not in 1..18446744073709551615",
                "expected a whole number from 1",
            ),
            (
                "0 is not in 1..=4294967295",
                "expected a whole number from 1 to 4294967295",
            ),
            ("invalid digit found in string", "expected a whole number"),
            (
                "unknown variant `x`, expected one of `a`, `b`",
                "expected one of `a`, `b`",
            ),
            (
                "expected newtons from 1 to 2",
                "expected newtons from 1 to 2",
            ),
        ] {
            assert_eq!(of_argument(message), expected);
        }
    }

    #[test]
    fn types_are_told_in_plain_words() {
        for (message, expected) in [
            (
                "invalid value: integer `-1`, expected usize",
                "found integer `-1`, expected a whole number from 0",
            ),
            (
                "invalid type: string \"3\", expected f32\n",
                "found string \"3\", expected a number",
            ),
            (
                "invalid type: integer `3`, expected struct Table",
                "found integer `3`, expected a table",
            ),
            (
                "invalid value: integer `65536`, expected u16",
                "found integer `65536`, expected a whole number from 0 to 65535",
            ),
            (
                "invalid type: map, expected a sequence",
                "found a table, expected a list",
            ),
            (
                "invalid length 1, expected an array of length 2",
                "found a list of 1, expected a list of two",
            ),
            (
                "unknown field `bit`, expected one of `at_s`, `kind`",
                "unknown key `bit`, expected one of `at_s`, `kind`",
            ),
            (
                "unknown variant `x`, expected `u8` or `u16le`",
                "found `x`, expected `u8` or `u16le`",
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
