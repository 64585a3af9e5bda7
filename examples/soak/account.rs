//! The checks at the end: of every press, and of the daemon's resources.

use std::fs;
use std::path::PathBuf;
use std::process::Child;
use std::time::Duration;

use crate::Failure;
use crate::player::Player;

/// The time until memory grows no more: the black boxes hold a minute, and up to a stretch of ten
/// seconds more of each sensor that was there all the time, and the first reloads need room for a
/// second model. The events that are held for `since` take minutes more to fill, so a longer run
/// leaves out its first quarter.
const WARM: Duration = Duration::from_secs(120);

/// The daemon's memory in kB, descriptors and threads.
pub(crate) fn usage(daemon: &Child) -> Result<[u64; 3], Failure> {
    let directory = PathBuf::from(format!("/proc/{}", daemon.id()));
    let status = fs::read_to_string(directory.join("status"))?;
    let of = |key: &str| {
        let line = status.lines().find_map(|line| line.strip_prefix(key));
        let number = line.and_then(|line| line.split_whitespace().next()?.parse().ok());
        number.ok_or(format!("no {key} in /proc"))
    };
    let descriptors = fs::read_dir(directory.join("fd"))?.count() as u64;
    Ok([of("VmRSS:")?, descriptors, of("Threads:")?])
}

/// Compares the presses sent with those that a subscriber read, press by press.
pub(crate) fn account(sent: &[Player], ends: &[Vec<String>], is_complete: bool) -> Vec<String> {
    let mut problems = Vec::new();
    let (mut judged, mut lost) = (0, 0);
    for (sensor, (player, ends)) in sent.iter().zip(ends).enumerate() {
        if player.sent.len() != ends.len() {
            problems.push(format!(
                "s{sensor}: sent {} presses, heard {}",
                player.sent.len(),
                ends.len()
            ));
        }
        for (number, (is_judged, end)) in (1..).zip(player.sent.iter().zip(ends)) {
            let expected = if *is_judged { "final" } else { "lost" };
            if end != expected {
                problems.push(format!(
                    "s{sensor}, press {number}: found {end:?}, expected {expected}"
                ));
            }
            judged += u64::from(*is_judged);
            lost += u64::from(!is_judged);
        }
    }
    if is_complete {
        println!(
            "presses: {} = {judged} with a verdict + {lost} lost with the link",
            judged + lost
        );
    }
    problems
}

/// Compares the medians of the two halves of the time after the start.
pub(crate) fn growth(samples: &[(Duration, [u64; 3])]) -> Vec<String> {
    let length = samples.last().map_or(Duration::ZERO, |(at, _)| *at);
    let warm: Vec<[u64; 3]> = samples
        .iter()
        .filter(|(at, _)| *at > WARM.max(length / 4))
        .map(|(_, s)| *s)
        .collect();
    let (first, second) = warm.split_at(warm.len() / 2);
    let mut problems = Vec::new();
    // Memory may vary by a twentieth and a MB. Guests, files and the threads that open ports come
    // and go.
    let kinds = [
        ("kB of memory", 0.05, 1024),
        ("descriptors", 0.0, 2),
        ("threads", 0.0, 2),
    ];
    for (kind, (name, share, more)) in kinds.into_iter().enumerate() {
        let median = |samples: &[[u64; 3]]| {
            let mut values: Vec<u64> = samples.iter().map(|sample| sample[kind]).collect();
            values.sort_unstable();
            values.get(values.len() / 2).copied().unwrap_or_default()
        };
        let (before, after) = (median(first), median(second));
        println!("{name}: {before}, then {after}");
        if after as f64 > before as f64 * (1.0 + share) + f64::from(more) {
            problems.push(format!("{name} grew from {before} to {after}"));
        }
    }
    problems
}
