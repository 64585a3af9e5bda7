use super::*;

const CONTACT: Contact = Contact {
    threshold_n: 0.07,
    area_taxels: 3,
};

fn even(array: Array, count: u16) -> RawFrame {
    let mut frame = RawFrame::zero(array);
    frame.counts.fill(count.into());
    frame
}

fn raw(counts: &[(usize, u16)]) -> RawFrame {
    raw_of(Array::JX255N, counts)
}

fn raw_of(array: Array, counts: &[(usize, u16)]) -> RawFrame {
    let mut frame = even(array, 2);
    for &(place, count) in counts {
        frame.counts[place] = count.into();
    }
    frame
}

fn settings(dead_taxels: &[[usize; 2]]) -> Settings {
    Settings {
        dead_taxels: dead_taxels.to_vec(),
        ..Settings::default()
    }
}

fn gains(rows: usize, cols: usize, gain: impl Fn(usize, usize) -> f32) -> Option<Gains> {
    let row = |row| (0..cols).map(|col| gain(row, col)).collect();
    Some(Gains::Taxels((0..rows).map(row).collect()))
}

#[test]
fn force_grows_with_a_power_of_the_counts_and_with_the_gain_of_its_taxel() {
    let array = Array { rows: 5, cols: 4 };
    let gain = |row, col| 1.0 + 0.1 * (4 * row + col) as f32;
    for (exponent, counts, newtons) in [
        (1.0, 27, 1.0),
        (2.0, 27, 25.0),
        (0.5, 27, 0.2),
        (0.5, 2, 0.0),
        // Two counts below the baseline.
        (0.5, 0, -0.04 * 2.0_f32.sqrt()),
        (1.0, 0, -0.08),
    ] {
        let settings = Settings {
            exponent,
            gains: gains(5, 4, gain),
            tare_frames: 1,
            ..Settings::default()
        };
        let mut tare = Tare::new(&settings, array, CONTACT);
        tare.observe(&raw_of(array, &[]));
        for place in 0..array.taxels() {
            let (row, col) = array.position(place);
            let found = tare.apply(&raw_of(array, &[(place, counts)])).newtons;
            let off = found[place] - newtons * gain(row, col);
            assert!(off.abs() < 1e-4, "{counts} at {place}, {exponent}");
            assert!(found.iter().filter(|&&n| n != 0.0).count() <= 1);
        }
    }
}

#[test]
fn gains_of_another_array_or_beyond_any_film_are_refused() {
    let one_is = |value: f32| gains(5, 4, move |r, c| if (r, c) == (1, 2) { value } else { 1.0 });
    for (gains, expected) in [
        (
            gains(4, 5, |_, _| 1.0),
            "found 4 rows of 5, expected 5 of 4",
        ),
        (one_is(0.0), "found 0.0 at [1, 2], expected 0.001 to 1000"),
        (one_is(f32::NAN), "found NaN at [1, 2]"),
    ] {
        let settings = Settings {
            gains,
            ..Settings::default()
        };
        let error = settings.check(Array { rows: 5, cols: 4 }).unwrap_err();
        assert!(error.problem.starts_with(expected), "{error}");
    }
}

#[test]
fn a_baseline_follows_by_its_bound_while_no_live_taxel_is_in_contact() {
    // The taxels read one count more, 0.04 N, but the gain of column 1 makes it 0.08 N there, which
    // is a contact.
    let drifted = even(Array::JX255N, 3);
    let newtons = |auto_tare, gain: f32, dead_taxels: &[[usize; 2]], seconds| {
        let settings = Settings {
            auto_tare,
            tare_frames: 1,
            gains: gains(28, 28, |_, col| if col == 1 { gain } else { 1.0 }),
            ..settings(dead_taxels)
        };
        let mut tare = Tare::new(&settings, Array::JX255N, CONTACT);
        tare.observe(&raw(&[]));
        (0..seconds).for_each(|_| tare.follow(&drifted));
        tare.apply(&drifted).newtons
    };
    assert_eq!(newtons(false, 1.0, &[], 36_000)[0], 0.04);
    let after_a_minute = newtons(true, 1.0, &[], 60);
    assert!((after_a_minute[0] - (0.04 - 60.0 / 3600.0)).abs() < 1e-5);
    assert_eq!(newtons(true, 1.0, &[], 150)[0], 0.0);
    // A contact anywhere keeps every baseline.
    let touched = newtons(true, 2.0, &[], 36_000);
    assert_eq!((touched[0], touched[1]), (0.04, 0.08));
    // A dead taxel is no contact.
    let column: Vec<[usize; 2]> = (0..28).map(|row| [row, 1]).collect();
    assert_eq!(newtons(true, 2.0, &column, 150)[0], 0.0);
    // A touch below the threshold takes four minutes, whatever power of the counts newtons are.
    let settings = Settings {
        auto_tare: true,
        tare_frames: 1,
        newtons_per_count: 0.001,
        exponent: 2.0,
        ..Settings::default()
    };
    let mut tare = Tare::new(&settings, Array::JX255N, CONTACT);
    tare.observe(&raw(&[]));
    let drifted = raw(&[(0, 10)]);
    let mut left = |seconds| {
        (0..seconds).for_each(|_| tare.follow(&drifted));
        tare.apply(&drifted).newtons[0]
    };
    assert!((0.010..0.020).contains(&left(120)) && left(125) < 1e-6);
}

