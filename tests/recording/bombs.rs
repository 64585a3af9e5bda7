//! Files that are small and would fill the memory.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::Path;
use std::process::Command;

use mcap::records::MessageHeader;

use crate::bench::{BINARY, Bench, ran};

/// Runs the program with so many MiB of memory. Returns exit code and stderr.
fn within(mib: u64, bench: &Bench, arguments: &str) -> (i32, String) {
    let mut command = Command::new("sh");
    let line = format!("ulimit -d {} && exec \"$0\" {arguments}", mib << 10);
    command
        .args(["-c", &line, BINARY])
        .current_dir(bench.path(""));
    let (code, _, stderr) = ran(&mut command);
    (code, stderr)
}

/// Writes a recording of one chunk of almost 64 MiB.
fn write(path: &Path, fill: impl FnOnce(&mut mcap::Writer<File>)) {
    let options = mcap::WriteOptions::new()
        .chunk_size(Some(80 << 20))
        .repeat_schemas(false);
    let mut out = options.create(File::create(path).unwrap()).unwrap();
    fill(&mut out);
    out.finish().unwrap();
}

#[test]
fn a_chunk_of_tiny_records_is_read_one_by_one() {
    let bench = Bench::new();
    let path = bench.path("tiny.mcap");
    write(&path, |out| {
        let schema = out.add_schema("x", "x", b"x").unwrap();
        let channel_id = out
            .add_channel(schema, "/x", "x", &BTreeMap::new())
            .unwrap();
        // A record takes 31 bytes.
        for _ in 0..2_000_000 {
            let header = MessageHeader {
                channel_id,
                sequence: 0,
                log_time: 0,
                publish_time: 0,
            };
            out.write_to_known_channel(&header, b"").unwrap();
        }
    });
    assert!(fs::metadata(&path).unwrap().len() < 64 << 20);
    // The chunk is held packed and unpacked.
    let (code, stderr) = within(280, &bench, "replay tiny.mcap");
    assert_eq!(code, 1, "{stderr}");
    assert!(stderr.contains("found no state of a sensor"), "{stderr}");
    let (code, stderr) = within(280, &bench, "recover tiny.mcap --out good.mcap");
    assert!(stderr.contains("2000000 messages"), "{code}: {stderr}");
}

#[test]
fn descriptions_without_end_are_left_out() {
    let bench = Bench::new();
    let path = bench.path("described.mcap");
    // Each has a number of its own, and takes nothing in the file.
    write(&path, |out| {
        for number in 1..200_u16 {
            let name = format!("x{number}");
            out.add_schema_with_id(number, &name, "x", &vec![0; 1 << 20])
                .unwrap();
            out.flush().unwrap();
        }
    });
    assert!(fs::metadata(&path).unwrap().len() < 1 << 20);
    let (code, stderr) = within(120, &bench, "recover described.mcap --out good.mcap");
    assert_eq!(code, 1, "{stderr}");
    assert!(!stderr.contains("memory"), "{stderr}");
}
