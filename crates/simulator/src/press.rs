//! One specimen under the sensor: from gap and force to pressure and taxel forces.
//!
//! A [`Bench`] holds values that are costly to make and shared by presses: FFT plans and kernels. It
//! never changes a result: a fresh bench gives the same bytes.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::block::{Block, LOCAL_NU, Standing};
use super::contact::{Contact, Local, Problem, Solver, TOLERANCE};
use super::kernel::{self, Base, Layer};
use super::object::{Face, Pose};
use super::substance::{Law, Substance, Texture};
use super::texture::Patch;
use crate::random::Stream;
use crate::{CELL_MM, CELLS};

/// Window widths in cells. FFTs of twice these sizes are fast.
const WIDTHS: [usize; 6] = [24, 32, 48, 64, 96, CELLS];

/// Poisson's ratio of every cover.
const COVER_NU: f64 = 0.45;

/// The cover of a sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Cover {
    pub(super) young_mpa: f64,
    pub(super) thickness_mm: f64,
}

impl Default for Cover {
    /// The cover of the JX255N (assumed: soft silicone).
    fn default() -> Self {
        Self {
            young_mpa: 3.0,
            thickness_mm: 1.0,
        }
    }
}

impl Cover {
    /// A guess at the compliance under a contact of this radius, mm per MPa: that of a layer, or of a
    /// half-space if the cover is thick.
    fn compliance(self, radius_mm: f64) -> f64 {
        let plane_strain = self.young_mpa / (1.0 - COVER_NU * COVER_NU);
        let layer = self.thickness_mm * kernel::confined_compliance(COVER_NU) / plane_strain;
        layer.min(radius_mm / (0.42 * plane_strain))
    }
}

/// An object's face in its pose.
pub(super) struct Specimen {
    pub(super) substance: Substance,
    pub(super) young_mpa: f64,
    height_mm: f64,
    /// Undeformed gap over the whole sensor, `[CELLS, CELLS]`.
    gap_mm: Vec<f32>,
    /// The layer that bears the load; `None` for a half-space.
    layer: Option<LayerKey>,
    /// What a block with free sides has beyond its layer.
    block: Option<Block>,
    /// Whether the face is flat.
    pub(super) is_flat: bool,
}

/// Draws the roughness of one posture's face.
pub(super) fn draw_patch(texture: &Texture, roughness: f64, stream: &mut Stream) -> Patch {
    let factor = roughness * (0.35 * stream.normal()).exp();
    Patch::new(texture, factor, stream)
}

/// The part of the sensor on which a press is solved.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Window {
    /// First row and column, in cells of the sensor.
    pub(super) corner: (usize, usize),
    pub(super) width: usize,
}

/// Solvers and kernels, kept between presses. By default it is for the default cover.
#[derive(Default)]
pub(super) struct Bench {
    pub(super) cover: Cover,
    solvers: BTreeMap<usize, Solver>,
    spectra: Vec<(Influence, Arc<[f32]>)>,
}

/// The layer that bears a load.
#[derive(Clone, Copy, PartialEq)]
struct LayerKey {
    nu: f64,
    base: Base,
    /// The layer's height in cells.
    height: f64,
}

/// The quantities that determine a spectrum: the width of the window, the layer (a half-space without one), and a
/// factor.
#[derive(Clone, Copy, PartialEq)]
struct Influence {
    width: usize,
    layer: Option<LayerKey>,
    unit: f64,
}

/// The number of spectra held: those of the cover, and of an object's up to three heights, for some widths.
const SPECTRA: usize = 24;

impl Specimen {
    pub(super) fn new(
        substance: Substance,
        young_mpa: f64,
        face: &Face,
        pose: &Pose,
        patch: &Patch,
    ) -> Self {
        let gap_mm = face.gap_mm(pose, patch);
        let (layer, block) = bearing(&substance, young_mpa, face, pose);
        Self {
            substance,
            young_mpa,
            height_mm: face.height_mm,
            gap_mm,
            layer,
            block,
            is_flat: face.flat.is_some(),
        }
    }

