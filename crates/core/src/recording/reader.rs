//! Reads the bytes of an MCAP file back as entries.

use std::collections::BTreeMap;
use std::io::{Cursor, ErrorKind, Read};

use mcap::records::{Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};

use super::message::{self, INPUT, MOTION};
use super::{Entry, Error, MAGIC};
use crate::frame::Stamp;

/// An entry of a sensor, and its moment.
#[derive(Debug, Clone, PartialEq)]
pub struct Found {
    /// The sensor's name.
    pub sensor: String,
    /// The moment of the entry.
    pub at: Stamp,
    /// The entry.
    pub entry: Entry,
}

/// The longest chunk that is read, packed and unpacked. A chunk of ours ends with the first message
/// after 1 MiB. Those of other programs may be longer.
pub(super) const LONGEST_CHUNK_BYTES: usize = 64 << 20;

/// The bytes of a chunk's record before its data, without the name of the compression: two times, the
/// unpacked length, the checksum, the name's length, and the data's length.
const CHUNK_HEADER_BYTES: usize = 8 + 8 + 8 + 4 + 4 + 8;

/// The records of a file or of a chunk, one after another: the opcode and the bytes of each.
pub(super) struct Records<R> {
    source: R,
    linear: LinearReader,
    /// The bytes of the file's magic that are still to be read.
    magic: usize,
}

impl<R: Read> Records<R> {
    /// The records of a file. Chunks are records here.
    fn of_file(source: R) -> Self {
        let options = LinearReaderOptions::default()
            .with_emit_chunks(true)
            .with_record_length_limit(LONGEST_CHUNK_BYTES);
        Self {
            source,
            linear: LinearReader::new_with_options(options),
            magic: MAGIC.len(),
        }
    }

    fn read(&mut self) -> Result<Option<(u8, Vec<u8>)>, Error> {
        while let Some(event) = self.linear.next_event() {
            match event? {
                LinearReadEvent::ReadRequest(wanted) => {
                    let read = loop {
                        match self.source.read(self.linear.insert(wanted)) {
                            Err(error) if error.kind() == ErrorKind::Interrupted => {}
                            read => break read?,
                        }
                    };
                    self.magic = self.magic.saturating_sub(read);
                    if read == 0 && self.magic > 0 {
                        // Such a short file holds nothing that could be saved.
                        let found = MAGIC.len() - self.magic;
                        let words = format!("found {found} bytes, expected a recording");
                        return Err(Error::Content(words));
                    }
                    self.linear.notify_read(read);
                }
                LinearReadEvent::Record { opcode, data } => {
                    return Ok(Some((opcode, data.to_vec())));
                }
            }
        }
        Ok(None)
    }
}

impl Records<Cursor<Vec<u8>>> {
    /// The records of a chunk whose record has the bytes `body`. The chunk is held unpacked, and never all
    /// its records: a chunk may have millions. The unpacked length is checked before the chunk is unpacked,
    /// and the checksum before any record is used. The chunk is read apart from the file and without what
    /// may follow its data, because the crate reads past the data of a chunk without compression.
    ///
    /// # Errors
    ///
    /// Fails if the chunk is cut off or too long.
    pub(super) fn of_chunk(mut body: Vec<u8>) -> Result<Self, Error> {
        let Record::Chunk { header, data } = parse(op::CHUNK, &body)? else {
            return Err(mcap::McapError::UnexpectedEoc.into());
        };
        let length = header.uncompressed_size;
        if length > LONGEST_CHUNK_BYTES as u64 {
            return Err(mcap::McapError::ChunkTooLarge(length).into());
        }
        let options = LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_prevalidate_chunk_crcs(true)
            // The crate holds the chunk itself to the limit of its records too.
            .with_record_length_limit(LONGEST_CHUNK_BYTES);
        let length = CHUNK_HEADER_BYTES + header.compression.len() + data.len();
        body.truncate(length);
        let length = (length as u64).to_le_bytes();
        body.splice(..0, [op::CHUNK].into_iter().chain(length));
        Ok(Self {
            source: Cursor::new(body),
            linear: LinearReader::new_with_options(options),
            magic: 0,
        })
    }
}

impl<R: Read> Iterator for Records<R> {
    type Item = Result<(u8, Vec<u8>), Error>;

    fn next(&mut self) -> Option<Self::Item> {
        self.read().transpose()
    }
}

