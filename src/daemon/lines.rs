//! The lines of a connection. Their length has a bound, so that the other end does not decide how
//! much memory the daemon uses.

use bytes::{Bytes, BytesMut};
use tokio::io::AsyncRead;
pub(crate) use tokio_util::codec::AnyDelimiterCodecError as LineError;
use tokio_util::codec::{AnyDelimiterCodec, Decoder, FramedRead};

/// Reads lines, without their newlines. Cancelling the wait for one loses nothing. After a line that is too
/// long, nothing more can be read.
pub(crate) type Lines<R> = FramedRead<R, WholeLines>;

/// The lines of `input`.
pub(crate) fn lines<R: AsyncRead>(input: R, longest_bytes: usize) -> Lines<R> {
    let newline = b"\n".to_vec();
    let codec = AnyDelimiterCodec::new_with_max_length(newline.clone(), newline, longest_bytes);
    FramedRead::new(input, WholeLines(codec))
}

/// Whole lines alone. A last one without a newline was cut off, and is dropped.
pub(crate) struct WholeLines(AnyDelimiterCodec);

impl Decoder for WholeLines {
    type Item = Bytes;
    type Error = LineError;

    fn decode(&mut self, bytes: &mut BytesMut) -> Result<Option<Bytes>, LineError> {
        self.0.decode(bytes)
    }

    fn decode_eof(&mut self, bytes: &mut BytesMut) -> Result<Option<Bytes>, LineError> {
        let line = self.0.decode(bytes)?;
        if line.is_none() {
            bytes.clear();
        }
        Ok(line)
    }
}

#[cfg(test)]
mod tests {
    use futures_util::StreamExt as _;

    use super::*;

    #[tokio::test]
    async fn lines_are_whole_and_no_longer_than_the_bound() {
        for (text, expected, is_whole) in [
            ("one\n\ntwo\n", "one//two", true),
            ("one\ncut", "one", true),
            ("12345\n12345\n", "12345/12345", true),
            ("12345\n123456\nno", "12345", false),
            ("12345\n1234567", "12345", false),
        ] {
            let mut lines = lines(text.as_bytes(), 5);
            let mut found = Vec::new();
            let end = loop {
                match lines.next().await {
                    Some(Ok(line)) => found.push(String::from_utf8(line.to_vec()).unwrap()),
                    end => break end,
                }
            };
            assert_eq!(
                (&*found.join("/"), end.is_none()),
                (expected, is_whole),
                "{text:?}"
            );
        }
    }
}
