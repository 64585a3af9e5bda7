//! Copies the whole parts of a damaged recording into a new one.
//!
//! One scan goes from front to back and trusts no index. It goes from record to record, and takes each
//! chunk whose checksum fits. Where a record is damaged, the next one's place is unknown, so the scan
//! searches for the bytes that every chunk has at the same place. It holds one chunk of bounded size.

use std::collections::BTreeMap;
use std::io::{self, Read, Seek, SeekFrom, Write};

use mcap::MAGIC;
use mcap::records::{Channel, Record, op};
use mcap::write::NoSeek;

use super::message;
use super::reader::{LONGEST_CHUNK_BYTES, Records, decoder, parse};
use super::{Entry, Error, writer};

/// The result of recovering a damaged recording.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Recovered {
    /// The number of saved messages.
    pub messages: u64,
    /// The number of saved messages that are states of a sensor. A recording can be played from the
    /// first state on.
    pub states: u64,
    /// The number of whole chunks.
    pub chunks: u64,
    /// The first and the last saved moment, in nanoseconds since 1970.
    pub span_ns: Option<(u64, u64)>,
    /// The beginning and the length of each stretch that is damaged, or is a chunk that is not read.
    pub lost: Vec<(u64, u64)>,
    /// The number of messages in whole chunks that cannot be read, because of damage or because nothing
    /// describes their channel.
    pub messages_lost: u64,
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
const BLOCK_BYTES: usize = 1 << 13;

/// Copies the whole parts of `broken` to `good`, and returns an account of them.
///
/// # Errors
///
/// Returns an error if reading or writing fails. Damage is not an error.
pub fn recover<R: Read + Seek, W: Write>(
    broken: R,
    good: W,
) -> Result<(Recovered, W), RecoverError> {
    let mut broken = Broken::new(broken).map_err(RecoverError::Read)?;
    let mut copy = Copy::new(good)?;
    // The magic is skipped unread, so damage to it loses nothing.
    let mut place = MAGIC.len() as u64;
    while place < broken.length && !copy.done.complete {
        let found = broken.record(place).map_err(RecoverError::Read)?;
        let (end, is_copied) = match found {
            Some((op::CHUNK, body, end)) => {
                let is_copied = match body {
                    Some(body) => copy.chunk(body)?,
                    None => false,
                };
                copy.done.chunks += u64::from(is_copied);
                (end, is_copied)
            }
            Some((opcode, Some(body), end)) if copy.outside(opcode, &body)? => (end, true),
            // Only its length is read of an attachment, which is left out.
            Some((op::ATTACHMENT, None, end)) => (end, true),
            _ => {
                let next = broken.chunk_from(place + 1);
                (next.map_err(RecoverError::Read)?, false)
            }
        };
        if !is_copied {
            copy.done.lost.push((place, end - place));
        }
        place = end;
    }
    Ok(copy.finish()?)
}

/// The opcode, the bytes and the end of a record.
type FoundRecord = (u8, Option<Vec<u8>>, u64);

/// The damaged file.
struct Broken<R> {
    file: R,
    length: u64,
}

impl<R: Read + Seek> Broken<R> {
    fn new(mut file: R) -> io::Result<Self> {
        let length = file.seek(SeekFrom::End(0))?;
        Ok(Self { file, length })
    }

    /// The place of the next chunk from `from` on, whether it is whole or not, or the end of the file.
    fn chunk_from(&mut self, mut from: u64) -> io::Result<u64> {
        loop {
            let block = self.bytes(from, from + BLOCK_BYTES as u64)?;
            let mut heads = block.windows(HEAD_BYTES).enumerate();
            let left = self.length.saturating_sub(from);
            if let Some((at, _)) = heads.find(|(at, head)| is_chunk_head(head, left - *at as u64)) {
                return Ok(from + at as u64);
            }
            if block.len() < BLOCK_BYTES {
                return Ok(self.length);
            }
            // A chunk's head may lie across the border of two blocks.
            from += (block.len() - HEAD_BYTES + 1) as u64;
        }
    }

