//! Words for people: errors on one line, and a check for text that is safe to show.

use std::error::Error;

use serde::Serialize;
use serde::de::{DeserializeOwned, IntoDeserializer as _, value};

/// Writes a line to stderr, like `eprintln!`, but goes on if nobody can read it: the disk is full, or the
/// terminal has gone. `eprintln!` panics then, and a panic ends the process. What is hidden is escaped, and
/// a text without end is cut: it may come from a file or a process of somebody else.
#[macro_export]
macro_rules! stderr_line {
    ($($text:tt)*) => {{
        use std::io::Write as _;
        let text = $crate::wording::shown(&format!($($text)*));
        let _ = writeln!(std::io::stderr(), "{text}");
    }};
}

/// The longest text that is shown at once, in characters.
const LONGEST_SHOWN: usize = 16_384;

/// The text as a terminal may show it: hidden characters escaped, and not longer than a person reads.
pub fn shown(text: &str) -> String {
    match text.char_indices().nth(LONGEST_SHOWN) {
        Some((end, _)) => lines(&text[..end]) + "...",
        None => lines(text),
    }
}

/// The name under which a kind, state, phase or note is published. The log, the metrics and
/// recordings use it too. [`named`] reads it.
pub fn name(state: &impl Serialize) -> String {
    match serde_json::to_value(state) {
        Ok(serde_json::Value::String(name)) => name,
        other => unreachable!("a state without data is published as its name, not {other:?}"),
    }
}

/// The value of this name, as commands, files and events write it.
///
/// # Errors
///
/// Returns an error that lists the names if there is no such one.
pub fn named<T: DeserializeOwned>(name: &str) -> Result<T, value::Error> {
    T::deserialize(name.into_deserializer())
}

/// The parser of a number in this range, as commands have it.
pub fn within(least: f64, most: f64) -> impl Fn(&str) -> Result<f64, String> + Clone + Send + Sync {
    move |text| {
        let number = text.parse::<f64>().ok();
        let number = number.filter(|number| (least..=most).contains(number));
        number.ok_or_else(|| format!("expected a number from {least} to {most}"))
    }
}

/// Parses a number above 0 that is so near to 1 that a clock can count seconds made of it.
pub fn positive(text: &str) -> Result<f64, String> {
    within(1e-6, 1e9)(text)
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
    let mut kept = text.to_owned();
    while let Some((before, after)) = kept.split_once(" (os error ")
        && let Some((number, rest)) = after.split_once(')')
        && number.bytes().all(|digit| digit.is_ascii_digit())
    {
        kept = format!("{before}{rest}");
    }
    kept
}

/// Escapes the hidden characters of each line. Without this, the name of a file could control the
/// terminal.
pub fn lines(text: &str) -> String {
    let lines: Vec<String> = text.split('\n').map(escaped).collect();
    lines.join("\n")
}

/// The same JSON without hidden characters, for a terminal. They are inside strings only.
///
/// # Example
///
/// ```
/// use hardnessd_core::wording::json_escaped;
///
/// let safe = json_escaped("{\"label\":\"a\u{202e}b\u{9b}é\"}");
/// assert_eq!(safe, r#"{"label":"a\u202eb\u009bé"}"#);
/// ```
pub fn json_escaped(json: &str) -> String {
    let mut escaped = String::with_capacity(json.len());
    for c in json.chars() {
        if is_hidden(c) {
            escaped += &format!("\\u{:04x}", u32::from(c));
        } else {
            escaped.push(c);
        }
    }
    escaped
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
    let message = cut_found(&in_words(&message));
    let Some(span) = error.span() else {
        return message;
    };
    let before = &text[..span.start.min(text.len())];
    let line_start = before.rfind('\n').map_or(0, |newline| newline + 1);
    let line = before.matches('\n').count() + 1;
    let column = before[line_start..].chars().count() + 1;
    let found = text[line_start..].lines().next().unwrap_or_default().trim();
    let found = cut(found);
    format!("line {line}, column {column}, `{found}`: {message}")
}

/// The parser's message in words: the name of a type becomes what it holds, and the list of all names
/// becomes the most similar one, if one is similar.
fn in_words(message: &str) -> String {
    const TYPES: [(&str, &str); 13] = [
        ("u8", "a whole number from 0 to 255"),
        ("u16", "a whole number from 0 to 65535"),
        ("u32", "a whole number from 0 to 4294967295"),
        ("u64", "a whole number from 0 on"),
        ("usize", "a whole number from 0 on"),
        ("a nonzero u32", "a whole number from 1 on"),
        ("a nonzero usize", "a whole number from 1 on"),
        ("f32", "a number"),
        ("f64", "a number"),
        ("a string", "a text in quotes"),
        ("a boolean", "true or false"),
        ("a sequence", "a list in brackets"),
        ("socket address", "ADDRESS:PORT in quotes"),
    ];
    if message == "invalid socket address syntax" {
        return "expected ADDRESS:PORT, such as \"127.0.0.1:8256\"".to_owned();
    }
    let Some((found, expected)) = message.split_once(", expected ") else {
        return message.to_owned();
    };
    if let Some((_, words)) = TYPES.iter().find(|(name, _)| *name == expected) {
        return format!("{found}, expected {words}");
    }
    if expected.starts_with("struct ") {
        return format!("{found}, expected a table");
    }
    let names = |text: &str| -> Vec<String> {
        let names = text.split('`').skip(1).step_by(2);
        names.map(str::to_owned).collect()
    };
    let Some(unknown) = names(found).pop() else {
        return message.to_owned();
    };
    let likeness = |name: &String| match is_misspelt(&unknown, name) {
        true => 1.0,
        false => strsim::jaro_winkler(&unknown, name),
    };
    let mut known = names(expected);
    known.sort_by(|a, b| likeness(b).total_cmp(&likeness(a)));
    let is_as_near = |other: &String| likeness(&known[0]) - likeness(other) < AS_SIMILAR;
    match known.first() {
        Some(name) if likeness(name) >= SIMILAR && !known[1..].iter().any(is_as_near) => {
            format!("{found}: did you mean `{name}`?")
        }
        _ => message.to_owned(),
    }
}

