//! Surface displacement under a loaded square cell: half-space, and a layer bonded to a base.
//!
//! All values are dimensionless: lengths are in cells, and the plane-strain modulus E* is 1. The
//! displacement in mm is the value here times cell_mm / E* times the cell's pressure.

use std::f64::consts::PI;
use std::sync::LazyLock;

/// Displacement at offset (`x`, `y`) cells from the centre of a cell under unit pressure on an
/// elastic half-space (Love 1929; Johnson, Contact Mechanics, eq. 3.25).
pub(super) fn half_space(x: f64, y: f64) -> f64 {
    let (xp, xm, yp, ym) = (x + 0.5, x - 0.5, y + 0.5, y - 0.5);
    // x ln((y1 + sqrt(y1^2 + x^2)) / (y2 + sqrt(y2^2 + x^2))), written with asinh, which stays
    // exact for negative y2.
    let term = |x: f64, y1: f64, y2: f64| x * ((y1 / x.abs()).asinh() - (y2 / x.abs()).asinh());
    (term(xp, yp, ym) - term(xm, yp, ym) + term(yp, xp, xm) - term(ym, xp, xm)) / PI
}

/// The half-space that a layer is bonded to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Base {
    /// Poisson's ratio.
    pub(super) nu: f64,
    /// The ratio of the shear moduli, layer to base.
    pub(super) shear_ratio: f64,
}

impl Base {
    /// A rigid base.
    pub(super) const RIGID: Self = Self {
        nu: 0.0,
        shear_ratio: 0.0,
    };
}

/// Influence of a layer bonded to a base, in free space.
///
/// With `K(q) = 2 / (E* q) S(q h)` for the layer and `2 / (E* q)` for the half-space, the layer's
/// influence is the half-space's minus a smooth part, which depends only on r / h:
/// `(1 / (pi E* h)) phi(r / h)`, `phi(s) = integral of (1 - S(x)) J0(x s) dx`.
/// Taking the difference in real space keeps the kernel free of periodic images.
pub(super) struct Layer {
    phi: Vec<f64>,
    /// S(0), the compliance of the base as a share of the layer's. Far away, only the base acts.
    base: f64,
}

impl Layer {
    /// The layer of Poisson's ratio `nu` on `base`.
    pub(super) fn new(nu: f64, base: Base) -> Self {
        let weight = |&(x, weight): &(f64, f64)| weight * (1.0 - layer_ratio(x, nu, base));
        let weights: Vec<f64> = NODES.iter().map(weight).collect();
        let sum = |values: &[f64]| weights.iter().zip(values).map(|(w, j0)| w * j0).sum();
        Self {
            phi: BESSEL.chunks_exact(weights.len()).map(sum).collect(),
            base: layer_ratio(0.0, nu, base),
        }
    }

    /// Displacement at offset (`x`, `y`) cells on a layer `height` cells thick.
    pub(super) fn influence(&self, x: f64, y: f64, height: f64) -> f64 {
        if x.hypot(y) > REACH * height {
            return self.base * half_space(x, y);
        }
        // The smooth part varies over one layer height, so a thin layer needs its mean over the
        // cell.
        let parts = if height < 8.0 { 4 } else { 1 };
        let mut sum = 0.0;
        for i in 0..parts {
            for j in 0..parts {
                let offset = |k: i32| (f64::from(k) + 0.5) / f64::from(parts) - 0.5;
                sum += self.phi_at((x + offset(i)).hypot(y + offset(j)) / height);
            }
        }
        half_space(x, y) - sum / (f64::from(parts * parts) * PI * height)
    }

    fn phi_at(&self, s: f64) -> f64 {
        let at = s / STEP;
        let k = (at as usize).min(self.phi.len() - 2);
        let part = at - k as f64;
        self.phi[k] * (1.0 - part) + self.phi[k + 1] * part
    }
}

/// The nodes and weights of an integral over x from 0 to 16, where 1 - S is below 1e-9: composite
/// Gauss-Legendre quadrature with 5 points on each of 64 panels.
static NODES: LazyLock<Vec<(f64, f64)>> = LazyLock::new(|| {
    const POINTS: [(f64, f64); 5] = [
        (0.0, 0.568_888_888_888_889),
        (0.538_469_310_105_683, 0.478_628_670_499_366),
        (-0.538_469_310_105_683, 0.478_628_670_499_366),
        (0.906_179_845_938_664, 0.236_926_885_056_189),
        (-0.906_179_845_938_664, 0.236_926_885_056_189),
    ];
    let (end, panels) = (16.0, 64);
    let half = 0.5 * end / f64::from(panels);
    let nodes = (0..panels).flat_map(|panel| {
        let middle = half * f64::from(2 * panel + 1);
        POINTS.map(|(at, weight)| (middle + half * at, weight * half))
    });
    nodes.collect()
});

