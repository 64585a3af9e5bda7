//! Objects and their positions under the sensor: families, sizes, faces, postures.
//!
//! Lengths are in mm. x and y are in the sensor's plane, from its centre. Heights are measured
//! downwards from the highest point of the face.

use std::f64::consts::TAU;

use serde::{Deserialize, Serialize};

use super::texture::Patch;
use crate::random::{Stream, log_even};
use crate::{CELL_MM, CELLS};

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

/// The number of postures that an object is pressed in (paper: "at least six").
pub(super) const POSTURES: usize = 6;
/// The depth beside the object, which no press reaches.
const NOTHING_MM: f64 = 1e3;

/// An object's upper face in each posture, the same in every material.
pub(super) type Object = [Face; POSTURES];

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
    Flat {
        flat: FlatFace,
        edge: f64,
        crown: f64,
    },
}

/// The face's position under the sensor in one press.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pose {
    pub(super) turn_rad: f64,
    pub(super) shift_mm: [f64; 2],
    /// Slopes along x and y.
    pub(super) tilt: [f64; 2],
}

impl Pose {
    /// Draws a pose: the turn is uniform, the shift uniform within 6 mm, the tilt normal. A flat face
    /// shifts further and tilts up to 10 degrees, half of them less than 2.5.
    pub(super) fn draw(face: &Face, stream: &mut Stream) -> Self {
        let turn_rad = stream.range(0.0, TAU);
        let most_mm = face.flat.map_or(SHIFT_MM, |_| FLAT_SHIFT_MM);
        let shift_mm = [(); 2].map(|()| stream.range(-most_mm, most_mm));
        let tilt = if face.flat.is_some() {
            let slope = FLAT_TILT_DEG * stream.uniform().powi(2);
            let (sin, cos) = stream.range(0.0, TAU).sin_cos();
            [cos, sin].map(|along| slope.to_radians().tan() * along)
        } else {
            [(); 2].map(|()| (face.tilt_sd_deg * stream.normal()).to_radians().tan())
        };
        Self {
            turn_rad,
            shift_mm,
            tilt,
        }
    }

    /// The axes of the face on the cells of the sensor.
    pub(super) fn axes(&self) -> Axes {
        let (sin, cos) = self.turn_rad.sin_cos();
        let first_mm = (0.5 - 0.5 * CELLS as f64) * CELL_MM;
        let (x, y) = (first_mm - self.shift_mm[0], first_mm - self.shift_mm[1]);
        Axes {
            first: [cos * x + sin * y, cos * y - sin * x],
            across: [cos * CELL_MM, -sin * CELL_MM],
        }
    }
}

/// The places of cells in the axes of a face, mm from its middle.
#[derive(Debug, Clone, Copy)]
pub(super) struct Axes {
    /// The place of the first cell.
    first: [f64; 2],
    /// From a cell to the next one in its row.
    pub(super) across: [f64; 2],
}

impl Axes {
    /// The place of a cell.
    pub(super) fn at(&self, row: usize, column: usize) -> [f64; 2] {
        let (row, column) = (row as f64, column as f64);
        let [cos, sin] = [self.across[0], -self.across[1]];
        let u = self.first[0] + column * cos + row * sin;
        let v = self.first[1] + row * cos - column * sin;
        [u, v]
    }

    /// The axes on the cells from this one on.
    pub(super) fn from(self, (row, column): (usize, usize)) -> Self {
        Self {
            first: self.at(row, column),
            ..self
        }
    }
}

/// How far a face shifts, how far a flat one does, and how far that tilts.
const SHIFT_MM: f64 = 6.0;
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

