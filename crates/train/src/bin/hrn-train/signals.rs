//! Ends the trainer at a signal, and says how to continue.

use signal_hook::consts::{SIGINT, SIGTERM, SIGXFSZ};
use signal_hook::iterator::Signals;

/// Ends the process at SIGINT and SIGTERM, with 130 and 143, and prints the command that continues. At the limit of a
/// file's size, writing fails as on a full disk, and SIGXFSZ does not end the process.
///
/// Every file on the disk is whole at any moment, and a run continues from its last checkpoint. So
/// there is nothing to wait for.
///
/// # Errors
///
/// Fails if the system refuses a handler, or has no thread to wait on.
pub(super) fn end_at_signals(how_to_continue: Option<String>) -> std::io::Result<()> {
    let mut signals = Signals::new([SIGINT, SIGTERM, SIGXFSZ])?;
    std::thread::Builder::new().spawn(move || {
        if let Some(signal) = signals.forever().find(|&signal| signal != SIGXFSZ) {
            let hint = how_to_continue
                .map_or_else(String::new, |command| format!("; to continue: {command}"));
            hardnessd_core::stderr_line!("hrn-train: interrupted{hint}");
            std::process::exit(128 + signal);
        }
    })?;
    Ok(())
}

/// The command line of this process, with `more` at its end unless it is there.
pub(super) fn again(more: Option<&str>) -> Option<String> {
    let words = std::env::args_os().map(|word| word.to_string_lossy().into_owned());
    let mut words: Vec<String> = words.collect();
    let more = more.filter(|more| !words.iter().any(|word| word == more));
    words.extend(more.map(str::to_owned));
    shlex::try_join(words.iter().map(String::as_str)).ok()
}
