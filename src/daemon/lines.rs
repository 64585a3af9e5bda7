//! The lines of a connection. Their length has a bound, so that the other end does not decide how
//! much memory the daemon uses.

use std::io;

use bytes::{Buf, BytesMut};
use tokio::io::{AsyncRead, AsyncReadExt};

/// Reads whole lines from `input`.
#[derive(Debug)]
pub(crate) struct Lines<R> {
    input: R,
    longest_bytes: usize,
    /// The bytes after the last whole line.
    unread: BytesMut,
    /// The number of first bytes of `unread` that have no newline.
    searched: usize,
}

/// The outcome of reading a line.
#[derive(Debug)]
pub(crate) enum LineRead {
    /// A line, without its newline.
    Line(BytesMut),
    /// The line is longer than the bound. Nothing after it can be read.
    TooLong,
    /// The other end sends no more. A last line without a newline is dropped.
    End,
}

impl<R: AsyncRead + Unpin> Lines<R> {
    pub(crate) fn new(input: R, longest_bytes: usize) -> Self {
        Self {
            input,
            longest_bytes,
            unread: BytesMut::new(),
            searched: 0,
        }
    }

    /// Waits for a whole line. Cancelling the wait loses nothing.
    pub(crate) async fn next(&mut self) -> io::Result<LineRead> {
        loop {
            let rest = &self.unread[self.searched..];
            if let Some(length) = rest.iter().position(|&byte| byte == b'\n') {
                let length = self.searched + length;
                if length > self.longest_bytes {
                    return Ok(LineRead::TooLong);
                }
                self.searched = 0;
                let line = self.unread.split_to(length);
                self.unread.advance(1);
                return Ok(LineRead::Line(line));
            }
            self.searched = self.unread.len();
            if self.searched > self.longest_bytes {
                return Ok(LineRead::TooLong);
            }
            if self.input.read_buf(&mut self.unread).await? == 0 {
                return Ok(LineRead::End);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The lines read from `text`, whose bytes come in pieces, and the outcome that ended them.
    async fn read(text: &[u8], piece: usize, longest: usize) -> (Vec<String>, LineRead) {
        let (mut here, there) = tokio::io::duplex(piece);
        let text = text.to_vec();
        tokio::spawn(async move {
            // A write fails if the reader stopped at a line that is too long.
            let _ = tokio::io::AsyncWriteExt::write_all(&mut here, &text).await;
        });
        let mut lines = Lines::new(there, longest);
        let mut found = Vec::new();
        loop {
            match lines.next().await.unwrap() {
                LineRead::Line(line) => found.push(String::from_utf8(line.to_vec()).unwrap()),
                stopped => return (found, stopped),
            }
        }
    }

    #[tokio::test]
    async fn lines_are_whole_however_they_come() {
        for piece in [1, 3, 64] {
            let (found, stopped) = read(b"one\n\nthree\nno end", piece, 8).await;
            assert_eq!(found, ["one", "", "three"]);
            assert!(matches!(stopped, LineRead::End), "{stopped:?}");
        }
    }

    #[tokio::test]
    async fn a_line_over_the_bound_ends_it_before_it_is_held() {
        for piece in [1, 64] {
            let (found, stopped) = read(b"12345678\n123456789\n", piece, 8).await;
            assert_eq!(found, ["12345678"]);
            assert!(matches!(stopped, LineRead::TooLong), "{stopped:?}");
        }
        let endless = Lines::new(tokio::io::repeat(b'x'), 1 << 16);
        let mut endless = endless;
        assert!(matches!(endless.next().await.unwrap(), LineRead::TooLong));
        assert!(endless.unread.capacity() <= 4 << 16);
    }
}
