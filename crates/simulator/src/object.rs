//! Objects and their positions under the sensor: families, sizes, faces, postures.
//!
//! Lengths are in mm. x and y are in the sensor's plane, from its centre. Heights are measured
//! downwards from the highest point of the face.

use serde::{Deserialize, Serialize};

use super::contact::Axes;
use super::texture::Patch;
use crate::random::{Stream, log_even};

/// The distribution that the objects' shapes are drawn from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Shapes {
    /// One distribution for all materials. The test objects have the same geometry, posture and
    /// force in every test material, so shape cannot reveal the label.
    Matched,
    /// Like `matched`, but with radii from 8 to 60 mm, and with edges and points. One frame then
    /// says little of the hardness, because it fixes only R / E*.
    Wide,
    /// Plates, bars, boxes and discs with flat faces only, the same for all materials.
    Flat,
    /// As the paper's pictures suggest: rigid objects are mostly flat boxes, soft ones round. Part
    /// of any accuracy on these shapes comes from the shape.
    Paper,
}

/// The family of an object's shape.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Family {
    /// A ball.
    Ball,
    /// A cylinder.
    Cylinder,
    /// A box with crowned faces.
    Box,
    /// A wedge.
    Wedge,
    /// A pebble.
    Pebble,
    /// A cone, tip up.
    Point,
    /// A flat plate.
    Plate,
    /// A flat-faced bar.
    Bar,
    /// A flat-faced box.
    FlatBox,
    /// A flat round face.
    Disc,
}

impl Family {
    /// The names of the families, by their numbers.
    pub const NAMES: [&str; 10] = [
        "ball", "cylinder", "box", "wedge", "pebble", "point", "plate", "bar", "flat-box", "disc",
    ];
}

/// The number of postures that an object is pressed in (paper: "at least six").
pub(super) const POSTURES: usize = 6;
/// The depth beside the object, which no press reaches.
const NOTHING_MM: f64 = 1e3;

/// An object's outline, the same in every material.
#[derive(Debug, Clone)]
pub(super) struct Object {
    /// The family of its shape.
    pub(super) family: Family,
    solid: Solid,
    edge_mm: f64,
    /// Radius of curvature of the three pairs of faces; negative for hollow faces.
    crown_mm: [f64; 3],
}

#[derive(Debug, Clone, Copy)]
enum Solid {
    /// A ball or a pebble.
    Round {
        axes: [f64; 3],
    },
    Cylinder {
        radius: f64,
        length: f64,
    },
    Block {
        sides: [f64; 3],
    },
    Wedge {
        length: f64,
        tip: f64,
        flank_deg: f64,
    },
    /// A cone, tip up.
    Point {
        tip: f64,
        flank_deg: f64,
    },
    /// A body with a flat face and free sides.
    Flat {
        face: FlatFace,
        height: f64,
    },
}

/// The outline of a flat face.
#[derive(Debug, Clone, Copy)]
pub(super) enum FlatFace {
    Rectangle { sides_mm: [f64; 2] },
    Round { radius_mm: f64 },
}

/// The face that the sensor meets in one posture.
#[derive(Debug, Clone, Copy)]
pub(super) struct Face {
    outline: Outline,
    /// The height from the table to the highest point.
    pub(super) height_mm: f64,
    /// Standard deviation of the tilt in degrees: large for round objects, which roll, and small
    /// for flat ones.
    pub(super) tilt_sd_deg: f64,
    /// Factor on the texture's rms.
    pub(super) roughness: f64,
    /// The face of a body with flat faces and free sides. Such a face is pressed tilted and off its
    /// middle.
    pub(super) flat: Option<FlatFace>,
}

