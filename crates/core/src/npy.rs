//! Reader and writer of one numpy array: a header, then numbers.
//!
//! In: the bytes of an `.npy` file, alone or within an `.npz` file. Out: a [`Header`] and elements.
//! [`to_bytes`] is the way back. The parser goes over the header once and reads only three keys;
//! the header's length is bounded. It unpacks no more bytes than the header asks for.

use std::io::{self, Read};

/// The longest header that is read, in bytes. Numpy writes about a hundred bytes and reads ten
/// thousand.
const LONGEST_HEADER: usize = 10_000;
/// The largest number of dimensions.
const MOST_DIMENSIONS: usize = 8;
/// The number of bytes that are unpacked at once.
const BLOCK_BYTES: usize = 1 << 16;

/// The header of an array.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Header {
    /// The type of the elements, as numpy writes it: `<f4`.
    pub descr: String,
    /// Whether the first axis changes fastest.
    pub fortran_order: bool,
    /// The length of each axis.
    pub shape: Vec<usize>,
}

/// The reason why bytes are not a usable array. Each message follows the word "found".
#[derive(Debug, thiserror::Error)]
pub enum NpyError {
    /// The magic bytes are missing.
    #[error("no .npy array")]
    Magic,
    /// The format is newer than this reader.
    #[error("an .npy array of version {0}")]
    Version(u8),
    /// The header is too long.
    #[error("a header of {0} bytes, of which at most {LONGEST_HEADER} are read")]
    LongHeader(usize),
    /// The header is not UTF-8.
    #[error("a header that is no text")]
    NoText,
    /// A key is unknown, or occurs twice.
    #[error("a header with {0:?}")]
    Key(String),
    /// A character is not the expected one.
    #[error("a header with {found:?} where `{expected}` should be")]
    Character {
        /// The text from that character on.
        found: String,
        /// The expected character.
        expected: char,
    },
    /// A quoted text has no closing quote.
    #[error("a header with a text that does not end")]
    OpenText,
    /// A value is neither `True` nor `False`.
    #[error("a header with {0:?} as truth")]
    Truth(String),
    /// The length of an axis is not a number.
    #[error("a length {0:?}")]
    Length(String),
    /// The array has too many axes.
    #[error("more than {MOST_DIMENSIONS} dimensions")]
    Dimensions,
    /// There is more text after the header.
    #[error("a header that ends with {0:?}")]
    Trailing(String),
    /// The header lacks a key.
    #[error("a header without `{0}`")]
    Missing(&'static str),
    /// There are fewer elements than the header says.
    #[error("{found} elements of {expected}")]
    Few {
        /// The number of elements in the file.
        found: usize,
        /// The number of elements by the header.
        expected: usize,
    },
    /// There are more elements than the header says.
    #[error("more than {0} elements")]
    Many(usize),
    /// The elements have the wrong type.
    #[error("dtype '{0}'")]
    Type(String),
    /// The shape is not that of a table.
    #[error("an array of shape {0:?}")]
    Shape(Vec<usize>),
    /// The file ends too early.
    #[error("an array that is cut off")]
    CutOff,
    /// The bytes cannot be read or unpacked.
    #[error(transparent)]
    Io(io::Error),
}

impl From<io::Error> for NpyError {
    fn from(error: io::Error) -> Self {
        match error.kind() {
            io::ErrorKind::UnexpectedEof => Self::CutOff,
            _ => Self::Io(error),
        }
    }
}

/// Reads an array's header.
///
/// # Errors
///
/// Returns an [`NpyError`] if there is no header or an unreadable one.
pub fn header(reader: &mut impl Read) -> Result<Header, NpyError> {
    let mut start = [0; 8];
    reader.read_exact(&mut start)?;
    let [magic @ .., major, _minor] = start;
    if &magic != b"\x93NUMPY" {
        return Err(NpyError::Magic);
    }
    let length = match major {
        1 => {
            let mut length = [0; 2];
            reader.read_exact(&mut length)?;
            usize::from(u16::from_le_bytes(length))
        }
        2 | 3 => {
            let mut length = [0; 4];
            reader.read_exact(&mut length)?;
            u32::from_le_bytes(length) as usize
        }
        other => return Err(NpyError::Version(other)),
    };
    if length > LONGEST_HEADER {
        return Err(NpyError::LongHeader(length));
    }
    let mut text = vec![0; length];
    reader.read_exact(&mut text)?;
    let text = String::from_utf8(text).map_err(|_| NpyError::NoText)?;
    Text(text.as_str()).header()
}

/// Reads `count` elements of `SIZE` bytes, and no more. It allocates memory only for elements that
/// are there.
///
/// # Errors
///
/// Returns an [`NpyError`] if there are fewer or more elements, or they cannot be unpacked.
pub fn elements<const SIZE: usize, T>(
    reader: &mut impl Read,
    count: usize,
    element: impl Fn([u8; SIZE]) -> T,
) -> Result<Vec<T>, NpyError> {
    let mut values = Vec::new();
    let mut block = Vec::with_capacity(BLOCK_BYTES);
    while values.len() < count {
        let wanted = (count - values.len()).min(BLOCK_BYTES / SIZE) * SIZE;
        block.clear();
        reader
            .by_ref()
            .take(wanted as u64)
            .read_to_end(&mut block)?;
        let (elements, _) = block.as_chunks::<SIZE>();
        values.extend(elements.iter().map(|bytes| element(*bytes)));
        if block.len() < wanted {
            return Err(NpyError::Few {
                found: values.len(),
                expected: count,
            });
        }
    }
    match reader.read(&mut [0]) {
        Ok(0) => Ok(values),
        Ok(_) => Err(NpyError::Many(count)),
        // The unpacker compares the checksum at the end, and reports a difference here.
        Err(error) => Err(error.into()),
    }
}

/// Reads a table of f32, row by row.
///
/// # Errors
///
/// Returns an [`NpyError`] if the bytes are not an array, or not a table of f32.
pub fn table(reader: &mut impl Read) -> Result<Vec<Vec<f32>>, NpyError> {
    let Header {
        descr,
        fortran_order,
        shape,
    } = header(reader)?;
    if descr != "<f4" {
        return Err(NpyError::Type(descr));
    }
    let &[rows, cols] = shape.as_slice() else {
        return Err(NpyError::Shape(shape));
    };
    let count = rows.checked_mul(cols).filter(|&count| count > 0);
    let count = count.ok_or(NpyError::Shape(shape))?;
    let values = elements(reader, count, f32::from_le_bytes)?;
    let place = |row: usize, col: usize| match fortran_order {
        false => row * cols + col,
        true => col * rows + row,
    };
    let row = |row| (0..cols).map(|col| values[place(row, col)]).collect();
    Ok((0..rows).map(row).collect())
}

/// The part of a header's text that is not parsed yet.
struct Text<'a>(&'a str);

