//! What a run learns from, single frames or whole presses, and everything that depends on it.

use std::path::PathBuf;

use burn::tensor::Device;

use super::{Method, Request, adapt, course};
use crate::data::courses::{self, Courses};
use crate::data::dataset::{Dataset, DatasetError, Source};
use crate::learn::conformal::Calibration;
use crate::model::course as course_model;
use crate::model::evaluated::{Case, Evaluated};
use crate::model::export;
use crate::net::start;
use crate::run::{Description, Run};
use hardnessd_core::verdict::Hrn;
use hardnessd_simulator::Split;

/// The task of a run.
#[derive(Debug)]
pub enum Task {
    /// Single frames.
    Frames(Dataset, Frames),
    /// Whole presses and the files that they are from. With a start, the run adapts its model.
    Courses(
        Courses,
        Vec<Source>,
        Option<(start::ExportedNetwork, Calibration)>,
    ),
}

/// What is done with single frames.
#[derive(Debug)]
pub enum Frames {
    /// A method trains a network from random weights.
    Method(Method),
    /// The model of a file is adapted.
    Adapt(adapt::AdaptBase),
}

impl Task {
    /// Reads the data of a task of single frames, and joins its files.
    ///
    /// # Errors
    ///
    /// Fails if a file cannot be read, or the files do not go together.
    pub fn frames(data: &[PathBuf], frames: Frames) -> Result<Self, DatasetError> {
        let parts = data.iter().map(|path| courses::single_frames(path));
        let parts: Vec<Dataset> = parts.collect::<Result<_, _>>()?;
        for part in &parts {
            part.warn_of_object_in_both_splits();
        }
        Ok(Self::Frames(Dataset::joined(parts)?, frames))
    }

    /// Reads the data of a task of whole presses, and joins its files.
    ///
    /// # Errors
    ///
    /// Fails if a file cannot be read, or the files do not go together.
    pub fn courses(
        data: &[PathBuf],
        start: Option<(start::ExportedNetwork, Calibration)>,
    ) -> Result<Self, DatasetError> {
        let (courses, sources) = Courses::read_all(data)?;
        Ok(Self::Courses(courses, sources, start))
    }

    /// The description of the run, checked against the data before anything is written.
    ///
    /// # Errors
    ///
    /// Fails if the data do not have what the run needs.
    pub fn description(&self, request: &Request) -> anyhow::Result<Description> {
        match self {
            Self::Frames(dataset, Frames::Method(method)) => {
                let description = request.of_method(*method, dataset)?;
                super::check(Some(*method), dataset, &description)?;
                Ok(description)
            }
            Self::Frames(dataset, Frames::Adapt(start)) => {
                let labels = dataset.labelled(Split::Train)?.len();
                let description = Description {
                    settings: start.settings(request.settings)?,
                    ..request.of("adapt", labels, dataset.sources.clone())
                };
                super::check(None, dataset, &description)?;
                Ok(description)
            }
            Self::Courses(courses, sources, start) => {
                let name = if start.is_some() { "adapt" } else { "course" };
                course::description(name, courses, sources.clone(), request)
            }
        }
    }

    /// Trains, and writes the model and its evaluation to the run's directory. A resumed run
    /// continues from the files there. Returns the evaluation on the test split, if the data has one.
    ///
    /// # Errors
    ///
    /// Fails if the training diverges, or the directory cannot be read or written.
    pub fn train(
        &self,
        description: &Description,
        run: &Run,
        device: &Device,
    ) -> anyhow::Result<Option<Evaluated>> {
        match self {
            Self::Frames(dataset, Frames::Method(method)) => {
                super::train(*method, dataset, description, run, device)
            }
            Self::Frames(dataset, Frames::Adapt(start)) => {
                adapt::train(dataset, start.clone(), description, run, device)
            }
            Self::Courses(courses, _, start) => {
                course::train(courses, start.clone(), description, run, device)
            }
        }
    }

    /// The verdicts of a model on the labelled presses of the test split.
    ///
    /// # Errors
    ///
    /// Fails if there are none, or the model cannot judge one.
    pub fn test_cases(&self, model: &Hrn) -> anyhow::Result<Vec<Case>> {
        match self {
            Self::Frames(dataset, _) => {
                export::cases(model, dataset, &dataset.labelled(Split::Test)?)
            }
            Self::Courses(courses, ..) => {
                let given = course_model::Given::NONE;
                let verdicts =
                    course_model::verdicts(model, courses, Split::Test, given, |course| course)?;
                Ok(course_model::cases(&verdicts))
            }
        }
    }

    /// Split, level and object of every press.
    pub fn presses(&self) -> Vec<(Split, u8, Option<u32>)> {
        match self {
            Self::Frames(dataset, _) => {
                let samples = dataset.samples.iter();
                let press = samples.map(|sample| (sample.split, sample.level, sample.object));
                press.collect()
            }
            Self::Courses(courses, ..) => {
                let presses = courses.presses.iter();
                let press = presses.map(|press| (press.split, press.level, Some(press.object)));
                press.collect()
            }
        }
    }
}
