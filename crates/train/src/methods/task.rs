//! What a run learns from, single frames or whole presses, and everything that depends on it.

use std::path::PathBuf;

use burn::tensor::Device;

use super::{Method, Request, course};
use crate::data::courses::{self, Courses};
use crate::data::dataset::{Dataset, DatasetError, Source};
use crate::model::evaluated::Evaluated;
use crate::run::{Description, Run};
use hardnessd_simulator::Split;

/// The task of a run.
#[derive(Debug)]
pub enum Task {
    /// Single frames, and the method that learns from them.
    Frames(Dataset, Method),
    /// Whole presses and the files that they are from.
    Courses(Courses, Vec<Source>),
}

impl Task {
    /// Reads the data of a task of single frames, and joins its files.
    ///
    /// # Errors
    ///
    /// Fails if a file cannot be read, or the files do not go together.
    pub fn frames(data: &[PathBuf], method: Method) -> Result<Self, DatasetError> {
        let parts = data.iter().map(|path| courses::single_frames(path));
        let parts: Vec<Dataset> = parts.collect::<Result<_, _>>()?;
        for part in &parts {
            part.warn_of_object_in_both_splits();
        }
        Ok(Self::Frames(Dataset::joined(parts)?, method))
    }

    /// Reads the data of a task of whole presses, and joins its files.
    ///
    /// # Errors
    ///
    /// Fails if a file cannot be read, or the files do not go together.
    pub fn courses(data: &[PathBuf]) -> Result<Self, DatasetError> {
        let (courses, sources) = Courses::read_all(data)?;
        Ok(Self::Courses(courses, sources))
    }

    /// The description of the run, checked against the data before anything is written.
    ///
    /// # Errors
    ///
    /// Fails if the data do not have what the run needs.
    pub fn description(&self, request: &Request) -> anyhow::Result<Description> {
        match self {
            Self::Frames(dataset, method) => {
                let description = request.of_method(*method, dataset)?;
                super::check(*method, dataset, &description)?;
                Ok(description)
            }
            Self::Courses(courses, sources) => {
                course::description(courses, sources.clone(), request)
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
            Self::Frames(dataset, method) => {
                super::train(*method, dataset, description, run, device)
            }
            Self::Courses(courses, _) => course::train(courses, description, run, device),
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
