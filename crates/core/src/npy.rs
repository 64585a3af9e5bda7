//! Reader and writer of one numpy array: a header, then numbers.
//!
//! In: the bytes of an `.npy` file, alone or within an `.npz` file. Out: a [`Header`] and numbers.
//! [`to_bytes`] is the way back. The length of a header is bounded, and no more bytes are unpacked
//! than the header asks for.

use std::io::{self, Read};

use serde::Deserialize;

/// The longest header that is read, in bytes. Numpy writes about a hundred bytes and reads ten
/// thousand.
const LONGEST_HEADER: usize = 10_000;
/// The number of bytes that are unpacked at once.
const BLOCK_BYTES: usize = 1 << 16;

/// The header of an array.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
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
    /// The header is not as numpy writes it.
    #[error("a header that cannot be read: {0}")]
    Header(String),
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
    /// The elements are no numbers, or of a size or a byte order that is not read.
    #[error("dtype '{}'", short(.0))]
    Type(String),
    /// A number does not fit into the type that is needed.
    #[error("{value:?} at {place}")]
    Value {
        /// The number.
        value: f64,
        /// Its place among the elements.
        place: usize,
    },
    /// The shape is not the expected one.
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

impl Header {
    /// Reads the header at the beginning of an array.
    ///
    /// # Errors
    ///
    /// Returns an [`NpyError`] if there is no header or an unreadable one.
    pub fn read(reader: &mut impl Read) -> Result<Self, NpyError> {
        let mut start = [0; 8];
        reader.read_exact(&mut start)?;
        let [magic @ .., major, _minor] = start;
        if &magic != b"\x93NUMPY" {
            return Err(NpyError::Magic);
        }
        let mut length = [0; 4];
        match major {
            1 => reader.read_exact(&mut length[..2])?,
            2 | 3 => reader.read_exact(&mut length)?,
            other => return Err(NpyError::Version(other)),
        }
        let length = u32::from_le_bytes(length) as usize;
        if length > LONGEST_HEADER {
            return Err(NpyError::LongHeader(length));
        }
        let mut text = vec![0; length];
        reader.read_exact(&mut text)?;
        let header = serde_json::from_str(&as_json(&text));
        header.map_err(|error| NpyError::Header(short(&error.to_string())))
    }

    /// The bytes before the elements of an array, whose length is a multiple of 64.
    pub fn to_bytes(&self) -> Vec<u8> {
        const BEFORE_TEXT: usize = 10;
        let lengths: Vec<String> = self.shape.iter().map(usize::to_string).collect();
        // A tuple of one number ends with a comma in Python.
        let comma = if lengths.len() == 1 { "," } else { "" };
        let text = format!(
            "{{'descr': '{}', 'fortran_order': {}, 'shape': ({}{comma})}}",
            self.descr,
            if self.fortran_order { "True" } else { "False" },
            lengths.join(", ")
        );
        let length = (BEFORE_TEXT + text.len() + 1).next_multiple_of(64) - BEFORE_TEXT;
        let text = format!("{text:<width$}\n", width = length - 1);
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((length as u16).to_le_bytes());
        bytes.extend(text.as_bytes());
        bytes
    }

    /// The number of elements. `None` if no machine can hold so many.
    pub fn count(&self) -> Option<usize> {
        let mut lengths = self.shape.iter();
        lengths.try_fold(1_usize, |count, &length| count.checked_mul(length))
    }

