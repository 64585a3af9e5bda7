//! The interval of an accuracy, by a bootstrap over what was drawn independently.
//!
//! Presses of one object are near-copies, and so are those of all sensors under one cover, which press the
//! same objects. An interval over presses would be too narrow.

use std::collections::BTreeMap;

use hardnessd_simulator::random::Stream;

/// So few units of a stratum do not show how much units vary.
const FEW: usize = 4;
/// The number of draws.
const DRAWS: usize = 2_000;

/// A judged press.
#[derive(Debug, Clone, Copy)]
pub struct Drawn {
    /// The stratum that its unit is drawn in.
    pub stratum: u8,
    /// The unit that it is drawn with.
    pub unit: u32,
    /// 1 if it was judged rightly and 0 if not, or the difference of two such numbers.
    pub value: f64,
}

/// The mean that is estimated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mean {
    /// Over the presses.
    OfPresses,
    /// Over the strata, of the means over their presses.
    OfStrata,
}

/// The sum of values and the number of presses of a unit.
type Sum = [f64; 2];

impl Mean {
    fn of(self, strata: impl ExactSizeIterator<Item = Sum>) -> f64 {
        let count = strata.len() as f64;
        match self {
            Self::OfPresses => {
                let [sum, n] = total(strata);
                sum / n
            }
            Self::OfStrata => strata.map(|[sum, n]| sum / n).sum::<f64>() / count,
        }
    }
}

/// The sums of the units of each stratum.
fn strata(presses: &[Drawn]) -> Vec<Vec<Sum>> {
    let mut strata = BTreeMap::<u8, BTreeMap<u32, Sum>>::new();
    for press in presses {
        let units = strata.entry(press.stratum).or_default();
        let sum = units.entry(press.unit).or_default();
        sum[0] += press.value;
        sum[1] += 1.0;
    }
    let units = strata.into_values();
    units.map(|units| units.into_values().collect()).collect()
}

/// The mean of the values of presses. NaN without any.
pub fn mean(presses: &[Drawn], mean: Mean) -> f64 {
    let strata = strata(presses);
    mean.of(strata.iter().map(|units| total(units.iter().copied())))
}

/// The 95 % interval of the mean. Each draw takes units of each stratum, with replacement.
/// `None` if a stratum has only one unit, because nothing then says how much its units vary, and if all
/// values are the same, because every draw is then the same. But if all were judged rightly, the low end is the share
/// at which that happens to so many units by a chance of 2.5 % (Clopper and Pearson 1934).
///
/// A draw of all n units would vary less than the units do, by (n - 1) / n. So a draw takes n - 1 of them, and
/// counts each n / (n - 1) times (Rao and Wu 1988, "Resampling inference with complex survey data").
pub fn of(presses: &[Drawn], mean: Mean) -> Option<[f64; 2]> {
    let strata = strata(presses);
    let is_one = strata.iter().any(|units| units.len() < 2);
    let first = presses.first()?.value;
    let are_same = presses.iter().all(|press| press.value == first);
    if are_same && first == 1.0 {
        let units: usize = strata.iter().map(Vec::len).sum();
        return Some([0.025_f64.powf(1.0 / units as f64), 1.0]);
    }
    if is_one || are_same {
        return None;
    }
    let mut stream = Stream::new(0, "bootstrap by object");
    let mut draw = |units: &Vec<Sum>| {
        let drawn = (1..units.len()).map(|_| units[stream.below(units.len())]);
        let times = units.len() as f64 / (units.len() - 1) as f64;
        total(drawn).map(|sum| sum * times)
    };
    let draws = (0..DRAWS).map(|_| mean.of(strata.iter().map(&mut draw)));
    let mut draws: Vec<f64> = draws.collect();
    draws.sort_by(f64::total_cmp);
    Some([quantile(&draws, 0.025), quantile(&draws, 0.975)])
}

/// The 95 % interval of the mean over the strata. To the bootstrap it adds what that cannot see: the units of a stratum
/// may be alike because they are few. A stratum of fewer than four units, or of units that are all alike, counts with
/// the interval of Clopper and Pearson (1934), as if each unit had one press. The distances of all limits from the mean
/// are added as independent ones are (Zou and Donner 2008, "Construction of confidence limits about effect measures").
pub fn of_balanced(presses: &[Drawn]) -> Option<[f64; 2]> {
    let mut each = BTreeMap::<u8, Vec<Drawn>>::new();
    for press in presses {
        each.entry(press.stratum).or_default().push(*press);
    }
    let count = each.len() as f64;
    let mut squares = [0.0; 2];
    let mut add = |limits: [f64; 2], share: f64, strata: usize| {
        for (square, limit) in squares.iter_mut().zip(limits) {
            *square += ((limit - share) * strata as f64 / count).powi(2);
        }
    };
    let mut varied = Vec::new();
    for own in each.into_values() {
        let units = strata(&own).concat();
        let share = |[sum, n]: Sum| sum / n;
        let mut pairs = units.windows(2);
        let are_alike = pairs.all(|pair| share(pair[0]) == share(pair[1]));
        if are_alike || units.len() < FEW {
            let share = share(total(units.iter().copied()));
            add(of_share(share, units.len()), share, 1);
        } else {
            varied.push(own);
        }
    }
    let strata = varied.len();
    let varied = varied.concat();
    if let Some(limits) = of(&varied, Mean::OfStrata) {
        add(limits, mean(&varied, Mean::OfStrata), strata);
    }
    let [below, above] = squares.map(f64::sqrt);
    let centre = mean(presses, Mean::OfStrata);
    (count > 0.0).then(|| [(centre - below).max(0.0), (centre + above).min(1.0)])
}

