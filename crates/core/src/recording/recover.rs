//! Copies the whole parts of a damaged recording into a new one.
//!
//! One scan goes from front to back and trusts no index. It takes each chunk whose checksum fits.
//! If no record follows another one, its length is damaged, and the next record's place is unknown.
//! The scan then searches for the bytes that every chunk has at the same place. It holds one chunk of
//! bounded size.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Read, Seek, SeekFrom, Write};

use mcap::MAGIC;
use mcap::records::{Channel, Record, op};
use mcap::write::NoSeek;

use super::message;
use super::reader::{ChunkRecords, LONGEST_CHUNK_BYTES, decoder, parse};
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
    /// The beginning and the length of each stretch that is damaged, or is a chunk that is not read.
    pub lost: Vec<(u64, u64)>,
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
    while let Some(found) = scan.next().map_err(RecoverError::Read)? {
        match found {
            Whole::Record(record, bytes) => copy.take(*record, bytes)?,
            Whole::Chunk(mut chunk, place) => loop {
                match chunk.next() {
                    Some(Ok((record, bytes))) => copy.take(record, bytes)?,
                    Some(Err(_)) => break scan.lost.push((place, scan.place - place)),
                    None => break scan.whole += 1,
                }
            },
            Whole::End => {}
        }
    }
    copy.done.lost = scan.lost;
    copy.done.chunks = scan.whole;
    copy.done.complete = scan.complete;
    Ok(copy.finish()?)
}

/// What the scan found.
enum Whole {
    /// A record, and the number of its bytes.
    Record(Box<Record<'static>>, usize),
    /// A chunk, and its place. Its records may be damaged.
    Chunk(Box<ChunkRecords>, u64),
    /// The end of what is worth reading, or a chunk that is not read.
    End,
}

/// The damaged file.
struct Scan<R> {
    file: R,
    length: u64,
    /// The place where the scan continues.
    place: u64,
    /// The number of whole chunks.
    whole: u64,
    lost: Vec<(u64, u64)>,
    complete: bool,
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
            lost: Vec::new(),
            complete: false,
        })
    }

    /// The next whole record or chunk. `None` if there are no more.
    fn next(&mut self) -> io::Result<Option<Whole>> {
        while self.place < self.length && !self.complete {
            match self.records_at(self.place)? {
                Some((found, end)) => {
                    self.place = end;
                    return Ok(Some(found));
                }
                None => self.skip()?,
            }
        }
        Ok(None)
    }

    /// The record or chunk that begins at `place`, and its end. `None` if nothing whole begins there.
    fn records_at(&mut self, place: u64) -> io::Result<Option<(Whole, u64)>> {
        let Some((opcode, end)) = self.record_at(place)? else {
            return Ok(None);
        };
        if end - place > RECORD_HEAD_BYTES + LONGEST_CHUNK_BYTES as u64 {
            return Ok(None);
        }
        let bytes = self.bytes(place, end)?;
        let Some((_, body)) = bytes.split_at_checked(RECORD_HEAD_BYTES as usize) else {
            return Ok(None);
        };
        // The rest of the file only repeats what was read. These records have fixed lengths. With
        // another length, the record is another one whose first byte is damaged.
        if matches!((opcode, body.len()), (op::DATA_END, 4) | (op::FOOTER, 20)) {
            self.complete = true;
            return Ok(Some((Whole::End, end)));
        }
        let record = match parse(opcode, body) {
            Ok(Record::Chunk { header, .. }) => {
                if !is_chunk_head(&bytes, self.length - place) {
                    return Ok(None);
                }
                let Ok(chunk) = ChunkRecords::new(&header, body) else {
                    self.lost.push((place, end - place));
                    return Ok(Some((Whole::End, end)));
                };
                return Ok(Some((Whole::Chunk(Box::new(chunk), place), end)));
            }
            // A message has no checksum of its own. In a file with chunks it is another record
            // whose first byte is damaged.
            Ok(Record::Message { .. }) if self.whole > 0 => return Ok(None),
            Ok(record) => record.into_owned(),
            Err(_) => return Ok(None),
        };
        let is_followed = end == self.length || self.record_at(end)?.is_some();
        let record = Whole::Record(Box::new(record), body.len());
        Ok(is_followed.then_some((record, end)))
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
        Ok((known && end <= self.length).then_some((opcode, end)))
    }

    /// Gives up the bytes at the scan's place. The scan continues at the next chunk, whether it is whole
    /// or not, or at the end of the file.
    fn skip(&mut self) -> io::Result<()> {
        let lost = self.place;
        let mut from = lost + 1;
        self.place = loop {
            let block = self.bytes(from, from + BLOCK_BYTES as u64)?;
            let mut heads = block.windows(HEAD_BYTES).enumerate();
            let left = self.length.saturating_sub(from);
            if let Some((at, _)) = heads.find(|(at, head)| is_chunk_head(head, left - *at as u64)) {
                break from + at as u64;
            }
            if block.len() < BLOCK_BYTES {
                break self.length;
            }
            // A chunk's head may lie across the border of two blocks.
            from += (block.len() - HEAD_BYTES + 1) as u64;
        };
        self.lost.push((lost, self.place - lost));
        Ok(())
    }

    /// The bytes from `start` to `end`, or fewer if the file ends before.
    fn bytes(&mut self, start: u64, end: u64) -> io::Result<Vec<u8>> {
        self.file.seek(SeekFrom::Start(start))?;
        let mut bytes = Vec::new();
        self.file
            .by_ref()
            .take(end - start)
            .read_to_end(&mut bytes)?;
        Ok(bytes)
    }
}

