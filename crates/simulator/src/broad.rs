//! Broad materials: each object gets a material that is drawn for it.
//!
//! In: a stream. Out: a [`Body`] whose modulus follows from the Shore hardness by the durometer, so
//! that the label is the durometer's reading. The ranges contain each number of the eight named
//! materials, except for creep: three of them have one element, and a broad material has two. Three
//! ranges have such a number near their middle.

use super::durometer::{self, Durometer};
use super::level::level_of;
use super::material::{Body, Material};
use super::substance::{Creep, Law, Substance, Texture};
use crate::random::{Stream, log_even};

/// The names of the laws' materials in a data set, where `foam` alone is a named material: elastic
/// solids, solids that flow, foams, and thin soft layers on a stiff core.
pub(super) const LAWS: [&str; 4] = [
    "broad-solid",
    "broad-plastic",
    "broad-foam",
    "broad-layered",
];

/// The softest and the hardest reading of the objects that are drawn by their Shore hardness.
const SHORE: (f64, f64) = (15.0, 95.0);
/// Share of level 1's objects that is drawn by the modulus.
const STIFF_SHARE: f64 = 0.5;
/// Range of the moduli of objects drawn by the modulus, MPa, log-uniform.
const STIFF_MPA: (f64, f64) = (5.0, 3000.0);
/// Ranges of Poisson's ratio of solids, plastics, foams and layers, uniform.
const NU: [(f64, f64); 4] = [(0.33, 0.49), (0.38, 0.49), (0.05, 0.30), (0.10, 0.49)];
/// p_H of plastics relative to E, log-uniform.
const HARDNESS: (f64, f64) = (1.0 / 20.0, 1.0 / 4.0);
/// m, s_p relative to E (log-uniform) and e_D of foams.
const EXPONENT: (f64, f64) = (2.0, 3.0);
const PLATEAU: (f64, f64) = (0.08, 0.50);
const STRAIN: (f64, f64) = (0.30, 0.60);
/// Thickness of a layer in mm, and the core's modulus relative to the layer's, both log-uniform.
const THICKNESS_MM: (f64, f64) = (1.5, 10.0);
const CORE: (f64, f64) = (20.0, 2000.0);
/// The least ratio of a layer's thickness to the durometer's depth. A thinner layer would be
/// squeezed to nothing, and the reading would depend on the core beneath it.
const LAYER_PER_DEPTH: f64 = 1.25;
/// The two terms of creep: j uniform, tau log-uniform.
const CREEP: [((f64, f64), (f64, f64)); 2] =
    [((0.03, 0.35), (0.15, 0.6)), ((0.02, 0.35), (1.0, 4.0))];
/// Texture: rms in um and wavelengths in mm log-uniform; Hurst exponent and anisotropy uniform.
const RMS_UM: (f64, f64) = (30.0, 170.0);
const SHORTEST_MM: (f64, f64) = (2.0, 5.0);
const LONGEST_MM: (f64, f64) = (8.0, 40.0);
const HURST: (f64, f64) = (0.4, 0.9);
const ANISOTROPY: (f64, f64) = (1.0, 2.0);

/// Draws what an object of this material is made of; of a random material without one.
pub(super) fn body_of(material: Option<Material>, stream: &mut Stream) -> Body {
    match material {
        Some(material) => Body::named(material, stream),
        None => draw(stream),
    }
}

/// Draws an object's material.
///
/// The Shore hardness is uniform from 15 to 95. Half of level 1 is stiffer than the durometer can
/// distinguish well. There the modulus is log-uniform and the Shore hardness is the durometer's
/// reading. A soft law whose reading falls into another level is drawn again. The stiff half has no
/// layered objects, because a layer is the soft part of its object.
fn draw(stream: &mut Stream) -> Body {
    let (softest, hardest) = SHORE;
    let shore = hardest - (hardest - softest) * stream.uniform();
    if level_of(shore) == 1 && stream.uniform() < STIFF_SHARE {
        return stiff(stream);
    }
    let law = stream.below(LAWS.len());
    let substance = substance(law, shore, stream);
    let young_mpa = Durometer::new(&substance).young_mpa(shore);
    body(law, substance, young_mpa, shore)
}