    /// The opcode, the bytes and the end of the record at `place`. `None` if there is none: a chunk begins
    /// with the bytes that every chunk has, and another record is followed by a record or by the end of
    /// the file. The bytes of an attachment, and of a record longer than any that is read, are `None`.
    fn record(&mut self, place: u64) -> io::Result<Option<FoundRecord>> {
        let Some(end) = self.end_of(place)? else {
            return Ok(None);
        };
        let head = self.bytes(place, place + HEAD_BYTES as u64)?;
        let is_whole = match head[0] {
            op::CHUNK => is_chunk_head(&head, self.length - place),
            _ => end == self.length || self.end_of(end)?.is_some(),
        };
        let body_at = place + RECORD_HEAD_BYTES;
        let is_read = head[0] != op::ATTACHMENT && end - body_at <= LONGEST_CHUNK_BYTES as u64;
        let body = match is_whole && is_read {
            true => Some(self.bytes(body_at, end)?),
            false => None,
        };
        Ok(is_whole.then_some((head[0], body, end)))
    }

    /// The end of the record at `place`, if there can be a record.
    fn end_of(&mut self, place: u64) -> io::Result<Option<u64>> {
        let head = self.bytes(place, place + RECORD_HEAD_BYTES)?;
        let is_record = head.len() as u64 == RECORD_HEAD_BYTES
            && (op::HEADER..=op::DATA_END).contains(&head[0]);
        let end = place + RECORD_HEAD_BYTES;
        let end = end.saturating_add(number(&head, LENGTH_AT));
        Ok(Some(end).filter(|&end| is_record && end <= self.length))
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
    if head.first() != Some(&op::CHUNK) {
        return false;
    }
    let length = number(head, LENGTH_AT);
    let is_of = |compression: &&[u8]| {
        let packed_at = COMPRESSION_AT + compression.len();
        let data_at = (packed_at + 8) as u64;
        let named = head.get(COMPRESSION_AT..packed_at) == Some(*compression);
        named && length.checked_sub(number(head, packed_at)) == Some(data_at - RECORD_HEAD_BYTES)
    };
    length <= left.saturating_sub(RECORD_HEAD_BYTES) && COMPRESSIONS.iter().any(is_of)
}

/// The number of eight bytes at `at`.
fn number(head: &[u8], at: usize) -> u64 {
    let bytes = head.get(at..at + 8).and_then(|bytes| bytes.try_into().ok());
    bytes.map_or(u64::MAX, u64::from_le_bytes)
}

/// The new file.
struct Copy<W: Write> {
    out: mcap::Writer<NoSeek<W>>,
    /// The names of the schemas in the new file. It has one schema and one channel of a number: a later one
    /// is damage.
    schemas: BTreeMap<u16, String>,
    /// The channels in the new file, and the schema of each.
    channels: BTreeMap<u16, u16>,
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

    /// Adds the records of a chunk. Returns `false` if it is damaged: what stands before the damage is added.
    fn chunk(&mut self, body: Vec<u8>) -> Result<bool, Error> {
        let Ok(records) = Records::of_chunk(body) else {
            return Ok(false);
        };
        for record in records {
            let Ok((opcode, body)) = record else {
                return Ok(false);
            };
            let Ok(record) = parse(opcode, &body) else {
                return Ok(false);
            };
            self.take(record, body.len())?;
        }
        Ok(true)
    }