    /// The plane-strain modulus E / (1 - nu^2), MPa.
    fn plane_strain_mpa(&self) -> f64 {
        self.substance.plane_strain(self.young_mpa)
    }

    /// The local law at one step: see [`Local`].
    pub(super) fn local<'a>(&self, factor: f64, history_mpa: &'a [f32], time_s: f64) -> Local<'a> {
        Local {
            law: self.substance.law,
            young_mpa: self.young_mpa,
            height_mm: self.height_mm,
            factor,
            history_mpa,
            time_s,
        }
    }

    /// The gap on a window, `[width, width]`.
    pub(super) fn gap_on(&self, window: Window) -> Vec<f32> {
        on_window(&self.gap_mm, window)
    }

    /// The block on a window, with `unit` times its influence for Young's modulus 1 and `spectrum`.
    fn standing<'a>(
        &'a self,
        window: Window,
        spectrum: &'a [f32],
        unit: f64,
    ) -> Option<Standing<'a>> {
        self.block.as_ref().map(|block| Standing {
            block,
            spectrum,
            factor: on_window(&block.factor, window),
            axes: block.axes.from(window.corner),
            unit,
        })
    }

    /// A guess at the contact under `force_n`: cells with a gap below this depth close.
    ///
    /// With overlap volume V at depth d, and radius a of half the overlap's area, a sphere and a
    /// flat punch both obey `F = 0.42 E* V / a` within 7 %. The cover adds its own compliance.
    fn closing_depth_mm(&self, cover: Cover, force_n: f64) -> f64 {
        let soft = match self.substance.law {
            Law::Foam { .. } => 0.4,
            Law::Solid | Law::Plastic { .. } | Law::Layered { .. } => 0.9,
        };
        let stiffness = 0.42 * self.plane_strain_mpa() * soft;
        let (mut low, mut high) = (0.0_f32, 16.0_f32);
        for _ in 0..16 {
            let depth = 0.5 * (low + high);
            let (mut sum, mut count) = (0.0_f32, 0.0_f32);
            for &gap in &self.gap_mm {
                let overlap = (depth - gap).max(0.0);
                sum += overlap;
                count += if overlap > 0.0 { 1.0 } else { 0.0 };
            }
            let area = CELL_MM * CELL_MM;
            let (volume, covered) = (f64::from(sum) * area, f64::from(count) * area);
            let radius = (0.5 * covered / std::f64::consts::PI).sqrt();
            let force = volume / (radius / stiffness + cover.compliance(radius));
            if force < force_n {
                low = depth;
            } else {
                high = depth;
            }
        }
        // A sphere touches where the undeformed gap is less than half the depth. A stiff rough face
        // behaves nearly as a mattress and touches where the gap is less than the whole depth.
        let share = if self.young_mpa > 20.0 { 1.0 } else { 0.6 };
        share * f64::from(high)
    }

    /// The smallest window around the cells closer than `depth_mm`, with a margin.
    fn window_around(&self, depth_mm: f64, least_width: usize) -> Window {
        const MARGIN: usize = 2;
        let depth = depth_mm as f32;
        let (mut first, mut last) = ((CELLS, CELLS), (0, 0));
        for (k, &gap) in self.gap_mm.iter().enumerate() {
            if gap <= depth {
                let (i, j) = (k / CELLS, k % CELLS);
                first = (first.0.min(i), first.1.min(j));
                last = (last.0.max(i), last.1.max(j));
            }
        }
        let extent = (last.0 - first.0).max(last.1 - first.1) + 1 + 2 * MARGIN;
        let fits = |&width: &usize| width >= extent.max(least_width);
        let width = WIDTHS.into_iter().find(fits).unwrap_or(CELLS);
        let corner = |first: usize, last: usize| {
            ((first + last).div_ceil(2))
                .saturating_sub(width / 2)
                .min(CELLS - width)
        };
        Window {
            corner: (corner(first.0, last.0), corner(first.1, last.1)),
            width,
        }
    }
}

