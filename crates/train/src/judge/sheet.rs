//! A picture of simulated presses, to check the data by eye before they are used.
//!
//! In: labelled samples and sequences. Out: the bytes of a PNG, all taxels on one logarithmic
//! colour scale in newtons. Writes no file.

use std::collections::BTreeMap;

use super::canvas::{Canvas, GAP, MARGIN, TEXT, TILE};
use crate::data::dataset::laid;
use hardnessd_core::frame::{Array, Frame, RawFrame};
use hardnessd_core::press;
use hardnessd_core::verdict::ModelFrame;
use hardnessd_simulator::{
    CourseMoment, LabelledCourse, LabelledSample, Material, Materials, NEWTONS_PER_COUNT,
    Reference, material_names,
};

/// Frames in a row of the sheet.
pub const TILES: usize = 12;
const ROW: usize = TILE + TEXT + GAP;
const HEAD: usize = 2 * TEXT + GAP;
const FOOT: usize = 56;

/// Draws up to twelve samples of each material, from the lightest press to the hardest, and up to
/// twelve frames of each sequence, spread over its first press. The baseline of a sequence is taken
/// to be zero.
///
/// # Errors
///
/// Returns an error if the PNG encoder fails.
pub fn sheet(
    samples: &[LabelledSample],
    sequences: &[(Material, Vec<RawFrame>)],
) -> anyhow::Result<Vec<u8>> {
    let mut materials: Vec<u8> = samples.iter().map(|sample| sample.material).collect();
    materials.sort_unstable();
    materials.dedup();
    let width = MARGIN + TILES * (TILE + GAP);
    let height = HEAD + materials.len() * ROW + HEAD + sequences.len() * ROW + FOOT;
    let mut canvas = Canvas::new(width, height);
    let threshold_n = contact_threshold_n();
    let title =
        format!("samples: force, Shore hardness, contact area in taxels at {threshold_n} N");
    canvas.text(GAP, GAP, &title);
    let mut top = HEAD;
    for &material in &materials {
        let mut of_material: Vec<&LabelledSample> = samples
            .iter()
            .filter(|sample| sample.material == material)
            .collect();
        name(&mut canvas, top, usize::from(material));
        of_material.sort_by(|a, b| a.force_n.total_cmp(&b.force_n));
        for (tile, sample) in spread(&of_material).enumerate() {
            let area = sample.frame.contact_area_taxels(threshold_n);
            let caption = format!("{:.0} N, {:.0}, {area}", sample.force_n, sample.shore);
            canvas.tile(tile, top, &laid(&sample.frame), &caption);
        }
        top += ROW;
    }
    if !sequences.is_empty() {
        canvas.text(
            GAP,
            top + GAP,
            "sequences: one press from touch to release, frame number, force read",
        );
    }
    top += HEAD;
    for (material, frames) in sequences {
        name(&mut canvas, top, usize::from(material.index()));
        let press = first_press(frames);
        for (tile, &(number, raw)) in spread(&press).enumerate() {
            let frame = of_counts(&raw.counts);
            canvas.tile(
                tile,
                top,
                &frame,
                &format!("{number}: {:.1} N", frame.force_n()),
            );
        }
        top += ROW;
    }
    canvas.colour_bar(top + GAP);
    canvas.png()
}

/// The frame with these counts of the simulated sensor.
fn of_counts(counts: &[u16]) -> ModelFrame {
    let newtons = counts.iter();
    laid(&Frame {
        array: Array::JX255N,
        newtons: newtons
            .map(|&counts| f32::from(counts) * NEWTONS_PER_COUNT)
            .collect(),
    })
}

/// A named row of frames, each with a caption.
#[derive(Debug)]
pub struct Strip<'a> {
    /// The row's name, drawn to the left of the frames.
    pub name: String,
    /// The frames with their captions. At most twelve are drawn.
    pub tiles: Vec<(&'a ModelFrame, String)>,
}

impl<'a> Strip<'a> {
    /// A row of frames whose captions give contact area, force and greatest taxel.
    pub fn of(name: &str, frames: impl Iterator<Item = &'a ModelFrame>) -> Self {
        let tile = |frame: &'a ModelFrame| {
            let peak = frame.newtons.iter().copied().fold(0.0, f32::max);
            let area = frame.contact_area_taxels(contact_threshold_n());
            let force = frame.force_n();
            (frame, format!("{area}, {force:.0} N, {peak:.1} N"))
        };
        Self {
            name: name.to_owned(),
            tiles: frames.map(tile).collect(),
        }
    }
}

