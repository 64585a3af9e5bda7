//! One array of an `.npz` file: what its header says, then its numbers.
//!
//! A header is text of which only three keys are read, by a parser that goes over it once; its length
//! is bounded. Nothing is unpacked that the header does not ask for.

use std::io::{self, Read};

/// Longest header that is read, in bytes: numpy's own have about a hundred, and it reads ten thousand.
const LONGEST_HEADER: usize = 10_000;
/// Most dimensions of an array.
const MOST_DIMENSIONS: usize = 8;
/// Bytes unpacked at once.
const BLOCK_BYTES: usize = 1 << 16;

/// What an array's header says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Header {
    /// Type of its elements, as numpy writes it: `<f4`.
    pub(super) descr: String,
    /// Whether the first axis changes fastest.
    pub(super) fortran_order: bool,
    pub(super) shape: Vec<usize>,
}

/// Reads an array's header.
///
/// # Errors
///
/// What was found where a header should be.
pub(super) fn header(reader: &mut impl Read) -> Result<Header, String> {
    let mut start = [0; 8];
    exact(reader, &mut start)?;
    let [magic @ .., major, _minor] = start;
    if &magic != b"\x93NUMPY" {
        return Err("no .npy array".to_owned());
    }
    let length = match major {
        1 => {
            let mut length = [0; 2];
            exact(reader, &mut length)?;
            usize::from(u16::from_le_bytes(length))
        }
        2 | 3 => {
            let mut length = [0; 4];
            exact(reader, &mut length)?;
            u32::from_le_bytes(length) as usize
        }
        other => return Err(format!("an .npy array of version {other}")),
    };
    if length > LONGEST_HEADER {
        return Err(format!(
            "a header of {length} bytes, of which at most {LONGEST_HEADER} are read"
        ));
    }
    let mut text = vec![0; length];
    exact(reader, &mut text)?;
    let text = String::from_utf8(text).map_err(|_| "a header that is no text".to_owned())?;
    Text(text.as_str()).header()
}

fn exact(reader: &mut impl Read, bytes: &mut [u8]) -> Result<(), String> {
    reader.read_exact(bytes).map_err(|error| broken(&error))
}

/// What is said of data that cannot be read.
fn broken(error: &io::Error) -> String {
    match error.kind() {
        io::ErrorKind::UnexpectedEof => "an array that is cut off".to_owned(),
        _ => error.to_string(),
    }
}

/// Reads `count` elements of `SIZE` bytes, and no more. Room is made for those that are there.
///
/// # Errors
///
/// What was found, if there are fewer or more, or they cannot be unpacked.
pub(super) fn elements<const SIZE: usize, T>(
    reader: &mut impl Read,
    count: usize,
    element: impl Fn([u8; SIZE]) -> T,
) -> Result<Vec<T>, String> {
    let mut values = Vec::new();
    let mut block = Vec::with_capacity(BLOCK_BYTES);
    while values.len() < count {
        let wanted = (count - values.len()).min(BLOCK_BYTES / SIZE) * SIZE;
        block.clear();
        let read = reader.by_ref().take(wanted as u64).read_to_end(&mut block);
        read.map_err(|error| broken(&error))?;
        let (elements, _) = block.as_chunks::<SIZE>();
        values.extend(elements.iter().map(|bytes| element(*bytes)));
        if block.len() < wanted {
            return Err(format!("{} elements of {count}", values.len()));
        }
    }
    match reader.read(&mut [0]) {
        Ok(0) => Ok(values),
        Ok(_) => Err(format!("more than {count} elements")),
        // The checksum is compared at the end.
        Err(error) => Err(broken(&error)),
    }
}

/// The rest of a header's text.
struct Text<'a>(&'a str);

impl<'a> Text<'a> {
    fn header(mut self) -> Result<Header, String> {
        let (mut descr, mut fortran_order, mut shape) = (None, None, None);
        self.expect('{')?;
        while !self.take('}') {
            let key = self.quoted()?;
            self.expect(':')?;
            match key {
                "descr" if descr.is_none() => descr = Some(self.quoted()?.to_owned()),
                "fortran_order" if fortran_order.is_none() => fortran_order = Some(self.truth()?),
                "shape" if shape.is_none() => shape = Some(self.lengths()?),
                _ => return Err(format!("a header with {:?}", short(key))),
            }
            if !self.take(',') {
                self.expect('}')?;
                break;
            }
        }
        if !self.0.trim().is_empty() {
            return Err(format!("a header that ends with {:?}", short(self.0)));
        }
        let missing = |key: &str| format!("a header without `{key}`");
        Ok(Header {
            descr: descr.ok_or_else(|| missing("descr"))?,
            fortran_order: fortran_order.ok_or_else(|| missing("fortran_order"))?,
            shape: shape.ok_or_else(|| missing("shape"))?,
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

    fn expect(&mut self, char: char) -> Result<(), String> {
        if self.take(char) {
            return Ok(());
        }
        Err(format!(
            "a header with {:?} where `{char}` should be",
            short(self.0)
        ))
    }

    fn quoted(&mut self) -> Result<&'a str, String> {
        let quote = if self.take('"') { '"' } else { '\'' };
        if quote == '\'' {
            self.expect('\'')?;
        }
        let (text, rest) = self
            .0
            .split_once(quote)
            .ok_or("a header with a text that does not end")?;
        self.0 = rest;
        Ok(text)
    }

    fn truth(&mut self) -> Result<bool, String> {
        self.0 = self.0.trim_start();
        for (word, value) in [("True", true), ("False", false)] {
            if let Some(rest) = self.0.strip_prefix(word) {
                self.0 = rest;
                return Ok(value);
            }
        }
        Err(format!("a header with {:?} as truth", short(self.0)))
    }

    fn lengths(&mut self) -> Result<Vec<usize>, String> {
        self.expect('(')?;
        let mut lengths = Vec::new();
        while !self.take(')') {
            self.0 = self.0.trim_start();
            let digits = self.0.bytes().take_while(u8::is_ascii_digit).count();
            let (number, rest) = self.0.split_at(digits);
            let length = number.parse();
            let length = length.map_err(|_| format!("a length {:?}", short(self.0)))?;
            lengths.push(length);
            if lengths.len() > MOST_DIMENSIONS {
                return Err(format!("more than {MOST_DIMENSIONS} dimensions"));
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
fn short(text: &str) -> &str {
    let end = text.char_indices().nth(20).map_or(text.len(), |(at, _)| at);
    &text[..end]
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
            assert_eq!(header(&mut file(text).as_slice()), Ok(header_of), "{text}");
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
            let error = header(&mut file(text).as_slice()).unwrap_err();
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
            let error = header(&mut bytes).unwrap_err();
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
        assert_eq!(error, "more than 1000 elements");
        assert!(endless.0 <= 4_001, "{} bytes were unpacked", endless.0);
        let short = elements(&mut &[0; 7][..], 1 << 40, f32::from_le_bytes).unwrap_err();
        assert_eq!(short, "1 elements of 1099511627776");
        assert_eq!(
            elements(&mut &[1, 2][..], 2, u8::from_le_bytes),
            Ok(vec![1, 2])
        );
    }
}
