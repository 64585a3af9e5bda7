//! Verdicts beside what is true, and how many of them are right. The live page repeats the rule.

/// The verdicts so far.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Score {
    pub(crate) verdicts: u64,
    right: u64,
    /// The verdicts without a level.
    without: u64,
}

impl Score {
    /// Counts a verdict of a level, or of none. Returns its mark.
    pub(crate) fn take(&mut self, level: Option<u64>, truth: Option<u64>) -> &'static str {
        self.verdicts += 1;
        match level {
            None => {
                self.without += 1;
                "-"
            }
            Some(_) if level == truth => {
                self.right += 1;
                "ok"
            }
            Some(_) => "wrong",
        }
    }

    /// Counts the verdicts of `other` too.
    pub(crate) fn add(&mut self, other: Self) {
        self.verdicts += other.verdicts;
        self.right += other.right;
        self.without += other.without;
    }

    /// Such as `3 of 4 right, 0 wrong, 1 without a level`.
    pub(crate) fn in_words(self) -> String {
        let Self {
            verdicts,
            right,
            without,
        } = self;
        let wrong = verdicts - right - without;
        let without = match without {
            0 => String::new(),
            without => format!(", {without} without a level"),
        };
        format!("{right} of {verdicts} right, {wrong} wrong{without}")
    }
}