#[derive(Debug, Clone, Copy)]
enum Outline {
    Ellipsoid {
        x: f64,
        y: f64,
        z: f64,
    },
    Ridge {
        radius: f64,
        half_length: f64,
        edge: f64,
        flank_deg: f64,
    },
    Tip {
        radius: f64,
        flank_deg: f64,
    },
    Disc {
        radius: f64,
        edge: f64,
        crown: f64,
    },
    Rectangle {
        half_x: f64,
        half_y: f64,
        edge: f64,
        crown: f64,
    },
}

/// The face's position under the sensor in one press.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pose {
    turn_rad: f64,
    shift_mm: [f64; 2],
    /// Slopes along x and y.
    tilt: [f64; 2],
}

impl Pose {
    /// Draws a pose: the turn is uniform, the shift uniform within 6 mm, the tilt normal. A flat face
    /// shifts further and tilts up to 10 degrees, half of them less than 2.5.
    pub(super) fn draw(face: &Face, stream: &mut Stream) -> Self {
        let turn_rad = stream.range(0.0, std::f64::consts::TAU);
        if face.flat.is_some() {
            let mut shift = || stream.range(-FLAT_SHIFT_MM, FLAT_SHIFT_MM);
            let shift_mm = [shift(), shift()];
            let slope = (FLAT_TILT_DEG * stream.uniform().powi(2))
                .to_radians()
                .tan();
            let (sin, cos) = stream.range(0.0, std::f64::consts::TAU).sin_cos();
            return Self {
                turn_rad,
                shift_mm,
                tilt: [slope * cos, slope * sin],
            };
        }
        let shift_mm = [stream.range(-6.0, 6.0), stream.range(-6.0, 6.0)];
        let mut tilt = || (face.tilt_sd_deg * stream.normal()).to_radians().tan();
        Self {
            turn_rad,
            shift_mm,
            tilt: [tilt(), tilt()],
        }
    }

    /// A face in the middle of the sensor, parallel to it.
    #[cfg(test)]
    pub(super) const LEVEL: Self = Self {
        turn_rad: 0.0,
        shift_mm: [0.0; 2],
        tilt: [0.0; 2],
    };

    /// The same pose with another slope along x.
    #[cfg(test)]
    pub(super) fn tilted(self, slope: f64) -> Self {
        Self {
            tilt: [slope, 0.0],
            ..self
        }
    }

    /// The axes of the face on `width` x `width` cells around the sensor's centre.
    pub(super) fn axes(&self, width: usize, cell_mm: f64) -> Axes {
        let (sin, cos) = self.turn_rad.sin_cos();
        let first_mm = (0.5 - 0.5 * width as f64) * cell_mm;
        let (x, y) = (first_mm - self.shift_mm[0], first_mm - self.shift_mm[1]);
        Axes {
            first: [cos * x + sin * y, cos * y - sin * x],
            across: [cos * cell_mm, -sin * cell_mm],
        }
    }
}

/// How far a flat face shifts, and how far it tilts.
const FLAT_SHIFT_MM: f64 = 15.0;
const FLAT_TILT_DEG: f64 = 10.0;

/// Weights of ball, cylinder, box, wedge, pebble and point for the paper's rigid objects.
const RIGID: [f64; 6] = [0.05, 0.15, 0.62, 0.08, 0.10, 0.0];
/// The weights for the paper's soft objects.
const SOFT: [f64; 6] = [0.42, 0.18, 0.12, 0.03, 0.25, 0.0];
/// The weights for all objects of the matched shapes: the mean of the paper's two.
const MATCHED: [f64; 6] = [0.235, 0.165, 0.37, 0.055, 0.175, 0.0];
/// The weights for all objects of the wide shapes.
const WIDE: [f64; 6] = [0.20, 0.18, 0.26, 0.12, 0.14, 0.10];
/// Radii of balls, cylinders and crowns of the wide shapes in mm, log-uniform. Pebbles' axes are
/// within a tenth of such a radius.
const WIDE_RADIUS_MM: (f64, f64) = (8.0, 60.0);
/// Radii of edges and points of the wide shapes in mm. Sharper ones would fit between the taxels.
const WIDE_TIP_MM: (f64, f64) = (2.0, 10.0);

