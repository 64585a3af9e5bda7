//! A body that stands on the ground with free sides: how its flat face yields.
//!
//! A half-space carries a flat load mostly at its rim, because the material beside the load holds
//! back. A block has nothing beside it: it is squeezed as a whole, evenly, and bends where the load
//! is off its middle. So its influence has two parts. Short waves sink in as on a half-space, with
//! twice the effect at a free side, which mirrors them. Beyond that, the whole block is a column.
//!
//! In: sides, height and Poisson's ratio. Out: a factor for each cell, and the column's compliance.
//! What is not modelled: friction, buckling, and the higher pressure in the middle of a flat block
//! that hardly changes its volume.

use std::f64::consts::PI;

use super::fourier::Convolver;
use super::kernel::confined_compliance;
use super::object::{Axes, FlatFace};
use crate::CELLS;

/// Poisson's ratio of the layer that carries the short waves. Short waves depend on the plane-strain
/// modulus only, and with this ratio an even load sinks in evenly.
pub(super) const LOCAL_NU: f64 = 0.2;
/// The greatest height of that layer, as shares of the block's height and of its narrow side.
const LOCAL_HEIGHT: (f64, f64) = (0.6, 0.5);
/// A lower block is a layer: its sides matter on a narrow seam only.
const LEAST_HEIGHT: f64 = 0.25;
/// Near a side, an even load on the layer sinks in by `1 - SIDE exp(-distance / (REACH height))` of
/// what it does far away. Fitted to the layer's kernel on squares and strips: with the factors that
/// follow, an even load sinks in evenly within 1 % (rms).
const SIDE: f64 = 0.58;
const REACH: f64 = 0.2;

/// A block under a sensor, apart from its modulus.
pub(super) struct Block {
    /// The sides of the face, mm. Those of a round one are the square's of the same area.
    sides_mm: [f64; 2],
    /// The radius of a round face.
    radius_mm: Option<f64>,
    /// The height that yields, mm.
    height_mm: f64,
    /// The axes of the face on the whole sensor.
    pub(super) axes: Axes,
    /// The factor on a cell's pressure and on its displacement, over the whole sensor. 0 beside the
    /// block.
    pub(super) factor: Vec<f32>,
    /// What the block yields as a column: mm under an even pressure of 1 MPa, for Young's modulus 1.
    compliance: f64,
}

/// A block under a window of the sensor.
pub(super) struct Standing<'a> {
    pub(super) block: &'a Block,
    /// Spectrum of the short waves' influence, mm per MPa.
    pub(super) spectrum: &'a [f32],
    /// The block's factor on the window.
    pub(super) factor: Vec<f32>,
    /// The axes on the window.
    pub(super) axes: Axes,
    /// The factor on the compliance for Young's modulus 1.
    pub(super) unit: f64,
}

impl Block {
    /// A block with this face on the cells of the sensor, of Poisson's ratio `nu`, on a core with this
    /// compliance. `None` for one so low that it is a layer.
    pub(super) fn new(
        face: FlatFace,
        height_mm: f64,
        nu: f64,
        core: f64,
        axes: Axes,
    ) -> Option<Self> {
        let (sides_mm, radius_mm) = match face {
            FlatFace::Rectangle { sides_mm } => (sides_mm, None),
            FlatFace::Round { radius_mm } => {
                let side_mm = PI.sqrt() * radius_mm;
                ([side_mm; 2], Some(radius_mm))
            }
        };
        let narrow_mm = sides_mm[0].min(sides_mm[1]);
        if height_mm <= LEAST_HEIGHT * narrow_mm {
            return None;
        }
        let mut block = Self {
            sides_mm,
            radius_mm,
            height_mm,
            axes,
            factor: Vec::new(),
            compliance: 0.0,
        };
        block.compliance = block.column(nu) + core;
        let cells = 0..CELLS * CELLS;
        let factor = cells.map(|k| block.factor_at(axes.at(k / CELLS, k % CELLS)));
        block.factor = factor.collect();
        Some(block)
    }

    /// The height of the layer that carries the short waves, mm.
    pub(super) fn local_mm(&self) -> f64 {
        let narrow_mm = self.sides_mm[0].min(self.sides_mm[1]);
        (LOCAL_HEIGHT.0 * self.height_mm).min(LOCAL_HEIGHT.1 * narrow_mm)
    }

    fn factor_at(&self, [u, v]: [f64; 2]) -> f32 {
        let reach = REACH * self.local_mm();
        let held = |at: f64, side: f64| {
            let near = |distance: f64| SIDE * (-distance.max(0.0) / reach).exp();
            1.0 - near(0.5 * side - at) - near(0.5 * side + at)
        };
        let share = match self.radius_mm {
            Some(radius) if u.hypot(v) > radius => return 0.0,
            Some(radius) => held(u.hypot(v), 2.0 * radius),
            None if u.abs() > 0.5 * self.sides_mm[0] || v.abs() > 0.5 * self.sides_mm[1] => {
                return 0.0;
            }
            None => held(u, self.sides_mm[0]) * held(v, self.sides_mm[1]),
        };
        (1.0 / share.sqrt()) as f32
    }

