//! One instant of the sensor: 28x28 taxels, row-major.
//!
//! [`RawFrame`] is in counts, as it came off the wire; [`Frame`] is in newtons, after tare and
//! dead-taxel replacement. Only `tare` makes the second from the first, so raw counts cannot
//! reach the press tracker.

/// Rows of a frame, and of the network's input (paper, "Tactile sensor").
pub const ROWS: usize = 28;
/// Columns of a frame.
pub const COLS: usize = 28;
/// Taxels in a frame.
pub const TAXELS: usize = ROWS * COLS;

/// A frame in sensor counts. Taxels outside a smaller array are 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RawFrame {
    /// `[ROWS, COLS]` flattened, row-major, in counts.
    pub counts: [u16; TAXELS],
}

impl Default for RawFrame {
    fn default() -> Self {
        Self {
            counts: [0; TAXELS],
        }
    }
}

/// A frame in newtons.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// `[ROWS, COLS]` flattened, row-major, in newtons a taxel; finite and not negative.
    pub newtons: [f32; TAXELS],
}

impl Default for Frame {
    fn default() -> Self {
        Self {
            newtons: [0.0; TAXELS],
        }
    }
}

impl Frame {
    /// Contact area in taxels: those at or above `threshold_n`.
    pub fn contact_area_taxels(&self, threshold_n: f32) -> u32 {
        self.newtons
            .iter()
            .map(|&n| u32::from(n >= threshold_n))
            .sum()
    }

    /// Total force in newtons, summed in f64 so that the order of taxels does not show.
    pub fn force_n(&self) -> f64 {
        self.newtons.iter().map(|&n| f64::from(n)).sum()
    }
}