/// The part of a field of the whole sensor that lies on a window.
fn on_window(field: &[f32], window: Window) -> Vec<f32> {
    let rows = (0..window.width).flat_map(|i| {
        let at = (window.corner.0 + i) * CELLS + window.corner.1;
        &field[at..at + window.width]
    });
    rows.copied().collect()
}

/// A stiffer block counts as a layer, which is cheaper to solve: beside the cover it does not yield.
const STIFF_MPA: f64 = 50.0;
/// The solver's tolerance for flat faces. Their rough contacts are large and slow to solve.
const FLAT_TOLERANCE: f64 = 2e-3;

/// The layer that bears a load on a face, and the block that it is a part of.
fn bearing(
    substance: &Substance,
    young_mpa: f64,
    face: &Face,
    pose: &Pose,
) -> (Option<LayerKey>, Option<Block>) {
    let key = |nu, base, height_mm: f64| LayerKey {
        nu,
        base,
        height: height_mm / CELL_MM,
    };
    let layer = substance.layer(face.height_mm);
    let layer = layer.map(|(base, height_mm)| key(substance.nu, base, height_mm));
    let Some(flat) = face.flat else {
        return (layer, None);
    };
    // What lies on a stiff core yields, and the core hardly.
    let (yields_mm, core) = match substance.law {
        Law::Layered { thickness_mm, core } if thickness_mm < face.height_mm => {
            (thickness_mm, (face.height_mm - thickness_mm) / core)
        }
        _ => (face.height_mm, 0.0),
    };
    let block = Block::new(flat, yields_mm, substance.nu, core, pose.axes());
    match block.filter(|_| young_mpa < STIFF_MPA) {
        Some(block) => {
            let layer = key(LOCAL_NU, Base::RIGID, block.local_mm());
            (Some(layer), Some(block))
        }
        None => {
            let whole = key(substance.nu, Base::RIGID, yields_mm);
            (layer.or(Some(whole)), None)
        }
    }
}

impl Window {
    /// Whether the window is the whole sensor.
    pub(super) fn is_whole(self) -> bool {
        self.width == CELLS
    }

    /// The next wider window for the same contact, if there is one.
    pub(super) fn wider(self, specimen: &Specimen, cover: Cover, force_n: f64) -> Option<Self> {
        let depth_mm = specimen.closing_depth_mm(cover, force_n);
        (!self.is_whole()).then(|| specimen.window_around(depth_mm, self.width + 1))
    }
}

impl Bench {
    /// A bench for a sensor with this cover.
    pub(super) fn under(cover: Cover) -> Self {
        Self {
            cover,
            ..Self::default()
        }
    }

    /// Presses with a force held for `hold_s` after a ramp of `ramp_s`. Returns the window, the
    /// pressure (MPa) on it and the contact. The window grows until the contact fits.
    pub(super) fn press(
        &mut self,
        specimen: &Specimen,
        force_n: f64,
        ramp_s: f64,
        hold_s: f64,
    ) -> (Window, Vec<f32>, Contact) {
        let depth_mm = specimen.closing_depth_mm(self.cover, force_n);
        let mut window = specimen.window_around(depth_mm, 0);
        loop {
            let gap = specimen.gap_on(window);
            let guess = |&gap: &f32| (depth_mm as f32 - gap).max(0.0);
            let mut pressure: Vec<f32> = gap.iter().map(guess).collect();
            // Under a linear ramp, the mean age of the load is half the ramp. Flow with the fourth
            // power of the pressure counts a fifth of the ramp.
            let factor = specimen.substance.compliance_ratio(hold_s + 0.5 * ramp_s);
            let local = specimen.local(factor, &[], hold_s + 0.2 * ramp_s);
            let contact = self.solve(specimen, window, &gap, force_n, local, &mut pressure);
            if window.is_whole() || !touches_border(&pressure, window.width) {
                return (window, pressure, contact);
            }
            window = specimen.window_around(depth_mm, window.width + 1);
        }
    }

