//! The file of a data set, put together from the parts of its captures array by array.

use std::io::{Seek, Write};
use std::iter::once;

use super::collection::{Collection, Samples, Used};
use super::parts;
use crate::data::courses::{Courses, Press};
use crate::data::dataset::Sample;
use crate::data::dataset::file::Element;
use crate::data::dataset::stream::Stream;
use hardnessd_core::frame::{COLS, ROWS, TAXELS};

/// The number of earlier frames that are copied at once.
const BLOCK_FRAMES: usize = 64;

impl Collection {
    /// Writes the data set. It holds the arrays of one part at a time.
    ///
    /// # Errors
    ///
    /// Returns an error if a part cannot be read, or the errors of writing to `out`.
    pub fn write<W: Write + Seek>(&self, out: W) -> anyhow::Result<()> {
        let mut npz = Stream::new(out);
        if self.is_of_courses {
            self.add_courses(&mut npz)?;
        } else {
            self.add_frames(&mut npz)?;
        }
        let meta = self.meta().into_bytes();
        npz.add("meta", &[meta.len()], once(Ok(meta)))?;
        npz.finish()?;
        Ok(())
    }

    fn add_frames<W: Write + Seek>(&self, npz: &mut Stream<W>) -> anyhow::Result<()> {
        let (n, _) = self.all;
        let samples: &[Sample] = match &self.earlier {
            Some(Samples::Frames(samples)) => samples,
            _ => &[],
        };
        let frames = samples
            .iter()
            .map(|sample| Ok(sample.frame.newtons.to_vec()));
        let added = |used: &Used| parts::array(&used.part, "frames", &[ROWS, COLS], used.presses);
        npz.add::<f32>("frames", &[n, ROWS, COLS], frames.chain(self.each(added)))?;

        let earlier = |value: fn(&Sample) -> u8| samples.iter().map(value).collect();
        self.add_labels(npz, "level", earlier(|sample| sample.level), |used| {
            used.level
        })?;
        // An array has a value for every sample or is missing.
        let objects = samples.iter().filter_map(|sample| sample.object).collect();
        self.add_labels(npz, "object", objects, |used| used.object)?;
        if self.shape.material {
            let materials = samples.iter().filter_map(|sample| sample.material);
            let material = |used: &Used| used.material.unwrap_or_default();
            self.add_labels(npz, "material", materials.collect(), material)?;
        }
        let forces = samples.iter().filter_map(|sample| sample.force_n).collect();
        let added = |used: &Used| parts::array(&used.part, "force", &[], used.presses);
        npz.add::<f32>("force", &[n], once(Ok(forces)).chain(self.each(added)))?;
        let split = self.split as u8;
        self.add_labels(npz, "split", earlier(|sample| sample.split as u8), |_| {
            split
        })?;
        if self.shape.shore {
            let shores = samples.iter().filter_map(|sample| sample.shore).collect();
            let shore = |used: &Used| used.shore.unwrap_or(f32::NAN);
            self.add_labels(npz, "shore", shores, shore)?;
        }
        Ok(())
    }

    fn add_courses<W: Write + Seek>(&self, npz: &mut Stream<W>) -> anyhow::Result<()> {
        let (n, rows) = self.all;
        let none = Courses::default();
        let earlier = match &self.earlier {
            Some(Samples::Courses(courses)) => courses,
            _ => &none,
        };
        let frames = earlier.frames_mn.chunks(BLOCK_FRAMES * TAXELS);
        let frames = frames.map(|frames| Ok(frames.to_vec()));
        let added = |used: &Used| parts::array(&used.part, "frames_mn", &[ROWS, COLS], used.frames);
        let frames = frames.chain(self.each(added));
        npz.add::<u16>("frames_mn", &[rows, ROWS, COLS], frames)?;

        // A part counts its presses and frames from 0.
        let added = |used: &Used| {
            let mut press: Vec<u32> = parts::array(&used.part, "press", &[], used.frames)?;
            press
                .iter_mut()
                .for_each(|press| *press += used.before.0 as u32);
            Ok(press)
        };
        let presses = once(Ok(earlier.press.clone())).chain(self.each(added));
        npz.add("press", &[rows], presses)?;
        for (name, values) in [
            ("time_s", &earlier.time_s),
            ("approach_mm", &earlier.approach_mm),
        ] {
            let added = |used: &Used| parts::array(&used.part, name, &[], used.frames);
            let values = once(Ok(values.clone())).chain(self.each(added));
            npz.add::<f32>(name, &[rows], values)?;
        }
        let added = |used: &Used| parts::array(&used.part, "known", &[], used.frames);
        let known = once(Ok(earlier.known.clone())).chain(self.each(added));
        npz.add::<u8>("known", &[rows], known)?;

        let of = &earlier.presses;
        let bytes = |value: fn(&Press) -> u8| of.iter().map(value).collect();
        let material = |used: &Used| used.material.unwrap_or_default();
        let split = self.split as u8;
        self.add_labels(npz, "level", bytes(|press| press.level), |used| used.level)?;
        self.add_labels(npz, "material", bytes(|press| press.material), material)?;
        self.add_labels(npz, "split", bytes(|press| press.split as u8), |_| split)?;
        let objects = of.iter().map(|press| press.object).collect();
        self.add_labels(npz, "object", objects, |used| used.object)?;
        let added = |used: &Used| {
            let mut best: Vec<u32> = parts::array(&used.part, "best", &[], used.presses)?;
            best.iter_mut()
                .for_each(|best| *best += used.before.1 as u32);
            Ok(best)
        };
        let best = of.iter().map(|press| press.best).collect();
        npz.add("best", &[n], once(Ok(best)).chain(self.each(added)))?;
        let shores = of.iter().map(|press| press.shore).collect();
        let shore = |used: &Used| used.shore.unwrap_or(f32::NAN);
        self.add_labels(npz, "shore", shores, shore)?;
        let forces: Vec<f32> = of.iter().map(|press| press.force_n).collect();
        let arms = of.iter().map(|press| press.arm_n_per_mm).collect();
        for (name, values) in [("force", forces), ("arm_n_per_mm", arms)] {
            let added = |used: &Used| parts::array(&used.part, name, &[], used.presses);
            npz.add::<f32>(name, &[n], once(Ok(values)).chain(self.each(added)))?;
        }
        Ok(())
    }

    /// The blocks of an array, one for each capture.
    fn each<'s, T: 's>(
        &'s self,
        block: impl Fn(&Used) -> anyhow::Result<Vec<T>> + 's,
    ) -> impl Iterator<Item = anyhow::Result<Vec<T>>> + 's {
        self.used.iter().map(block)
    }

    /// Adds an array with a value for each press. All presses of a capture have the same value.
    fn add_labels<W: Write + Seek, T: Element>(
        &self,
        npz: &mut Stream<W>,
        name: &str,
        earlier: Vec<T>,
        value: impl Fn(&Used) -> T,
    ) -> anyhow::Result<()> {
        let added = |used: &Used| Ok(vec![value(used); used.presses]);
        let blocks = once(Ok(earlier)).chain(self.used.iter().map(added));
        npz.add(name, &[self.all.0], blocks)
    }
}
