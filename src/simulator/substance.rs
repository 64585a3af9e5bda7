//! What an object is made of: law, creep and texture, whatever its hardness.

use super::kernel::Base;

/// How the bulk answers beyond linear elasticity. Stresses and moduli are relative to E.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Law {
    /// Elastic half-space.
    Solid,
    /// Elastic half-space that flows: p_H.
    Plastic { hardness: f64 },
    /// Bonded layer of the object's height, with a plateau: m, s_p, e_D.
    Foam {
        exponent: f64,
        plateau: f64,
        strain: f64,
    },
    /// A layer of E bonded to an elastic half-space: its thickness, and the core's modulus.
    Layered { thickness_mm: f64, core: f64 },
}

/// Poisson's ratio of the core under a layer.
const CORE_NU: f64 = 0.3;

/// One term of the creep compliance, `j (1 - exp(-t / tau))`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Creep {
    pub(super) j: f64,
    pub(super) tau_s: f64,
}

impl Creep {
    /// No term.
    pub(super) const NONE: Self = Self { j: 0.0, tau_s: 1.0 };
}

/// Roughness of a face.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Texture {
    pub(super) rms_um: f64,
    pub(super) shortest_mm: f64,
    pub(super) longest_mm: f64,
    pub(super) hurst: f64,
    pub(super) anisotropy: f64,
}

/// What an object is made of, but for its modulus.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Substance {
    /// Poisson's ratio.
    pub(super) nu: f64,
    pub(super) law: Law,
    pub(super) creep: [Creep; 2],
    pub(super) texture: Texture,
}

impl Substance {
    /// The terms of its creep compliance.
    pub(super) fn creep(&self) -> impl Iterator<Item = &Creep> {
        self.creep.iter().filter(|creep| creep.j > 0.0)
    }

    /// J(t) / J0 = 1 + sum j (1 - exp(-t / tau)).
    pub(super) fn compliance_ratio(&self, time_s: f64) -> f64 {
        1.0 + self
            .creep()
            .map(|c| c.j * -(-time_s / c.tau_s).exp_m1())
            .sum::<f64>()
    }

    /// The layer that answers a load, by its base and height in mm, of an object `height_mm` high;
    /// `None`: a half-space.
    pub(super) fn layer(&self, height_mm: f64) -> Option<(Base, f64)> {
        match self.law {
            Law::Solid | Law::Plastic { .. } => None,
            Law::Foam { .. } => Some((Base::Rigid, height_mm)),
            Law::Layered { thickness_mm, core } => {
                let base = Base::Elastic {
                    nu: CORE_NU,
                    shear_ratio: (1.0 + CORE_NU) / ((1.0 + self.nu) * core),
                };
                Some((base, thickness_mm))
            }
        }
    }

    /// E / (1 - nu^2).
    pub(super) fn plane_strain(&self, young_mpa: f64) -> f64 {
        young_mpa / (1.0 - self.nu * self.nu)
    }
}