/// The shares of which so many right units, or fewer and more, are found by a chance of 2.5 % each.
fn of_share(right: f64, units: usize) -> [f64; 2] {
    // The chance of at most `most` right ones.
    let at_most = |most: usize, share: f64| {
        let mut chance = (1.0 - share).powi(units as i32);
        let mut sum = 0.0;
        for count in 0..=most {
            sum += chance;
            chance *= (units - count) as f64 / (count + 1) as f64 * share / (1.0 - share);
        }
        sum
    };
    // The greatest share that is not excluded by so many right ones.
    let greatest = |right: usize| {
        if right == units {
            return 1.0;
        }
        let (mut below, mut above) = (0.0, 1.0);
        for _ in 0..50 {
            let middle = 0.5 * (below + above);
            match at_most(right, middle) < 0.025 {
                true => above = middle,
                false => below = middle,
            }
        }
        0.5 * (below + above)
    };
    let right = right * units as f64;
    // The least share of right ones is what the greatest share of wrong ones leaves.
    let least = 1.0 - greatest(units - right.floor() as usize);
    [least, greatest(right.ceil() as usize)]
}

fn total(sums: impl Iterator<Item = Sum>) -> Sum {
    sums.fold([0.0; 2], |[sum, n], [more, of]| [sum + more, n + of])
}

/// The quantile, linear between the two nearest values, as numpy does by default.
fn quantile(sorted: &[f64], q: f64) -> f64 {
    let place = q * (sorted.len() - 1) as f64;
    let below = place.floor() as usize;
    let above = (below + 1).min(sorted.len() - 1);
    sorted[below] + (place - below as f64) * (sorted[above] - sorted[below])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 50 presses of each unit of one stratum, of which `right` were judged rightly.
    fn units(right: &[usize]) -> Vec<Drawn> {
        let presses = |(unit, &right): (u32, &usize)| {
            (0..50).map(move |n| Drawn {
                stratum: 1,
                unit,
                value: f64::from(u8::from(n < right)),
            })
        };
        (0..).zip(right).flat_map(presses).collect()
    }

    #[test]
    fn the_interval_is_the_normal_one_of_the_units() {
        // Half of the units are all right. The mean's standard deviation is that of a sample, divided by the
        // root of its number: also for few units, where a draw of all units would be too narrow.
        for (count, tolerance) in [(400_u32, 0.08), (8, 0.25)] {
            let right: Vec<usize> = (0..count).map(|n| 50 * (n % 2) as usize).collect();
            let [low, high] = of(&units(&right), Mean::OfPresses).unwrap();
            let deviation = 0.5 / f64::from(count - 1).sqrt();
            let expected = 2.0 * 1.96 * deviation;
            let found = high - low;
            assert!(
                (found / expected - 1.0).abs() < tolerance,
                "{count}: {found}, expected {expected}"
            );
        }
    }

    #[test]
    fn a_level_of_few_units_that_are_alike_widens_the_interval() {
        let of = |levels: &[&[usize]]| {
            let presses = (0..).zip(levels).flat_map(|(stratum, right)| {
                let own = units(right).into_iter();
                own.map(move |press| Drawn { stratum, ..press })
            });
            of_balanced(&presses.collect::<Vec<_>>()).unwrap()
        };
        let all = [50; 60];
        // Two units say no more than that a fifth is right (0.025^(1/2) = 0.158).
        let [low, high] = of(&[&all[..2], &all]);
        assert!((low - (1.0 - 0.5 * (1.0 - 0.158))).abs() < 0.01, "{low}");
        assert_eq!(high, 1.0);
        // One press less does not make it surer.
        let [lower, _] = of(&[&all[..2], &[[49].as_slice(), &all[..59]].concat()]);
        assert!((low - lower).abs() < 0.02, "{low} {lower}");
        // One unit says nothing, and units of which each has half right are a fair coin's.
        assert!(of(&[&all[..1]])[0] < 0.03);
        let [low, high] = of(&[&[25; 10]]);
        assert!(
            (low - 0.187).abs() < 1e-3 && (high - 0.813).abs() < 1e-3,
            "{low} {high}"
        );
    }

    #[test]
    fn one_unit_of_a_stratum_has_no_interval() {
        assert_eq!(of(&units(&[40]), Mean::OfPresses), None);
        // Nothing varies where all verdicts are wrong.
        assert_eq!(of(&units(&[0, 0, 0]), Mean::OfPresses), None);
        // Where all are right, 19 of 20 is not excluded by 71 units, and is by 72.
        for (count, is_excluded) in [(71, false), (72, true)] {
            let [low, high] = of(&units(&vec![50; count]), Mean::OfPresses).unwrap();
            assert_eq!((low > 0.95, high), (is_excluded, 1.0), "{count}: {low}");
        }
        let mut presses = units(&[40, 30]);
        assert!(of(&presses, Mean::OfPresses).is_some());
        presses.push(Drawn {
            stratum: 2,
            unit: 7,
            value: 1.0,
        });
        assert_eq!(of(&presses, Mean::OfPresses), None);
        assert_eq!(mean(&presses, Mean::OfStrata), 0.5 * (0.7 + 1.0));
    }
}
