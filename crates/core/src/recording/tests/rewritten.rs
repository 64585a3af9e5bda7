//! Recordings that another program has rewritten.

use mcap::records::Record;
use mcap::{Compression, WriteOptions};

use super::*;

/// A recording rewritten with `options`.
fn rewritten(file: &[u8], options: WriteOptions) -> Vec<u8> {
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
        let rewritten = rewritten(&file, options);
        assert_eq!(play(&rewritten), events, "{name}");
        let (found, good) = recover(Cursor::new(&rewritten), Vec::new()).unwrap();
        assert!(found.is_whole(), "{name}: {found:?}");
        assert_eq!(play(&good), events, "{name}");
    }
}

#[test]
fn a_chunk_of_an_unknown_compression_is_said_to_be_one() {
    let (mut file, _) = recorded(10, 7);
    let name = (0..file.len()).find(|&place| file[place..].starts_with(b"\x04\0\0\0zstd"));
    file[name.unwrap() + 4] = b'Z';
    let error = Reader::new(&file[..]).find_map(Result::err).unwrap();
    let expected = "found a chunk packed with \"Zstd\", expected zstd, lz4 or none";
    assert_eq!(error.to_string(), expected);
}
