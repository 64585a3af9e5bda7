//! Faults of the cable: whether bytes come, when, and at which rate they are read.

use super::times::Span;

/// The state of the line at a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Line {
    /// Send the bytes, at the speed of the line.
    Up,
    /// Send the bytes all at once.
    AtOnce,
    /// Send nothing.
    Silent,
    /// Send nothing, and remove the port.
    Unplugged,
}

/// A fault of the cable, for a time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct OfCable {
    pub(super) span: Span,
    pub(super) kind: Kind,
}

/// What happens to the line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Kind {
    /// The port is gone.
    Unplug,
    /// No frame is sent.
    Silence,
    /// Half of the first frame is sent, and nothing after it.
    Half {
        /// Whether the other half comes at the end.
        other_half: bool,
        /// Whether the first frame is over.
        has_begun: bool,
    },
    /// Frames are held back until the end.
    Stall,
    /// The reader's baud rate is this many times the sensor's.
    WrongBaud { ratio: f64 },
}

/// The cable, and the bytes that it holds back.
#[derive(Debug, Default)]
pub(super) struct Cable {
    faults: Vec<OfCable>,
    held: Vec<u8>,
}

impl Cable {
    pub(super) fn new(faults: Vec<OfCable>) -> Self {
        let held = Vec::new();
        Self { faults, held }
    }

    /// Makes of the frame that is due at `time_s` the bytes to send now, and returns how to send
    /// them.
    pub(super) fn strike(&mut self, time_s: f64, bytes: &mut Vec<u8>) -> Line {
        let mut line = Line::Up;
        let before = std::mem::take(&mut self.held);
        let now = |fault: &&mut OfCable| fault.span.has(time_s);
        for fault in self.faults.iter_mut().filter(now) {
            let is_sent = matches!(line, Line::Up | Line::AtOnce);
            match &mut fault.kind {
                Kind::Unplug => line = Line::Unplugged,
                Kind::WrongBaud { ratio } if is_sent => {
                    *bytes = misread(bytes, *ratio);
                    line = Line::AtOnce;
                }
                Kind::Half {
                    other_half,
                    has_begun,
                } if is_sent && !*has_begun => {
                    *has_begun = true;
                    let tail = bytes.split_off(bytes.len() / 2);
                    if *other_half {
                        self.held = tail;
                    }
                }
                Kind::Stall if is_sent => {
                    self.held.append(bytes);
                    line = Line::Silent;
                }
                Kind::Silence | Kind::Half { .. } if is_sent => line = Line::Silent,
                Kind::Silence | Kind::Half { .. } | Kind::Stall | Kind::WrongBaud { .. } => {}
            }
        }
        match line {
            Line::Up | Line::AtOnce if !before.is_empty() => {
                bytes.splice(0..0, before);
                Line::AtOnce
            }
            Line::Silent => {
                self.held.splice(0..0, before);
                Line::Silent
            }
            // A cable that is pulled loses what it holds.
            Line::Unplugged => {
                self.held.clear();
                Line::Unplugged
            }
            line => line,
        }
    }
}

/// The bytes that a UART reads at `ratio` times the rate of the sender of `bytes`. It waits for a
/// start bit, and samples the line in the middle of each of its own bits. The line is idle after
/// the bytes.
fn misread(bytes: &[u8], ratio: f64) -> Vec<u8> {
    let bits = bytes.iter().flat_map(|byte| {
        let data = (0..8).map(move |bit| byte >> bit & 1 == 1);
        std::iter::once(false).chain(data).chain([true])
    });
    let line: Vec<bool> = bits.collect();
    let level = |time: f64| line.get(time as usize).copied().unwrap_or(true);
    let mut read = Vec::new();
    let mut time = 0.0;
    while (time as usize) < line.len() {
        if level(time) {
            time = time.floor() + 1.0;
            continue;
        }
        let middle = |bit: f64| time + (bit + 0.5) / ratio;
        let byte = (0..8).fold(0, |byte, bit| {
            byte | u8::from(level(middle(f64::from(bit) + 1.0))) << bit
        });
        read.push(byte);
        time = middle(9.0);
        // After a byte without its stop bit, the line must rise first.
        while !level(time) && (time as usize) < line.len() {
            time = time.floor() + 1.0;
        }
    }
    read
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reader_at_another_rate_reads_other_bytes() {
        let all: Vec<u8> = (0..=255).collect();
        assert_eq!(misread(&all, 1.0), all);
        // A rate within 4 % of the sensor's reads the same.
        assert_eq!(misread(&all, 1.03), all);
        assert_eq!(misread(&all, 0.97), all);
        // Twice as fast, it reads each bit twice, from the start bit on.
        assert_eq!(misread(&[0x0F], 2.0), [0xFE, 0x80]);
        // Half as fast, it reads every second bit, and then the idle line.
        assert_eq!(misread(&[0b0101_0101], 0.5), [0xFF]);
        assert_eq!(misread(&[0x00], 0.5), [0xF8]);
    }
}