/// J0(x s) for each s of the table of phi and each node x, `[steps, nodes]`. It is the same for all layers.
/// To compute it for each took 6 to 9 % of a simulation.
static BESSEL: LazyLock<Vec<f64>> = LazyLock::new(|| {
    let count = (REACH / STEP) as usize + 3;
    let steps = (0..count).map(|k| k as f64);
    let of_step = |k: f64| NODES.iter().map(move |&(x, _)| libm::j0(x * STEP * k));
    steps.flat_map(of_step).collect()
});

/// Distance in layer heights beyond which the layer does not move, because its Green's function has
/// decayed.
const REACH: f64 = 12.0;
/// Spacing of the table of phi, in layer heights. Linear interpolation errs by less than 1e-4 of
/// phi.
const STEP: f64 = 0.01;

/// S(x) of the bonded layer, with x = q h, k = 3 - 4 nu, the ratio m of the shear moduli, layer to
/// base, and k' of the base (O'Sullivan and King 1988):
/// `S = [1 + 4 c x e - l c e^2] / [1 - (l + c + 4 c x^2) e + l c e^2]`, `e = exp(-2x)`,
/// `c = (m - 1) / (m + k)`, `l = (m k' - k) / (m k' + 1)`. On a rigid base this is
/// `S = [k sinh 2x - 2x] / [k cosh 2x + (k^2 + 1) / 2 + 2 x^2]`.
fn layer_ratio(x: f64, nu: f64, base: Base) -> f64 {
    let k = 3.0 - 4.0 * nu;
    let m = base.shear_ratio;
    let own = m * (3.0 - 4.0 * base.nu);
    let (c, l) = ((m - 1.0) / (m + k), (own - k) / (own + 1.0));
    let e = (-2.0 * x).exp();
    (1.0 + 4.0 * c * x * e - l * c * e * e) / (1.0 - (l + c + 4.0 * c * x * x) * e + l * c * e * e)
}

/// E* K(0) / h = E* / M: the layer's compliance under uniform pressure, M the confined modulus.
pub(super) fn confined_compliance(nu: f64) -> f64 {
    // E* = E / (1 - nu^2), M = E (1 - nu) / ((1 + nu) (1 - 2 nu)).
    (1.0 - 2.0 * nu) / ((1.0 - nu) * (1.0 - nu))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::near;

    #[test]
    fn half_space_tends_to_the_point_load() {
        for (x, y) in [(20.0, 0.0), (12.0, 15.0), (-30.0, 4.0)] {
            let point = 1.0 / (PI * f64::hypot(x, y));
            near(half_space(x, y), point, 2e-3, "far away");
        }
        // The value at the centre of a uniformly loaded square of side 1 is 4 ln(1 + sqrt 2) / pi.
        let centre = 4.0 * (1.0 + 2_f64.sqrt()).ln() / PI;
        assert!((half_space(0.0, 0.0) - centre).abs() < 1e-12);
    }

    #[test]
    fn layer_sums_to_its_confined_compliance() {
        for (nu, height) in [(0.45, 1.143), (0.1, 6.0), (0.25, 10.0), (0.15, 0.8)] {
            let layer = Layer::new(nu, Base::RIGID);
            let reach = (REACH * height) as i32 + 1;
            let mut sum = 0.0;
            for i in -reach..=reach {
                for j in -reach..=reach {
                    sum += layer.influence(f64::from(i), f64::from(j), height);
                }
            }
            let expected = height * confined_compliance(nu);
            near(sum, expected, 5e-3, &format!("nu {nu}"));
        }
    }

    /// A core of Poisson's ratio 0.3, whose E is `core` times the E of a layer of Poisson's ratio
    /// `nu`.
    fn core(nu: f64, core: f64) -> Base {
        Base {
            nu: 0.3,
            shear_ratio: 1.3 / ((1.0 + nu) * core),
        }
    }

    #[test]
    fn a_core_like_its_layer_is_a_half_space_and_a_very_stiff_one_is_rigid() {
        let (same, stiff) = (
            Layer::new(0.3, core(0.3, 1.0)),
            Layer::new(0.4, core(0.4, 1e9)),
        );
        let rigid = Layer::new(0.4, Base::RIGID);
        for (x, y) in [(0.0, 0.0), (2.0, 1.0), (9.0, 4.0), (40.0, 3.0)] {
            let half_space = half_space(x, y);
            assert!((same.influence(x, y, 3.0) / half_space - 1.0).abs() < 1e-6);
            let off = stiff.influence(x, y, 3.0) - rigid.influence(x, y, 3.0);
            assert!(off.abs() < 1e-6 * half_space + 1e-8, "{off}");
        }
    }
}
