use std::io::Cursor;

use serde_json::json;

use super::*;
use crate::event::{self, Event, Rejection};
use crate::frame::{RawFrame, sparse};
use crate::pipeline::Clock;
use crate::test_support::{at, hrn, labels, sensor};
use crate::wire;

mod rewritten;

/// The inputs of a story and their times: two presses of a second and a half, a context, damage, a
/// tare, a loss and a return.
fn story() -> Vec<(Stamp, Input<'static>)> {
    let layout = wire::Layout::new(&wire::Settings::default()).unwrap();
    let mut story = vec![(at(0), Input::Opened)];
    for frame in 0..80_u64 {
        let mut raw = RawFrame::default();
        // The baseline drifts by a count.
        raw.counts.fill(3 + frame as u16 / 40);
        if [20..28, 50..58].iter().any(|press| press.contains(&frame)) {
            for place in 300..300 + 4 * (frame % 10) as usize {
                raw.counts[place] = 60 + frame as u16;
            }
        }
        let mut bytes = Vec::new();
        layout.encode(&raw, &mut bytes);
        if frame == 33 {
            bytes[100] ^= 1;
        }
        let ms = 200 * frame + 10;
        match frame {
            12 => story.push((at(ms), Input::Context(Some(json!({"tag": "x"}))))),
            35 => story.push((at(ms), Input::Tare)),
            // The clock is set in the first press.
            24 => {
                let until = at(ms + 60).mono.as_nanos();
                story.push((at(ms), Input::ClockSet(i64::try_from(until).unwrap())));
            }
            54 => {
                story.push((at(ms), Input::Lost("end of file".into())));
                story.push((at(ms + 1), Input::Unavailable("no such device".into())));
                story.push((at(ms + 2), Input::Opened));
            }
            _ => {}
        }
        // The robot sends the arm's position 50 ms before and 50 ms after a frame. Once the
        // position jumps.
        let point = |ms: u64, mm| Point {
            at_ns: i64::try_from(at(ms).mono.as_nanos()).unwrap(),
            mm,
        };
        let mm = if frame == 40 {
            70.0
        } else {
            0.1 * frame as f64
        };
        let points = [point(ms.saturating_sub(50), mm), point(ms + 50, mm + 0.05)];
        story.push((at(ms), Input::Motion(points.to_vec().into())));
        // The frame arrives in three pieces, as on a serial line.
        for (piece, bytes) in bytes.chunks(300).enumerate() {
            let came = at(ms + 20 * piece as u64 + 3);
            story.push((came, Input::Bytes(bytes.to_vec().into())));
        }
    }
    story.push((at(17_000), Input::Tick));
    story.push((at(17_500), Input::Shutdown));
    story
}

/// What begins a recording of the sensor.
fn about(hrn: &Hrn) -> About {
    About {
        robot: "arm-7".to_owned(),
        run: "r".to_owned(),
        boot_id: "b".to_owned(),
        reason: None,
        labels: labels(),
        sensors: vec![RecordedSensor::new(&sensor(), hrn)],
    }
}

/// A recording of the story, and its events during recording. It has a state every `states` inputs,
/// and a chunk ends after every `chunk` inputs. Between the presses, the configuration is read
/// again.
fn recorded(states: usize, chunk: usize) -> (Vec<u8>, Vec<Event>) {
    let hrn = hrn();
    let mut writer = Writer::new(Vec::new(), &about(&hrn)).unwrap();
    let mut pipeline = Pipeline::new(sensor(), hrn.clone(), Clock::Arrival);
    let mut events = Vec::new();
    for (index, (at, input)) in story().into_iter().enumerate() {
        if index % states == 0 {
            let state = State::of(&pipeline, labels());
            writer.entry(0, at, &Entry::State(Box::new(state))).unwrap();
        }
        if index == 160 {
            let mut changed = sensor().description().clone();
            changed.min_force_n = 1e3;
            changed.press.end_frames = 1;
            changed.calibration.gains = None;
            let changed = Sensor::new(changed).unwrap();
            let settings = Entry::Settings(Box::new(RecordedSensor::new(&changed, &hrn)));
            writer.entry(0, at, &settings).unwrap();
            pipeline.reload(changed, hrn.clone()).unwrap();
        }
        writer.entry(0, at, &Entry::Input(input.clone())).unwrap();
        let mut came = pipeline.take(input, at);
        for event in &mut came {
            writer.event(event).unwrap();
            if let Event::Hardness(verdict) = event {
                verdict.mono_ns = None;
            }
        }
        events.append(&mut came);
        if index % chunk == chunk - 1 {
            writer.flush().unwrap();
        }
    }
    (writer.finish().unwrap(), events)
}