#[test]
fn a_first_tare_that_always_has_its_first_frame_goes_on_from_its_rest() {
    let mut tare = Tare::new(&settings(&[]), Array::JX255N, CONTACT);
    for count in [10, 2, 10, 2, 10] {
        tare.observe(&raw(&[(0, count), (1, count), (2, count)]));
        assert!(tare.is_at_rest());
    }
    let mut next = Tare::new(&settings(&[]), Array::JX255N, CONTACT);
    next.resume(tare.at_rest());
    for count in [10, 11, 10, 10] {
        for tare in [&mut tare, &mut next] {
            assert!(tare.aim().is_some());
            tare.observe(&raw(&[(0, count), (1, count), (2, count)]));
        }
    }
    assert_eq!((next.aim(), &next.baseline), (None, &tare.baseline));
}

#[test]
fn baseline_is_the_mean_and_frames_before_it_are_untared() {
    let mut tare = Tare::new(&settings(&[]), Array::JX255N, CONTACT);
    for count in [2, 3, 2, 3] {
        tare.observe(&raw(&[(0, count)]));
    }
    assert_eq!(tare.apply(&raw(&[])).newtons[5], 2.0 * 0.04);
    tare.observe(&raw(&[(0, 3)]));
    let frame = tare.apply(&raw(&[(0, 12), (1, 1)]));
    assert_eq!(frame.newtons[0], (12.0 - 13.0 / 5.0) * 0.04);
    assert_eq!(frame.newtons[1], (1.0 - 2.0) * 0.04, "below the baseline");
    assert_eq!(tare.aim(), None);
}

/// What touched the sensor during a first tare.
fn touch_of(tare: &Tare) -> Option<Touch> {
    match tare.aim()? {
        Aim::First { touch } => touch,
        Aim::Request => None,
    }
}

#[test]
fn a_moving_or_a_resting_load_is_contact() {
    let moves = "3 taxels varied by 0.07 N or more, [0, 2] by 0.08 N: free the sensor; if";
    let rests = "3 taxels read more than 0.5 N above the array's median, [0, 2] 0.52 N: free";
    for (taxels, counts, expected) in [
        (3, [2, 4], Some(moves)),
        (2, [2, 4], None),
        (3, [15, 15], Some(rests)),
        (3, [14, 14], None),
    ] {
        let mut tare = Tare::new(&settings(&[]), Array::JX255N, CONTACT);
        for frame in 0..5 {
            let touch: Vec<_> = (0..taxels).map(|i| (i, counts[frame % 2])).collect();
            tare.observe(&raw(&touch));
        }
        let found = touch_of(&tare).map(|touch| touch.to_string());
        assert_eq!(tare.aim().is_some(), expected.is_some());
        let (found, expected) = (found.unwrap_or_default(), expected.unwrap_or_default());
        assert!(found.starts_with(expected), "{found}");
    }
}

/// The counts of 40 taxels in each frame of a robot that presses again and again. `unloaded` of `cycle`
/// frames are without a load, and flicker by a count.
fn pressing(cycle: usize, unloaded: usize) -> Vec<RawFrame> {
    let frame = |number: usize| {
        let (loaded, place) = (cycle - unloaded, number.saturating_sub(unloaded));
        let count = if number < unloaded {
            2 + (number % 2) as u16
        } else {
            2 + 25 * (place + 1).min(loaded - place) as u16
        };
        let counts: Vec<(usize, u16)> = (300..340).map(|place| (place, count)).collect();
        raw(&counts)
    };
    (0..cycle).map(frame).collect()
}

