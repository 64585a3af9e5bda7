//! Reader and writer of one numpy array: a header, then numbers.
//!
//! In: the bytes of an `.npy` file, alone or within an `.npz` file. Out: a [`Header`] and numbers.
//! [`to_bytes`] is the way back. The length of a header is bounded, and no more bytes are unpacked
//! than the header asks for.

use std::io::{self, ErrorKind, Read};

use half::f16;
use serde::Deserialize;

/// The longest header that is read, in bytes. Numpy writes about a hundred bytes and reads ten
/// thousand.
const LONGEST_HEADER: usize = 10_000;
/// The number of bytes that are unpacked at once.
const BLOCK_BYTES: usize = 1 << 16;

/// An element type that our files may hold.
pub trait Element: Copy {
    /// The type's name in errors.
    const NAME: &'static str;
    /// The type's name in numpy's headers.
    const DESCR: &'static str;
    /// A number of any type as this one. `None` if it does not fit.
    fn of(number: f64) -> Option<Self>;
    /// Adds the element's bytes.
    fn push(self, bytes: &mut Vec<u8>);
}

macro_rules! element {
    ($type:ident, $descr:literal, $of:expr) => {
        impl Element for $type {
            const NAME: &'static str = stringify!($type);
            const DESCR: &'static str = $descr;
            fn of(number: f64) -> Option<Self> {
                $of(number as $type, number)
            }
            fn push(self, bytes: &mut Vec<u8>) {
                bytes.extend(self.to_le_bytes());
            }
        }
    };
}
element!(f32, "<f4", |rounded, _| Some(rounded));
element!(u32, "<u4", exactly);
element!(i32, "<i4", exactly);
element!(u16, "<u2", exactly);
element!(i16, "<i2", exactly);
element!(u8, "|u1", exactly);

/// A whole number, if it equals `number`.
fn exactly<T: Copy + Into<f64>>(whole: T, number: f64) -> Option<T> {
    (whole.into() == number).then_some(whole)
}

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

/// The error of bytes that are not a usable array. Each message follows the word "found".
fn unusable(found: String) -> io::Error {
    io::Error::new(ErrorKind::InvalidData, found)
}

/// Fills `bytes` from a reader that should not end before.
fn fill(reader: &mut impl Read, bytes: &mut [u8]) -> io::Result<()> {
    let filled = reader.read_exact(bytes);
    filled.map_err(|error| match error.kind() {
        ErrorKind::UnexpectedEof => unusable("an array that is cut off".to_owned()),
        _ => error,
    })
}

impl Header {
    /// The header of an array of this shape, whose elements are row by row.
    pub(crate) fn of<T: Element>(shape: &[usize]) -> Self {
        Self {
            descr: T::DESCR.to_owned(),
            fortran_order: false,
            shape: shape.to_vec(),
        }
    }

