//! Which of a robot's numbered events came, of those that it sent.
//!
//! A daemon numbers all its events in one row, so a number that does not come is an event that was missed.

/// How many of the newest numbers may still come late. Beyond these, one that did not come is missed for
/// good.
const LATE: u32 = u128::BITS;

/// The numbers of one run of a daemon.
#[derive(Debug)]
pub(super) struct Numbers {
    /// The highest number that came or is known to be given.
    last: u64,
    /// Bit `n`: number `last - n` came, or was given before counting began.
    came: u128,
    /// How many did not come, among the numbers below these bits.
    missed: u64,
}

impl Numbers {
    /// Counting begins with the number after `last`.
    pub(super) fn after(last: u64) -> Self {
        Self {
            last,
            came: u128::MAX,
            missed: 0,
        }
    }

    /// An event came. Whether it is the first with its number, as far as that is known.
    pub(super) fn come(&mut self, number: u64) -> bool {
        self.reach(number);
        let bit = 1_u128.checked_shl(u32::try_from(self.last - number).unwrap_or(LATE));
        let Some(bit) = bit else {
            return false;
        };
        let is_new = self.came & bit == 0;
        self.came |= bit;
        is_new
    }

    /// All numbers up to this one were given.
    pub(super) fn reach(&mut self, number: u64) {
        let Some(steps) = number.checked_sub(self.last).filter(|&steps| steps > 0) else {
            return;
        };
        // Numbers that were in the window and those that never were.
        let (old, never) = match u32::try_from(steps) {
            Ok(steps) if steps < LATE => ((!self.came >> (LATE - steps)).count_ones(), 0),
            _ => (self.came.count_zeros(), steps - u64::from(LATE)),
        };
        self.missed = self
            .missed
            .saturating_add(u64::from(old))
            .saturating_add(never);
        let shift = u32::try_from(steps).unwrap_or(LATE);
        self.came = self.came.checked_shl(shift).unwrap_or(0);
        self.last = number;
    }

    /// How far a number lies below all that may come late.
    pub(super) fn is_long_past(&self, number: u64) -> bool {
        self.last.saturating_sub(number) >= u64::from(LATE)
    }

    /// How many have not come.
    pub(super) fn missed(&self) -> u64 {
        self.missed
            .saturating_add(u64::from(self.came.count_zeros()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_that_does_not_come_is_missed_and_one_that_comes_late_is_not() {
        let mut numbers = Numbers::after(10);
        for (number, is_new, missed) in [
            (11, true, 0),
            (14, true, 2),
            (12, true, 1),
            (12, false, 1),
            // Given before counting began.
            (9, false, 1),
            (15, true, 1),
            // The window moves past what is missing.
            (200, true, 185),
            (13, false, 185),
            (199, true, 184),
        ] {
            assert_eq!(numbers.come(number), is_new, "{number}");
            assert_eq!(numbers.missed(), missed, "{number}");
        }
        numbers.reach(202);
        assert_eq!(numbers.missed(), 186);
    }

    #[test]
    fn numbers_that_come_are_counted_right_whatever_the_step() {
        for step in [1, 2, 127, 128, 129, 1000] {
            let mut numbers = Numbers::after(0);
            for turn in 1..=300 {
                assert!(numbers.come(turn * step));
                assert_eq!(numbers.missed(), turn * (step - 1), "{step}");
            }
        }
    }

    #[test]
    fn a_forged_number_overflows_nothing() {
        let mut numbers = Numbers::after(0);
        assert!(numbers.come(u64::MAX));
        assert_eq!(numbers.missed(), u64::MAX - 1);
        assert!(!numbers.come(3));
        assert!(numbers.is_long_past(3) && !numbers.is_long_past(u64::MAX - 1));
    }
}