fn play(file: &[u8]) -> Vec<Event> {
    let mut playback = Playback::new(hrn());
    let mut events = Vec::new();
    for found in Reader::new(file) {
        events.extend(playback.feed(found.unwrap()).unwrap());
    }
    assert_eq!(playback.labels(), labels());
    events
}

#[test]
fn a_recording_gives_the_very_events_it_was_made_of() {
    let (file, events) = recorded(1000, 7);
    let verdicts = events.iter().filter_map(|event| match event {
        Event::Hardness(verdict) => Some(verdict.rejected),
        _ => None,
    });
    let rejected: Vec<_> = verdicts.collect();
    // The clock is set in the first press, before its fourth frame.
    let known = events.iter().filter_map(|event| match event {
        Event::Frame(frame) => frame.approach_mm.map(|_| frame.frame),
        _ => None,
    });
    assert_eq!(
        known.collect::<Vec<_>>(),
        [21, 22, 23, 50, 51, 52, 53, 54, 55, 56]
    );
    assert_eq!(rejected.first(), Some(&None));
    assert_eq!(rejected.last(), Some(&Some(Rejection::LowForce)));
    assert_eq!(play(&file), events);
}

#[test]
fn a_recording_ends_when_the_last_thing_in_it_happened() {
    let (file, _) = recorded(1000, 7);
    let mut playback = Playback::new(hrn());
    for found in Reader::new(file.as_slice()) {
        playback.feed(found.unwrap()).unwrap();
    }
    let events = playback.end();
    let [Event::Status(status)] = &events[..] else {
        panic!("{events:?}")
    };
    assert_eq!(status.time, at(17_500).wall);
    assert_eq!(status.reason.as_deref(), Some("end of recording"));
    assert_eq!((status.frames, status.frames_damaged), (79, 1));
}

#[test]
fn a_pipeline_that_recalls_another_goes_on_as_that_one() {
    // With a state before each input, each input goes to a new pipeline made from the recording.
    let (file, events) = recorded(1, 7);
    assert_eq!(play(&file), events);
}

#[test]
fn a_sensor_that_cannot_be_is_refused_wherever_it_is_described() {
    let hrn = hrn();
    let good = RecordedSensor::new(&sensor(), &hrn);
    let pipeline = Pipeline::new(sensor(), hrn.clone(), Clock::Arrival);
    let state = |sensor: RecordedSensor| {
        Entry::State(Box::new(State {
            sensor,
            memory: pipeline.memory(),
            labels: labels(),
        }))
    };
    let [mut bad, mut nameless, mut other] = [(); 3].map(|()| good.clone());
    bad.description.press.early_settle_s = -1.0;
    nameless.description.name = "\u{1b}[2J\n".to_owned();
    // A dead taxel of the smaller array has no place in the larger one, nor the other way round.
    other.description.frame.rows = Some(2);
    other.description.calibration.gains = None;
    let of_name = "name: found \"\\u{1b}[2J\\n\", expected a letter a to z";
    let of_press = "press.early_settle_s: found -1.0";
    for (last, expected_error) in [
        (state(bad.clone()), of_press),
        (Entry::Settings(Box::new(bad)), of_press),
        (state(nameless), of_name),
        (
            Entry::Settings(Box::new(other)),
            "frame cannot change while the sensor runs",
        ),
    ] {
        let mut playback = Playback::new(hrn.clone());
        let mut feed = |entry| {
            playback.feed(Found {
                sensor: "forearm".to_owned(),
                at: at(0),
                entry,
            })
        };
        feed(state(good.clone())).unwrap();
        let error = feed(last).unwrap_err().to_string();
        let expected_error = format!("sensor \"forearm\": {expected_error}");
        assert!(error.starts_with(&expected_error), "{error}");
    }
}

