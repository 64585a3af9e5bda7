//! Recordings that another program has rewritten.

use std::collections::BTreeMap;
use std::sync::Arc;

use mcap::records::Record;
use mcap::{Channel, Compression, Message, WriteOptions};

use super::*;

/// A recording rewritten with `options`, with messages of another program of these lengths before
/// its own.
fn rewritten(file: &[u8], options: WriteOptions, foreign: &[usize]) -> Vec<u8> {
    let mut writer = options.create(Cursor::new(Vec::new())).unwrap();
    let mut metadata = Vec::new();
    for record in mcap::read::LinearReader::new(file).unwrap() {
        if let Record::Metadata(found) = record.unwrap() {
            metadata.push(found);
        }
    }
    metadata
        .iter()
        .for_each(|found| writer.write_metadata(found).unwrap());
    let camera = Arc::new(Channel {
        id: u16::MAX,
        topic: "/camera".to_owned(),
        schema: None,
        message_encoding: "jpeg".to_owned(),
        metadata: BTreeMap::new(),
    });
    for (sequence, bytes) in (0..).zip(foreign) {
        let message = Message {
            channel: camera.clone(),
            sequence,
            log_time: 0,
            publish_time: 0,
            data: vec![0; *bytes].into(),
        };
        writer.write(&message).unwrap();
    }
    for message in mcap::MessageStream::new(file).unwrap() {
        writer.write(&message.unwrap()).unwrap();
    }
    writer.finish().unwrap();
    writer.into_inner().into_inner()
}

#[test]
fn a_recording_that_another_program_rewrote_is_read_and_recovered() {
    let (file, _) = recorded(10, 7);
    let events = play(&file);
    let plain = WriteOptions::new().compression(None);
    for (name, options) in [
        ("lz4", plain.clone().compression(Some(Compression::Lz4))),
        ("not packed", plain.clone()),
        ("one long chunk", plain.clone().chunk_size(None)),
        ("no chunks", plain.clone().use_chunks(false)),
        (
            "no index",
            plain
                .emit_message_indexes(false)
                .emit_summary_records(false),
        ),
    ] {
        let rewritten = rewritten(&file, options, &[]);
        assert_eq!(play(&rewritten), events, "{name}");
        let (found, good) = recover(Cursor::new(&rewritten), Vec::new()).unwrap();
        assert!(found.is_whole(), "{name}: {found:?}");
        assert_eq!(play(&good), events, "{name}");
    }
}

#[test]
fn a_chunk_over_64_mib_is_said_to_be_too_long() {
    let (file, _) = recorded(10, 7);
    for compression in [None, Some(Compression::Lz4), Some(Compression::Zstd)] {
        let one_chunk = WriteOptions::new()
            .compression(compression)
            .chunk_size(None);
        let long = rewritten(&file, one_chunk, &[4 << 20; 16]);
        let error = Reader::new(&long[..]).find_map(Result::err).unwrap();
        let error = error.to_string();
        assert!(error.starts_with("found a chunk of 6"), "{error}");
        assert!(
            error.contains("at most 67108864: `mcap recover`"),
            "{error}"
        );
        let (found, _) = recover(Cursor::new(&long), Vec::new()).unwrap();
        assert_eq!(found.messages, 0);
        assert_eq!(found.lost[0].0, chunk_starts(&long)[0] as u64);
    }
}