/// Weights of plate, bar, box and disc.
const FLAT: [f64; 4] = [0.3, 0.3, 0.25, 0.15];
/// Sides of plates, of the share of plates that is larger than most arrays, the narrow and the long
/// side of bars, sides of boxes, and diameters of discs, mm, log-uniform.
const PLATE_MM: (f64, f64) = (15.0, 60.0);
const LARGE_MM: (f64, f64) = (60.0, 120.0);
const LARGE_SHARE: f64 = 0.1;
const BAR_MM: (f64, f64) = (1.0, 15.0);
const LONG_MM: (f64, f64) = (15.0, 60.0);
const BOX_MM: (f64, f64) = (5.0, 60.0);
const DISC_MM: (f64, f64) = (3.0, 60.0);
/// Heights of plates, and of the others, mm, log-uniform.
const THIN_MM: (f64, f64) = (2.0, 20.0);
const HIGH_MM: (f64, f64) = (2.0, 40.0);
/// The most of a height over the narrow side. A more slender thing is part of a body, or gives way.
const SLENDER: f64 = 2.0;
/// Radii of the edges, mm, log-uniform, and of the faces' crown.
const EDGE_MM: (f64, f64) = (0.2, 4.0);
const FLAT_CROWN_MM: f64 = 1e6;

impl Object {
    /// Draws an object. `level` only matters for the paper's shapes.
    ///
    /// Faces are crowned, except those of the paper's rigid objects, which are flat. A single frame
    /// fixes R / E* and no more, so it carries the hardness only if the range of radii is narrow. A
    /// flat soft face touches as a whole, whatever its hardness.
    pub(super) fn draw(shapes: Shapes, level: u8, stream: &mut Stream) -> Self {
        let weights = match shapes {
            Shapes::Wide => WIDE,
            Shapes::Flat => return Self::flat(stream),
            Shapes::Matched => MATCHED,
            Shapes::Paper if level == 1 => RIGID,
            Shapes::Paper => SOFT,
        };
        let is_wide = shapes == Shapes::Wide;
        let is_flat = shapes == Shapes::Paper && level == 1;
        let radius = |matched: (f64, f64), stream: &mut Stream| match is_wide {
            true => log_even(WIDE_RADIUS_MM, stream),
            false => stream.range(matched.0, matched.1),
        };
        let tip = |stream: &mut Stream| match is_wide {
            true => log_even(WIDE_TIP_MM, stream),
            false => stream.range(4.0, 10.0),
        };
        let flank_deg = |stream: &mut Stream| stream.range(30.0, 45.0);
        let (family, solid) = match drawn(&weights, stream) {
            0 => {
                let axes = [radius((24.0, 30.0), stream); 3];
                (Family::Ball, Solid::Round { axes })
            }
            1 => {
                let radius = radius((16.0, 22.0), stream);
                let length = stream.range(30.0, 60.0);
                (Family::Cylinder, Solid::Cylinder { radius, length })
            }
            2 => {
                let sides = [(25.0, 60.0), (25.0, 60.0), (18.0, 45.0)];
                let sides = sides.map(|(low, high)| stream.range(low, high));
                (Family::Box, Solid::Block { sides })
            }
            3 => {
                let wedge = Solid::Wedge {
                    length: stream.range(25.0, 50.0),
                    tip: tip(stream),
                    flank_deg: flank_deg(stream),
                };
                (Family::Wedge, wedge)
            }
            4 => {
                let axes = if is_wide {
                    let radius = log_even(WIDE_RADIUS_MM, stream);
                    std::array::from_fn(|_| radius * stream.range(0.9, 1.1))
                } else {
                    std::array::from_fn(|_| stream.range(23.0, 29.0))
                };
                (Family::Pebble, Solid::Round { axes })
            }
            _ => {
                let point = Solid::Point {
                    tip: tip(stream),
                    flank_deg: flank_deg(stream),
                };
                (Family::Point, point)
            }
        };
        let edge_mm = stream.range(1.0, 4.0);
        let crown_mm = std::array::from_fn(|_| {
            if !is_flat {
                return radius((31.0, 42.0), stream);
            }
            let radius = stream.range(800.0, 6000.0);
            if stream.uniform() < 0.3 {
                -radius
            } else {
                radius
            }
        });
        Self {
            family,
            solid,
            edge_mm,
            crown_mm,
        }
    }

