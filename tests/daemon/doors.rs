//! Bytes from strangers, at every input of the programs. Whatever the bytes are, the program
//! answers, never panics, and takes a bounded time. `properties.rs` has the properties. `fuzz/`
//! searches for bytes that break them, guided by coverage.

use std::path::Path;
use std::time::{Duration, Instant};

use hardnessd_core::tests::support::of_a_press;
use hardnessd_core::trial;
use proptest::prelude::*;
use proptest::test_runner::{RngAlgorithm, TestRng, TestRunner};
use serde_json::json;

/// Changes to bytes: the place, the new bytes, and the number of bytes that they replace.
type Damage = Vec<(prop::sample::Index, Vec<u8>, usize)>;

fn damage() -> impl Strategy<Value = Damage> {
    let change = (
        any::<prop::sample::Index>(),
        prop::collection::vec(any::<u8>(), 0..12),
        0_usize..12,
    );
    prop::collection::vec(change, 1..6)
}

fn damaged(bytes: &[u8], damage: Damage) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    for (place, new, gone) in damage {
        let start = place.index(bytes.len().max(1)).min(bytes.len());
        let end = (start + gone).min(bytes.len());
        bytes.splice(start..end, new);
    }
    bytes
}

/// The seconds for changes to the kept bytes. `HARDNESSD_DOORS_SECONDS` sets another number, for CI
/// and for longer searches.
fn seconds() -> u64 {
    let given = std::env::var("HARDNESSD_DOORS_SECONDS").ok();
    given.map_or(3, |given| given.parse().expect("seconds"))
}

/// The bytes that the fuzzer kept for a door, and a whole recording.
fn kept(door: &str) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("fuzz/corpus")
        .join(door);
    let files = std::fs::read_dir(&folder).expect("a corpus for each door");
    let mut kept: Vec<Vec<u8>> = files
        .map(|file| std::fs::read(file.unwrap().path()).unwrap())
        .collect();
    assert!(!kept.is_empty(), "{door}");
    // Folders have an order of their own.
    kept.sort();
    if ["recording", "recover"].contains(&door) {
        let context = json!({"tag": "x"});
        kept.push(of_a_press(|_| {}, Some(context), true).0);
    }
    kept
}

#[test]
fn every_property_holds_of_what_the_fuzzer_kept() {
    trial::set_program(env!("CARGO_BIN_EXE_hardnessd").into());
    for (door, property) in super::properties::ALL {
        for bytes in kept(door) {
            property(&bytes);
        }
    }
}

#[test]
fn every_property_holds_of_changes_to_what_the_fuzzer_kept() {
    trial::set_program(env!("CARGO_BIN_EXE_hardnessd").into());
    let end = Instant::now() + Duration::from_secs(seconds());
    let mut tried: u64 = 0;
    while Instant::now() < end {
        for (door, property) in super::properties::ALL {
            let kept = kept(door);
            let config = ProptestConfig {
                cases: 8,
                // Bytes that break a property are added to the corpus by hand.
                failure_persistence: None,
                ..ProptestConfig::default()
            };
            let inputs = (any::<prop::sample::Index>(), damage());
            // The same inputs in each run: a change is refused for what it breaks, and not by chance.
            let mut seed = [0; 32];
            seed[..8].copy_from_slice(&tried.to_le_bytes());
            let rng = TestRng::from_seed(RngAlgorithm::ChaCha, &seed);
            let ran = TestRunner::new_with_rng(config, rng).run(&inputs, |(which, damage)| {
                let which = which.index(kept.len());
                property(&damaged(&kept[which], damage));
                Ok(())
            });
            ran.unwrap_or_else(|error| panic!("{door}: {error}"));
            tried += 8;
        }
    }
    println!("{tried} changed inputs");
}