/// Draws an object. `level` only matters for the paper's shapes.
///
/// Faces are crowned, except those of the paper's rigid objects, which are flat. A single frame
/// fixes R / E* and no more, so it carries the hardness only if the range of radii is narrow. A
/// flat soft face touches as a whole, whatever its hardness.
pub(super) fn draw(shapes: Shapes, level: u8, stream: &mut Stream) -> Object {
    let weights = match shapes {
        Shapes::Wide => WIDE,
        Shapes::Flat => return flat(stream),
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
    // The face in a posture, by the radii of the edges and of the three pairs of faces, which are
    // drawn after the sizes.
    type Faces = Box<dyn Fn(usize, f64, [f64; 3]) -> Face>;
    let face: Faces = match drawn(&weights, stream) {
        0 => {
            let axes = [radius((24.0, 30.0), stream); 3];
            Box::new(move |posture, _, _| Face::round(axes, posture, 1.0))
        }
        1 => {
            let radius = radius((16.0, 22.0), stream);
            let length = stream.range(30.0, 60.0);
            // Four postures on its side and one on each end.
            let end = FlatFace::Round { radius_mm: radius };
            Box::new(move |posture, edge, crown| match posture {
                0..4 => Face::ridge(radius, length, edge, 90.0, 2.0 * radius),
                _ => Face::crowned(end, edge, crown[posture - 4], length),
            })
        }
        2 => {
            let sides = [(25.0, 60.0), (25.0, 60.0), (18.0, 45.0)];
            let sides = sides.map(|(low, high)| stream.range(low, high));
            Box::new(move |posture, edge, crown| {
                let up = (posture + 2) % 3;
                let sides_mm = [sides[(up + 1) % 3], sides[(up + 2) % 3]];
                let side = FlatFace::Rectangle { sides_mm };
                Face::crowned(side, edge, crown[up], sides[up])
            })
        }
        3 => {
            let (length, tip) = (stream.range(25.0, 50.0), tip(stream));
            let flank_deg = flank_deg(stream);
            Box::new(move |_, edge, _| Face::ridge(tip, length, edge, flank_deg, WEDGE_HEIGHT_MM))
        }
        4 => {
            let axes = if is_wide {
                let radius = log_even(WIDE_RADIUS_MM, stream);
                std::array::from_fn(|_| radius * stream.range(0.9, 1.1))
            } else {
                std::array::from_fn(|_| stream.range(23.0, 29.0))
            };
            Box::new(move |posture, _, _| Face::round(axes, posture, 2.0))
        }
        _ => {
            let (radius, flank_deg) = (tip(stream), flank_deg(stream));
            let outline = Outline::Tip { radius, flank_deg };
            Box::new(move |_, _, _| Face::new(outline, WEDGE_HEIGHT_MM))
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
    std::array::from_fn(|posture| face(posture, edge_mm, crown_mm))
}

/// Draws an object with flat faces, which stands or lies on something rigid.
pub(super) fn flat(stream: &mut Stream) -> Object {
    let rectangle = |stream: &mut Stream, one, other| FlatFace::Rectangle {
        sides_mm: [log_even(one, stream), log_even(other, stream)],
    };
    let kind = drawn(&FLAT, stream);
    let flat = match kind {
        0 if stream.uniform() < LARGE_SHARE => rectangle(stream, LARGE_MM, LARGE_MM),
        0 => rectangle(stream, PLATE_MM, PLATE_MM),
        1 => rectangle(stream, BAR_MM, LONG_MM),
        2 => rectangle(stream, BOX_MM, BOX_MM),
        _ => FlatFace::Round {
            radius_mm: 0.5 * log_even(DISC_MM, stream),
        },
    };
    let narrow_mm = flat.narrow_mm();
    let height = log_even(if kind == 0 { THIN_MM } else { HIGH_MM }, stream);
    let edge_mm = log_even(EDGE_MM, stream).min(0.4 * narrow_mm);
    [Face::block(flat, height.min(SLENDER * narrow_mm), edge_mm); POSTURES]
}

impl FlatFace {
    /// The narrow side.
    fn narrow_mm(self) -> f64 {
        match self {
            Self::Rectangle { sides_mm: [a, b] } => a.min(b),
            Self::Round { radius_mm } => 2.0 * radius_mm,
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

    /// The top of a ball or a pebble, with this factor on the roughness.
    fn round(axes: [f64; 3], posture: usize, roughness: f64) -> Self {
        let up = posture % 3;
        let [x, y, z] = [axes[(up + 1) % 3], axes[(up + 2) % 3], axes[up]];
        Self {
            tilt_sd_deg: 1.5,
            roughness,
            ..Self::new(Outline::Ellipsoid { x, y, z }, 2.0 * z)
        }
    }

    /// A cylinder on its side, or an edge whose flanks fall at this angle.
    fn ridge(radius: f64, length: f64, edge: f64, flank_deg: f64, height_mm: f64) -> Self {
        let ridge = Outline::Ridge {
            radius,
            half_length: 0.5 * length,
            edge,
            flank_deg,
        };
        Self::new(ridge, height_mm)
    }

    /// A face that is crowned, or nearly flat.
    fn crowned(flat: FlatFace, edge: f64, crown: f64, height_mm: f64) -> Self {
        Self::new(Outline::Flat { flat, edge, crown }, height_mm)
    }

    /// A flat disc with a small edge, held to within this tilt.
    pub(super) fn flat(radius_mm: f64, tilt_sd_deg: f64) -> Self {
        let flat = FlatFace::Round { radius_mm };
        Self {
            tilt_sd_deg,
            ..Self::crowned(flat, 0.5, FLAT_CROWN_MM, 20.0)
        }
    }

    /// The flat face of a body with free sides.
    pub(super) fn block(flat: FlatFace, height_mm: f64, edge_mm: f64) -> Self {
        Self {
            flat: Some(flat),
            ..Self::crowned(flat, edge_mm, FLAT_CROWN_MM, height_mm)
        }
    }

    /// The top of a ball that does not roll.
    pub(super) fn ball(radius: f64) -> Self {
        Self {
            tilt_sd_deg: 0.0,
            ..Self::round([radius; 3], 0, 1.0)
        }
    }

    /// Gap h in mm under a level sensor at each of its cells. The least gap
    /// is 0.
    pub(super) fn gap_mm(&self, pose: &Pose, patch: &Patch) -> Vec<f32> {
        let (sin, cos) = pose.turn_rad.sin_cos();
        let middle = 0.5 * CELLS as f64;
        let mut gap = vec![NOTHING_MM as f32; CELLS * CELLS];
        for (k, gap) in gap.iter_mut().enumerate() {
            let at = |i: usize| (i as f64 + 0.5 - middle) * CELL_MM;
            let x = at(k % CELLS) - pose.shift_mm[0];
            let y = at(k / CELLS) - pose.shift_mm[1];
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
            Outline::Flat { flat, edge, crown } => {
                let [past_u, past_v] = match flat {
                    FlatFace::Rectangle { sides_mm: [a, b] } => {
                        [u.abs() - (0.5 * a - edge), v.abs() - (0.5 * b - edge)]
                    }
                    FlatFace::Round { radius_mm } => [u.hypot(v) - (radius_mm - edge), 0.0],
                };
                rounded(past_u, past_v, edge) + crowned(crown, u.hypot(v))
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
        for k in 0..2000 {
            let [face, ..] = flat(&mut Stream::new(3, "flat").child(k));
            let narrow_mm = face.flat.expect("a flat face").narrow_mm();
            let most_mm = (2.0 * narrow_mm).min(40.0);
            assert!(face.height_mm <= most_mm, "{face:?}");
            narrow.push(narrow_mm);
        }
        narrow.sort_by(f64::total_cmp);
        assert!(narrow[0] < 1.1 && narrow[1900] > 30.0 && narrow[1999] > 60.0);
    }
}