fn stiff(stream: &mut Stream) -> Body {
    loop {
        let law = stream.below(LAWS.len() - 1);
        let young_mpa = log_even(STIFF_MPA, stream);
        let substance = substance(law, 100.0, stream);
        let shore = Durometer::new(&substance).reading(young_mpa);
        if level_of(shore) == 1 {
            return body(law, substance, young_mpa, shore);
        }
    }
}

fn body(law: usize, substance: Substance, young_mpa: f64, shore: f64) -> Body {
    Body {
        substance,
        young_mpa,
        shore,
        level: level_of(shore),
        material: (Material::ALL.len() + law) as u8,
    }
}

/// Draws the properties of a material with the law of this index.
fn substance(law: usize, shore: f64, stream: &mut Stream) -> Substance {
    let nu = even(NU[law], stream);
    let law = match law {
        0 => Law::Solid,
        1 => Law::Plastic {
            hardness: log_even(HARDNESS, stream),
        },
        2 => Law::Foam {
            exponent: even(EXPONENT, stream),
            plateau: log_even(PLATEAU, stream),
            strain: even(STRAIN, stream),
        },
        _ => {
            let (least, most) = THICKNESS_MM;
            let least = least.max(LAYER_PER_DEPTH * durometer::depth_mm(shore));
            Law::Layered {
                thickness_mm: log_even((least, most), stream),
                core: log_even(CORE, stream),
            }
        }
    };
    Substance {
        nu,
        law,
        creep: CREEP.map(|(j, tau_s)| Creep {
            j: even(j, stream),
            tau_s: log_even(tau_s, stream),
        }),
        texture: Texture {
            rms_um: log_even(RMS_UM, stream),
            shortest_mm: log_even(SHORTEST_MM, stream),
            longest_mm: log_even(LONGEST_MM, stream),
            hurst: even(HURST, stream),
            anisotropy: even(ANISOTROPY, stream),
        },
    }
}

fn even((low, high): (f64, f64), stream: &mut Stream) -> f64 {
    stream.range(low, high)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_durometer_reads_what_a_drawn_object_is_labelled_with() {
        let mut stream = Stream::new(2, "labels");
        for _ in 0..32 {
            let body = draw(&mut stream);
            let read = Durometer::new(&body.substance).reading(body.young_mpa);
            assert!((read - body.shore).abs() < 0.1, "reads {read}: {body:?}");
            assert_eq!(body.level, level_of(body.shore));
        }
    }

    #[test]
    fn shore_and_laws_are_even_and_half_of_level_1_is_stiff() {
        let mut stream = Stream::new(3, "broad");
        let bodies: Vec<Body> = (0..400).map(|_| draw(&mut stream)).collect();
        let count = |is: &dyn Fn(&Body) -> bool| bodies.iter().filter(|body| is(body)).count();
        // Of 80 degrees, 20 are in each of these ranges.
        for from in [15.0, 30.0, 50.0] {
            let within = count(&|body| from < body.shore && body.shore <= from + 20.0);
            assert!((70..130).contains(&within), "{within} from {from}");
        }
        for (material, law) in (8..).zip(LAWS) {
            let own = count(&|body| body.material == material);
            assert!((60..135).contains(&own), "{law}: {own} of 400");
        }
        // Level 1 is 25 of 80, and half of it is stiff. Of that half,
        // log(3000 / 100) / log(3000 / 5), or 53 %, has a modulus above 100 MPa.
        let stiff = count(&|body| {
            let is_layered = matches!(body.substance.law, Law::Layered { .. });
            assert!(!is_layered || body.young_mpa < 100.0, "{body:?}");
            body.young_mpa > 100.0
        });
        assert!((18..50).contains(&stiff), "{stiff} of 400");
    }
}
