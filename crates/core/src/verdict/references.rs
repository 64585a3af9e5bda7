//! Presses on pieces whose properties are known, and what a model of format 3 takes of them.
//!
//! In: such presses, on the model's grid. Out: [`References`], which the model computes once and
//! takes beside each press of the same sensor. They show it what the sensor reads of what it knows.

use std::collections::BTreeSet;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::course::TimeSeries;
use crate::wording::name;

/// The most presses that a sensor may have as references.
pub const MOST_REFERENCES: usize = 64;
/// The numbers of the input `piece`.
pub const PIECE: usize = 7;

/// What is known of a pressed piece.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase", deny_unknown_fields)]
pub enum Piece {
    /// A rigid flat piece of this width in mm.
    Flat {
        /// The width.
        width_mm: f32,
    },
    /// A rigid ball of this radius in mm.
    Ball {
        /// The radius.
        radius_mm: f32,
    },
    /// An object whose Shore OO hardness lies in this range. A measured hardness is both ends.
    Shore {
        /// The least and the greatest Shore OO.
        range: [f32; 2],
    },
}

impl Piece {
    /// The input `piece`: whether it is flat, its width, whether it is a ball, its radius, whether
    /// its hardness is known, its least and its greatest hardness. What is not known is 0.
    pub fn numbers(piece: Option<Self>) -> [f32; PIECE] {
        match piece {
            None => [0.0; PIECE],
            Some(Self::Flat { width_mm }) => [1.0, width_mm, 0.0, 0.0, 0.0, 0.0, 0.0],
            Some(Self::Ball { radius_mm }) => [0.0, 0.0, 1.0, radius_mm, 0.0, 0.0, 0.0],
            Some(Self::Shore { range }) => [0.0, 0.0, 0.0, 0.0, 1.0, range[0], range[1]],
        }
    }

    /// The rigid piece that a text names: `flat:MM` or `ball:MM`, with 0.1 to 1000 mm.
    pub fn rigid(text: &str) -> Option<Self> {
        let (form, mm) = text.split_once(':')?;
        let mm: Option<f32> = mm.trim().parse().ok();
        match (form.trim(), mm.filter(|mm| (0.1..=1000.0).contains(mm))?) {
            ("flat", width_mm) => Some(Self::Flat { width_mm }),
            ("ball", radius_mm) => Some(Self::Ball { radius_mm }),
            _ => None,
        }
    }

    /// An object of which nothing is known.
    pub const UNKNOWN: Self = Self::Shore {
        range: [0.0, 100.0],
    };

    /// Whether nothing is known of the piece.
    pub fn is_unknown(self) -> bool {
        self == Self::UNKNOWN
    }

    /// What a press on the piece makes known of the sensor.
    fn knowledge(self) -> Knowledge {
        match self {
            Self::Flat { .. } | Self::Ball { .. } => Knowledge::Rigid,
            Self::UNKNOWN => Knowledge::Own,
            Self::Shore { .. } => Knowledge::Labelled,
        }
    }
}

/// A press on a known piece.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReferencePress {
    /// The press.
    #[serde(flatten)]
    pub course: TimeSeries,
    /// The piece.
    pub piece: Piece,
}

/// What a model knows of a sensor, as far as its promises depend on it. Of several references, the last one
/// in this order counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Knowledge {
    /// Nothing.
    None,
    /// Rigid pieces, and nothing else.
    Rigid,
    /// Its own presses, and no labelled objects.
    Own,
    /// Objects of known hardness.
    Labelled,
}

impl Knowledge {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::None, Self::Rigid, Self::Own, Self::Labelled];
}

/// A press on a known piece as one model takes it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Reference {
    pub(super) knowledge: Knowledge,
    /// The numbers that the model keeps of the press. In a recording they are base64 of little-endian f32.
    #[serde(serialize_with = "write_features", deserialize_with = "read_features")]
    pub(super) features: Vec<f32>,
}

fn write_features<S: Serializer>(features: &[f32], serializer: S) -> Result<S::Ok, S::Error> {
    let bytes: Vec<u8> = features.iter().flat_map(|x| x.to_le_bytes()).collect();
    serializer.serialize_str(&STANDARD.encode(bytes))
}

fn read_features<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<f32>, D::Error> {
    let bytes = STANDARD.decode(String::deserialize(deserializer)?);
    let bytes = bytes.map_err(|error| D::Error::custom(format_args!("features: {error}")))?;
    let (numbers, rest) = bytes.as_chunks::<4>();
    let features: Vec<f32> = numbers.iter().map(|&x| f32::from_le_bytes(x)).collect();
    if !rest.is_empty() || !features.iter().all(|x| x.is_finite()) {
        let found = "numbers that are not finite, or another number of bytes";
        return Err(D::Error::custom(format_args!("features: found {found}")));
    }
    Ok(features)
}

impl Reference {
    /// A press on `piece` of which a model keeps these numbers.
    pub(super) fn new(piece: Piece, features: Vec<f32>) -> Self {
        Self {
            knowledge: piece.knowledge(),
            features,
        }
    }
}

/// A sensor's references as one model takes them. [`super::Model::references`] computes them.
/// Recordings hold them, so that a replay needs no other file.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct References {
    /// Each press.
    pub(super) presses: Vec<Reference>,
    /// Whether there are some that are not used, because they made verdicts worse.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    ignored: bool,
}

impl References {
    /// The references that a model takes without any.
    pub const NONE: Self = Self {
        presses: Vec::new(),
        ignored: false,
    };

    /// References that are not used, because they made verdicts worse.
    pub const IGNORED: Self = Self {
        presses: Vec::new(),
        ignored: true,
    };

    /// These presses.
    pub(crate) fn of(presses: Vec<Reference>) -> Self {
        Self {
            presses,
            ignored: false,
        }
    }

    /// These references, and as many of the last of `more` as a model takes beside them.
    #[must_use]
    pub(crate) fn and(&self, more: &Self, most: usize) -> Self {
        let room = most.saturating_sub(self.presses.len());
        let first = more.presses.len().saturating_sub(room);
        Self {
            presses: [&self.presses, &more.presses[first..]].concat(),
            ignored: self.ignored,
        }
    }

    /// The references without the one at `place`.
    pub(super) fn without(&self, place: usize) -> Self {
        let mut others = self.clone();
        others.presses.remove(place);
        others
    }

    /// Whether there are some that are not used, because they made verdicts worse.
    pub fn are_ignored(&self) -> bool {
        self.ignored
    }

    /// Whether there are none, not even some that are not used.
    pub fn is_none(&self) -> bool {
        *self == Self::NONE
    }

    /// The knowledge whose promises a verdict keeps.
    pub(crate) fn knowledge(&self) -> Knowledge {
        let each = self.presses.iter().map(|press| press.knowledge);
        each.max().unwrap_or(Knowledge::None)
    }

    /// Which kinds there are, as `hardness` publishes them: `none`, or some of `own`, `rigid` and
    /// `labelled` in this order, joined by `+`.
    pub fn kinds(&self) -> String {
        let known: BTreeSet<Knowledge> = self.presses.iter().map(|press| press.knowledge).collect();
        let order = [Knowledge::Own, Knowledge::Rigid, Knowledge::Labelled];
        let kinds = order.iter().filter(|kind| known.contains(kind)).map(name);
        match known.is_empty() {
            true => name(&Knowledge::None),
            false => kinds.collect::<Vec<_>>().join("+"),
        }
    }
}