    /// Adds a record outside of chunks. Returns `false` if it is damaged.
    fn outside(&mut self, opcode: u8, body: &[u8]) -> Result<bool, Error> {
        // The rest of the file only repeats what was read. These records have fixed lengths. With
        // another length, the record is another one whose first byte is damaged.
        if matches!((opcode, body.len()), (op::DATA_END, 4) | (op::FOOTER, 20)) {
            self.done.complete = true;
            return Ok(true);
        }
        match parse(opcode, body) {
            // A chunk that is whole is none of these. A message has no checksum of its own: in a file with
            // chunks it is another record whose first byte is damaged.
            Ok(Record::Chunk { .. }) | Err(_) => Ok(false),
            Ok(Record::Message { .. }) if self.done.chunks > 0 => Ok(false),
            Ok(record) => self.take(record, body.len()).map(|()| true),
        }
    }

    /// Adds a record of this many bytes.
    fn take(&mut self, record: Record<'_>, bytes: usize) -> Result<(), Error> {
        if let Record::Metadata(_) | Record::Schema { .. } | Record::Channel(_) = record {
            self.described_bytes = self.described_bytes.saturating_add(bytes);
            if self.described_bytes > MOST_DESCRIBED_BYTES {
                self.done.messages_lost += 1;
                return Ok(());
            }
        }
        match record {
            Record::Metadata(metadata) => self.out.write_metadata(&metadata)?,
            Record::Schema { header, data } if header.id > 0 => {
                self.describe(header.id, &header.name, &header.encoding, &data)?;
            }
            Record::Channel(channel) => self.begin(&channel)?,
            Record::Message { header, data } => {
                if !self.channels.contains_key(&header.channel_id) {
                    self.restore(header.channel_id, &data)?;
                }
                let Some(schema) = self.channels.get(&header.channel_id) else {
                    self.done.messages_lost += 1;
                    return Ok(());
                };
                let decode = self.schemas.get(schema).and_then(|name| decoder(name));
                match decode.map(|decode| decode(&data, header.log_time)) {
                    Some(Err(_)) => {
                        self.done.messages_lost += 1;
                        return Ok(());
                    }
                    Some(Ok(found)) if matches!(found.entry, Entry::State(_)) => {
                        self.done.states += 1;
                    }
                    _ => {}
                }
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

    /// Adds a schema to the new file.
    fn describe(&mut self, id: u16, name: &str, encoding: &str, text: &[u8]) -> Result<(), Error> {
        if !self.schemas.contains_key(&id) {
            self.out.add_schema_with_id(id, name, encoding, text)?;
            self.schemas.insert(id, name.to_owned());
        }
        Ok(())
    }

    /// Adds a channel to the new file, if its schema is there.
    fn begin(&mut self, channel: &Channel) -> Result<(), Error> {
        let Channel {
            id,
            schema_id,
            topic,
            message_encoding,
            metadata,
        } = channel;
        let is_described = *schema_id == 0 || self.schemas.contains_key(schema_id);
        if is_described && !self.channels.contains_key(id) {
            self.out
                .add_channel_with_id(*id, *schema_id, topic, message_encoding, metadata)?;
            self.channels.insert(*id, *schema_id);
        }
        Ok(())
    }

    /// Restores a channel of ours whose record is lost. Its number tells the topic, and every
    /// message has the sensor's name.
    fn restore(&mut self, id: u16, message: &[u8]) -> Result<(), Error> {
        let ours = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
        let named = |name: &String| !name.is_empty() && name.chars().all(ours);
        let Some(sensor) = message::sensor_of(message).filter(named) else {
            return Ok(());
        };
        let topic = writer::topic_of(id);
        let schema_id = writer::schema_id(topic);
        self.describe(schema_id, topic.schema, "ros2msg", topic.text().as_bytes())?;
        if self.schemas[&schema_id] != topic.schema {
            return Ok(());
        }
        self.begin(&Channel {
            id,
            schema_id,
            topic: topic.of(&sensor),
            message_encoding: "cdr".to_owned(),
            metadata: BTreeMap::new(),
        })
    }
}

impl Recovered {
    /// Whether the file was whole.
    pub fn is_whole(&self) -> bool {
        self.complete && self.lost.is_empty() && self.messages_lost == 0
    }
}