#[test]
fn the_first_tare_takes_the_first_quiet_frames_wherever_a_robot_begins() {
    for (cycle, unloaded) in [(15, 8), (20, 6), (20, 5)] {
        let frames = pressing(cycle, unloaded);
        for begin in 0..cycle {
            let mut tare = Tare::new(&settings(&[]), Array::JX255N, CONTACT);
            let mut frames = frames.iter().cycle().skip(begin).take(2 * cycle);
            let taken = frames.position(|raw| {
                tare.observe(raw);
                tare.aim().is_none()
            });
            // The next five quiet frames in a row.
            let wait = if begin + 5 <= unloaded {
                0
            } else {
                cycle - begin
            };
            assert_eq!(taken, Some(wait + 4), "{unloaded} of {cycle} from {begin}");
            let offsets = tare.offsets();
            assert!(offsets.most_counts < 3.0, "{offsets:?}");
        }
    }
}

#[test]
fn what_a_tare_compares_is_the_array_and_its_live_taxels() {
    let check = |dead: &[[usize; 2]], threshold_n, frames: [RawFrame; 2]| {
        let mut settings = settings(dead);
        settings.tare_frames = 2;
        let contact = Contact {
            threshold_n,
            ..CONTACT
        };
        let mut tare = Tare::new(&settings, Array::JX255N, contact);
        frames.iter().for_each(|raw| tare.observe(raw));
        touch_of(&tare).map(|touch| touch.kind)
    };
    let touched = Some(TouchKind::Varies);
    let flicker = |count| [2, count].map(|count| raw(&[(0, count), (1, count), (2, count)]));
    let row = [[0, 0], [0, 1], [0, 2]];
    for (dead, expected) in [(&row[..], None), (&row[..2], None), (&[], touched)] {
        assert_eq!(check(dead, 0.07, flicker(9)), expected, "{dead:?}");
    }
    // Only values above the median count as high: some taxels may rest low.
    let mut high = even(Array::JX255N, 30);
    high.counts[..4].fill(0.0);
    assert_eq!(check(&[], 0.07, [high.clone(), high]), None);
    // A variation equal to the threshold counts: two counts are 0.08 N.
    assert_eq!(check(&[], 0.08, flicker(4)), touched);
    assert_eq!(check(&[], 0.081, flicker(4)), None);
}

#[test]
fn the_offsets_are_those_of_live_taxels_and_no_tare_is_taken_of_no_frames() {
    let mut settings = settings(&[[0, 1]]);
    settings.tare_frames = 2;
    let mut tare = Tare::new(&settings, Array::JX255N, CONTACT);
    (0..2).for_each(|_| tare.observe(&raw(&[(0, 9), (1, 900)])));
    assert_eq!(tare.outcome(), None, "nobody asked for the first");
    let offsets = tare.offsets();
    assert_eq!((offsets.least_counts, offsets.most_counts), (2.0, 9.0));
    assert!((offsets.mean_counts - (2.0 * 782.0 + 9.0) / 783.0).abs() < 1e-4);
    settings.tare_frames = 0;
    let mut tare = Tare::new(&settings, Array::JX255N, CONTACT);
    assert_eq!(tare.retake(), Err(RetareError::NoFrames));
}

#[test]
fn a_dead_taxel_is_the_mean_of_its_live_neighbours() {
    let check = |array: Array, dead: &[[usize; 2]], counts: &[(usize, u16)], expected: &[f32]| {
        let settings = Settings {
            tare_frames: 0,
            ..settings(dead)
        };
        let tare = Tare::new(&settings, array, CONTACT);
        let newtons = tare.apply(&raw_of(array, counts)).newtons;
        for (&[row, col], expected) in dead.iter().zip(expected) {
            let found = newtons[array.place(row, col)];
            assert!((found - 0.04 * expected).abs() < 1e-6, "{found} {expected}");
        }
    };
    let counts = [(0, 255), (1, 255), (28, 10), (29, 20)];
    check(
        Array::JX255N,
        &[[0, 0], [0, 1]],
        &counts,
        &[15.0, 34.0 / 4.0],
    );
    // The border of an array has fewer neighbours, down to none.
    check(Array { rows: 1, cols: 2 }, &[[0, 0]], &[(1, 50)], &[50.0]);
    check(Array { rows: 1, cols: 1 }, &[[0, 0]], &[(0, 50)], &[0.0]);
}
