//! The inputs of a model of format 3.
//!
//! In: the course of a press, the pressed piece, the sensor's references. Out: the model's inputs as
//! tensors.

use tract_onnx::prelude::*;

use super::course::{Sample, TimeSeries};
use super::features::FEATURES;
use super::grid::{COLS, ROWS, TAXELS};
use super::references::{PIECE, Piece, References};

/// An input of a model of courses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Input {
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
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Lengths {
    /// The frames of a press.
    pub(super) frames: usize,
    /// The references, and the numbers of each. Both are 0 in a model that takes none.
    pub(super) references: usize,
    pub(super) features: usize,
}

/// What a model of courses judges.
pub(super) struct Query<'a> {
    pub(super) course: &'a TimeSeries,
    /// The pressed piece, if the press is to become a reference.
    pub(super) piece: Option<Piece>,
    pub(super) references: &'a References,
}

impl Input {
    /// Every input.
    pub(super) const ALL: [Self; 10] = [
        Self::Frames,
        Self::TimeS,
        Self::ApproachMm,
        Self::Known,
        Self::Mask,
        Self::ArmNPerMm,
        Self::Piece,
        Self::References,
        Self::Given,
        Self::Features,
    ];
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

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Frames => "frames",
            Self::TimeS => "time_s",
            Self::ApproachMm => "approach_mm",
            Self::Known => "known",
            Self::Mask => "mask",
            Self::ArmNPerMm => "arm_n_per_mm",
            Self::Piece => "piece",
            Self::References => "references",
            Self::Given => "given",
            Self::Features => "features",
        }
    }

    /// The shape of the input in a model of these lengths.
    pub(super) fn shape(self, lengths: Lengths) -> Vec<usize> {
        match self {
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
        let each = |value: fn(&Sample) -> f32| {
            let values = course.moments.iter().map(value);
            values.collect::<Vec<f32>>()
        };
        let mut values = match self {
            Self::Frames => {
                let mut values = Vec::with_capacity(lengths.frames * TAXELS);
                for moment in &course.moments {
                    values.extend(moment.frame.pressed());
                }
                values
            }
            Self::TimeS => each(|moment| moment.time_s),
            Self::ApproachMm => each(|moment| moment.approach_mm.unwrap_or(0.0)),
            Self::Known => each(|moment| f32::from(u8::from(moment.approach_mm.is_some()))),
            Self::Mask => each(|_| 1.0),
            Self::ArmNPerMm => vec![course.arm_n_per_mm],
            Self::Piece => Piece::numbers(query.piece).to_vec(),
            Self::References => query.references.features.clone(),
            Self::Given => vec![1.0; query.references.count],
            Self::Features => course.features().to_vec(),
        };
        let shape = self.shape(lengths);
        values.resize(shape.iter().product(), 0.0);
        Tensor::from_shape(&shape, &values)
    }
}