#[test]
fn a_memory_that_no_pipeline_came_to_is_refused() {
    let hrn = hrn();
    let mut pipeline = Pipeline::new(sensor(), hrn.clone(), Clock::Arrival);
    // Take one state during the first tare, and one during a press.
    let (mut taring, mut pressed) = (None, None);
    for (moment, input) in story() {
        pipeline.take(input, moment);
        let state = State::of(&pipeline, labels());
        let kept = match pipeline.frame_counts().0 {
            3 => &mut taring,
            22 => &mut pressed,
            _ => continue,
        };
        *kept = Some(serde_json::to_value(state).unwrap());
    }
    let fed = |state: &Option<Value>, change: Option<(&str, Value)>| {
        let mut state = state.clone().unwrap();
        if let Some((place, value)) = change {
            *state.pointer_mut(place).unwrap() = value;
        }
        let state = serde_json::from_value(state).map_err(|error| error.to_string())?;
        let found = Found {
            sensor: "forearm".to_owned(),
            at: at(0),
            entry: Entry::State(Box::new(state)),
        };
        let played = Playback::new(hrn.clone()).feed(found);
        played.map(drop).map_err(|error| error.to_string())
    };
    assert_eq!(fed(&taring, None), Ok(()));
    assert_eq!(fed(&pressed, None), Ok(()));
    let peak = "/memory/tracker/state/Pressed/peak";
    let near = "/memory/tracker/state/Pressed/settling/near/0";
    for (state, place, value) in [
        (&taring, "/memory/pipeline/context", json!("picking")),
        (
            &taring,
            "/memory/pipeline/context",
            json!({"tag": "x".repeat(1024)}),
        ),
        (&taring, "/memory/decoder/received", json!(5)),
        (&taring, "/memory/decoder/received", json!(u64::MAX)),
        (&taring, "/memory/decoder/skipped", json!(1_000_000)),
        (&taring, "/memory/decoder/anchor", json!(1_u64 << 40)),
        (&taring, "/memory/tare/baseline/7", json!(-1.0)),
        (&taring, "/memory/tare/baseline/7", json!(1e39)),
        (&taring, "/memory/tare/taking/1/seen", json!(5)),
        (&taring, "/memory/tare/taking/1/wanted", json!(u32::MAX)),
        (&taring, "/memory/tare/taking/1/sum/7", json!(u32::MAX)),
        (&taring, "/memory/pipeline/frames", json!(u64::MAX)),
        (
            &taring,
            "/memory/pipeline/frames_damaged",
            json!(1_u64 << 40),
        ),
        (&taring, "/memory/tracker/presses", json!(4)),
        (&pressed, "/memory/tracker/presses", json!(2)),
        (&pressed, &format!("{peak}/area"), json!(785)),
        (&pressed, &format!("{peak}/array/cols"), json!(29)),
        (&pressed, &format!("{near}/contact_area_taxels"), json!(9)),
        (&pressed, &format!("{peak}/moment/frame"), json!(22)),
    ] {
        let refusal = fed(state, Some((place, value.clone()))).unwrap_err();
        let expected = "sensor \"forearm\": memory: found what no pipeline can have come to";
        assert!(
            refusal.starts_with(expected),
            "{place} = {value}: {refusal}"
        );
    }
    let wrong = sparse::write(&[0.5, -1.0]);
    let refusal = fed(&pressed, Some((&format!("{peak}/frame"), json!(wrong)))).unwrap_err();
    assert!(
        refusal.contains("N at a taxel, expected 0 or more"),
        "{refusal}"
    );
}

#[test]
fn a_context_that_is_too_deep_is_refused_in_an_input_and_in_a_state() {
    let nested = |levels: usize| (1..levels).fold(json!({}), |inner, _| json!({"a": inner}));
    let read = |entry: Entry| {
        let message = message::encode_entry("forearm", at(0), &entry);
        let read = message::decode_entry(&message, 1);
        read.map(drop).map_err(|error| error.to_string())
    };
    for (levels, expected) in [
        (event::CONTEXT_LEVELS, Ok(())),
        (
            event::CONTEXT_LEVELS + 1,
            Err("context: found 17 levels, expected at most 16".to_owned()),
        ),
    ] {
        let context = Some(nested(levels));
        let mut pipeline = Pipeline::new(sensor(), hrn(), Clock::Arrival);
        pipeline.set_context(context.clone());
        let state = State::of(&pipeline, labels());
        assert_eq!(read(Entry::Input(Input::Context(context))), expected);
        assert_eq!(read(Entry::State(Box::new(state))), expected);
    }
}