    /// Draws an object with flat faces, which stands or lies on something rigid.
    pub(super) fn flat(stream: &mut Stream) -> Self {
        let rectangle = |sides_mm| FlatFace::Rectangle { sides_mm };
        let (family, face) = match drawn(&FLAT, stream) {
            0 => {
                let sides = if stream.uniform() < LARGE_SHARE {
                    LARGE_MM
                } else {
                    PLATE_MM
                };
                let sides_mm = [log_even(sides, stream), log_even(sides, stream)];
                (Family::Plate, rectangle(sides_mm))
            }
            1 => {
                let sides_mm = [log_even(BAR_MM, stream), log_even(LONG_MM, stream)];
                (Family::Bar, rectangle(sides_mm))
            }
            2 => {
                let sides_mm = [log_even(BOX_MM, stream), log_even(BOX_MM, stream)];
                (Family::FlatBox, rectangle(sides_mm))
            }
            _ => {
                let radius_mm = 0.5 * log_even(DISC_MM, stream);
                (Family::Disc, FlatFace::Round { radius_mm })
            }
        };
        let narrow_mm = match face {
            FlatFace::Rectangle { sides_mm: [a, b] } => a.min(b),
            FlatFace::Round { radius_mm } => 2.0 * radius_mm,
        };
        let height = match family {
            Family::Plate => log_even(THIN_MM, stream),
            _ => log_even(HIGH_MM, stream),
        };
        Self {
            family,
            solid: Solid::Flat {
                face,
                height: height.min(SLENDER * narrow_mm),
            },
            edge_mm: log_even(EDGE_MM, stream).min(0.4 * narrow_mm),
            crown_mm: [FLAT_CROWN_MM; 3],
        }
    }

    /// The upper face in posture `posture` (0 to 5).
    pub(super) fn face(&self, posture: usize) -> Face {
        let edge = self.edge_mm;
        match self.solid {
            Solid::Round { axes } => {
                let up = posture % 3;
                let (x, y, z) = (axes[(up + 1) % 3], axes[(up + 2) % 3], axes[up]);
                Face {
                    tilt_sd_deg: 1.5,
                    roughness: if self.family == Family::Pebble {
                        2.0
                    } else {
                        1.0
                    },
                    ..Face::new(Outline::Ellipsoid { x, y, z }, 2.0 * z)
                }
            }
            // A cylinder has four postures on its side and one on each end.
            Solid::Cylinder { radius, length } if posture < 4 => {
                let ridge = Outline::Ridge {
                    radius,
                    half_length: 0.5 * length,
                    edge,
                    flank_deg: 90.0,
                };
                Face::new(ridge, 2.0 * radius)
            }
            Solid::Cylinder { radius, length } => {
                let crown = self.crown_mm[posture - 4];
                let disc = Outline::Disc {
                    radius,
                    edge,
                    crown,
                };
                Face::new(disc, length)
            }
            Solid::Block { sides } => {
                let up = (posture + 2) % 3;
                let sides_mm = [sides[(up + 1) % 3], sides[(up + 2) % 3]];
                let outline = FlatFace::Rectangle { sides_mm }.outline(edge, self.crown_mm[up]);
                Face::new(outline, sides[up])
            }
            Solid::Wedge {
                length,
                tip,
                flank_deg,
            } => {
                let ridge = Outline::Ridge {
                    radius: tip,
                    half_length: 0.5 * length,
                    edge,
                    flank_deg,
                };
                Face::new(ridge, WEDGE_HEIGHT_MM)
            }
            Solid::Point { tip, flank_deg } => {
                let radius = tip;
                Face::new(Outline::Tip { radius, flank_deg }, WEDGE_HEIGHT_MM)
            }
            Solid::Flat { face, height } => Face {
                flat: Some(face),
                ..Face::new(face.outline(edge, FLAT_CROWN_MM), height)
            },
        }
    }
}

