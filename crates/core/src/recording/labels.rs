//! Labels: notes on what was pressed in a recording.

use std::collections::BTreeMap;

use crate::verdict::{Piece, sha256_hex};
use crate::wording;

/// Notes of the user by key, for example on the pressed object.
pub type Labels = BTreeMap<String, String>;

/// The longest label: a label is a note, not a document.
const MOST_CHARS: usize = 1000;

/// Checks a label before it is written. `hrn-train collect` must be able to read the value under
/// its key. Only the model can say whether a `level` is one of its levels.
///
/// # Errors
///
/// Returns what is wrong, in words, if the key is empty, a character is hidden, the label is too long, or
/// the value of `object`, `shore` or `reference` is not what its reader takes.
///
/// # Example
///
/// ```
/// use hardnessd_core::recording::check_label;
///
/// assert!(check_label("object", "7").is_ok());
/// assert!(check_label("material", "oak").is_ok());
/// let error = check_label("object", "99999999999").unwrap_err();
/// assert!(error.ends_with("expected a whole number from 0 to 4294967295"));
/// ```
pub fn check_label(key: &str, value: &str) -> Result<(), String> {
    if key.is_empty() {
        return Err("the label has no key: write KEY=VALUE".to_owned());
    }
    let found = key.chars().count() + value.chars().count();
    if found > MOST_CHARS {
        return Err(format!(
            "found {found} characters, expected at most {MOST_CHARS}"
        ));
    }
    if let Some(text) = [key, value]
        .into_iter()
        .find(|text| !wording::is_plain(text))
    {
        let expected = "text without control or bidirectional characters";
        return Err(format!("found {text:?}, expected {expected}"));
    }
    let (fits, expected) = match key {
        "object" => (
            value.parse::<u32>().is_ok(),
            "a whole number from 0 to 4294967295",
        ),
        "shore" => {
            let shore = value.parse();
            let fits = shore.is_ok_and(|shore: f32| (0.0..=100.0).contains(&shore));
            (fits, "a number from 0 to 100")
        }
        "reference" => (
            Piece::rigid(value).is_some(),
            "flat:MM or ball:MM with 0.1 to 1000 mm",
        ),
        _ => return Ok(()),
    };
    match fits {
        true => Ok(()),
        false => Err(format!("{key}: found {value:?}, expected {expected}")),
    }
}

/// The numbers below this are left to people, who count up from 0.
const NAMED: u32 = 1 << 31;

/// The number of an object that only has a name, for the label `object`: the same in every recording, whatever its
/// letters' case and the spaces are.
pub fn object_of(name: &str) -> u32 {
    let words: Vec<&str> = name.split_whitespace().collect();
    let hash = sha256_hex(words.join(" ").to_lowercase().as_bytes());
    let number = u32::from_str_radix(&hash[..8], 16).expect("a hash is hexadecimal");
    number | NAMED
}

/// The keys of labels that mean something to `hrn-train` and `identify`.
const KEYS: [&str; 6] = ["level", "object", "shore", "material", "reference", "name"];

/// The known key that a key is one typing error away from.
pub fn misspelt(key: &str) -> Option<&'static str> {
    let is_near = |known: &&str| strsim::osa_distance(key, known) == 1;
    KEYS.into_iter().find(is_near)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_with_one_typing_error_is_known_again() {
        for (key, known) in [
            ("levl", Some("level")),
            ("lvele", None),
            ("Shore", Some("shore")),
            ("level", None),
            ("note", None),
        ] {
            assert_eq!(misspelt(key), known, "{key}");
        }
    }

    #[test]
    fn an_object_has_one_number_however_its_name_is_typed() {
        assert_eq!(object_of("Yoga  mat "), object_of("yoga mat"));
        assert_ne!(object_of("yoga mat"), object_of("yoga mats"));
    }

    #[test]
    fn a_label_that_its_reader_could_not_use_is_refused() {
        for (key, value) in [
            ("object", "4294967295"),
            ("shore", "35.5"),
            ("material", ""),
        ] {
            assert_eq!(check_label(key, value), Ok(()), "{key}={value}");
        }
        let long = "x".repeat(1001);
        for (key, value, expected) in [
            ("", "7", "the label has no key: write KEY=VALUE"),
            ("object", "-1", "object: found \"-1\", expected a whole"),
            (
                "reference",
                "flat",
                "reference: found \"flat\", expected flat:MM",
            ),
            ("shore", "NaN", "shore: found \"NaN\", expected a number"),
            ("note", "\u{202e}7", "found \"\\u{202e}7\", expected text"),
            ("a\nb", "7", "found \"a\\nb\", expected text"),
            ("note", &long, "found 1005 characters, expected at most"),
        ] {
            let error = check_label(key, value).unwrap_err();
            assert!(error.starts_with(expected), "{error}");
        }
    }
}
