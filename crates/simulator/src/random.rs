//! Counter-based random streams: a value depends only on seed, stream name and position.
//!
//! Nothing here holds hidden global state, and a new stream never shifts an old one. The mixing
//! function is SplitMix64's finaliser (Steele, Lea, Flood 2014), which is enough for simulation and
//! initial weights, not for secrets.

use std::sync::OnceLock;

/// A stream of random numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stream {
    key: u64,
    position: u64,
}

const GOLDEN_GAMMA: u64 = 0x9E37_79B9_7F4A_7C15;

fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

impl Stream {
    /// The stream called `name` under `seed`, from its start.
    pub fn new(seed: u64, name: &str) -> Self {
        let key = name
            .bytes()
            .fold(mix(seed.wrapping_add(GOLDEN_GAMMA)), |key, byte| {
                mix(key.wrapping_add(GOLDEN_GAMMA) ^ u64::from(byte))
            });
        Self { key, position: 0 }
    }

    /// The independent sub-stream with the number `index`: one for each object, press or epoch.
    #[must_use]
    pub fn child(&self, index: u64) -> Self {
        Self {
            key: mix(self.key ^ mix(index.wrapping_add(GOLDEN_GAMMA))),
            position: 0,
        }
    }

    /// 64 random bits.
    pub fn next_u64(&mut self) -> u64 {
        self.position += 1;
        mix(self
            .key
            .wrapping_add(self.position.wrapping_mul(GOLDEN_GAMMA)))
    }

    /// A uniform number in `[0, 1)`, 53 bits.
    pub fn uniform(&mut self) -> f64 {
        (self.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// A uniform number in `[low, high)`.
    pub fn range(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.uniform()
    }

    /// A uniform number in `0..n`. Its bias is below 2^-53 for the sizes used here.
    ///
    /// # Panics
    ///
    /// Panics if `n` is 0.
    pub fn below(&mut self, n: usize) -> usize {
        assert!(n > 0, "an empty range has no element to draw");
        (((u128::from(self.next_u64())) * n as u128) >> 64) as usize
    }

    /// A standard normal number, by Box and Muller. Each takes two words, so the position stays a
    /// plain count.
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }

    /// Adds a normal number of this standard deviation to each of `values`. Faster than [`normal`]: the
    /// numbers are picked from 65,536 that were drawn once.
    ///
    /// [`normal`]: Self::normal
    pub(crate) fn add_noise(&mut self, values: &mut [f32], sd: f32) {
        static DRAWN: OnceLock<Vec<f32>> = OnceLock::new();
        let drawn = DRAWN.get_or_init(|| {
            let mut stream = Self::new(0, "noise");
            (0..1 << 16).map(|_| stream.normal() as f32).collect()
        });
        for four in values.chunks_mut(4) {
            let mut word = self.next_u64();
            for value in four {
                *value += sd * drawn[word as usize & 0xFFFF];
                word >>= 16;
            }
        }
    }

    /// Shuffles `items` (Fisher-Yates).
    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for last in (1..items.len()).rev() {
            items.swap(last, self.below(last + 1));
        }
    }
}

/// Draws a number between two, whose logarithm is uniform.
pub(crate) fn log_even(range: impl Into<[f64; 2]>, stream: &mut Stream) -> f64 {
    let [low, high] = range.into();
    stream.range(low.ln(), high.ln()).exp()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn streams_differ_by_seed_name_and_child() {
        let a = Stream::new(1, "a");
        let (seed, name) = (Stream::new(2, "a"), Stream::new(1, "b"));
        let all = [a, a.child(0), a.child(1), seed, name];
        let firsts = all.map(|mut stream| stream.next_u64());
        assert_eq!(BTreeSet::from(firsts).len(), 5);
    }

    #[test]
    fn moments_are_those_of_the_distributions() {
        let mut stream = Stream::new(3, "moments");
        let n = 100_000;
        let (mut sum, mut square, mut uniform) = (0.0, 0.0, 0.0);
        for _ in 0..n {
            let x = stream.normal();
            sum += x;
            square += x * x;
            uniform += stream.uniform();
        }
        let n = f64::from(n);
        assert!((sum / n).abs() < 0.015, "mean {}", sum / n);
        assert!((square / n - 1.0).abs() < 0.02, "variance {}", square / n);
        let mut noise = vec![1.0; 100_000];
        stream.add_noise(&mut noise, 2.0);
        let mean = noise.iter().sum::<f32>() / 1e5;
        let variance = noise.iter().map(|x| (x - mean).powi(2)).sum::<f32>() / 1e5;
        assert!((mean - 1.0).abs() < 0.03 && (variance / 4.0 - 1.0).abs() < 0.02);
        assert!(
            (uniform / n - 0.5).abs() < 0.005,
            "uniform mean {}",
            uniform / n
        );
    }
}
