//! An object's substance, apart from its hardness: law, creep and texture.

use serde::Deserialize;

use super::kernel::Base;

/// The law of the bulk. Stresses and moduli are relative to Young's modulus E.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Law {
    /// Elastic half-space.
    Solid,
    /// Elastic half-space that flows: p_H, the hardness.
    Plastic { hardness: f64 },
    /// Bonded layer of the object's height, with a plateau: m (exponent), s_p (plateau stress) and
    /// e_D (strain at which the cells have closed).
    Foam {
        exponent: f64,
        plateau: f64,
        strain: f64,
    },
    /// A layer of modulus E bonded to an elastic half-space: the layer's thickness, and the core's
    /// modulus.
    Layered { thickness_mm: f64, core: f64 },
}

/// Poisson's ratio of the core under a layer.
const CORE_NU: f64 = 0.3;

/// One term of the creep compliance, `j (1 - exp(-t / tau))`.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub(super) struct Creep {
    pub(super) j: f64,
    pub(super) tau_s: f64,
}

impl Creep {
    /// A term without effect.
    pub(super) const NONE: Self = Self { j: 0.0, tau_s: 1.0 };
}

/// Roughness of a face.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub(super) struct Texture {
    pub(super) rms_um: f64,
    pub(super) shortest_mm: f64,
    pub(super) longest_mm: f64,
    pub(super) hurst: f64,
    pub(super) anisotropy: f64,
}

/// The properties of a material except its modulus.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub(super) struct Substance {
    /// Poisson's ratio.
    pub(super) nu: f64,
    pub(super) law: Law,
    pub(super) creep: [Creep; 2],
    pub(super) texture: Texture,
}

impl Substance {
    /// The terms of the creep compliance that have an effect.
    pub(super) fn creep(&self) -> impl Iterator<Item = &Creep> {
        self.creep.iter().filter(|creep| creep.j > 0.0)
    }

    /// The creep compliance over its instantaneous value: J(t) / J0 = 1 + sum j
    /// (1 - exp(-t / tau)).
    pub(super) fn compliance_ratio(&self, time_s: f64) -> f64 {
        let terms = self.creep().map(|c| c.j * -(-time_s / c.tau_s).exp_m1());
        1.0 + terms.sum::<f64>()
    }

    /// The base and the height in mm of the layer that bears a load, for an object `height_mm`
    /// high. `None` for a half-space.
    pub(super) fn layer(&self, height_mm: f64) -> Option<(Base, f64)> {
        match self.law {
            Law::Solid | Law::Plastic { .. } => None,
            Law::Foam { .. } => Some((Base::RIGID, height_mm)),
            Law::Layered { thickness_mm, core } => {
                let base = Base {
                    nu: CORE_NU,
                    shear_ratio: (1.0 + CORE_NU) / ((1.0 + self.nu) * core),
                };
                Some((base, thickness_mm))
            }
        }
    }

    /// The plane-strain modulus E / (1 - nu^2).
    pub(super) fn plane_strain(&self, young_mpa: f64) -> f64 {
        young_mpa / (1.0 - self.nu * self.nu)
    }
}