#[test]
fn a_file_cut_off_anywhere_is_saved_up_to_its_last_whole_chunk() {
    let (file, _) = recorded(10, 7);
    let inputs = |file: &[u8]| Reader::new(file).map(Result::unwrap).count();
    let all = inputs(&file);
    let mut saved_before = 0;
    for cut in (0..file.len()).step_by(97) {
        let (recovered, good) = recover(Cursor::new(&file[..cut]), Vec::new()).unwrap();
        let saved = inputs(&good);
        assert!(saved >= saved_before && saved <= all, "{saved} at {cut}");
        assert!(!recovered.is_whole() || saved == all);
        saved_before = saved;
    }
    assert_eq!(saved_before, all, "what is cut off last is the summary");
    let (recovered, good) = recover(Cursor::new(&file), Vec::new()).unwrap();
    assert!(recovered.is_whole(), "{recovered:?}");
    assert_eq!(play(&good), play(&file));
}

#[test]
fn one_flipped_bit_costs_its_chunk_and_no_more() {
    let (file, _) = recorded(10, 7);
    let messages = |file: &[u8]| recover(Cursor::new(file), Vec::new()).unwrap();
    let (whole, _) = messages(&file);
    // A chunk has seven inputs, their events, and perhaps a state and changed settings.
    let largest = 7 * 4 + 2;
    // Flip every byte of one chunk and around it, and samples of the rest.
    let middle = file.len() / 2..file.len() / 2 + 800;
    for place in (0..file.len()).filter(|p| p % 31 == 0 || middle.contains(p)) {
        let mut file = file.clone();
        file[place] ^= 1 << (place % 8);
        let (found, good) = messages(&file);
        let lost = whole.messages - found.messages;
        assert!(
            lost <= largest,
            "{lost} messages lost by byte {place}: {found:?}"
        );
        assert!(found.lost.len() <= 1, "{found:?} by byte {place}");
        // The saved part can be read and played.
        if place % 50 == 0 {
            play(&good);
        }
    }
}

#[test]
fn what_is_saved_without_a_state_is_told() {
    let (file, _) = recorded(1000, 7);
    let mut unplayable = 0;
    for place in (0..file.len()).step_by(97) {
        let mut file = file.clone();
        file[place] ^= 1;
        let (found, good) = recover(Cursor::new(&file), Vec::new()).unwrap();
        let mut playback = Playback::new(hrn());
        for found in Reader::new(&good[..]) {
            playback.feed(found.unwrap()).unwrap();
        }
        assert_eq!(found.states, playback.sensors() as u64, "byte {place}");
        unplayable += usize::from(found.messages > 0 && found.states == 0);
    }
    assert!(unplayable > 0, "no byte lies within the first chunk");
}

#[test]
fn what_is_no_recording_is_refused_in_words() {
    let error = |file: &[u8]| {
        let mut errors = Reader::new(file).filter_map(Result::err);
        errors.next().map(|error| error.to_string())
    };
    assert!(error(b"no recording at all").unwrap().contains("no MCAP"));
    for (file, found) in [(&b""[..], "found 0 bytes"), (b"\x89MCAP", "found 5 bytes")] {
        assert_eq!(
            error(file).unwrap(),
            format!("{found}, expected a recording")
        );
    }
    let (file, _) = recorded(10, 7);
    assert_eq!(error(&file), None);
    assert!(error(&file[..file.len() / 2]).unwrap().contains("recover"));
    let (nothing, _) = recover(Cursor::new(b"no recording at all"), Vec::new()).unwrap();
    assert_eq!(nothing.messages, 0);
}

/// A chunk of ours whose header says `unpacked` bytes.
fn chunk(unpacked: u64, packed: &[u8]) -> Vec<u8> {
    let mut body = vec![0; 16];
    body.extend(unpacked.to_le_bytes());
    body.extend(0_u32.to_le_bytes());
    body.extend(b"\x04\0\0\0zstd");
    body.extend((packed.len() as u64).to_le_bytes());
    body.extend(packed);
    let mut record = vec![mcap::records::op::CHUNK];
    record.extend((body.len() as u64).to_le_bytes());
    record.extend(body);
    record
}

