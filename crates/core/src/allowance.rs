//! How much may happen in a time: frames of a sensor, bytes of a port, lines of a log.

use std::time::Duration;

use serde::{Deserialize, Serialize};

/// Counts what happened against the time that it may take. It has no clock.
///
/// # Example
///
/// Ten may happen in a second, and three at once.
///
/// ```
/// use std::time::Duration;
///
/// use hardnessd_core::allowance::Allowance;
///
/// let (cost, at_once) = (Duration::from_millis(100), Duration::from_millis(200));
/// let mut allowance = Allowance::default();
/// let mut allows = |ms| allowance.allows(Duration::from_millis(ms), cost, at_once);
/// assert!(allows(0) && allows(0) && allows(0));
/// assert!(!allows(0) && !allows(99));
/// assert!(allows(100) && !allows(100));
/// ```
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Allowance {
    /// The moment of the last question.
    asked: Duration,
    /// The time that is used up at that moment.
    used: Duration,
}

impl Allowance {
    /// Whether something may happen at `at` that takes up the time `cost`. If so, it counts. What takes up
    /// `at_once` may happen before time must pass, and one thing more.
    pub fn allows(&mut self, at: Duration, cost: Duration, at_once: Duration) -> bool {
        self.used = self.used.saturating_sub(at.saturating_sub(self.asked));
        self.asked = at;
        let allows = self.used <= at_once;
        if allows {
            self.used = self.used.saturating_add(cost);
        }
        allows
    }
}