    /// Reads the header at the beginning of an array.
    ///
    /// # Errors
    ///
    /// Returns an error if there is no header or an unreadable one.
    pub fn read(reader: &mut impl Read) -> io::Result<Self> {
        let mut start = [0; 8];
        fill(reader, &mut start)?;
        let [magic @ .., major, _minor] = start;
        if &magic != b"\x93NUMPY" {
            return Err(unusable("no .npy array".to_owned()));
        }
        let mut length = [0; 4];
        match major {
            1 => fill(reader, &mut length[..2])?,
            2 | 3 => fill(reader, &mut length)?,
            other => return Err(unusable(format!("an .npy array of version {other}"))),
        }
        let length = u32::from_le_bytes(length) as usize;
        if length > LONGEST_HEADER {
            return Err(unusable(format!(
                "a header of {length} bytes, of which at most {LONGEST_HEADER} are read"
            )));
        }
        let mut text = vec![0; length];
        fill(reader, &mut text)?;
        let header = serde_json::from_str(&as_json(&text));
        header.map_err(|error| {
            let problem = short(&error.to_string());
            unusable(format!("a header that cannot be read: {problem}"))
        })
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

    /// The number of elements. `None` if it is larger than any memory.
    pub fn count(&self) -> Option<usize> {
        let mut lengths = self.shape.iter();
        lengths.try_fold(1_usize, |count, &length| count.checked_mul(length))
    }

    /// Reads the elements that follow the header, and no more bytes, and returns them row by row. It allocates
    /// memory only for elements that are there.
    ///
    /// # Errors
    ///
    /// Returns an error if the elements are no numbers or one does not fit, if there are fewer or more
    /// elements, or they cannot be unpacked.
    pub fn elements<T: Element>(&self, reader: &mut impl Read) -> io::Result<Vec<T>> {
        let count = self.count();
        let count = count.ok_or_else(|| self.unexpected_shape())?;
        let size = size(&self.descr);
        let size = size.ok_or_else(|| unusable(format!("dtype '{}'", short(&self.descr))))?;
        let mut values = Vec::new();
        // What grows takes up to twice its room. A header may promise more than there is.
        let _ = values.try_reserve_exact(count);
        let mut block = Vec::with_capacity(BLOCK_BYTES);
        while values.len() < count {
            let wanted = (count - values.len()).min(BLOCK_BYTES / size) * size;
            block.clear();
            reader
                .by_ref()
                .take(wanted as u64)
                .read_to_end(&mut block)?;
            for bytes in block.chunks_exact(size) {
                let value = number(&self.descr, bytes);
                let place = values.len();
                let element = T::of(value);
                values.push(element.ok_or_else(|| unusable(format!("{value:?} at {place}")))?);
            }
            if block.len() < wanted {
                let found = values.len();
                return Err(unusable(format!("{found} elements of {count}")));
            }
        }
        match reader.read(&mut [0]) {
            Ok(0) if self.fortran_order => {
                let places = 0..count;
                Ok(places.map(|place| values[self.place(place)]).collect())
            }
            Ok(0) => Ok(values),
            Ok(_) => Err(unusable(format!("more than {count} elements"))),
            // The unpacker compares the checksum at the end, and reports a difference here.
            Err(error) => Err(error),
        }
    }

    /// The place in Fortran order, in which the first axis changes fastest, of the element at `index` in C
    /// order, in which the last one does.
    fn place(&self, mut index: usize) -> usize {
        let mut place = 0;
        for (axis, &length) in self.shape.iter().enumerate().rev() {
            let stride: usize = self.shape[..axis].iter().product();
            place += index % length * stride;
            index /= length;
        }
        place
    }

    /// The error of an array whose shape is not the expected one.
    pub fn unexpected_shape(&self) -> io::Error {
        unusable(format!("an array of shape {:?}", self.shape))
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

/// The bytes of an element of the type `descr`. `None` if the type is not read.
fn size(descr: &str) -> Option<usize> {
    match descr.strip_prefix(['<', '>', '|'])? {
        "u1" | "i1" => Some(1),
        "u2" | "i2" | "f2" => Some(2),
        "u4" | "i4" | "f4" => Some(4),
        "u8" | "i8" | "f8" => Some(8),
        _ => None,
    }
}

/// The value of an element of the type `descr`. Integers above 2^53 lose their last digits.
fn number(descr: &str, bytes: &[u8]) -> f64 {
    let unused = 64 - 8 * bytes.len();
    let mut low_first = [0; 8];
    low_first[..bytes.len()].copy_from_slice(bytes);
    if descr.starts_with('>') {
        low_first[..bytes.len()].reverse();
    }
    let bits = u64::from_le_bytes(low_first);
    match (&descr[1..2], bytes.len()) {
        ("f", 2) => f16::from_bits(bits as u16).to_f64(),
        ("f", 4) => f32::from_bits(bits as u32).into(),
        ("f", _) => f64::from_bits(bits),
        ("i", _) => ((bits << unused).cast_signed() >> unused) as f64,
        _ => bits as f64,
    }
}

/// Reads a table of numbers, row by row.
///
/// # Errors
///
/// Returns an error if the bytes are not an array, or not a table of numbers.
pub fn table(reader: &mut impl Read) -> io::Result<Vec<Vec<f32>>> {
    let header = Header::read(reader)?;
    let (&[_, cols], Some(1..)) = (header.shape.as_slice(), header.count()) else {
        return Err(header.unexpected_shape());
    };
    let values: Vec<f32> = header.elements(reader)?;
    Ok(values.chunks_exact(cols).map(<[f32]>::to_vec).collect())
}

/// The bytes of an array of this shape in numpy's format. The elements are row by row.
///
/// # Panics
///
/// Panics if the shape has another number of elements.
pub fn to_bytes<T: Element>(shape: &[usize], elements: &[T]) -> Vec<u8> {
    let header = Header::of::<T>(shape);
    assert_eq!(header.count(), Some(elements.len()), "{shape:?}");
    let mut bytes = header.to_bytes();
    bytes.reserve_exact(size_of_val(elements));
    elements.iter().for_each(|element| element.push(&mut bytes));
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
            &deep("{'descr':"),
            &" ".repeat(LONGEST_HEADER + 1),
            "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,)}",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (2, -1)}",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (1,), 'more': 1}",
            "{'descr': '<f4'}",
            "{'descr': '<f4",
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
        let mut endless = Endless(0);
        let elements = of("<f4", false, &[10, 100]).elements::<f32>(&mut endless);
        assert_eq!(elements.unwrap_err().to_string(), "more than 1000 elements");
        assert!(endless.0 <= 4_001, "{} bytes were unpacked", endless.0);
        let header = of("<f4", false, &[1 << 40, 1 << 40]);
        let error = header.elements::<f32>(&mut &[0; 7][..]).unwrap_err();
        let expected = "an array of shape [1099511627776, 1099511627776]";
        assert_eq!(error.to_string(), expected);
    }

    #[test]
    fn numbers_of_every_type_are_read_if_they_fit() {
        fn read<T: Element>(descr: &str, bytes: &[u8]) -> Result<Vec<T>, String> {
            let header = of(descr, false, &[bytes.len() / size(descr).unwrap_or(1)]);
            let read = header.elements(&mut &*bytes);
            read.map_err(|error| error.to_string())
        }
        let half = [0.5_f32.to_le_bytes(), (-2.0_f32).to_le_bytes()].concat();
        let double = [0.5_f64.to_le_bytes(), (-2.0_f64).to_le_bytes()].concat();
        let long = [7_i64.to_le_bytes(), (-7_i64).to_le_bytes()].concat();
        for (descr, bytes, expected) in [
            ("|u1", &[1, 255][..], [1.0, 255.0]),
            ("|i1", &[1, 255], [1.0, -1.0]),
            ("<u2", &[1, 0, 0, 1], [1.0, 256.0]),
            (">i2", &[0, 1, 255, 255], [1.0, -1.0]),
            ("<i8", &long, [7.0, -7.0]),
            ("<f4", &half, [0.5, -2.0]),
            (">f4", &[0x3F, 0x80, 0, 0, 0xC0, 0, 0, 0], [1.0, -2.0]),
            ("<f8", &double, [0.5, -2.0]),
            // 1, and the least number.
            ("<f2", &[0, 0x3C, 1, 0], [1.0, 2_f32.powi(-24)]),
            (">f2", &[0xC0, 0, 0x35, 0x55], [-2.0, 0.333_251_95]),
        ] {
            assert_eq!(read(descr, bytes), Ok(expected.to_vec()), "{descr}");
        }
        for (descr, bytes, expected) in [
            ("<u2", &[1, 0, 255, 255][..], "65535.0 at 1"),
            ("<f2", &[0, 0x7C], "inf at 0"),
            ("|O", &[0; 4], "dtype '|O'"),
        ] {
            assert_eq!(read::<u8>(descr, bytes), Err(expected.to_owned()));
        }
    }

    #[test]
    fn a_table_is_read_in_both_orders_as_it_is_written() {
        let values = [1.0_f32, 2.0, 3.0, 4.0, 5.0, 6.0];
        let bytes = to_bytes(&[2, 3], &values);
        let rows = table(&mut bytes.as_slice()).unwrap();
        assert_eq!(rows, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
        let numbers = &bytes[bytes.len() - 24..];
        let read = |header: Header| table(&mut [&header.to_bytes(), numbers].concat().as_slice());
        let columns = read(of("<f4", true, &[2, 3])).unwrap();
        assert_eq!(columns, [[1.0, 3.0, 5.0], [2.0, 4.0, 6.0]]);
        assert_eq!(read(of("<f8", false, &[1, 3])).unwrap()[0].len(), 3);
        for (header, expected) in [
            (of("<f4", false, &[6]), "an array of shape [6]"),
            (of("<f4", false, &[2, 2]), "more than 4 elements"),
            (of("<f4", false, &[2, 4]), "6 elements of 8"),
            (
                of("<f4", false, &[1 << 40, 2]),
                "6 elements of 2199023255552",
            ),
        ] {
            let error = read(header).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
    }
}
