//! The inputs of a model.
//!
//! In: the course of a press, the pressed piece, the sensor's references. Out: the model's inputs as
//! tensors.

use serde::{Deserialize, Serialize};
use tract_onnx::prelude::*;
use tract_onnx::tract_core::internal::bail;

use super::course::{Moment, TimeSeries};
use super::features::FEATURES;
use super::grid::{COLS, ROWS};
use super::parts::PARTS;
use super::references::{PIECE, Piece, References};
use crate::frame::Array;
use crate::wording;

/// An input of a model, by its name in the file. The first two are those of format 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Input {
    Frame,
    Parts,
    Frames,
    TimeS,
    ApproachMm,
    Known,
    Mask,
    ArmNPerMm,
    Piece,
    References,
    Given,
    Features,
}

/// The lengths of the inputs of a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Lengths {
    /// The array of a model of format 1.
    pub(super) array: Array,
    /// The frames of a press.
    pub(super) frames: usize,
    /// The references, and the numbers of each. Both are 0 in a model that takes none.
    pub(super) references: usize,
    pub(super) features: usize,
}

/// What a model judges. One of format 1 takes the course alone.
pub(super) struct Query<'a> {
    pub(super) course: &'a TimeSeries,
    /// The pressed piece, if the press is to become a reference.
    pub(super) piece: Option<Piece>,
    pub(super) references: &'a References,
}

impl Input {
    /// The inputs that have a place for each frame.
    pub(super) const OF_FRAMES: [Self; 5] = [
        Self::Frames,
        Self::TimeS,
        Self::ApproachMm,
        Self::Known,
        Self::Mask,
    ];
    /// The inputs of a model that takes references.
    pub(super) const OF_REFERENCES: [Self; 3] = [Self::Piece, Self::References, Self::Given];

    pub(super) fn name(self) -> String {
        wording::name(&self)
    }

    /// The shape of the input in a model of these lengths.
    pub(super) fn shape(self, lengths: Lengths) -> Vec<usize> {
        let Array { rows, cols } = lengths.array;
        match self {
            Self::Frame => vec![1, 1, rows, cols],
            Self::Parts => vec![1, PARTS, rows, cols],
            Self::Frames => vec![1, lengths.frames, ROWS, COLS],
            Self::ArmNPerMm => vec![1, 1],
            Self::TimeS | Self::ApproachMm | Self::Known | Self::Mask => vec![1, lengths.frames],
            Self::Piece => vec![1, PIECE],
            Self::References => vec![1, lengths.references, lengths.features],
            Self::Given => vec![1, lengths.references],
            Self::Features => vec![1, FEATURES],
        }
    }

    /// The tensor of this input for `query`. Places after the last frame or reference are 0.
    pub(super) fn tensor(self, query: &Query, lengths: Lengths) -> TractResult<Tensor> {
        let course = query.course;
        let pressed = |moment: &Moment| -> Vec<f32> { moment.frame.pressed().collect() };
        let each =
            |value: fn(&Moment) -> f32| -> Vec<f32> { course.moments.iter().map(value).collect() };
        let mut values = match self {
            Self::Frame | Self::Parts => bail!("the model takes no courses"),
            Self::Frames => course.moments.iter().flat_map(pressed).collect(),
            Self::TimeS => each(|moment| moment.time_s),
            Self::ApproachMm => each(|moment| moment.approach_mm.unwrap_or(0.0)),
            Self::Known => each(|moment| f32::from(u8::from(moment.approach_mm.is_some()))),
            Self::Mask => each(|_| 1.0),
            Self::ArmNPerMm => vec![course.arm_n_per_mm],
            Self::Piece => Piece::numbers(query.piece).to_vec(),
            Self::References => {
                let presses = query.references.presses.iter();
                presses.flat_map(|press| press.features.clone()).collect()
            }
            Self::Given => vec![1.0; query.references.presses.len()],
            Self::Features => course.features().to_vec(),
        };
        let shape = self.shape(lengths);
        values.resize(shape.iter().product(), 0.0);
        Tensor::from_shape(&shape, &values)
    }
}