fn contact_threshold_n() -> f32 {
    press::Thresholds::default().contact_threshold_n
}

/// The meaning of the captions of [`Strip::of`], for titles.
pub fn captions() -> String {
    format!(
        "contact area in taxels at {} N, force, greatest taxel",
        contact_threshold_n()
    )
}

/// Draws rows of frames under a title.
///
/// # Errors
///
/// Returns an error if the PNG encoder fails.
pub fn strips(title: &str, strips: &[Strip]) -> anyhow::Result<Vec<u8>> {
    let width = MARGIN + TILES * (TILE + GAP);
    let mut canvas = Canvas::new(width, HEAD + strips.len() * ROW + FOOT);
    canvas.text(GAP, GAP, title);
    let mut top = HEAD;
    for strip in strips {
        canvas.text(GAP, top + TILE / 2, &strip.name);
        for (tile, (frame, caption)) in strip.tiles.iter().take(TILES).enumerate() {
            canvas.tile(tile, top, frame, caption);
        }
        top += ROW;
    }
    canvas.colour_bar(top + GAP);
    canvas.png()
}

/// Writes a row's name: its material and level. Only a named material has one level.
fn name(canvas: &mut Canvas, top: usize, material: usize) {
    let name = material_names(Materials::Broad)[material];
    canvas.text(GAP, top + TILE / 2 - TEXT, name);
    let level = Material::ALL.get(material).map(|named| named.level());
    let level = level.map_or_else(|| "all levels".to_owned(), |level| format!("level {level}"));
    canvas.text(GAP, top + TILE / 2, &level);
}

/// Draws one press of each material and level over time. The captions give seconds, the arm's
/// approach in mm and the newtons read.
///
/// # Errors
///
/// Returns an error if the PNG encoder fails.
pub fn courses(courses: &[LabelledCourse]) -> anyhow::Result<Vec<u8>> {
    let mut shown: BTreeMap<(u8, u8), &LabelledCourse> = BTreeMap::new();
    for course in courses {
        let key = (course.material, course.level);
        shown.entry(key).or_insert(course);
    }
    let named = shown.into_values().map(|course| {
        let name = material_names(Materials::Broad)[usize::from(course.material)];
        let name = format!("{} {:.0}", name.trim_start_matches("broad-"), course.shore);
        (name, course)
    });
    over_time("names with Shore hardness", named)
}

/// The number of presses of [`sensors`], and of sensors that read each.
const SHOWN: (usize, usize) = (3, 5);

/// Draws what several sensors read of the same press of an object, a flat piece and a ball. The
/// captions are those of [`courses`].
///
/// # Errors
///
/// Returns an error if the PNG encoder fails.
pub fn sensors(courses: &[LabelledCourse]) -> anyhow::Result<Vec<u8>> {
    // The sensors that read a press have its object and its force in common.
    let mut presses: BTreeMap<(u32, u32), Vec<&LabelledCourse>> = BTreeMap::new();
    for course in courses {
        let key = (course.object, course.force_n.to_bits());
        presses.entry(key).or_default().push(course);
    }
    let of = |wanted: fn(&LabelledCourse) -> bool| {
        let presses = presses.values().filter(|press| wanted(press[0]));
        presses.max_by_key(|press| press.len())
    };
    let kinds: [fn(&LabelledCourse) -> bool; SHOWN.0] = [
        |course| course.reference.is_none(),
        |course| matches!(course.reference, Some(Reference::Flat { .. })),
        |course| matches!(course.reference, Some(Reference::Ball { .. })),
    ];
    let named = kinds.into_iter().filter_map(of).flat_map(|press| {
        press.iter().take(SHOWN.1).map(|course| {
            let what = match course.reference {
                None => format!("{:.0}", course.shore),
                Some(Reference::Flat { .. }) => "flat".to_owned(),
                Some(Reference::Ball { radius_mm }) => format!("r {radius_mm:.0}"),
            };
            let (sensor, force_n) = (course.sensor, course.force_n);
            (format!("{sensor}: {what}, {force_n:.0} N"), *course)
        })
    });
    over_time(
        "names with sensor, Shore hardness and greatest force",
        named,
    )
}