    /// Solves one step on a window from the guess in `pressure`.
    pub(super) fn solve(
        &mut self,
        specimen: &Specimen,
        window: Window,
        gap_mm: &[f32],
        force_n: f64,
        local: Local,
        pressure_mpa: &mut [f32],
    ) -> Contact {
        let cover = self.spectrum(Influence {
            width: window.width,
            layer: Some(LayerKey {
                nu: COVER_NU,
                base: Base::RIGID,
                height: self.cover.thickness_mm / CELL_MM,
            }),
            unit: CELL_MM * (1.0 - COVER_NU * COVER_NU) / self.cover.young_mpa,
        });
        let object = self.of_object(specimen, window.width, local.factor);
        let block = specimen.standing(window, &object, local.factor / specimen.young_mpa);
        let both: Vec<f32> = object.iter().zip(&*cover).map(|(o, c)| o + c).collect();
        let problem = Problem {
            gap_mm,
            spectrum: if block.is_some() { &cover } else { &both },
            block,
            local,
            force_n,
            cell_mm: CELL_MM,
            tolerance: match specimen.is_flat {
                true => FLAT_TOLERANCE,
                false => TOLERANCE,
            },
        };
        self.solver(window.width).solve(&problem, pressure_mpa)
    }

    /// Displacement in mm of the object alone under an effective pressure.
    pub(super) fn displacement(
        &mut self,
        specimen: &Specimen,
        window: Window,
        pressure_mpa: &[f32],
    ) -> Vec<f32> {
        let object = self.of_object(specimen, window.width, 1.0);
        let convolver = &mut self.solver(window.width).convolver;
        let mut displacement = vec![0.0; pressure_mpa.len()];
        match specimen.standing(window, &object, 1.0 / specimen.young_mpa) {
            Some(block) => block.displace(convolver, pressure_mpa, &mut displacement),
            None => convolver.convolve(&object, pressure_mpa, &mut displacement),
        }
        displacement
    }

    fn solver(&mut self, width: usize) -> &mut Solver {
        let solvers = self.solvers.entry(width);
        solvers.or_insert_with(|| Solver::new(width))
    }

    /// The spectrum of an object's influence times `factor`, mm per MPa.
    fn of_object(&mut self, specimen: &Specimen, width: usize, factor: f64) -> Vec<f32> {
        let unit = (factor * CELL_MM / specimen.plane_strain_mpa()) as f32;
        let spectrum = self.spectrum(Influence {
            width,
            layer: specimen.layer,
            unit: 1.0,
        });
        spectrum.iter().map(|&o| unit * o).collect()
    }

    fn spectrum(&mut self, of: Influence) -> Arc<[f32]> {
        if let Some((_, held)) = self.spectra.iter().find(|(held, _)| *held == of) {
            return Arc::clone(held);
        }
        let Influence { width, layer, unit } = of;
        let convolver = &mut self.solver(width).convolver;
        let made = match layer {
            None => convolver.spectrum(|i, j| unit * kernel::half_space(i as f64, j as f64)),
            Some(LayerKey { nu, base, height }) => {
                let layer = Layer::new(nu, base);
                convolver.spectrum(|i, j| unit * layer.influence(i as f64, j as f64, height))
            }
        };
        let made: Arc<[f32]> = made.into();
        if self.spectra.len() == SPECTRA {
            self.spectra.remove(0);
        }
        self.spectra.push((of, Arc::clone(&made)));
        made
    }
}