/// Parses a record. An attachment is passed over, because the crate panics on one whose lengths do not
/// fit. No recording of ours has any. Nor is a header read.
pub(super) fn parse(opcode: u8, body: &[u8]) -> Result<Record<'_>, mcap::McapError> {
    let (texts, are_more) = match opcode {
        op::ATTACHMENT | op::HEADER => {
            let data = body.into();
            return Ok(Record::Unknown { opcode, data });
        }
        op::SCHEMA => (texts(body, 2, 2), false),
        op::CHANNEL => (texts(body, 4, 2), true),
        op::CHUNK => (texts(body, 28, 1), false),
        op::METADATA => (texts(body, 0, 1), true),
        _ => return mcap::parse_record(opcode, body),
    };
    // After the texts comes the length of a list of further ones.
    let are_whole = texts.is_some_and(|rest| !are_more || list_of_texts(rest).is_some());
    match are_whole {
        true => mcap::parse_record(opcode, body),
        false => Err(mcap::McapError::UnexpectedEoc),
    }
}

/// What follows so many texts, which begin at `start`. `None` if one is longer than the record: the crate takes as much
/// memory as the length says before it looks.
fn texts(body: &[u8], start: usize, count: usize) -> Option<&[u8]> {
    let mut rest = body.get(start..)?;
    for _ in 0..count {
        let (length, text) = rest.split_first_chunk::<4>()?;
        rest = text.get(u32::from_le_bytes(*length) as usize..)?;
    }
    Some(rest)
}

/// The same for a list of texts, which has its own length before it.
fn list_of_texts(list: &[u8]) -> Option<()> {
    let (length, rest) = list.split_first_chunk::<4>()?;
    let mut rest = rest.get(..u32::from_le_bytes(*length) as usize)?;
    while !rest.is_empty() {
        rest = texts(rest, 0, 1)?;
    }
    Some(())
}

/// The decoder of the messages of a schema, if they are read.
pub(super) fn decoder(schema: &str) -> Option<Decode> {
    match schema {
        _ if schema == INPUT.schema => Some(message::decode_entry),
        _ if schema == MOTION.schema => Some(message::decode_motion),
        _ => None,
    }
}

/// A function that reads a message and the time at which it was logged, in nanoseconds since 1970.
pub(super) type Decode = fn(&[u8], u64) -> Result<Found, Error>;

/// Reads a recording from its beginning. It yields the entries in order, and ends after the first
/// error.
///
/// # Example
///
/// [`Writer`](super::Writer) has an example with a recording. This example reads bytes that are not
/// a recording:
///
/// ```
/// use hardnessd_core::recording::Reader;
///
/// let mut reader = Reader::new(&b"no recording"[..]);
/// let error = reader.next().unwrap().unwrap_err();
/// assert_eq!(error.to_string(), "found no MCAP file, expected a recording");
/// assert!(reader.next().is_none());
/// ```
pub struct Reader<R> {
    records: Records<R>,
    /// The decoders of the messages that are read, by schema number. `channels` has them by channel
    /// number.
    schemas: BTreeMap<u16, Decode>,
    channels: BTreeMap<u16, Decode>,
    /// The current chunk.
    chunk: Option<Records<Cursor<Vec<u8>>>>,
    /// Whether the summary, an error or the end was reached.
    done: bool,
}

impl<R: Read> Reader<R> {
    /// A reader of `source`.
    pub fn new(source: R) -> Self {
        Self {
            records: Records::of_file(source),
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            chunk: None,
            done: false,
        }
    }

    fn read(&mut self) -> Result<Option<Found>, Error> {
        loop {
            let of_chunk = self.chunk.as_mut().and_then(Iterator::next);
            if of_chunk.is_none() {
                self.chunk = None;
            }
            let Some((opcode, body)) = of_chunk.or_else(|| self.records.next()).transpose()? else {
                return Ok(None);
            };
            match opcode {
                // The summary only repeats what was read.
                op::DATA_END => return Ok(None),
                op::CHUNK => self.chunk = Some(Records::of_chunk(body)?),
                _ => {
                    if let Some(found) = self.take(parse(opcode, &body)?)? {
                        return Ok(Some(found));
                    }
                }
            }
        }
    }

    /// Learns from a schema or a channel. Returns the entry of a message that is read.
    fn take(&mut self, record: Record<'_>) -> Result<Option<Found>, Error> {
        match record {
            Record::Schema { header, .. } => {
                if let Some(decode) = decoder(&header.name) {
                    self.schemas.insert(header.id, decode);
                }
            }
            Record::Channel(channel) => {
                if let Some(&decode) = self.schemas.get(&channel.schema_id) {
                    self.channels.insert(channel.id, decode);
                }
            }
            Record::Message { header, data } => {
                if let Some(decode) = self.channels.get(&header.channel_id) {
                    return decode(&data, header.log_time).map(Some);
                }
            }
            _ => {}
        }
        Ok(None)
    }
}

impl<R: Read> Iterator for Reader<R> {
    type Item = Result<Found, Error>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.done {
            return None;
        }
        let found = self.read().transpose();
        self.done = !matches!(found, Some(Ok(_)));
        found
    }
}