/// Whether a name is one typing error away from another: a letter, or two that are swapped.
pub fn is_misspelt(name: &str, other: &str) -> bool {
    strsim::osa_distance(name, other) == 1
}

/// Names with at least this Jaro-Winkler similarity count as similar.
const SIMILAR: f64 = 0.75;
/// Names whose similarities differ by less are as similar as each other.
const AS_SIMILAR: f64 = 0.04;

/// The most characters of its input that an error repeats, at its beginning and at its end.
const LONGEST_END: usize = 100;
/// The most bytes of what a parser expected.
const LONGEST_EXPECTED: usize = 1000;

/// A text without its middle, if it is longer than an error repeats.
pub fn cut(text: &str) -> String {
    let begin = text.char_indices().nth(LONGEST_END);
    let end = text.char_indices().nth_back(LONGEST_END - 1);
    match (begin, end) {
        (Some((begin, _)), Some((end, _))) if begin < end => {
            format!("{}...{}", &text[..begin], &text[end..])
        }
        _ => text.to_owned(),
    }
}

/// A parser's message with what it found cut, and what it expected whole, because that is a list of ours.
pub fn cut_found(message: &str) -> String {
    match message.rsplit_once(", expected ") {
        Some((found, expected)) if expected.len() <= LONGEST_EXPECTED => {
            format!("{}, expected {expected}", cut(found))
        }
        _ => cut(message),
    }
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
    }

    #[test]
    fn what_is_shown_says_nothing_to_the_terminal_and_has_an_end() {
        let shown = shown("one\u{1b}[2J\u{2028}\u{202e}\ntwo");
        assert_eq!(shown, "one\\u{1b}[2J\\u{2028}\\u{202e}\ntwo");
        assert_eq!(super::shown(&shown), shown, "escaped once");
        let endless = "é".repeat(1 << 20);
        assert_eq!(super::shown(&endless).chars().count(), LONGEST_SHOWN + 3);
    }

    #[test]
    fn an_error_is_one_line_with_each_cause_once_and_without_its_number() {
        let missing = || io::Error::from_raw_os_error(2);
        for error in [Wrapped::Whole(missing()), Wrapped::Bare(missing())] {
            let expected = "x: cannot read: No such file or directory";
            assert_eq!(line(&error), expected);
        }
        let two = io::Error::other(format!("{}, then {}", missing(), missing()));
        let expected = "No such file or directory, then No such file or directory";
        assert_eq!(line(&two), expected);
        for strange in ["a (os error x) b", "a (os error 2"] {
            assert_eq!(line(&io::Error::other(strange)), strange);
        }
        // Whatever a file is called.
        let error = io::Error::other("a\nb\u{1b}[2J\t\u{e9}\u{202e}: cannot read");
        let expected = "a\\nb\\u{1b}[2J\\t\u{e9}\\u{202e}: cannot read";
        assert_eq!(line(&error), expected);
    }

    #[test]
    fn text_is_plain_unless_a_character_of_it_is_hidden() {
        for text in ["arm-7", "Arm Nº 7", "рука", "手", "ذراع", "é", ""] {
            assert!(is_plain(text), "{text:?}");
        }
        for hidden in [
            "\n",
            "\u{1b}[2J",
            "\u{85}",
            "\u{202e}",
            "\u{2066}",
            "\u{2028}",
        ] {
            assert!(!is_plain(&format!("arm{hidden}7")), "{hidden:?}");
        }
    }

    #[test]
    fn an_error_in_toml_names_its_place_and_shows_the_line() {
        let of = |text: &str| of_toml(text, &toml::from_str::<toml::Table>(text).unwrap_err());
        let error = of("a = 1\n  b = [2\n");
        assert!(error.starts_with("line 2, column "), "{error}");
        assert!(error.contains(", `b = [2`: "), "{error}");
        assert!(!of("é = 1\na b\n").contains('\n'));
        for text in [format!("a = [{}", "1, ".repeat(5000)), "b ".repeat(5000)] {
            let long = of(&text);
            assert!(long.chars().count() < 500, "{long}");
        }
        let names = "`name`, ".repeat(60);
        let found = cut_found(&format!(
            "unknown field `{}`, expected {names}",
            "x".repeat(999)
        ));
        assert!(
            found.ends_with(&names) && found.len() < names.len() + 250,
            "{found}"
        );
    }
}