#[test]
fn every_chunk_that_a_daemon_writes_is_within_bounds() {
    // Without a flush, the writer itself ends each chunk.
    let hrn = hrn();
    let mut writer = Writer::new(Vec::new(), &about(&hrn)).unwrap();
    let pipeline = Pipeline::new(sensor(), hrn, Clock::Arrival);
    let state = Entry::State(Box::new(State::of(&pipeline, labels())));
    for index in 0..3_000 {
        writer.entry(0, at(index), &state).unwrap();
    }
    let file = writer.finish().unwrap();
    let mut chunks = 0;
    for record in mcap::read::LinearReader::new(&file).unwrap() {
        if let mcap::records::Record::Chunk { header, .. } = record.unwrap() {
            let unpacked = header.uncompressed_size as usize;
            assert!(4 * unpacked <= reader::LONGEST_RECORD_BYTES, "{unpacked}");
            chunks += 1;
        }
    }
    assert!(chunks > 3, "{chunks} chunks");
    let (recovered, good) = recover(Cursor::new(&file), Vec::new()).unwrap();
    assert!(recovered.is_whole(), "{recovered:?}");
    assert_eq!(Reader::new(&good[..]).map(Result::unwrap).count(), 3_000);
}

#[test]
fn a_chunk_that_would_fill_the_memory_is_lost_and_no_other() {
    let (file, _) = recorded(10, 7);
    let (whole, _) = recover(Cursor::new(&file), Vec::new()).unwrap();
    // 250 MB of zeros pack into some kilobytes.
    let zeros = packed(&[], 250 << 20);
    assert!(zeros.len() < 32 << 10, "{}", zeros.len());
    let middle = chunk_starts(&file)[3];
    let mut bomb = file[..middle].to_vec();
    bomb.extend(chunk(250 << 20, &zeros));
    bomb.extend(&file[middle..]);
    let (found, good) = recover(Cursor::new(&bomb), Vec::new()).unwrap();
    assert_eq!(found.messages, whole.messages);
    assert_eq!((found.lost.len(), found.unread.len()), (0, 1), "{found:?}");
    assert!(!found.is_whole());
    assert_eq!(play(&good), play(&file));
    // Playing it fails with an error, and unpacks nothing.
    let error = Reader::new(&bomb[..]).find_map(Result::err).unwrap();
    assert!(
        error.to_string().contains("expected at most 67108864"),
        "{error}"
    );
    // A chunk whose header says too few bytes is refused too.
    let mut lie = file[..middle].to_vec();
    lie.extend(chunk(1 << 20, &zeros));
    lie.extend(&file[middle..]);
    let (found, _) = recover(Cursor::new(&lie), Vec::new()).unwrap();
    assert_eq!(found.messages, whole.messages);
}

#[test]
fn an_attachment_with_wrong_lengths_is_an_error_and_no_panic() {
    let (file, _) = recorded(10, 7);
    let middle = chunk_starts(&file)[3];
    let head = [&[0; 16][..], &[0; 4], &[0; 4]].concat();
    for (data, rest, is_whole) in [
        (0_u64, 4, true),
        (3, 7, true),
        // No room for the checksum, or for the length of the data.
        (0, 3, false),
        (1, 4, false),
        (u64::MAX, 4, false),
    ] {
        let mut body = [&head[..], &data.to_le_bytes()].concat();
        body.extend(vec![0; rest]);
        let mut with = file[..middle].to_vec();
        with.push(mcap::records::op::ATTACHMENT);
        with.extend((body.len() as u64).to_le_bytes());
        with.extend(&body);
        with.extend(&file[middle..]);
        let error = Reader::new(&with[..]).find_map(Result::err);
        assert_eq!(error.is_none(), is_whole, "{data} {rest}: {error:?}");
        let (found, good) = recover(Cursor::new(&with), Vec::new()).unwrap();
        assert_eq!(found.lost.is_empty(), is_whole, "{data} {rest}");
        assert_eq!(play(&good), play(&file));
    }
}