fn over_time<'a>(
    names: &str,
    named: impl Iterator<Item = (String, &'a LabelledCourse)>,
) -> anyhow::Result<Vec<u8>> {
    let newtons = |moment: &CourseMoment| ModelFrame {
        newtons: std::array::from_fn(|k| 1e-3 * f32::from(moment.millinewtons[k])),
    };
    let frames: Vec<(String, &LabelledCourse, Vec<ModelFrame>)> = named
        .map(|(name, course)| (name, course, course.moments.iter().map(newtons).collect()))
        .collect();
    let rows: Vec<Strip> = frames
        .iter()
        .map(|(name, course, frames)| {
            let pairs: Vec<(&CourseMoment, &ModelFrame)> =
                course.moments.iter().zip(frames).collect();
            Strip {
                name: name.clone(),
                tiles: spread(&pairs)
                    .map(|&(moment, frame)| {
                        let (time_s, mm) = (moment.time_s, moment.approach_mm);
                        (frame, format!("{time_s:.2} {mm:.1} {:.0}", frame.force_n()))
                    })
                    .collect(),
            }
        })
        .collect();
    let title = format!("presses over time: seconds, approach in mm, newtons read; {names}");
    strips(&title, &rows)
}

/// Up to [`TILES`] of `items`, from the first to the last at even distances.
fn spread<T>(items: &[T]) -> impl Iterator<Item = &T> {
    let count = items.len().min(TILES);
    (0..count).map(move |k| &items[k * (items.len() - 1) / (count - 1).max(1)])
}

/// The frames of the first press with their numbers, one empty frame on each side.
fn first_press(frames: &[RawFrame]) -> Vec<(usize, &RawFrame)> {
    let loaded = |raw: &RawFrame| raw.counts.iter().any(|&counts| counts > 0);
    let Some(first) = frames.iter().position(loaded) else {
        return Vec::new();
    };
    // Two empty frames end the press. A single one comes from a light touch that flickers.
    let length = frames[first..]
        .windows(2)
        .position(|pair| !pair.iter().any(loaded))
        .unwrap_or(frames.len() - first);
    let end = (first + length + 1).min(frames.len());
    frames
        .iter()
        .enumerate()
        .take(end)
        .skip(first.saturating_sub(1))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use hardnessd_simulator::{DatasetSettings, Sequence, SequenceSettings, Shapes, dataset};

    fn small(shapes: Shapes, objects: u32, presses: u32) -> Vec<LabelledSample> {
        let settings = DatasetSettings {
            seed: 1,
            objects,
            test_objects: objects,
            presses,
            shapes,
            ..DatasetSettings::default()
        };
        dataset(&settings, 2, |_| ())
    }

    fn sequence(material: Material) -> (Material, Vec<RawFrame>) {
        let settings = SequenceSettings {
            seed: 1,
            materials: vec![material],
            presses: Some(1),
            ..SequenceSettings::default()
        };
        (
            material,
            Sequence::new(settings).map(|frame| frame.raw).collect(),
        )
    }

    #[test]
    fn a_sheet_shows_every_material_and_sequence() {
        let samples = small(Shapes::Matched, 1, 2);
        let sequences = [sequence(Material::SoftCandy)];
        let bytes = sheet(&samples, &sequences).unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(&bytes))
            .read_info()
            .unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        let size = reader.next_frame(&mut pixels).unwrap();
        assert_eq!(size.width as usize, MARGIN + TILES * (TILE + GAP));
        // Each row's first tile holds something brighter than the darkest colour.
        let tops = (0..8).map(|k| HEAD + k * ROW).chain([2 * HEAD + 8 * ROW]);
        for top in tops {
            let bright = (top..top + TILE)
                .flat_map(|y| (MARGIN..MARGIN + 4 * (TILE + GAP)).map(move |x| (x, y)))
                .filter(|&(x, y)| {
                    let at = 3 * (y * size.width as usize + x);
                    pixels[at + 1] > 60 && pixels[at..at + 3] != [250; 3]
                })
                .count();
            assert!(bright >= 16, "nothing to be seen at {top}");
        }
        assert!(sheet(&[], &[]).is_ok());
    }
}