impl FlatFace {
    fn outline(self, edge: f64, crown: f64) -> Outline {
        match self {
            Self::Rectangle { sides_mm: [a, b] } => Outline::Rectangle {
                half_x: 0.5 * a,
                half_y: 0.5 * b,
                edge,
                crown,
            },
            Self::Round { radius_mm } => Outline::Disc {
                radius: radius_mm,
                edge,
                crown,
            },
        }
    }
}

/// Draws an index with the probabilities `weights`.
fn drawn(weights: &[f64], stream: &mut Stream) -> usize {
    let mut rest = stream.uniform();
    let place = weights.iter().position(|&weight| {
        rest -= weight;
        rest < 0.0
    });
    // Rounding can leave a small rest, which goes to the last weight above 0.
    let last = weights.iter().rposition(|&weight| weight > 0.0);
    place.or(last).unwrap_or_default()
}

/// Height of wedges and points, which rest on their base with the tip up.
const WEDGE_HEIGHT_MM: f64 = 30.0;

impl Face {
    fn new(outline: Outline, height_mm: f64) -> Self {
        Self {
            outline,
            height_mm,
            tilt_sd_deg: 0.1,
            roughness: 1.0,
            flat: None,
        }
    }

    /// A flat disc with a small edge, held to within this tilt.
    pub(super) fn flat(radius_mm: f64, tilt_sd_deg: f64) -> Self {
        let outline = FlatFace::Round { radius_mm }.outline(0.5, FLAT_CROWN_MM);
        Self {
            tilt_sd_deg,
            ..Self::new(outline, 20.0)
        }
    }

    /// The face of a block.
    #[cfg(test)]
    pub(super) fn block(flat: FlatFace, height_mm: f64, edge_mm: f64) -> Self {
        Self {
            flat: Some(flat),
            ..Self::new(flat.outline(edge_mm, FLAT_CROWN_MM), height_mm)
        }
    }

    /// The top of a ball.
    pub(super) fn ball(radius: f64) -> Self {
        let [x, y, z] = [radius; 3];
        Self {
            tilt_sd_deg: 0.0,
            ..Self::new(Outline::Ellipsoid { x, y, z }, 2.0 * radius)
        }
    }

    /// Gap h in mm under a level sensor at `width` x `width` cells around the centre. The least gap
    /// is 0.
    pub(super) fn gap_mm(
        &self,
        pose: &Pose,
        patch: &Patch,
        width: usize,
        cell_mm: f64,
    ) -> Vec<f32> {
        let (sin, cos) = pose.turn_rad.sin_cos();
        let middle = 0.5 * width as f64;
        let mut gap = vec![NOTHING_MM as f32; width * width];
        for (k, gap) in gap.iter_mut().enumerate() {
            let at = |i: usize| (i as f64 + 0.5 - middle) * cell_mm;
            let (x, y) = (
                at(k % width) - pose.shift_mm[0],
                at(k / width) - pose.shift_mm[1],
            );
            let (u, v) = (cos * x + sin * y, cos * y - sin * x);
            let drop = self.outline.drop_mm(u, v);
            if drop < NOTHING_MM {
                let level = drop + pose.tilt[0] * x + pose.tilt[1] * y;
                *gap = level as f32 - patch.height_mm(u, v);
            }
        }
        let least = gap.iter().copied().fold(f32::INFINITY, f32::min);
        gap.iter_mut().for_each(|gap| *gap -= least);
        gap
    }
}