#[test]
fn small_chunks_of_a_small_file_unpack_to_a_bounded_length() {
    let (file, _) = recorded(10, 7);
    let (whole, _) = recover(Cursor::new(&file), Vec::new()).unwrap();
    let middle = chunk_starts(&file)[3];
    // Each of these chunks is small enough. It has one record of zeros. Together they have 700 MiB.
    let zeros = 7 << 20;
    let head = [&[0x80][..], &(zeros as u64).to_le_bytes()].concat();
    let (length, packed) = ((head.len() + zeros) as u64, packed(&head, zeros));
    let mut hostile = file[..middle].to_vec();
    for _ in 0..100 {
        hostile.extend(chunk(length, &packed));
    }
    hostile.extend(&file[middle..]);
    let most = reader::most_unpacked(hostile.len() as u64);
    assert!(most < 50 * length, "{most} of {} bytes", hostile.len());
    let (found, _) = recover(Cursor::new(&hostile), Vec::new()).unwrap();
    assert!(found.lost.len() > 50, "{}", found.lost.len());
    assert_eq!(found.messages, whole.messages, "the other chunks fit");
    let error = Reader::new(&hostile[..]).find_map(Result::err).unwrap();
    assert!(error.to_string().contains("256 times"), "{error}");
}

/// `begin` and then `zeros` zeros, packed as zstd does: a block of raw bytes, and blocks of one
/// repeated byte.
fn packed(begin: &[u8], zeros: usize) -> Vec<u8> {
    const BLOCK: usize = 128 << 10;
    // The header: magic, a window of 128 KiB, no checksum, no length.
    let mut packed = vec![0x28, 0xb5, 0x2f, 0xfd, 0x00, 0x38];
    packed.extend(&(begin.len() << 3).to_le_bytes()[..3]);
    packed.extend(begin);
    let blocks = zeros / BLOCK;
    for block in 0..blocks {
        let last = usize::from(block + 1 == blocks);
        let head = (BLOCK << 3) | (1 << 1) | last;
        packed.extend(&head.to_le_bytes()[..3]);
        packed.push(0);
    }
    packed
}

/// The places where the chunks of a whole file begin.
fn chunk_starts(file: &[u8]) -> Vec<usize> {
    let mut place = MAGIC.len();
    let mut starts = Vec::new();
    while file[place] != mcap::records::op::DATA_END {
        if file[place] == mcap::records::op::CHUNK {
            starts.push(place);
        }
        let length = u64::from_le_bytes(file[place + 1..place + 9].try_into().unwrap());
        place += 9 + length as usize;
    }
    starts
}

#[test]
fn the_worst_file_is_read_a_few_times_and_no_more() {
    let (file, _) = recorded(10, 7);
    let whole = recover(Cursor::new(&file), Vec::new()).unwrap().0.messages;
    let head = |opcode: u8, length: u64| {
        let mut head = vec![opcode];
        head.extend(length.to_le_bytes());
        head
    };
    // These patterns are: heads of chunks whose lengths do not agree; records that claim the rest
    // of the file; and both in turn, so that each search ends soon.
    let mut heads = chunk(1 << 10, b"");
    heads[1] = 200;
    let claim = head(mcap::records::op::METADATA, 1 << 20);
    let turns = [chunk(1 << 10, b""), claim.clone()].concat();
    for (what, pattern) in [("heads", heads), ("claims", claim), ("turns", turns)] {
        let mut hostile = MAGIC.to_vec();
        while hostile.len() < 4 << 20 {
            hostile.extend(&pattern);
        }
        hostile.extend(&file[MAGIC.len()..]);
        let (messages, read) = recover::read_of(&hostile);
        assert!(
            read < 8 * hostile.len() as u64,
            "{what}: {read} bytes read of {}",
            hostile.len()
        );
        assert!(messages * 10 >= whole * 9, "{what}: {messages} of {whole}");
    }
}

#[test]
fn a_replay_knows_the_time_after_2038() {
    let wall: jiff::Timestamp = "2041-03-01T12:00:00.25Z".parse().unwrap();
    let late = Stamp { wall, ..at(0) };
    let message = message::encode_entry("forearm", late, &Entry::Input(Input::Tick));
    let log_time_ns = u64::try_from(wall.as_nanosecond()).unwrap();
    let (_, read, _) = message::decode_entry(&message, log_time_ns).unwrap();
    assert_eq!(read, late);
    // The header of the message, which other programs read, ends in 2038.
    let (_, by_header, _) = message::decode_entry(&message, 0).unwrap();
    assert_eq!(by_header.wall.to_string(), "2038-01-19T03:14:07.25Z");
}
