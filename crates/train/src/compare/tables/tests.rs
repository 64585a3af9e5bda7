//! Tests of the tables with runs that differ.

use std::collections::BTreeMap;

use super::*;
use crate::compare::results::{Details, Entry};
use crate::data::dataset::LabelChoice;
use crate::judge::metrics::Judged;
use crate::settings::Profile;

/// A comparison of one method with seeds 1, 2, ...; `runs` holds the steps and the revision of each
/// run.
fn comparison(runs: &[(u64, &str)]) -> Comparison {
    let judged = Judged {
        level: 1,
        probabilities: vec![1.0, 0.0, 0.0, 0.0],
        object: Some(0),
    };
    let evaluation = Evaluation::of(&[judged], 4);
    let entry = |(seed, &(steps, _)): (u64, &(u64, &str))| Entry {
        method: "hrn15".to_owned(),
        seed,
        profile: Profile::Smoke,
        labels: 24,
        label_choice: LabelChoice::Object,
        steps,
        seconds: 1.0,
        paper_split: None,
        fresh: evaluation.clone(),
        matched: evaluation.clone(),
        shifts: BTreeMap::new(),
        run: format!("hrn15-{seed}"),
    };
    let details = |&(steps, revision): &(u64, &str)| Details {
        revisions: revision.to_owned(),
        history: History {
            stages: vec![Stage {
                name: "hrn".to_owned(),
                rows: vec![BTreeMap::from([("step".to_owned(), steps as f64)])],
            }],
        },
        ..Details::default()
    };
    Comparison {
        entries: (1..).zip(runs).map(entry).collect(),
        details: runs.iter().map(details).collect(),
        swaps: Vec::new(),
    }
}

#[test]
fn steps_are_means_over_seeds_to_the_nearest_step() {
    let comparison = comparison(&[(1_000, "a"), (1_000, "a"), (1_001, "a"), (1_002, "a")]);
    let rows = comparison.rows();
    // The mean is 1,000.75.
    assert_eq!(headline(&rows).rows[0][9], "1,001");
    assert_eq!(price(&rows).rows[0][2], "1,001");
    assert_eq!(price(&rows).rows[0][4], "hrn 1,001");
}

#[test]
fn every_revision_that_made_a_run_is_named_once() {
    let written = provenance(&comparison(&[
        (1, "0.1 (aa)"),
        (1, "0.1 (bb)\n0.1 (cc)"),
        (1, "0.1 (aa)"),
    ]));
    let line = written.lines().next().unwrap();
    let named = "--seeds 3, 0.1 (aa), 0.1 (bb), 0.1 (cc).";
    assert!(line.ends_with(named), "{line}");
    let written = provenance(&comparison(&[(1, "")]));
    assert!(
        written.starts_with("Made by hrn-train compare --profile smoke --seeds 1.\n"),
        "{written}"
    );
}