/// Whether these bytes, [`HEAD_BYTES`] or more, begin a chunk that ends within `left` bytes. The check
/// compares its lengths with each other, so the rest of the chunk need not be read.
fn is_chunk_head(head: &[u8], left: u64) -> bool {
    let length = number(head, LENGTH_AT);
    let is_of = |compression: &&[u8]| {
        let packed_at = COMPRESSION_AT + compression.len();
        let data_at = (packed_at + 8) as u64;
        let named = head.get(COMPRESSION_AT..packed_at) == Some(*compression);
        named && length.checked_sub(number(head, packed_at)) == Some(data_at - RECORD_HEAD_BYTES)
    };
    head.first() == Some(&op::CHUNK)
        && length <= left.saturating_sub(RECORD_HEAD_BYTES)
        && COMPRESSIONS.iter().any(is_of)
}

/// The number of eight bytes at `at`.
fn number(head: &[u8], at: usize) -> u64 {
    let bytes = head.get(at..at + 8).and_then(|bytes| bytes.try_into().ok());
    bytes.map_or(u64::MAX, u64::from_le_bytes)
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
    /// The bytes of the descriptions so far.
    described_bytes: usize,
    done: Recovered,
}

/// The most bytes of schemas, channels and metadata. Those of ours take some kilobytes, and those of other
/// programs some hundreds. More of them are left out.
const MOST_DESCRIBED_BYTES: usize = 4 << 20;

impl<W: Write> Copy<W> {
    fn new(good: W) -> Result<Self, Error> {
        Ok(Self {
            out: writer::options().create(NoSeek::new(good))?,
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            described: BTreeSet::new(),
            begun: BTreeSet::new(),
            described_bytes: 0,
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

    /// Adds a record of this many bytes.
    fn take(&mut self, record: Record<'static>, bytes: usize) -> Result<(), Error> {
        if !matches!(record, Record::Message { .. }) {
            self.described_bytes = self.described_bytes.saturating_add(bytes);
            if self.described_bytes > MOST_DESCRIBED_BYTES {
                self.done.messages_unknown += 1;
                return Ok(());
            }
        }
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
                    return Ok(());
                }
                let Channel {
                    topic, schema_id, ..
                } = &self.channels[&header.channel_id];
                let schema = self.schemas.get(schema_id);
                let decode = schema.and_then(|(name, ..)| decoder(name));
                match decode.map(|decode| decode(&data, header.log_time)) {
                    Some(Err(_)) => {
                        self.done.messages_damaged += 1;
                        return Ok(());
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
            && self.messages_unknown == 0
            && self.messages_damaged == 0
    }
}