    /// Reads the elements that follow the header, and no more bytes. It allocates memory only for
    /// elements that are there. `convert` gives the number as the needed type, if it fits.
    ///
    /// # Errors
    ///
    /// Returns an [`NpyError`] if the elements are no numbers or one does not fit, if there are fewer
    /// or more elements, or they cannot be unpacked.
    pub fn elements<T>(
        &self,
        reader: &mut impl Read,
        convert: impl Fn(f64) -> Option<T>,
    ) -> Result<Vec<T>, NpyError> {
        let count = self.count();
        let count = count.ok_or_else(|| NpyError::Shape(self.shape.clone()))?;
        let number = number(&self.descr);
        let (size, number) = number.ok_or_else(|| NpyError::Type(self.descr.clone()))?;
        let mut values = Vec::new();
        let mut block = Vec::with_capacity(BLOCK_BYTES);
        while values.len() < count {
            let wanted = (count - values.len()).min(BLOCK_BYTES / size) * size;
            block.clear();
            reader
                .by_ref()
                .take(wanted as u64)
                .read_to_end(&mut block)?;
            for bytes in block.chunks_exact(size) {
                let (value, place) = (number(bytes), values.len());
                values.push(convert(value).ok_or(NpyError::Value { value, place })?);
            }
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
}

/// The beginning of a text from a file, for a message.
fn short(text: &str) -> String {
    let text = text.chars().take(60);
    text.map(|char| if char.is_control() { ' ' } else { char })
        .collect()
}

/// A header as JSON. It is a dictionary in Python with a text, a truth and a tuple of numbers, so it
/// differs from JSON in quotes, brackets, truths, and commas after the last element. None of the texts
/// that are read has such a character.
fn as_json(header: &[u8]) -> String {
    let mut text = String::from_utf8_lossy(header).into_owned();
    text.retain(|char| !char.is_whitespace());
    for (python, json) in [
        ("'", "\""),
        ("(", "["),
        (")", "]"),
        ("True", "true"),
        ("False", "false"),
        (",]", "]"),
        (",}", "}"),
    ] {
        text = text.replace(python, json);
    }
    text
}

/// The value of an element from its bytes.
type Decode = fn(&[u8]) -> f64;

/// The size of an element of the type `descr`, and its value from its bytes. `None` if the type is not
/// read. Integers above 2^53 lose their last digits.
#[expect(
    clippy::cast_lossless,
    reason = "the same line reads the wide integers, which have no `From`"
)]
fn number(descr: &str) -> Option<(usize, Decode)> {
    macro_rules! little_endian {
        ($type:ty) => {
            Some((size_of::<$type>(), |bytes| {
                let bytes = bytes.try_into().expect("a chunk of this size");
                <$type>::from_le_bytes(bytes) as f64
            }))
        };
    }
    match descr {
        "|u1" | "<u1" | ">u1" => little_endian!(u8),
        "|i1" | "<i1" | ">i1" => little_endian!(i8),
        "<u2" => little_endian!(u16),
        "<i2" => little_endian!(i16),
        "<u4" => little_endian!(u32),
        "<i4" => little_endian!(i32),
        "<u8" => little_endian!(u64),
        "<i8" => little_endian!(i64),
        "<f4" => little_endian!(f32),
        "<f8" => little_endian!(f64),
        _ => None,
    }
}

/// Reads a table of numbers, row by row.
///
/// # Errors
///
/// Returns an [`NpyError`] if the bytes are not an array, or not a table of numbers.
pub fn table(reader: &mut impl Read) -> Result<Vec<Vec<f32>>, NpyError> {
    let header = Header::read(reader)?;
    let (&[rows, cols], Some(1..)) = (header.shape.as_slice(), header.count()) else {
        return Err(NpyError::Shape(header.shape));
    };
    let values = header.elements(reader, |value| Some(value as f32))?;
    let place = |row: usize, col: usize| match header.fortran_order {
        false => row * cols + col,
        true => col * rows + row,
    };
    let row = |row| (0..cols).map(|col| values[place(row, col)]).collect();
    Ok((0..rows).map(row).collect())
}