    /// What the block yields beyond its short waves, for Young's modulus 1 and Poisson's ratio `nu`.
    ///
    /// With free sides the modulus is E. It rises to the confined modulus M with the shape factor S
    /// (loaded over free area of a block bonded at both ends, twice as high), first as `E (1 + 2 S^2)`
    /// (Gent and Lindley 1959).
    fn column(&self, nu: f64) -> f64 {
        let [a, b] = self.sides_mm;
        let shape = a * b / (4.0 * (a + b) * self.height_mm);
        // E* = E / (1 - nu^2), and M = E* / confined_compliance.
        let plane_strain = 1.0 / (1.0 - nu * nu);
        let held = plane_strain / confined_compliance(nu) - 1.0;
        let gent = 2.0 * shape * shape;
        let modulus = 1.0 + gent * held / (gent + held);
        let local = self.local_mm() * confined_compliance(LOCAL_NU) / plane_strain;
        (self.height_mm / modulus - local).max(0.0)
    }
}

impl Standing<'_> {
    /// Adds the displacement under a pressure to `displacement`.
    pub(super) fn displace(
        &self,
        convolver: &mut Convolver,
        pressure_mpa: &[f32],
        displacement: &mut [f32],
    ) {
        let width = convolver.width;
        let loaded: Vec<f32> = (pressure_mpa.iter().zip(&self.factor))
            .map(|(p, s)| p * s)
            .collect();
        let mut sunk = vec![0.0; loaded.len()];
        convolver.convolve(self.spectrum, &loaded, &mut sunk);
        // The force over the area, and the moments over the second moments of the face.
        let mut means = [0.0; 3];
        for (k, &pressure) in pressure_mpa.iter().enumerate() {
            if pressure != 0.0 {
                let [u, v] = self.axes.at(k / width, k % width);
                let pressure = f64::from(pressure);
                means[0] += pressure;
                means[1] += pressure * u;
                means[2] += pressure * v;
            }
        }
        let [cos, sin] = self.axes.across;
        let cell_mm2 = cos * cos + sin * sin;
        let [a, b] = self.block.sides_mm;
        let unit = self.unit * self.block.compliance * cell_mm2 / (a * b);
        let even = unit * means[0];
        let along_u = unit * means[1] / (a * a / 12.0);
        let along_v = unit * means[2] / (b * b / 12.0);
        for (k, displacement) in displacement.iter_mut().enumerate() {
            let factor = self.factor[k];
            if factor > 0.0 {
                let [u, v] = self.axes.at(k / width, k % width);
                *displacement += factor * sunk[k] + (even + along_u * u + along_v * v) as f32;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::kernel::confined_compliance;
    use super::super::material::Material;
    use super::super::object::{Face, FlatFace, Pose};
    use super::super::press::{Bench, Cover, Specimen, Window};
    use super::super::substance::{Creep, Law, Substance};
    use super::super::texture::Patch;
    use crate::CELL_MM;
    use crate::random::Stream;
    use crate::tests::near;

    const SIDE_MM: f64 = 24.0 * CELL_MM;
    const SQUARE: FlatFace = FlatFace::Rectangle {
        sides_mm: [SIDE_MM; 2],
    };

    fn cover(young_mpa: f64, thickness_mm: f64) -> Cover {
        Cover {
            young_mpa,
            thickness_mm,
        }
    }

    /// A smooth elastic body with this face, on the ground under the middle of the sensor.
    fn body(face: FlatFace, height_mm: f64, young_mpa: f64, nu: f64, tilt: f64) -> Specimen {
        let substance = Substance {
            nu,
            law: Law::Solid,
            creep: [Creep::NONE; 2],
            ..Material::Rubber.properties().substance
        };
        let patch = Patch::new(&substance.texture, 0.0, &mut Stream::new(1, "block"));
        let pose = Pose {
            turn_rad: 0.0,
            shift_mm: [0.0; 2],
            tilt: [tilt, 0.0],
        };
        let face = Face::block(face, height_mm, 0.2);
        Specimen::new(substance, young_mpa, &face, &pose, &patch)
    }

    /// The approach in mm, and the pressure in the middle and at the middle of the rim, over the mean.
    fn pressed(bench: &mut Bench, specimen: &Specimen, force_n: f64) -> (f64, [f64; 2]) {
        let (window, pressure, contact) = bench.press(specimen, force_n, 0.0, 0.0);
        assert!(contact.converged, "{contact:?}");
        let loaded = pressure.iter().filter(|&&p| p > 0.0).count() as f64;
        let mean = pressure.iter().map(|&p| f64::from(p)).sum::<f64>() / loaded;
        let at = |row: usize, column: usize| {
            let Window { corner, width } = window;
            f64::from(pressure[(row - corner.0) * width + column - corner.1]) / mean
        };
        // The square has the cells 44 to 67.
        (contact.approach_mm, [at(56, 56), at(56, 44)])
    }

    #[test]
    fn a_soft_block_is_a_column_and_carries_an_even_load() {
        let mut bench = Bench::under(cover(1e4, 1.0));
        for (height_mm, young_mpa, nu) in [(42.0, 0.5, 0.3), (42.0, 0.2, 0.1), (20.0, 1.0, 0.49)] {
            let specimen = body(SQUARE, height_mm, young_mpa, nu, 0.0);
            let (approach_mm, [middle, rim]) = pressed(&mut bench, &specimen, 8.0);
            let shape = SIDE_MM / (8.0 * height_mm);
            let modulus = young_mpa * (1.0 + 2.0 * shape * shape);
            let expected = 8.0 * height_mm / (SIDE_MM * SIDE_MM * modulus);
            near(approach_mm, expected, 0.03, "a column");
            assert!(
                (0.9..1.1).contains(&middle) && (0.8..1.2).contains(&rim),
                "{middle} {rim}"
            );
        }
    }

    #[test]
    fn a_rigid_block_carries_its_load_at_the_rim_of_a_soft_cover() {
        let steel = body(SQUARE, 20.0, 2e5, 0.3, 0.0);
        let soft = body(SQUARE, 20.0, 0.3, 0.3, 0.0);
        let mut bench = Bench::under(cover(2.0, 8.0));
        let [(_, [middle, rim]), (_, [soft_middle, soft_rim])] =
            [&steel, &soft].map(|body| pressed(&mut bench, body, 10.0));
        assert!(rim > 1.5 * middle, "steel: {rim} at the rim, {middle}");
        assert!(
            soft_rim < 1.35 * soft_middle,
            "soft: {soft_rim}, {soft_middle}"
        );

        // A thin cover is squeezed as a layer, and a very thick one as a half-space under a punch.
        let plane_strain = |young_mpa: f64| young_mpa / (1.0 - 0.45_f64.powi(2));
        let (window, pressure, thin) = Bench::under(cover(2.0, 0.5)).press(&steel, 10.0, 0.0, 0.0);
        // In the middle, where the rounded edge does not matter.
        let Window { corner, width } = window;
        let share =
            pressure[(56 - corner.0) * width + 56 - corner.1] / pressure.iter().sum::<f32>();
        let mean = 10.0 * f64::from(share) / (CELL_MM * CELL_MM);
        let expected = mean * 0.5 * confined_compliance(0.45) / plane_strain(2.0);
        near(thin.approach_mm, expected, 0.015, "a thin cover");
        let round = FlatFace::Round { radius_mm: 14.0 };
        let punch = body(round, 20.0, 2e5, 0.3, 0.0);
        let (_, _, contact) = Bench::under(cover(1.0, 1e4)).press(&punch, 10.0, 0.0, 0.0);
        let expected = 10.0 / (2.0 * plane_strain(1.0) * contact.radius_mm);
        near(contact.approach_mm, expected, 0.015, "a thick cover");
    }

    #[test]
    fn a_sheet_on_the_ground_is_a_layer() {
        let mut bench = Bench::under(cover(1e4, 1.0));
        let specimen = body(SQUARE, 2.0, 0.5, 0.3, 0.0);
        let (approach_mm, _) = pressed(&mut bench, &specimen, 8.0);
        let even = 8.0 / (SIDE_MM * SIDE_MM) * 2.0 * confined_compliance(0.3) * (1.0 - 0.09) / 0.5;
        near(approach_mm, even, 0.06, "a sheet");
    }

    #[test]
    fn a_tilted_block_bends() {
        // Tilted by less than the load can level, a column has strain linear over its face.
        let (height_mm, young_mpa) = (42.0, 0.2);
        let tilt = 0.1;
        let mut bench = Bench::under(cover(1e4, 1.0));
        let specimen = body(SQUARE, height_mm, young_mpa, 0.1, tilt);
        let (_, [middle, rim]) = pressed(&mut bench, &specimen, 10.0);
        let mean = 10.0 / (SIDE_MM * SIDE_MM);
        let expected = 1.0 + young_mpa / height_mm * tilt * 11.5 * CELL_MM / mean;
        assert!((middle - 1.0).abs() < 0.1, "{middle}");
        near(rim, expected, 0.1, "the rim");
    }
}
