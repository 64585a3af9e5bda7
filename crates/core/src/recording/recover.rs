//! Copies the whole parts of a damaged recording into a new one.
//!
//! One scan goes from front to back and trusts no index. It takes each chunk whose checksum fits.
//! If a record does not fill its length, the next record's place is unknown. The scan then searches
//! for the bytes that every chunk has at the same place. Whatever the file holds, the
//! scan reads no more than a few times its length, unpacks a bounded length ([`Chunks`]), and
//! holds one chunk of bounded size.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Read, Seek, SeekFrom, Write};

use mcap::MAGIC;
use mcap::records::{Channel, Record, op};
use mcap::write::NoSeek;

use super::message;
use super::reader::{Chunks, LONGEST_CHUNK_BYTES, decoder, parse, too_long};
use super::{Entry, Error, writer};

/// The result of recovering a damaged recording.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Recovered {
    /// The number of saved messages.
    pub messages: u64,
    /// The number of saved messages that other programs wrote.
    pub messages_foreign: u64,
    /// The number of saved messages that are states of a sensor. A recording can be played from the
    /// first state on.
    pub states: u64,
    /// The number of whole chunks.
    pub chunks: u64,
    /// The first and the last saved moment, in nanoseconds since 1970.
    pub span_ns: Option<(u64, u64)>,
    /// The beginning and the length of each damaged stretch, in bytes of the file.
    pub lost: Vec<(u64, u64)>,
    /// The place of each chunk that is not damaged and yet not read, and the reason.
    pub unread: Vec<(u64, String)>,
    /// The number of messages in whole chunks whose channel is unknown.
    pub messages_unknown: u64,
    /// The number of messages in whole chunks that cannot be read. A chunk without a checksum may
    /// have them.
    pub messages_damaged: u64,
    /// Whether the file had its end.
    pub complete: bool,
}

/// The file that could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum RecoverError {
    /// The damaged file cannot be read.
    #[error(transparent)]
    Read(io::Error),
    /// The new file cannot be written.
    #[error(transparent)]
    Write(#[from] Error),
}

/// The bytes of a record's opcode and length.
const RECORD_HEAD_BYTES: u64 = 9;
/// The place of a record's length: after its opcode.
const LENGTH_AT: usize = 1;
/// The place of the name of a chunk's compression: after opcode, length, two times, the unpacked
/// length and the checksum.
const COMPRESSION_AT: usize = RECORD_HEAD_BYTES as usize + 16 + 8 + 4;
/// The names of the compressions, with their lengths.
const COMPRESSIONS: [&[u8]; 3] = [b"\x04\0\0\0zstd", b"\x03\0\0\0lz4", b"\0\0\0\0"];
/// The bytes before a chunk's data: after the longest name and the data's length.
const HEAD_BYTES: usize = COMPRESSION_AT + COMPRESSIONS[0].len() + 8;
/// The number of bytes that are searched at once.
const BLOCK_BYTES: usize = 1 << 20;

/// Copies the whole parts of `broken` to `good`, and returns an account of them.
///
/// # Errors
///
/// Returns an error if reading or writing fails. Damage is not an error.
pub fn recover<R: Read + Seek, W: Write>(
    broken: R,
    good: W,
) -> Result<(Recovered, W), RecoverError> {
    let mut scan = Scan::new(broken).map_err(RecoverError::Read)?;
    let mut copy = Copy::new(good)?;
    while let Some(records) = scan.next().map_err(RecoverError::Read)? {
        copy.take(records)?;
    }
    copy.done.lost = scan.lost;
    copy.done.unread = scan.unread;
    copy.done.chunks = scan.whole;
    copy.done.complete = scan.complete;
    Ok(copy.finish()?)
}

/// The damaged file.
struct Scan<R> {
    file: R,
    length: u64,
    /// The place where the scan continues.
    place: u64,
    /// The number of whole chunks.
    whole: u64,
    chunks: Chunks,
    lost: Vec<(u64, u64)>,
    unread: Vec<(u64, String)>,
    /// The numbers of the channels so far.
    channels: BTreeSet<u16>,
    complete: bool,
    /// The number of bytes read as records that turned out not to be records.
    wasted: u64,
    /// The block that was searched last, and its place in the file.
    block: (u64, Vec<u8>),
    /// The number of all bytes read.
    #[cfg(test)]
    read: u64,
}