/// The bytes of an array of f32 with `rows` rows and `cols` columns, row by row, in numpy's format.
///
/// # Panics
///
/// Panics if there are not `rows * cols` values.
pub fn to_bytes(values: &[f32], rows: usize, cols: usize) -> Vec<u8> {
    assert_eq!(values.len(), rows * cols, "a value for each row and column");
    let header = Header {
        descr: "<f4".to_owned(),
        fortran_order: false,
        shape: vec![rows, cols],
    };
    let mut bytes = header.to_bytes();
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

    fn of(descr: &str, fortran_order: bool, shape: &[usize]) -> Header {
        Header {
            descr: descr.to_owned(),
            fortran_order,
            shape: shape.to_vec(),
        }
    }

    #[test]
    fn a_header_is_read_as_numpy_writes_it() {
        for (text, expected) in [
            (
                "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 28, 28), }      \n",
                of("<f4", false, &[2, 28, 28]),
            ),
            (
                "{\"shape\":(7,),\"fortran_order\":True,\"descr\":\"|u1\"}",
                of("|u1", true, &[7]),
            ),
            (
                "{'descr': '<f4', 'fortran_order': False, 'shape': ()}\n",
                of("<f4", false, &[]),
            ),
        ] {
            let read = |bytes: Vec<u8>| Header::read(&mut bytes.as_slice()).unwrap();
            assert_eq!(read(file(text)), expected, "{text}");
            assert_eq!(expected.to_bytes().len() % 64, 0);
            assert_eq!(read(expected.to_bytes()), expected);
        }
    }

    #[test]
    fn what_is_no_header_is_refused_at_once_in_one_line() {
        let deep = |open: &str| open.repeat(LONGEST_HEADER / open.len());
        for text in [
            // The parser of npyz 0.9 and ndarray-npy 0.10 takes 45 s for 14 braces, and three times as
            // long for each further one.
            &deep("{"),
            &deep("("),
            &deep("{'descr':"),
            &" ".repeat(LONGEST_HEADER + 1),
            "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,)}",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (2, -1)}",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (99999999999999999999,)}",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (1,), 'shape': (2,)}",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (1,), 'more': 1}",
            "{'descr': '<f4'}",
            "{'descr': '<f4",
            "{'a\\nb': 1}",
            "{} {}",
            "\n\n\u{7}",
        ] {
            let error = Header::read(&mut file(text).as_slice());
            let error = error.unwrap_err().to_string();
            assert!(error.starts_with("a header "), "{text:.40}: {error}");
            assert!(error.len() < 120 && !error.contains('\n'), "{error}");
        }
        for (mut bytes, expected) in [
            (&b"PK\x03\x04"[..], "cut off"),
            (b"\x93NUMPX\x01\0", "no .npy array"),
            (b"\x93NUMPY\x04\0", "version 4"),
            (b"\x93NUMPY\x01\0\xff\0{", "cut off"),
        ] {
            let error = Header::read(&mut bytes).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
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
        let elements = |header: Header, reader: &mut dyn Read| {
            let mut reader = reader;
            let error = header.elements(&mut reader, Some).unwrap_err();
            error.to_string()
        };
        let mut endless = Endless(0);
        let error = elements(of("<f4", false, &[10, 100]), &mut endless);
        assert_eq!(error, "more than 1000 elements");
        assert!(endless.0 <= 4_001, "{} bytes were unpacked", endless.0);
        let error = elements(of("<f4", false, &[1 << 40]), &mut &[0; 7][..]);
        assert_eq!(error, "1 elements of 1099511627776");
        let error = elements(of("<f4", false, &[1 << 40, 1 << 40]), &mut &[0; 7][..]);
        assert_eq!(error, "an array of shape [1099511627776, 1099511627776]");
    }

    #[test]
    fn numbers_of_every_type_are_read_if_they_fit() {
        let read = |descr: &str, bytes: &[u8]| {
            let header = of(
                descr,
                false,
                &[bytes.len() / number(descr).map_or(1, |of| of.0)],
            );
            header.elements(&mut &*bytes, |value| (value < 300.0).then_some(value))
        };
        for (descr, bytes, expected) in [
            ("|u1", &[1, 255][..], [1.0, 255.0]),
            ("|i1", &[1, 255], [1.0, -1.0]),
            ("<u2", &[1, 0, 0, 1], [1.0, 256.0]),
            ("<i2", &[1, 0, 255, 255], [1.0, -1.0]),
            ("<i4", &[1, 0, 0, 0, 255, 255, 255, 255], [1.0, -1.0]),
        ] {
            assert_eq!(read(descr, bytes).unwrap(), expected, "{descr}");
        }
        for number in [0.5_f64, -2.0] {
            assert_eq!(read("<f8", &number.to_le_bytes()).unwrap(), [number]);
            let narrow = (number as f32).to_le_bytes();
            assert_eq!(read("<f4", &narrow).unwrap(), [number]);
        }
        assert_eq!(read("<i8", &(-7_i64).to_le_bytes()).unwrap(), [-7.0]);
        assert_eq!(read("<u8", &7_u64.to_le_bytes()).unwrap(), [7.0]);
        for (descr, bytes, expected) in [
            ("<u2", &[1, 0, 255, 255][..], "65535.0 at 1"),
            (">f4", &[0; 4], "dtype '>f4'"),
            ("|O", &[0; 4], "dtype '|O'"),
        ] {
            let error = read(descr, bytes).unwrap_err().to_string();
            assert_eq!(error, expected);
        }
    }

    #[test]
    fn a_table_is_read_in_both_orders_as_it_is_written() {
        let values = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        let bytes = to_bytes(&values, 2, 3);
        let rows = table(&mut bytes.as_slice()).unwrap();
        assert_eq!(rows, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
        let numbers = &bytes[bytes.len() - 24..];
        let read = |header: Header| table(&mut [&header.to_bytes(), numbers].concat().as_slice());
        let columns = read(of("<f4", true, &[2, 3])).unwrap();
        assert_eq!(columns, [[1.0, 3.0, 5.0], [2.0, 4.0, 6.0]]);
        assert_eq!(read(of("<f8", false, &[1, 3])).unwrap()[0].len(), 3);
        for (header, expected) in [
            (of("<f4", false, &[6]), "an array of shape [6]"),
            (
                of("<f4", false, &[9_000_000_000, 0]),
                "of shape [9000000000, 0]",
            ),
            (of("<f4", false, &[2, 2]), "more than 4 elements"),
            (of("<f4", false, &[2, 4]), "6 elements of 8"),
        ] {
            let error = read(header).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
    }
}