pub(super) fn touches_border(pressure_mpa: &[f32], width: usize) -> bool {
    let last = width - 1;
    (0..width).any(|k| {
        [k, last * width + k, k * width, k * width + last]
            .into_iter()
            .any(|at| pressure_mpa[at] > 0.0)
    })
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::material::Material;
    use super::super::object::{Face, Pose};
    use super::*;
    use crate::tests::near;

    /// A ball of radius 27 mm of this material, with `roughness` times its roughness.
    pub(crate) fn ball(material: Material, roughness: f64) -> Specimen {
        let properties = material.properties();
        let substance = properties.substance;
        let face = Face::ball(27.0);
        let mut stream = Stream::new(2, "ball");
        let pose = Pose::draw(&face, &mut stream);
        let patch = Patch::new(&substance.texture, roughness, &mut stream);
        Specimen::new(
            substance,
            properties.young_mpa(properties.shore.mean),
            &face,
            &pose,
            &patch,
        )
    }

    #[test]
    fn radius_follows_from_force_and_r_over_e_as_hertz_says() {
        // A smooth solid ball under a cover that hardly yields obeys a^3 = 3 F R / (4 E*), with the
        // compliance after creep. A sphere is steeper than Hertz's paraboloid, which changes a by
        // 1 % where a is a quarter of R.
        let mut bench = Bench::under(Cover {
            young_mpa: 1e4,
            ..Cover::default()
        });
        let rubber = Material::Rubber.properties().substance;
        for (radius, young_mpa, force_n) in [
            (12.0, 2.0, 10.0),
            (27.0, 0.6, 10.0),
            (27.0, 2.0, 25.0),
            (60.0, 0.9, 5.0),
            (60.0, 2.5, 25.0),
        ] {
            let face = Face::ball(radius);
            let mut stream = Stream::new(4, "hertz");
            let pose = Pose::draw(&face, &mut stream);
            let patch = Patch::new(&rubber.texture, 0.0, &mut stream);
            let specimen = Specimen::new(rubber, young_mpa, &face, &pose, &patch);
            let (_, _, contact) = bench.press(&specimen, force_n, 0.0, 1.0);
            let softened = rubber.plane_strain(young_mpa) / rubber.compliance_ratio(1.0);
            let expected = (0.75 * force_n * radius / softened).cbrt();
            let what = format!("R {radius} mm, E {young_mpa} MPa, {force_n} N");
            near(contact.radius_mm, expected, 0.04, &what);
        }
    }

    #[test]
    fn every_material_carries_the_prescribed_force() {
        let mut bench = Bench::default();
        for material in Material::ALL {
            for force_n in [2.0, 25.0] {
                let ball = ball(material, 1.0);
                let (_, pressure, contact) = bench.press(&ball, force_n, 0.5, 1.0);
                let what = format!("{material:?} at {force_n} N: {contact:?}");
                assert!(contact.converged, "{what}");
                let mpa = pressure.iter().map(|&p| f64::from(p)).sum::<f64>();
                near(mpa * CELL_MM * CELL_MM, force_n, 1e-4, &what);
            }
        }
    }

    #[test]
    fn softer_levels_spread_the_force_wider() {
        // As in the paper's figure 2, on one smooth shape: the contact radius rises with the level,
        // in the training materials and in the test materials.
        let mut bench = Bench::default();
        for materials in [&Material::ALL[..4], &Material::ALL[4..]] {
            for force_n in [4.0, 12.0, 25.0] {
                let radii_mm = materials.iter().map(|&material| {
                    let ball = ball(material, 0.02);
                    let (_, _, contact) = bench.press(&ball, force_n, 0.5, 1.0);
                    contact.radius_mm
                });
                let radii_mm: Vec<f64> = radii_mm.collect();
                let is_wider = |pair: &[f64]| pair[1] > 1.05 * pair[0];
                let what = format!("{materials:?} at {force_n} N: {radii_mm:?}");
                assert!(radii_mm.windows(2).all(is_wider), "{what}");
            }
        }
    }

    #[test]
    fn a_used_bench_gives_what_a_fresh_one_gives() {
        let mut used = Bench::default();
        let _ = used.press(&ball(Material::Sponge, 1.0), 20.0, 0.5, 1.0);
        let press = |bench: &mut Bench| bench.press(&ball(Material::YogaMat, 1.0), 9.0, 0.5, 1.0);
        let (window, pressure, _) = press(&mut used);
        let (fresh_window, fresh, _) = press(&mut Bench::default());
        assert_eq!(window, fresh_window);
        assert!(pressure == fresh, "caches change the result");
    }
}
