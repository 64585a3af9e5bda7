//! The lines of a connection. Their length has a bound, so that the other end does not decide how
//! much memory the daemon uses.

use tokio::io::AsyncRead;
pub(crate) use tokio_util::codec::AnyDelimiterCodecError as LineError;
use tokio_util::codec::{AnyDelimiterCodec, FramedRead};

/// Reads lines, without their newlines. Cancelling the wait for one loses nothing. After a line that is too
/// long, nothing more can be read.
pub(crate) type Lines<R> = FramedRead<R, AnyDelimiterCodec>;

/// The lines of `input`.
pub(crate) fn lines<R: AsyncRead>(input: R, longest_bytes: usize) -> Lines<R> {
    let newline = b"\n".to_vec();
    let codec = AnyDelimiterCodec::new_with_max_length(newline.clone(), newline, longest_bytes);
    FramedRead::new(input, codec)
}
