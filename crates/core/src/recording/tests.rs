use std::io::Cursor;
use std::sync::Arc;

use serde_json::json;

use super::*;
use crate::event::{Event, Press, PressState};
use crate::frame::RawFrame;
use crate::pipeline::Clock;
use crate::tests::support::{about, at, hrn, labels, sensor};
use crate::verdict::{BUILT_IN, Model, References};
use crate::wire;

mod rewritten;

/// The inputs of a story and their times: two presses of a second and a half, a context, damage, a
/// tare, a loss and a return.
fn story() -> Vec<(Stamp, Input)> {
    let layout = wire::Layout::new(&wire::Settings::default()).unwrap();
    let mut story = vec![(at(0), Input::Opened)];
    for frame in 0..80_u64 {
        let mut raw = RawFrame::default();
        // The baseline drifts by a count.
        raw.counts.fill(f32::from(3 + frame as u16 / 40));
        if [20..28, 50..58].iter().any(|press| press.contains(&frame)) {
            for place in 300..300 + 4 * (frame % 10) as usize {
                raw.counts[place] = 60.0 + frame as f32;
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
        story.push((at(ms), Input::Motion(points.to_vec())));
        // The frame arrives in three pieces, as on a serial line.
        for (piece, bytes) in bytes.chunks(300).enumerate() {
            let came = at(ms + 20 * piece as u64 + 3);
            story.push((came, Input::Bytes(bytes.to_vec())));
        }
    }
    story.push((at(17_000), Input::Tick));
    story.push((at(17_500), Input::Shutdown));
    story
}

/// A recording of the story, and its events during recording. It has a state every `states` inputs, or
/// at the next rest, and a chunk ends after every `chunk` inputs. Between the presses, the
/// configuration is read again.
fn recorded(states: usize, chunk: usize) -> (Vec<u8>, Vec<Event>) {
    let hrn = hrn();
    let about = about(&labels(), RecordedSensor::new(&sensor(), &hrn));
    let mut writer = Writer::new(Vec::new(), &about).unwrap();
    let mut pipeline = Pipeline::new(sensor(), hrn.clone(), Clock::Arrival);
    let (mut events, mut is_due) = (Vec::new(), false);
    for (index, (at, input)) in story().into_iter().enumerate() {
        is_due |= index % states == 0;
        if let Some(state) = State::of(&pipeline, &labels()).filter(|_| is_due) {
            writer.entry(0, at, &Entry::State(Box::new(state))).unwrap();
            is_due = false;
        }
        // The sensor begins anew with other tables, and later gets other limits of the model.
        if [160, 190].contains(&index) {
            let mut changed = pipeline.sensor().description().clone();
            if index == 160 {
                changed.press.end_frames = 1;
                changed.sensor.calibration.gains = None;
                let changed = Sensor::new(changed).unwrap();
                pipeline = pipeline.restarted(changed, hrn.clone());
            } else {
                changed.model.min_force_n = 1e3;
                let changed = Sensor::new(changed).unwrap();
                pipeline = pipeline.with_model(changed, hrn.clone()).unwrap();
            }
            let state = State::of(&pipeline, &labels()).unwrap();
            writer.entry(0, at, &Entry::State(Box::new(state))).unwrap();
        }
        writer.entry(0, at, &Entry::Input(input.clone())).unwrap();
        let mut came = pipeline.take(input, at).unwrap_or_default();
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

/// The events of a recording, but for those of its end, and the playback.
fn played(file: &[u8]) -> (Vec<Event>, Playback) {
    let mut playback = Playback::new(hrn());
    let mut events = Vec::new();
    for found in Reader::new(file) {
        events.extend(playback.feed(found.unwrap()).unwrap());
    }
    (events, playback)
}

fn play(file: &[u8]) -> Vec<Event> {
    let (events, playback) = played(file);
    assert_eq!(playback.labels(), labels());
    events
}

#[test]
fn a_recording_gives_the_very_events_it_was_made_of() {
    let (file, events) = recorded(1000, 7);
    let known = events.iter().filter_map(|event| match event {
        Event::Frame(frame) => frame.approach_mm.map(|_| frame.frame),
        _ => None,
    });
    let expected: Vec<u64> = (21..=28).chain(50..=56).collect();
    assert_eq!(known.collect::<Vec<_>>(), expected);
    let (found, mut playback) = played(&file);
    assert_eq!((found, playback.labels()), (events, labels()));
    // It ends when the last thing in it happened.
    let events = playback.end();
    let [Event::Status(status)] = &events[..] else {
        panic!("{events:?}")
    };
    assert_eq!(status.time, at(17_500).wall);
    assert_eq!(status.reason.as_deref(), Some("end of recording"));
    assert_eq!((status.frames, status.frames_damaged), (79, 1));
}

/// The events of a recording of which only the entries from `from` on are left.
fn clip(file: &[u8], from: usize) -> (Vec<Event>, Vec<String>) {
    let mut playback = Playback::new(hrn());
    let entries = Reader::new(file).map(Result::unwrap).skip(from);
    let events = entries.flat_map(|found| playback.feed(found).unwrap());
    (events.collect(), playback.left_out())
}

#[test]
fn a_clip_that_begins_anywhere_gives_the_events_from_its_first_rest_on() {
    let (file, events) = recorded(1, 7);
    assert_eq!(play(&file), events);
    let entries: Vec<Entry> = Reader::new(&file[..])
        .map(|found| found.unwrap().entry)
        .collect();
    let (mut in_a_press, mut at_rest) = (0, 0);
    for from in (0..entries.len()).step_by(5) {
        let (found, left_out) = clip(&file, from);
        // The events after the first state are the last ones of the whole recording.
        assert_eq!(found, events[events.len() - found.len()..], "from {from}");
        let is_at_rest = matches!(entries[from], Entry::State(_));
        assert_eq!(left_out.is_empty(), is_at_rest, "{left_out:?} from {from}");
        let first = found.iter().find(|event| matches!(event, Event::Press(_)));
        if let Some(Event::Press(Press { state, .. })) = first {
            assert_eq!(*state, PressState::Begin, "from {from}");
        }
        match left_out.first() {
            Some(note) if !note.contains("has no state") => in_a_press += 1,
            _ => at_rest += 1,
        }
    }
    assert!(in_a_press > 10 && at_rest > 10, "{in_a_press} {at_rest}");
    let (_, left_out) = clip(&file, entries.len() - 1);
    assert_eq!(
        left_out,
        ["sensor \"forearm\": left out: it has no state at rest"]
    );
}

#[test]
fn a_press_that_lost_its_end_with_missing_entries_is_aborted() {
    let (file, events) = recorded(1, 7);
    let is_begin =
        |event: &Event| matches!(event, Event::Press(press) if press.state == PressState::Begin);
    let mut playback = Playback::new(hrn());
    let (mut found, mut is_missing) = (Vec::new(), false);
    for entry in Reader::new(&file[..]).map(Result::unwrap) {
        is_missing &= !matches!(entry.entry, Entry::State(_));
        if !is_missing {
            found.extend(playback.feed(entry).unwrap());
        }
        is_missing |= found.len() < events.len() / 2 && found.last().is_some_and(is_begin);
    }
    let states = found.iter().filter_map(|event| match event {
        Event::Press(press) => Some((press.press, press.state, press.reason)),
        _ => None,
    });
    let expected = [
        (1, PressState::Begin, None),
        (1, PressState::Aborted, Some("end of recording")),
        (2, PressState::Begin, None),
    ];
    assert_eq!(states.take(3).collect::<Vec<_>>(), expected);
}

#[test]
fn references_that_change_hold_from_then_on() {
    let hrn = Arc::new(Model::load(BUILT_IN).unwrap());
    let other = hrn.identified(References::IGNORED).unwrap();
    let before = Pipeline::new(sensor(), hrn.clone(), Clock::Arrival);
    let after = before.with_model(sensor(), Arc::new(other)).unwrap();
    let mut playback = Playback::new(hrn);
    for (pipeline, are_ignored) in [(&before, false), (&after, true), (&before, false)] {
        let state = State::of(pipeline, &labels()).unwrap();
        let found = Found {
            sensor: "forearm".to_owned(),
            at: at(0),
            entry: Entry::State(Box::new(state)),
        };
        playback.feed(found).unwrap();
        let hrn = playback.pipeline("forearm").unwrap().hrn();
        assert_eq!(hrn.known_references().are_ignored(), are_ignored);
    }
}

#[test]
fn a_state_that_no_pipeline_came_to_is_refused() {
    let hrn = hrn();
    let mut pipeline = Pipeline::new(sensor(), hrn.clone(), Clock::Arrival);
    let mut at_rest = None;
    for (moment, input) in story().into_iter().take(120) {
        let _ = pipeline.take(input, moment);
        at_rest = State::of(&pipeline, &labels()).or(at_rest);
    }
    let state = at_rest.unwrap();
    let state = serde_json::to_value(state).unwrap();
    let fed = |place: &str, value: &str| {
        let mut state = state.clone();
        *state.pointer_mut(place).unwrap() = serde_json::from_str(value).unwrap();
        let data = state.to_string().into_bytes();
        let message = message::encode("forearm", at(0), message::STATE, data);
        let found = message::decode_entry(&message, 1).map_err(|error| error.to_string())?;
        let played = Playback::new(hrn.clone()).feed(found);
        played.map(drop).map_err(|error| error.to_string())
    };
    assert_eq!(fed("/format", &FORMAT.to_string()), Ok(()));
    // A place in the state, what is there, and what is said of it, if not `what no pipeline can have come to`.
    let cases = r#"
        /format | 1 | found a recording of format 1, expected
        /sensor/name | "\u001b[2J\n" | sensor "forearm": sensor.name: found "\u{1b}[2J\n", expected a letter a to z
        /at_rest/context | "picking" | context: found
        /at_rest/decoder/decoded | 18446744073709551615 |
        /at_rest/decoder/skipped | 1099511627776 |
        /at_rest/tare/baseline/7 | 1e39 | found other JSON
        /at_rest/judge/own | {"model": "", "presses": [{"reference": {"knowledge": "own", "features": ""}, "shore": 1e39}]} | found other JSON
        /at_rest/judge/objects/known | [{"name": "cup", "presses": 1, "log_sums": [0, 0, 0, 0], "shore_sums": [9, 9, 9, -1]}] |
        /at_rest/judge/objects/known | [{"name": "cup", "presses": 1, "log_sums": [0, 0, 0, 0], "shore_sums": [3e38, 9, 9, 1]}] |
        /at_rest/tare/baseline | [0.0] |
        /at_rest/motion/0 | [0, 1e9] |
        /at_rest/frames | 18446744073709551615 |
        /at_rest/presses | 1099511627776 |"#;
    for case in cases.trim().lines() {
        let parts: Vec<&str> = case.split('|').map(str::trim).collect();
        let [place, value, expected] = parts[..] else {
            panic!("{case}");
        };
        let expected = match expected {
            "" => "sensor \"forearm\": state: found what no pipeline can have come to",
            said => said,
        };
        let refusal = fed(place, value).unwrap_err();
        assert!(refusal.starts_with(expected), "{case}: {refusal}");
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
    let (mut file, _) = recorded(1000, 7);
    // Before the sensor begins anew, the only state is in the first chunk.
    file.truncate(file.len() / 3);
    let mut unplayable = 0;
    for place in (0..file.len()).step_by(97) {
        let mut file = file.clone();
        file[place] ^= 1;
        let (found, good) = recover(Cursor::new(&file), Vec::new()).unwrap();
        let (_, playback) = played(&good);
        let is_played = playback.nothing_played().is_none();
        assert_eq!(found.states == 1, is_played, "byte {place}");
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
}

fn record(opcode: u8, body: &[u8]) -> Vec<u8> {
    let length = (body.len() as u64).to_le_bytes();
    [&[opcode][..], &length, body].concat()
}

/// A chunk of ours whose header says `unpacked` bytes.
fn chunk(unpacked: u64, packed: &[u8]) -> Vec<u8> {
    let mut body = vec![0; 16];
    body.extend(unpacked.to_le_bytes());
    body.extend(0_u32.to_le_bytes());
    body.extend(b"\x04\0\0\0zstd");
    body.extend((packed.len() as u64).to_le_bytes());
    body.extend(packed);
    record(mcap::records::op::CHUNK, &body)
}

/// A whole file with more bytes before its fourth chunk.
fn with(file: &[u8], more: &[u8]) -> Vec<u8> {
    let summary = mcap::Summary::read(file).unwrap().unwrap();
    let fourth = summary.chunk_indexes[3].chunk_start_offset as usize;
    let (before, after) = file.split_at(fourth);
    [before, more, after].concat()
}

#[test]
fn a_chunk_that_would_fill_the_memory_is_lost_and_no_other() {
    let (file, _) = recorded(10, 7);
    let (whole, _) = recover(Cursor::new(&file), Vec::new()).unwrap();
    // 250 MB of zeros pack into some kilobytes.
    let zeros = packed_zeros(250 << 20);
    assert!(zeros.len() < 32 << 10, "{}", zeros.len());
    let bomb = with(&file, &chunk(250 << 20, &zeros));
    let (found, good) = recover(Cursor::new(&bomb), Vec::new()).unwrap();
    assert_eq!(found.messages, whole.messages);
    assert_eq!(found.lost.len(), 1, "{found:?}");
    assert!(!found.is_whole());
    assert_eq!(play(&good), play(&file));
    // Playing it fails with an error, and unpacks nothing.
    let error = Reader::new(&bomb[..]).find_map(Result::err).unwrap();
    assert!(
        error.to_string().contains("expected at most 67108864"),
        "{error}"
    );
    // A chunk whose header says too few bytes is refused too.
    let lie = with(&file, &chunk(1 << 20, &zeros));
    let (found, _) = recover(Cursor::new(&lie), Vec::new()).unwrap();
    assert_eq!(found.messages, whole.messages);
}

#[test]
fn an_attachment_is_passed_over_whatever_its_lengths_are_and_what_is_in_it() {
    use mcap::records::op::{ATTACHMENT, MESSAGE_INDEX};
    let (file, _) = recorded(10, 7);
    let lengths = |data: u64| {
        let body = [&[0; 24][..], &data.to_le_bytes(), &[0; 3]].concat();
        record(ATTACHMENT, &body)
    };
    // The indexes of another program may be long.
    let index_bytes = 5_u32 << 20;
    let mut index = vec![0; 6 + index_bytes as usize];
    index[2..6].copy_from_slice(&index_bytes.to_le_bytes());
    for (name, more) in [
        ("empty", lengths(0)),
        ("short", lengths(3)),
        ("endless", lengths(u64::MAX)),
        (
            "recording",
            record(ATTACHMENT, &[&[0; 80][..], &file].concat()),
        ),
        ("index", record(MESSAGE_INDEX, &index)),
    ] {
        let with = with(&file, &more);
        assert_eq!(play(&with), play(&file), "{name}");
        let (found, good) = recover(Cursor::new(&with), Vec::new()).unwrap();
        assert!(found.is_whole(), "{name}: {found:?}");
        assert_eq!(play(&good), play(&file), "{name}");
    }
}

/// So many zeros, packed as zstd does: in blocks of one repeated byte.
fn packed_zeros(zeros: usize) -> Vec<u8> {
    const BLOCK: usize = 128 << 10;
    // The header: magic, a window of 128 KiB, no checksum, no length.
    let mut packed = vec![0x28, 0xb5, 0x2f, 0xfd, 0x00, 0x38];
    let blocks = zeros / BLOCK;
    for block in 0..blocks {
        let last = usize::from(block + 1 == blocks);
        let head = (BLOCK << 3) | (1 << 1) | last;
        packed.extend(&head.to_le_bytes()[..3]);
        packed.push(0);
    }
    packed
}

#[test]
fn a_replay_knows_the_time_after_2038() {
    let wall: jiff::Timestamp = "2041-03-01T12:00:00.25Z".parse().unwrap();
    let late = Stamp { wall, ..at(0) };
    let message = message::encode_entry("forearm", late, &Entry::Input(Input::Tick));
    let log_time_ns = u64::try_from(wall.as_nanosecond()).unwrap();
    let read = message::decode_entry(&message, log_time_ns).unwrap();
    assert_eq!(read.at, late);
    // The header of the message, which other programs read, ends in 2038.
    let by_header = message::decode_entry(&message, 0).unwrap();
    assert_eq!(by_header.at.wall.to_string(), "2038-01-19T03:14:07.25Z");
}