impl<R: Read + Seek> Scan<R> {
    fn new(mut file: R) -> io::Result<Self> {
        let length = file.seek(SeekFrom::End(0))?;
        Ok(Self {
            file,
            length,
            // The magic is skipped unread, so damage to it loses nothing.
            place: MAGIC.len() as u64,
            whole: 0,
            chunks: Chunks::default(),
            lost: Vec::new(),
            unread: Vec::new(),
            channels: BTreeSet::new(),
            complete: false,
            wasted: 0,
            block: (0, Vec::new()),
            #[cfg(test)]
            read: 0,
        })
    }

    /// The next whole records. `None` if there are no more.
    fn next(&mut self) -> io::Result<Option<Vec<Record<'static>>>> {
        while self.place < self.length {
            let place = self.place;
            let Some((opcode, end)) = self.record_at(place)? else {
                self.place = match self.long_chunk_at(place)? {
                    Some(length) => {
                        self.unread.push((place, too_long(length)));
                        place + RECORD_HEAD_BYTES + length
                    }
                    None => self.skip(place)?,
                };
                continue;
            };
            let body = self.bytes(place + RECORD_HEAD_BYTES, end)?;
            match (opcode, body.len()) {
                // The rest of the file only repeats what was read. These records have fixed
                // lengths. With another length, the record is another one whose first byte is
                // damaged.
                (op::DATA_END, 4) | (op::FOOTER, 20) => {
                    self.complete = true;
                    return Ok(None);
                }
                _ => {}
            }
            let Some(record) = self.exact(opcode, &body) else {
                self.wasted += end - place;
                self.place = self.skip(place)?;
                continue;
            };
            self.place = end;
            match record {
                Record::Chunk { header, .. } => match self.chunks.records(&header, &body, end) {
                    Ok(records) => {
                        self.whole += 1;
                        self.note(&records);
                        return Ok(Some(records));
                    }
                    Err(Error::Unread(problem)) => self.unread.push((place, problem)),
                    Err(_) => self.lost.push((place, end - place)),
                },
                record => {
                    let records = vec![record.into_owned()];
                    self.note(&records);
                    return Ok(Some(records));
                }
            }
        }
        Ok(None)
    }

    /// Takes in the channels among `records`.
    fn note(&mut self, records: &[Record<'_>]) {
        let channels = records.iter().filter_map(|record| match record {
            Record::Channel(channel) => Some(channel.id),
            _ => None,
        });
        self.channels.extend(channels);
    }

    /// Parses a record if it fills its bytes to the last one. If it does not, its length is
    /// damaged, and its end is unknown.
    ///
    /// A message outside a chunk fills any length, and has no checksum. So its channel must be known,
    /// and in a file with chunks it is another record whose first byte is damaged.
    fn exact<'a>(&self, opcode: u8, body: &'a [u8]) -> Option<Record<'a>> {
        let record = parse(opcode, body).ok()?;
        let is_exact = match &record {
            Record::Message { header, .. } => {
                self.whole == 0 && self.channels.contains(&header.channel_id)
            }
            record => length(record, body) == Some(body.len()),
        };
        is_exact.then_some(record)
    }

    /// The opcode and the end of the record at `place`, if there can be a record.
    fn record_at(&mut self, place: u64) -> io::Result<Option<(u8, u64)>> {
        let head = self.bytes(place, place + RECORD_HEAD_BYTES)?;
        let Ok(head) = <[u8; RECORD_HEAD_BYTES as usize]>::try_from(head) else {
            return Ok(None);
        };
        let [opcode, length @ ..] = head;
        let length = u64::from_le_bytes(length);
        let end = place + RECORD_HEAD_BYTES + length.min(self.length);
        let known = (op::HEADER..=op::DATA_END).contains(&opcode);
        let fits = length <= LONGEST_CHUNK_BYTES as u64 && end <= self.length;
        // After that many wasted bytes, only chunks are tried as records.
        let hopeless = opcode != op::CHUNK && self.wasted > self.length;
        Ok((known && fits && !hopeless).then_some((opcode, end)))
    }

    /// The length of the chunk at `place`, if there is one that is longer than any that is read.
    fn long_chunk_at(&mut self, place: u64) -> io::Result<Option<u64>> {
        let head = self.bytes(place, place + HEAD_BYTES as u64)?;
        let is_chunk = head.len() == HEAD_BYTES && is_chunk_head(&head, self.length - place);
        let length = is_chunk.then(|| number(&head, LENGTH_AT));
        Ok(length.filter(|length| *length > LONGEST_CHUNK_BYTES as u64))
    }

    /// Gives up the bytes at `place`. Returns the place of the next chunk, or the end of the file.
    fn skip(&mut self, place: u64) -> io::Result<u64> {
        let next = self.next_chunk(place + 1)?.unwrap_or(self.length);
        self.lost.push((place, next - place));
        Ok(next)
    }

    /// The place of the next chunk from `place` on, whether the chunk is whole or not.
    fn next_chunk(&mut self, place: u64) -> io::Result<Option<u64>> {
        let mut from = place;
        while from + HEAD_BYTES as u64 <= self.length {
            let (start, block) = &self.block;
            let inside = from
                .checked_sub(*start)
                .and_then(|at| block.get(at as usize..));
            let Some(block) = inside.filter(|block| block.len() >= HEAD_BYTES) else {
                // The next search continues in the same block.
                self.block = (from, self.bytes(from, from + BLOCK_BYTES as u64)?);
                if self.block.1.len() < HEAD_BYTES {
                    // The file has become shorter during the scan.
                    return Ok(None);
                }
                continue;
            };
            let mut heads = block.windows(HEAD_BYTES).enumerate();
            let left = self.length - from;
            if let Some((at, _)) = heads.find(|(at, head)| is_chunk_head(head, left - *at as u64)) {
                return Ok(Some(from + at as u64));
            }
            // A chunk's head may lie across the border of two blocks.
            from += (block.len() - HEAD_BYTES + 1) as u64;
        }
        Ok(None)
    }

    /// The bytes from `start` to `end`, or fewer if the file ends before.
    fn bytes(&mut self, start: u64, end: u64) -> io::Result<Vec<u8>> {
        self.file.seek(SeekFrom::Start(start))?;
        let mut bytes = Vec::new();
        self.file
            .by_ref()
            .take(end - start)
            .read_to_end(&mut bytes)?;
        #[cfg(test)]
        {
            self.read += bytes.len() as u64;
        }
        Ok(bytes)
    }
}

