//! Ends the trainer at a signal, and says how to continue.

use std::sync::Arc;

use signal_hook::consts::{SIGINT, SIGTERM, SIGXFSZ};
use signal_hook::iterator::Signals;

/// Ends the process at SIGINT and SIGTERM, with 130 and 143, and prints the command that continues.
///
/// Every file on the disk is whole at any moment, and a run continues from its last checkpoint. So
/// there is nothing to wait for.
///
/// # Errors
///
/// Fails if the system refuses a handler, or has no thread to wait on.
pub(super) fn end_at_signals(how_to_continue: Option<String>) -> std::io::Result<()> {
    // At the limit of a file's size, the write fails as on a full disk, and SIGXFSZ does not end
    // the process.
    signal_hook::flag::register(SIGXFSZ, Arc::default())?;
    let mut signals = Signals::new([SIGINT, SIGTERM])?;
    std::thread::Builder::new().spawn(move || {
        if let Some(signal) = signals.forever().next() {
            let hint = how_to_continue
                .map_or_else(String::new, |command| format!("; to continue: {command}"));
            hardnessd_core::stderr_line!("hrn-train: interrupted{hint}");
            std::process::exit(128 + signal);
        }
    })?;
    Ok(())
}

/// The command that continues an interrupted `train`: the same one with `--resume`.
pub(super) fn resuming(arguments: impl Iterator<Item = String>) -> String {
    let mut words: Vec<String> = arguments.map(|word| quoted(&word)).collect();
    if !words.iter().any(|word| word == "--resume") {
        words.push("--resume".to_owned());
    }
    words.join(" ")
}

/// The command that continues an interrupted `compare`: the same one.
pub(super) fn again(arguments: impl Iterator<Item = String>) -> String {
    let words: Vec<String> = arguments.map(|word| quoted(&word)).collect();
    words.join(" ")
}

/// A word, quoted so that a shell takes it as one.
fn quoted(word: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_./=,:+@%".contains(c);
    if !word.is_empty() && word.chars().all(is_plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_to_continue_is_one_that_a_shell_takes() {
        let words = |words: &[&str]| {
            let words: Vec<String> = words.iter().map(|&word| word.to_owned()).collect();
            words.into_iter()
        };
        assert_eq!(
            resuming(words(&["hrn-train", "train", "--out", "my run's"])),
            r"hrn-train train --out 'my run'\''s' --resume"
        );
        assert_eq!(
            resuming(words(&["hrn-train", "train", "--resume"])),
            "hrn-train train --resume"
        );
        assert_eq!(
            again(words(&["hrn-train", "compare", ""])),
            "hrn-train compare ''"
        );
    }
}
