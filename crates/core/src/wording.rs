//! Words for people: errors on one line, and a check for text that is safe to show.

use std::error::Error;

use serde::de::{DeserializeOwned, IntoDeserializer as _, value};

/// Writes a line to stderr, like `eprintln!`, but goes on if nobody can read it: the disk is full, or the
/// terminal has gone. `eprintln!` panics then, and a panic ends the process.
#[macro_export]
macro_rules! stderr_line {
    ($($text:tt)*) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stderr(), $($text)*);
    }};
}

/// Like [`stderr_line!`], without the end of the line.
#[macro_export]
macro_rules! stderr_part {
    ($($text:tt)*) => {{
        use std::io::Write as _;
        let _ = write!(std::io::stderr(), $($text)*);
    }};
}

/// The value of this name, as commands, files and events write it.
///
/// # Errors
///
/// Returns an error that lists the names if there is no such one.
pub fn named<T: DeserializeOwned>(name: &str) -> Result<T, value::Error> {
    T::deserialize(name.into_deserializer())
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
    let mut kept = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        match part.split_once(')') {
            Some((number, rest)) if number.bytes().all(|digit| digit.is_ascii_digit()) => {
                kept += rest;
            }
            _ => kept = kept + " (os error " + part,
        }
    }
    kept
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
    let on_one_line = |part: &str| part.split_whitespace().collect::<Vec<_>>().join(" ");
    // A tip is a part of its own.
    let parts: Vec<String> = error.split("\n\n").map(on_one_line).collect();
    escaped(parts.join("; ").trim_start_matches("error: "))
}

/// The error of a TOML text on one line: its place, the text's line there, and the parser's message.
pub fn of_toml(text: &str, error: &toml::de::Error) -> String {
    let message = error.message().trim().replace('\n', ", ");
    let Some(span) = error.span() else {
        return message;
    };
    let before = &text[..span.start.min(text.len())];
    let line_start = before.rfind('\n').map_or(0, |newline| newline + 1);
    let line = before.matches('\n').count() + 1;
    let column = before[line_start..].chars().count() + 1;
    let found = text[line_start..].lines().next().unwrap_or_default().trim();
    format!("line {line}, column {column}, `{found}`: {message}")
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

/// The number as it was written, for example 0.1, and not the f64 that equals the f32.
pub fn as_written(value: f32) -> f64 {
    let text = format!("{value:?}");
    text.parse()
        .expect("a number's own text is a number's text")
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;

    #[derive(Debug, thiserror::Error)]
    enum Wrapped {
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
        for error in [Wrapped::Whole(cause()), Wrapped::Bare(cause())] {
            assert_eq!(line(&error), "x: cannot read: no such file");
        }
        let error = Wrapped::Within(cause());
        assert_eq!(line(&error), "x: no such file, expected a new file");
    }

    #[test]
    fn the_number_of_an_error_is_not_told() {
        let cause = |errno| io::Error::from_raw_os_error(errno);
        assert_eq!(
            line(&Wrapped::Bare(cause(2))),
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
    fn the_error_of_a_command_line_is_one_line_with_its_tip() {
        let rendered = "error: unrecognized subcommand 'replya'\n\n  tip: a similar subcommand exists: \
                        'replay'\n\nUsage: hardnessd <COMMAND>\n\nFor more information, try '--help'.\n";
        assert_eq!(
            of_usage(rendered),
            "unrecognized subcommand 'replya'; tip: a similar subcommand exists: 'replay'"
        );
        let missing =
            "error: the following required arguments were not provided:\n  <FILE>\n\nUsage: x";
        assert_eq!(
            of_usage(missing),
            "the following required arguments were not provided: <FILE>"
        );
    }

    #[test]
    fn an_error_is_one_line_whatever_a_file_is_called() {
        let error = io::Error::other("a\nb\u{1b}[2J\t\u{e9}\u{202e}: cannot read");
        assert_eq!(
            line(&error),
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
    fn hidden_characters_are_escaped() {
        assert_eq!(escaped("a\u{202e}b\u{9b}é"), "a\\u{202e}b\\u{9b}é");
    }

    #[test]
    fn an_error_in_toml_names_its_place_and_shows_the_line() {
        let of = |text: &str| of_toml(text, &toml::from_str::<toml::Table>(text).unwrap_err());
        let error = of("a = 1\n  b = [2\n");
        assert!(error.starts_with("line 2, column "), "{error}");
        assert!(error.contains(", `b = [2`: "), "{error}");
        assert!(!of("é = 1\na b\n").contains('\n'));
    }
}