/// Whether these [`HEAD_BYTES`] bytes begin a chunk that ends within `left` bytes. The check compares
/// its lengths with each other, so the rest of the chunk need not be read.
fn is_chunk_head(head: &[u8], left: u64) -> bool {
    let length = number(head, LENGTH_AT);
    let is_of = |compression: &&[u8]| {
        let packed_at = COMPRESSION_AT + compression.len();
        let data_at = (packed_at + 8) as u64;
        head[COMPRESSION_AT..].starts_with(compression)
            && length.checked_sub(number(head, packed_at)) == Some(data_at - RECORD_HEAD_BYTES)
    };
    head[0] == op::CHUNK
        && length <= left.saturating_sub(RECORD_HEAD_BYTES)
        && COMPRESSIONS.iter().any(is_of)
}

/// The number of eight bytes at `at`.
fn number(head: &[u8], at: usize) -> u64 {
    let bytes = head.get(at..at + 8).and_then(|bytes| bytes.try_into().ok());
    bytes.map_or(u64::MAX, u64::from_le_bytes)
}

/// The number of bytes that a record fills by its own lengths. `None` for a record that does not
/// come before the end of the data.
fn length(record: &Record<'_>, body: &[u8]) -> Option<usize> {
    let text = |text: &str| 4 + text.len();
    let map = |map: &BTreeMap<String, String>| {
        4 + map.iter().map(|(k, v)| text(k) + text(v)).sum::<usize>()
    };
    Some(match record {
        Record::Header(header) => text(&header.profile) + text(&header.library),
        Record::Schema { header, data } => {
            2 + text(&header.name) + text(&header.encoding) + 4 + data.len()
        }
        Record::Channel(channel) => {
            4 + text(&channel.topic) + text(&channel.message_encoding) + map(&channel.metadata)
        }
        Record::Chunk { header, data } => 36 + text(&header.compression) + data.len(),
        Record::MessageIndex(index) => 6 + 16 * index.records.len(),
        Record::Metadata(metadata) => text(&metadata.name) + map(&metadata.metadata),
        // An attachment has a checksum of its own.
        Record::Attachment { .. } => body.len(),
        _ => return None,
    })
}

/// The new file.
struct Copy<W: Write> {
    out: mcap::Writer<NoSeek<W>>,
    schemas: BTreeMap<u16, (String, String, Vec<u8>)>,
    channels: BTreeMap<u16, Channel>,
    /// The schemas that the new file already has.
    described: BTreeSet<u16>,
    /// The channels that the new file already has.
    begun: BTreeSet<u16>,
    done: Recovered,
}

impl<W: Write> Copy<W> {
    fn new(good: W) -> Result<Self, Error> {
        Ok(Self {
            out: writer::options().create(NoSeek::new(good))?,
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            described: BTreeSet::new(),
            begun: BTreeSet::new(),
            done: Recovered::default(),
        })
    }

