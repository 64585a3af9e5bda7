//! Compares frames that the generator makes from fixed noise with real frames, and draws both.

use anyhow::Context as _;

use super::Task;
use crate::judge::likeness::{Likeness, Reference};
use crate::judge::sheet::{self, Strip};
use crate::net::generator;
use crate::net::network::{Normalisation, Weights};
use crate::run::Run;

/// The most real frames to compare generated ones with. The comparison is pair by pair, so its cost
/// grows with the square.
const COMPARED: usize = 500;
/// The most pairs of strips of generated frames in a picture.
const STRIPS: usize = 3;

impl Task<'_> {
    /// Real samples to compare generated ones with.
    pub(super) fn reference(&self) -> anyhow::Result<Reference> {
        let order = self.order("compared", self.real, 0);
        let frames = self.frames(&order[..order.len().min(COMPARED)]);
        Reference::of(&frames, self.scale).context("real samples")
    }

    /// Compares frames generated from fixed noise with the real samples.
    pub(super) fn likeness(
        &self,
        real: &Reference,
        generator: &Weights,
    ) -> anyhow::Result<Likeness> {
        let samples = self.settings.samples_a_component;
        let statistics = generator::statistics(generator, samples, self.seed, self.device);
        let making = generator::Making {
            weights: generator,
            statistics: &statistics,
            scale: self.scale,
            sensor: self.sensor(),
            device: self.device,
        };
        let frames = generator::generate(
            &making,
            COMPARED / generator::COMPONENTS,
            &mut self.stream("compared noise"),
        );
        real.compare(&frames, generator::COMPONENTS)
            .context("generated samples")
    }

    /// Draws real frames above frames generated from fixed noise: one frame of each component, and
    /// below it a second frame of the same component.
    pub(super) fn picture(&self, generator: &Weights, epoch: u32, run: &Run) -> anyhow::Result<()> {
        let samples = self.settings.samples_a_component.max(2);
        let eta = generator::noise(samples, &mut self.stream("picture"), self.device);
        let images = generator::images(generator, eta, &mut Normalisation::Batch);
        let generated = generator::frames(&images, self.scale, self.sensor());
        let order = self.order("compared", self.real, 0);
        let real = self.frames(&order);
        let mut rows = vec![Strip::of("real", real.into_iter().take(sheet::TILES))];
        let (first, second) = generated.split_at(generator::COMPONENTS);
        let parts = first.chunks(sheet::TILES).zip(second.chunks(sheet::TILES));
        for (first, second) in parts.take(STRIPS) {
            rows.push(Strip::of("generated", first.iter()));
            rows.push(Strip::of("  again", second.iter()));
        }
        let stage = self.stage;
        let title = format!("{stage} after {epoch} epochs: {}", sheet::captions());
        let name = format!("samples/{stage}-{epoch:06}.png");
        run.write(&name, &sheet::strips(&title, &rows)?)
    }
}
