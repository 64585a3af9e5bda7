//! Presses on pieces whose properties are known, and what a model of format 3 takes of them.
//!
//! In: such presses, on the model's grid. Out: [`References`], which the model computes once and
//! takes beside each press of the same sensor. They show it what the sensor reads of what it knows.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::course::Course;

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
    pub course: Course,
    /// The piece.
    pub piece: Piece,
}

/// The kinds of a sensor's references.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ReferenceKinds {
    /// There are none, or the model takes none.
    #[default]
    None,
    /// Presses on rigid pieces.
    Rigid,
    /// Presses on objects of known hardness.
    Labelled,
    /// Presses on both.
    Both,
}

impl ReferenceKinds {
    fn of(presses: &[ReferencePress]) -> Self {
        let rigid = presses.iter().filter(|press| press.piece.is_rigid());
        match rigid.count() {
            0 if presses.is_empty() => Self::None,
            0 => Self::Labelled,
            count if count == presses.len() => Self::Rigid,
            _ => Self::Both,
        }
    }
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
        kinds: ReferenceKinds::None,
        count: 0,
        features: Vec::new(),
    };

    pub(super) fn new(presses: &[ReferencePress], features: Vec<f32>) -> Self {
        Self {
            kinds: ReferenceKinds::of(presses),
            count: presses.len(),
            features,
        }
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
