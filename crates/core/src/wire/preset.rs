//! The presets, and the keys of `[sensor.frame]` that are in force.

use std::sync::LazyLock;

use toml::Table;

use super::settings::{Cell, Preset, Settings};
use crate::range::OutOfRange;

/// The table of each preset.
static PRESETS: LazyLock<Table> = LazyLock::new(|| {
    let presets = include_str!("presets.toml").parse();
    presets.expect("the tests read the presets")
});

/// The keys that frames of text have.
const KEYS_OF_TEXT: [&str; 10] = [
    "preset",
    "heading",
    "mask",
    "invert",
    "rows",
    "cols",
    "order",
    "request",
    "request_ms",
    "start",
];

impl Preset {
    /// Whether frames are text.
    pub(super) fn is_text(self) -> bool {
        self == Self::Csv
    }

    /// The keys that the preset sets.
    pub fn keys(self) -> &'static Table {
        let table = &PRESETS[&self.to_string()];
        table.as_table().expect("each preset is a table")
    }
}

impl Settings {
    /// The preset: the one that is written, else `none` if the table marks frames of its own, else that
    /// of the JX255N.
    pub fn preset(&self) -> Preset {
        let is_own = self.sync.is_some() || self.tail.is_some() || self.framing.is_some();
        let unwritten = if is_own { Preset::None } else { Preset::Jx255n };
        self.preset.unwrap_or(unwritten)
    }

    /// The keys that are in force: those of the preset, except where the table has others.
    ///
    /// # Errors
    ///
    /// Returns an error if the table has a key that frames of the preset do not have.
    pub fn in_force(&self) -> Result<Self, OutOfRange> {
        let preset = self.preset();
        let written = Table::try_from(self).expect("the keys are plain values");
        let is_of_other = |key: &&String| match preset.is_text() {
            true => !KEYS_OF_TEXT.contains(&key.as_str()),
            false => *key == "heading",
        };
        if let Some(key) = written.keys().find(is_of_other) {
            let problem = format_args!(
                "found a value, expected none: frames of preset {preset} have no such part"
            );
            return Err(OutOfRange::because(key, problem));
        }
        let mut keys = Preset::None.keys().clone();
        if preset.is_text() {
            keys.retain(|key, _| KEYS_OF_TEXT.contains(&key));
        }
        keys.extend(preset.keys().clone());
        keys.extend(written);
        let keys: Self = keys.try_into().expect("each key is one of a table");
        Ok(Self {
            preset: Some(preset),
            stride_bytes: keys.stride_bytes.or(keys.cell.map(Cell::bytes)),
            mask: keys.mask.or(keys.cell.and_then(Cell::bits)),
            ..keys
        })
    }
}
