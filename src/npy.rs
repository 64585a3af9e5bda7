//! One numpy array: what its header says, then its numbers.
//!
//! In: the bytes of an `.npy` file, alone or within an `.npz` file. Out: a [`Header`] and elements; and
//! back. A parser goes over the header once and reads only three keys; the header's length is bounded.
//! Nothing is unpacked that the header does not ask for.

use std::io::{self, Read};

/// Longest header that is read, in bytes: numpy's own have about a hundred, and it reads ten thousand.
const LONGEST_HEADER: usize = 10_000;
/// Most dimensions of an array.
const MOST_DIMENSIONS: usize = 8;
/// Bytes unpacked at once.
const BLOCK_BYTES: usize = 1 << 16;

/// What an array's header says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Header {
    /// Type of its elements, as numpy writes it: `<f4`.
    pub descr: String,
    /// Whether the first axis changes fastest.
    pub fortran_order: bool,
    /// Length of each axis.
    pub shape: Vec<usize>,
}

/// What was found in place of an array. Each message continues "found".
#[derive(Debug, thiserror::Error)]
pub enum NpyError {
    /// Other bytes.
    #[error("no .npy array")]
    Magic,
    /// A format that is newer than this reader.
    #[error("an .npy array of version {0}")]
    Version(u8),
    /// A header that no array needs.
    #[error("a header of {0} bytes, of which at most {LONGEST_HEADER} are read")]
    LongHeader(usize),
    /// A header that is not UTF-8.
    #[error("a header that is no text")]
    NoText,
    /// A key that no header has, or one that comes twice.
    #[error("a header with {0:?}")]
    Key(String),
    /// Another character than the one that has to follow.
    #[error("a header with {found:?} where `{expected}` should be")]
    Character {
        /// The text from there on.
        found: String,
        /// The character.
        expected: char,
    },
    /// A quote without its other end.
    #[error("a header with a text that does not end")]
    OpenText,
    /// Neither `True` nor `False`.
    #[error("a header with {0:?} as truth")]
    Truth(String),
    /// An axis whose length is no number.
    #[error("a length {0:?}")]
    Length(String),
    /// More axes than are read.
    #[error("more than {MOST_DIMENSIONS} dimensions")]
    Dimensions,
    /// More text after the header.
    #[error("a header that ends with {0:?}")]
    Trailing(String),
    /// A key that every header has.
    #[error("a header without `{0}`")]
    Missing(&'static str),
    /// Fewer elements than the header says.
    #[error("{found} elements of {expected}")]
    Few {
        /// Those that are there.
        found: usize,
        /// Those that should be.
        expected: usize,
    },
    /// More elements than the header says.
    #[error("more than {0} elements")]
    Many(usize),
    /// Elements of another type.
    #[error("dtype '{0}'")]
    Type(String),
    /// Another shape than that of a table.
    #[error("an array of shape {0:?}")]
    Shape(Vec<usize>),
    /// The end of the file.
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
/// [`NpyError`], if there is no header that can be read.
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

/// Reads `count` elements of `SIZE` bytes, and no more. Room is made for those that are there.
///
/// # Errors
///
/// [`NpyError`], if there are fewer or more, or they cannot be unpacked.
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
        // The checksum is compared at the end.
        Err(error) => Err(error.into()),
    }
}

/// Reads a table of f32, row by row.
///
/// # Errors
///
/// [`NpyError`], if it is another array, or none.
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

/// The rest of a header's text.
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

    /// Whether `char` comes next; then it is taken.
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

/// The beginning of a text of which little is said.
fn short(text: &str) -> String {
    text.chars().take(20).collect()
}

/// The bytes of an array of f32 with this many rows and columns, row by row, as numpy reads it.
///
/// # Panics
///
/// If there is another number of `values`.
pub fn to_bytes(values: &[f32], rows: usize, cols: usize) -> Vec<u8> {
    assert_eq!(values.len(), rows * cols, "a value for each row and column");
    let mut text =
        format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({rows}, {cols}), }}");
    // Magic, version, length and text together have a multiple of 64 bytes; the text ends with a newline.
    const BEFORE_TEXT: usize = 10;
    let length = (BEFORE_TEXT + text.len() + 1).next_multiple_of(64) - BEFORE_TEXT;
    text = format!("{text:<width$}\n", width = length - 1);
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((length as u16).to_le_bytes());
    bytes.extend(text.as_bytes());
    bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
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

    /// Bytes without an end, and how many were asked for.
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
