//! Tables of settings: a key, its default and its range stand in one place.
//!
//! In: the table, as [`settings!`](crate::settings) declares it. Out: a struct that reads and writes the
//! table in TOML, and the check of its values. An error names the key, the value, and what it may be.

use std::fmt::{Debug, Display};

use crate::frame::Pitch;
use crate::wording::cut;

/// A value that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{key}: {problem}")]
pub struct OutOfRange {
    /// The key of the value, after those of its tables, such as `sensor.frame.rows`.
    pub key: String,
    /// What was found, and what was expected; or the problem and its remedy.
    pub problem: Box<str>,
}

impl OutOfRange {
    /// The error of a value `found` that does not fit.
    pub fn new(key: &str, found: impl Debug, expected: impl Display) -> Self {
        let found = cut(&format!("{found:?}"));
        Self::because(key, format_args!("found {found}, expected {expected}"))
    }

    /// The error of a value with this problem.
    pub fn because(key: &str, problem: impl Display) -> Self {
        Self {
            key: key.to_owned(),
            problem: problem.to_string().into(),
        }
    }

    /// The error of a value in the table `table`.
    #[must_use]
    pub fn within(self, table: &str) -> Self {
        Self {
            key: format!("{table}.{}", self.key),
            ..self
        }
    }
}

/// Returns an error about `found`, unless it `fits`.
///
/// # Errors
///
/// Returns [`OutOfRange`] if `fits` is false.
pub fn check(
    key: &str,
    found: impl Debug,
    fits: bool,
    expected: impl Display,
) -> Result<(), OutOfRange> {
    match fits {
        true => Ok(()),
        false => Err(OutOfRange::new(key, found, expected)),
    }
}

/// The range of a number in a table of settings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Range {
    least: f64,
    most: f64,
    /// Whether `least` itself is no value.
    is_open: bool,
    unit: &'static str,
}

/// The numbers from `least` to `most`. `unit` follows them in messages.
pub const fn from_to((least, most): (f64, f64), unit: &'static str) -> Range {
    Range {
        least,
        most,
        is_open: false,
        unit,
    }
}

/// The finite numbers from `least` on.
pub const fn at_least(least: f64) -> Range {
    from_to((least, f64::MAX), "")
}

/// The numbers above 0 and up to `most`.
pub const fn above_0(most: f64) -> Range {
    Range {
        least: 0.0,
        most,
        is_open: true,
        unit: "",
    }
}

impl Range {
    /// Checks the value of a key.
    ///
    /// # Errors
    ///
    /// Returns [`OutOfRange`] if one of its numbers is outside the range.
    pub fn check<T: Ranged>(self, key: &str, value: &T) -> Result<(), OutOfRange> {
        let Self {
            least,
            most,
            is_open,
            unit,
        } = self;
        let fits = |text: &str| {
            let number: f64 = text.parse().unwrap_or(f64::NAN);
            number <= most && (number > least || !is_open && number == least)
        };
        let Some(found) = value.numbers().into_iter().find(|text| !fits(text)) else {
            return Ok(());
        };
        let expected = match is_open {
            true => format!("a number above {least} and at most {most}"),
            false if most == f64::MAX => format!("{least} or more"),
            false => format!("{least} to {most} {unit}"),
        };
        let expected = expected.trim_end();
        Err(OutOfRange::because(
            key,
            format_args!("found {found}, expected {expected}"),
        ))
    }
}

/// A value whose numbers have a range.
pub trait Ranged {
    /// The numbers of the value, as they are written. Without a value, there are none.
    fn numbers(&self) -> Vec<String>;
}

macro_rules! ranged {
    ($($kind:ty)*) => {
        $(impl Ranged for $kind {
            fn numbers(&self) -> Vec<String> {
                vec![format!("{self:?}")]
            }
        })*
    };
}

ranged!(f64 f32 u8 u16 u32 u64 usize);

impl Ranged for Pitch {
    fn numbers(&self) -> Vec<String> {
        [self.rows_mm, self.cols_mm]
            .map(|mm| format!("{mm:?}"))
            .into()
    }
}

impl<T: Ranged> Ranged for Option<T> {
    fn numbers(&self) -> Vec<String> {
        self.as_ref().map_or_else(Vec::new, T::numbers)
    }
}

/// Declares a table of settings. Each key has its default after `=`, and its [`Range`] after `in` if it
/// has one. A key without a default is `None` by default, and TOML does not show it then.
///
/// # Example
///
/// ```
/// use hardnessd_core::range::from_to;
/// use hardnessd_core::settings;
///
/// settings! {
///     /// The `[motor]` table.
///     pub struct Motor {
///         /// The speed.
///         pub speed_mm_s: f64 = 5.0, in from_to((0.1, 90.0), "mm/s");
///         /// The name.
///         pub name: Option<String>;
///     }
/// }
///
/// assert_eq!(Motor::default().speed_mm_s, 5.0);
/// let motor: Motor = toml::from_str("speed_mm_s = 0.0")?;
/// let error = motor.check_ranges().unwrap_err();
/// assert_eq!(error.to_string(), "speed_mm_s: found 0.0, expected 0.1 to 90 mm/s");
/// assert!(toml::from_str::<Motor>("speed = 1.0").is_err());
/// # Ok::<(), toml::de::Error>(())
/// ```
#[macro_export]
macro_rules! settings {
    (@default) => { None };
    (@default $default:expr) => { $default };
    (
        $(#[$about_table:meta])*
        pub struct $table:ident {
            $(
                $(#[$about:meta])*
                $vis:vis $key:ident: $kind:ty $(= $default:expr)? $(, in $range:expr)?;
            )*
        }
    ) => {
        $(#[$about_table])*
        #[derive(Debug, Clone, PartialEq, ::serde::Serialize, ::serde::Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct $table {
            $($(#[$about])* $vis $key: $kind,)*
        }

        impl Default for $table {
            fn default() -> Self {
                Self { $($key: $crate::settings!(@default $($default)?),)* }
            }
        }

        impl $table {
            /// Checks that each value is in its range.
            ///
            /// # Errors
            ///
            /// Returns an error for the first value that is not.
            pub fn check_ranges(&self) -> Result<(), $crate::range::OutOfRange> {
                $($($range.check(stringify!($key), &self.$key)?;)?)*
                Ok(())
            }
        }
    };
}
