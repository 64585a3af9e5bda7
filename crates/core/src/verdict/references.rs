//! Presses on pieces whose properties are known, and what a model of format 3 takes of them.
//!
//! In: such presses, on the model's grid. Out: [`References`], which the model computes once and
//! takes beside each press of the same sensor. They show it what the sensor reads of what it knows.

use std::fmt;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::course::TimeSeries;

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

    /// An object of which nothing is known.
    pub const UNKNOWN: Self = Self::Shore {
        range: [0.0, 100.0],
    };

    /// Whether nothing is known of the piece.
    pub fn is_unknown(self) -> bool {
        self == Self::UNKNOWN
    }

    /// Whether the piece is rigid.
    pub fn is_rigid(self) -> bool {
        !matches!(self, Self::Shore { .. })
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

/// The kinds of the references that a verdict was made with. As text it is `none`, or the kinds in the
/// order of the fields, joined by `+`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReferenceKinds {
    /// Presses of objects of which nothing is known.
    pub own: bool,
    /// Presses on rigid pieces.
    pub rigid: bool,
    /// Presses on objects of known hardness.
    pub labelled: bool,
}

impl ReferenceKinds {
    /// No references, or a model that takes none.
    pub const NONE: Self = Self {
        own: false,
        rigid: false,
        labelled: false,
    };

    fn of(presses: &[ReferencePress]) -> Self {
        let has = |is: fn(Piece) -> bool| presses.iter().any(|press| is(press.piece));
        Self {
            own: has(Piece::is_unknown),
            rigid: has(Piece::is_rigid),
            labelled: has(|piece| !piece.is_rigid() && !piece.is_unknown()),
        }
    }

    fn and(self, other: Self) -> Self {
        Self {
            own: self.own || other.own,
            rigid: self.rigid || other.rigid,
            labelled: self.labelled || other.labelled,
        }
    }

    /// The kind whose promises a verdict keeps.
    pub fn knowledge(self) -> Knowledge {
        match self {
            Self { labelled: true, .. } => Knowledge::Labelled,
            Self { own: true, .. } => Knowledge::Own,
            Self { rigid: true, .. } => Knowledge::Rigid,
            Self::NONE => Knowledge::None,
        }
    }
}

impl fmt::Display for ReferenceKinds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let kinds = [
            (self.own, "own"),
            (self.rigid, "rigid"),
            (self.labelled, "labelled"),
        ];
        let words: Vec<&str> = kinds
            .iter()
            .filter(|kind| kind.0)
            .map(|kind| kind.1)
            .collect();
        f.write_str(if words.is_empty() { "none" } else { "" })?;
        f.write_str(&words.join("+"))
    }
}

/// What a model knows of a sensor, as far as its promises depend on it.
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

/// A sensor's references as one model takes them. [`super::Hrn::references`] computes them.
/// Recordings hold them, so that a replay needs no other file.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct References {
    kinds: ReferenceKinds,
    /// The number of presses.
    pub(super) count: usize,
    /// The features of each press, one after the other. In a recording they are base64 of
    /// little-endian f32.
    #[serde(serialize_with = "write_features", deserialize_with = "read_features")]
    pub(super) features: Vec<f32>,
    /// Whether there are some that are not used, because they made verdicts worse.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    ignored: bool,
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

impl References {
    /// The references that a model takes without any.
    pub const NONE: Self = Self {
        kinds: ReferenceKinds::NONE,
        count: 0,
        features: Vec::new(),
        ignored: false,
    };

    /// References that are not used, because they made verdicts worse.
    pub const IGNORED: Self = Self {
        kinds: ReferenceKinds::NONE,
        count: 0,
        features: Vec::new(),
        ignored: true,
    };

    pub(super) fn new(presses: &[ReferencePress], features: Vec<f32>) -> Self {
        Self {
            kinds: ReferenceKinds::of(presses),
            count: presses.len(),
            features,
            ignored: false,
        }
    }

    /// These references, and as many of the last of `more` as a model takes beside them.
    #[must_use]
    pub(crate) fn and(&self, more: &Self, most: usize) -> Self {
        let count = more.count.min(most.saturating_sub(self.count));
        if count == 0 {
            return self.clone();
        }
        let each = more.features.len() / more.count;
        let last = &more.features[more.features.len() - count * each..];
        Self {
            kinds: self.kinds.and(more.kinds),
            count: self.count + count,
            features: [&self.features, last].concat(),
            ignored: self.ignored,
        }
    }

    /// The references without the one at `place`. Their kinds are those of all.
    pub(super) fn without(&self, place: usize) -> Self {
        let each = self.features.len() / self.count;
        let (before, after) = (place * each, (place + 1) * each);
        let count = self.count - 1;
        let features = [&self.features[..before], &self.features[after..]].concat();
        match count {
            0 => Self::NONE,
            _ => Self {
                count,
                features,
                ..self.clone()
            },
        }
    }

    /// Whether there are some that are not used, because they made verdicts worse.
    pub fn are_ignored(&self) -> bool {
        self.ignored
    }

    /// Whether it is a single press.
    pub(crate) fn is_one(&self) -> bool {
        self.count == 1
    }

    /// Whether there are none.
    pub fn is_none(&self) -> bool {
        self.count == 0
    }

    /// Which kinds there are.
    pub fn kinds(&self) -> ReferenceKinds {
        self.kinds
    }
}