impl<'a> Text<'a> {
    fn header(mut self) -> Result<Header, NpyError> {
        let (mut descr, mut fortran_order, mut shape) = (None, None, None);
        self.expect('{')?;
        while !self.take('}') {
            let key = self.quoted()?;
            self.expect(':')?;
            match key {
                "descr" if descr.is_none() => descr = Some(self.quoted()?.to_owned()),
                "fortran_order" if fortran_order.is_none() => fortran_order = Some(self.truth()?),
                "shape" if shape.is_none() => shape = Some(self.lengths()?),
                _ => return Err(NpyError::Key(short(key))),
            }
            if !self.take(',') {
                self.expect('}')?;
                break;
            }
        }
        if !self.0.trim().is_empty() {
            return Err(NpyError::Trailing(short(self.0)));
        }
        Ok(Header {
            descr: descr.ok_or(NpyError::Missing("descr"))?,
            fortran_order: fortran_order.ok_or(NpyError::Missing("fortran_order"))?,
            shape: shape.ok_or(NpyError::Missing("shape"))?,
        })
    }

    /// Takes `char` if it comes next, and says whether it did.
    fn take(&mut self, char: char) -> bool {
        self.0 = self.0.trim_start();
        match self.0.strip_prefix(char) {
            Some(rest) => {
                self.0 = rest;
                true
            }
            None => false,
        }
    }