impl Outline {
    /// Depth in mm below the face's level at (`u`, `v`); [`NOTHING_MM`] beside the object.
    fn drop_mm(&self, u: f64, v: f64) -> f64 {
        match *self {
            Outline::Ellipsoid { x, y, z } => {
                let rest = 1.0 - (u / x).powi(2) - (v / y).powi(2);
                // The slope goes to infinity at the equator, which no contact reaches.
                if rest > 0.01 {
                    z * (1.0 - rest.sqrt())
                } else {
                    NOTHING_MM
                }
            }
            Outline::Ridge {
                radius,
                half_length,
                edge,
                flank_deg,
            } => {
                let end = rounded(u.abs() - (half_length - edge), 0.0, edge);
                end + flanked(radius, flank_deg, v.abs())
            }
            Outline::Tip { radius, flank_deg } => flanked(radius, flank_deg, u.hypot(v)),
            Outline::Disc {
                radius,
                edge,
                crown,
            } => {
                let r = u.hypot(v);
                rounded(r - (radius - edge), 0.0, edge) + crowned(crown, r)
            }
            Outline::Rectangle {
                half_x,
                half_y,
                edge,
                crown,
            } => {
                rounded(u.abs() - (half_x - edge), v.abs() - (half_y - edge), edge)
                    + crowned(crown, u.hypot(v))
            }
        }
        .min(NOTHING_MM)
    }
}

/// Drop of a rounded tip that continues as a flank, at `v` from its middle. A flank of 90 degrees
/// ends the object.
fn flanked(radius: f64, flank_deg: f64, v: f64) -> f64 {
    let turn = flank_deg.to_radians();
    let at = 0.99 * radius * turn.sin();
    if v < at {
        cap(radius, v)
    } else if flank_deg < 89.0 {
        cap(radius, at) + (v - at) * turn.tan()
    } else {
        NOTHING_MM
    }
}

/// Drop of an edge rounded with radius `edge`, at these distances past the start of the rounding.
fn rounded(past_u: f64, past_v: f64, edge: f64) -> f64 {
    let past = past_u.max(0.0).hypot(past_v.max(0.0));
    if past < 0.99 * edge {
        cap(edge, past)
    } else {
        NOTHING_MM
    }
}

/// Drop of a sphere of radius `crown`; a negative radius is hollow.
fn crowned(crown: f64, r: f64) -> f64 {
    if r >= 0.99 * crown.abs() {
        NOTHING_MM
    } else {
        crown.signum() * cap(crown.abs(), r)
    }
}

fn cap(radius: f64, r: f64) -> f64 {
    radius - (radius * radius - r * r).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flat_objects_have_faces_of_one_to_sixty_mm_and_more() {
        let mut narrow = Vec::new();
        let mut families = [0; Family::NAMES.len()];
        for k in 0..2000 {
            let object = Object::flat(&mut Stream::new(3, "flat").child(k));
            let Solid::Flat { face, height } = object.solid else {
                panic!("{object:?} is not flat");
            };
            families[object.family as usize] += 1;
            let narrow_mm = match face {
                FlatFace::Rectangle { sides_mm: [a, b] } => a.min(b),
                FlatFace::Round { radius_mm } => 2.0 * radius_mm,
            };
            assert!(height <= 40.0 && height <= 2.0 * narrow_mm, "{object:?}");
            assert!((0.2..=4.0).contains(&object.edge_mm), "{object:?}");
            assert!(2.0 * object.edge_mm < narrow_mm, "{object:?}");
            narrow.push(narrow_mm);
        }
        narrow.sort_by(f64::total_cmp);
        assert!(narrow[0] < 1.1 && narrow[1900] > 30.0 && narrow[1999] > 60.0);
        let flat = &families[Family::Plate as usize..];
        assert!(flat.iter().all(|&count| count > 200), "{families:?}");
        assert_eq!(flat.iter().sum::<i32>(), 2000);
    }
}