    /// Ends the new file.
    fn finish(mut self) -> Result<(Recovered, W), Error> {
        self.out.finish()?;
        let mut good = self.out.into_inner().into_inner();
        good.flush()?;
        Ok((self.done, good))
    }

    fn take(&mut self, records: Vec<Record<'static>>) -> Result<(), Error> {
        for record in records {
            match record {
                Record::Metadata(metadata) => self.out.write_metadata(&metadata)?,
                // The new file has one schema and one channel of a number. A later one is damage.
                Record::Schema { header, data } if !self.described.contains(&header.id) => {
                    let schema = (header.name, header.encoding, data.into_owned());
                    self.schemas.insert(header.id, schema);
                }
                Record::Channel(channel) if !self.begun.contains(&channel.id) => {
                    self.channels.insert(channel.id, channel);
                }
                Record::Message { header, data } => {
                    if !self.begin(header.channel_id, &data)? {
                        self.done.messages_unknown += 1;
                        continue;
                    }
                    let Channel {
                        topic, schema_id, ..
                    } = &self.channels[&header.channel_id];
                    let schema = self.schemas.get(schema_id);
                    let decode = schema.and_then(|(name, ..)| decoder(name));
                    match decode.map(|decode| decode(&data, header.log_time)) {
                        Some(Err(_)) => {
                            self.done.messages_damaged += 1;
                            continue;
                        }
                        Some(Ok((_, _, Entry::State(_)))) if writer::is_input(topic) => {
                            self.done.states += 1;
                        }
                        _ => {}
                    }
                    self.done.messages_foreign += u64::from(!writer::is_topic_of_ours(topic));
                    self.out.write_to_known_channel(&header, &data)?;
                    self.done.messages += 1;
                    let time = header.log_time;
                    let (first, last) = self.done.span_ns.unwrap_or((time, time));
                    self.done.span_ns = Some((first.min(time), last.max(time)));
                }
                // The writer makes new indexes.
                _ => {}
            }
        }
        Ok(())
    }

    /// Adds this channel to the new file if it is missing. Returns `false` if the channel is
    /// unknown.
    fn begin(&mut self, id: u16, message: &[u8]) -> Result<bool, Error> {
        if self.begun.contains(&id) {
            return Ok(true);
        }
        if !self.channels.contains_key(&id) && !self.restore(id, message) {
            return Ok(false);
        }
        let channel = &self.channels[&id];
        let schema_id = channel.schema_id;
        if let Some((name, encoding, data)) = self.schemas.get(&schema_id) {
            self.out
                .add_schema_with_id(schema_id, name, encoding, data)?;
            self.described.insert(schema_id);
        } else if schema_id != 0 {
            return Ok(false);
        }
        let Channel {
            topic,
            message_encoding,
            metadata,
            ..
        } = channel;
        self.out
            .add_channel_with_id(id, schema_id, topic, message_encoding, metadata)?;
        self.begun.insert(id);
        Ok(true)
    }

    /// Restores a channel of ours whose record is lost. Its number tells the topic, and every
    /// message has the sensor's name.
    fn restore(&mut self, id: u16, message: &[u8]) -> bool {
        let named = |name: &String| {
            let ours = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
            !name.is_empty() && name.chars().all(ours)
        };
        let Some(sensor) = message::sensor_of(message).filter(named) else {
            return false;
        };
        let topic = writer::topic_of(id);
        let schema_id = writer::schema_id(topic);
        let text = topic.text().into_bytes();
        let schema = (topic.schema.to_owned(), "ros2msg".to_owned(), text);
        if *self.schemas.entry(schema_id).or_insert(schema.clone()) != schema {
            return false;
        }
        let channel = Channel {
            id,
            schema_id,
            topic: topic.of(&sensor),
            message_encoding: "cdr".to_owned(),
            metadata: BTreeMap::new(),
        };
        self.channels.insert(id, channel);
        true
    }
}

impl Recovered {
    /// Whether the file was whole.
    pub fn is_whole(&self) -> bool {
        self.complete
            && self.lost.is_empty()
            && self.unread.is_empty()
            && self.messages_unknown == 0
            && self.messages_damaged == 0
    }
}

/// The number of messages in a file, and the number of bytes read to find them.
#[cfg(test)]
pub(super) fn read_of(file: &[u8]) -> (u64, u64) {
    let mut scan = Scan::new(io::Cursor::new(file)).expect("memory can be read");
    let mut messages = 0;
    while let Some(records) = scan.next().expect("memory can be read") {
        let is_message = |record: &&Record<'_>| matches!(record, Record::Message { .. });
        messages += records.iter().filter(is_message).count() as u64;
    }
    (messages, scan.read)
}