    fn expect(&mut self, char: char) -> Result<(), NpyError> {
        if self.take(char) {
            return Ok(());
        }
        Err(NpyError::Character {
            found: short(self.0),
            expected: char,
        })
    }

    fn quoted(&mut self) -> Result<&'a str, NpyError> {
        let quote = if self.take('"') { '"' } else { '\'' };
        if quote == '\'' {
            self.expect('\'')?;
        }
        let (text, rest) = self.0.split_once(quote).ok_or(NpyError::OpenText)?;
        self.0 = rest;
        Ok(text)
    }

    fn truth(&mut self) -> Result<bool, NpyError> {
        self.0 = self.0.trim_start();
        for (word, value) in [("True", true), ("False", false)] {
            if let Some(rest) = self.0.strip_prefix(word) {
                self.0 = rest;
                return Ok(value);
            }
        }
        Err(NpyError::Truth(short(self.0)))
    }

    fn lengths(&mut self) -> Result<Vec<usize>, NpyError> {
        self.expect('(')?;
        let mut lengths = Vec::new();
        while !self.take(')') {
            self.0 = self.0.trim_start();
            let digits = self.0.bytes().take_while(u8::is_ascii_digit).count();
            let (number, rest) = self.0.split_at(digits);
            let length = number.parse();
            let length = length.map_err(|_| NpyError::Length(short(self.0)))?;
            lengths.push(length);
            if lengths.len() > MOST_DIMENSIONS {
                return Err(NpyError::Dimensions);
            }
            self.0 = rest;
            if !self.take(',') {
                self.expect(')')?;
                break;
            }
        }
        Ok(lengths)
    }
}

/// The beginning of `text`, for a message.
fn short(text: &str) -> String {
    text.chars().take(20).collect()
}

/// The bytes of an array of f32 with `rows` rows and `cols` columns, row by row, in numpy's format.
///
/// # Panics
///
/// Panics if there are not `rows * cols` values.
pub fn to_bytes(values: &[f32], rows: usize, cols: usize) -> Vec<u8> {
    assert_eq!(values.len(), rows * cols, "a value for each row and column");
    let text = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({rows}, {cols}), }}");
    let mut bytes = padded(&text);
    bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    bytes
}

/// The header of an array whose elements follow row by row, as `ndarray-npy` writes it. `descr` is
/// the type of the elements, as in [`Header`].
pub fn header_bytes(descr: &str, shape: &[usize]) -> Vec<u8> {
    let lengths: Vec<String> = shape.iter().map(usize::to_string).collect();
    // A tuple of one number ends with a comma in Python.
    let comma = if shape.len() == 1 { "," } else { "" };
    let lengths = lengths.join(", ");
    padded(&format!(
        "{{'descr': '{descr}', 'fortran_order': False, 'shape': ({lengths}{comma})}}"
    ))
}

/// Magic, version and length before a header's text, and spaces and a newline after it. All
/// together are a multiple of 64 bytes.
fn padded(text: &str) -> Vec<u8> {
    const BEFORE_TEXT: usize = 10;
    let length = (BEFORE_TEXT + text.len() + 1).next_multiple_of(64) - BEFORE_TEXT;
    let text = format!("{text:<width$}\n", width = length - 1);
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((length as u16).to_le_bytes());
    bytes.extend(text.as_bytes());
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(text: &str) -> Vec<u8> {
        let length = (text.len() as u32).to_le_bytes();
        [b"\x93NUMPY\x02\x00", &length[..], text.as_bytes()].concat()
    }

    #[test]
    fn a_header_is_read_as_numpy_writes_it() {
        let expected = |fortran_order, shape: &[usize]| Header {
            descr: "<f4".to_owned(),
            fortran_order,
            shape: shape.to_vec(),
        };
        for (text, header_of) in [
            (
                "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 28, 28), }      \n",
                expected(false, &[2, 28, 28]),
            ),
            (
                "{\"shape\":(7,),\"fortran_order\":True,\"descr\":\"<f4\"}",
                expected(true, &[7]),
            ),
            (
                "{'descr': '<f4', 'fortran_order': False, 'shape': ()}\n",
                expected(false, &[]),
            ),
        ] {
            assert_eq!(
                header(&mut file(text).as_slice()).unwrap(),
                header_of,
                "{text}"
            );
        }
    }

    #[test]
    fn what_is_no_header_is_said_at_once() {
        let deep = "{".repeat(9_000);
        let long = " ".repeat(LONGEST_HEADER + 1);
        for (text, expected) in [
            (deep.as_str(), "a header with \"{{{{"),
            (long.as_str(), "a header of 10001 bytes"),
            ("{'descr': [('a', '<f4')]", "where `'` should be"),
            ("{'shape': (2, -1)}", "a length \"-1)}\""),
            ("{'shape': (99999999999999999999,)}", "a length"),
            ("{'shape': (1,1,1,1,1,1,1,1,1)}", "more than 8 dimensions"),
            ("{'shape': (1,), 'shape': (2,)}", "a header with \"shape\""),
            ("{'descr': '<f4'}", "without `fortran_order`"),
            ("{'descr': '<f4", "a text that does not end"),
            ("{} {}", "a header that ends with \" {}\""),
        ] {
            let error = header(&mut file(text).as_slice()).unwrap_err().to_string();
            assert!(error.contains(expected), "{text:.40}: {error}");
            assert!(error.len() < 100, "{error}");
        }
        for (bytes, expected) in [
            (&b"PK\x03\x04"[..], "cut off"),
            (b"\x93NUMPX\x01\0", "no .npy array"),
            (b"\x93NUMPY\x04\0", "version 4"),
            (b"\x93NUMPY\x01\0\xff\0{", "cut off"),
        ] {
            let mut bytes = bytes;
            let error = header(&mut bytes).unwrap_err().to_string();
            assert!(error.contains(expected), "{bytes:?}: {error}");
        }
    }

    /// A reader of endless bytes. It counts the bytes that were asked for.
    struct Endless(usize);

    impl Read for Endless {
        fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
            self.0 += into.len();
            into.fill(0);
            Ok(into.len())
        }
    }

    #[test]
    fn no_more_is_unpacked_than_the_header_asks_for() {
        let mut endless = Endless(0);
        let error = elements(&mut endless, 1_000, f32::from_le_bytes).unwrap_err();
        assert_eq!(error.to_string(), "more than 1000 elements");
        assert!(endless.0 <= 4_001, "{} bytes were unpacked", endless.0);
        let short = elements(&mut &[0; 7][..], 1 << 40, f32::from_le_bytes).unwrap_err();
        assert_eq!(short.to_string(), "1 elements of 1099511627776");
        let two = elements(&mut &[1, 2][..], 2, u8::from_le_bytes).unwrap();
        assert_eq!(two, [1, 2]);
    }

    #[test]
    fn a_table_is_read_in_both_orders_as_it_is_written() {
        let values = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        let bytes = to_bytes(&values, 2, 3);
        assert_eq!(bytes.len() % 64, 6 * 4);
        let rows = table(&mut bytes.as_slice()).unwrap();
        assert_eq!(rows, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
        let numbers: Vec<u8> = values
            .iter()
            .flat_map(|value| value.to_le_bytes())
            .collect();
        let read = |text: &str| table(&mut [file(text), numbers.clone()].concat().as_slice());
        let columns = read("{'descr': '<f4', 'fortran_order': True, 'shape': (2, 3)}").unwrap();
        assert_eq!(columns, [[1.0, 3.0, 5.0], [2.0, 4.0, 6.0]]);
        for (text, expected) in [
            (
                "{'descr': '<f8', 'fortran_order': False, 'shape': (1, 3)}",
                "dtype '<f8'",
            ),
            (
                "{'descr': '<f4', 'fortran_order': False, 'shape': (6,)}",
                "an array of shape [6]",
            ),
            (
                "{'descr': '<f4', 'fortran_order': False, 'shape': (9000000000, 0)}",
                "of shape [9000000000, 0]",
            ),
            (
                "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 2)}",
                "more than 4 elements",
            ),
            (
                "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 4)}",
                "6 elements of 8",
            ),
        ] {
            let error = read(text).unwrap_err().to_string();
            assert!(error.contains(expected), "{text}: {error}");
        }
    }
}
