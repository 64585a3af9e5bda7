//! Notifications to systemd. Without systemd, nothing here does anything.

use std::time::Duration;

use sd_notify::NotifyState;

/// Notifies systemd that the daemon serves: sockets answer, and ports are being opened.
pub(crate) fn ready() {
    notify(&[NotifyState::Ready]);
}

/// Notifies systemd that the configuration is being read again, until [`ready`] is called.
pub(crate) fn reloading() {
    let now = NotifyState::monotonic_usec_now().ok();
    let state = [NotifyState::Reloading].into_iter().chain(now);
    notify(&state.collect::<Vec<_>>());
}

/// Notifies systemd that the daemon is about to end.
pub(crate) fn stopping() {
    notify(&[NotifyState::Stopping]);
}

/// Feeds the watchdog, because the sensors' thread works. The state of the hardware does not matter.
pub(crate) fn alive((live, all): (usize, usize)) {
    let line = format!("{live} of {all} sensors live");
    notify(&[NotifyState::Watchdog, NotifyState::Status(&line)]);
}

/// How often [`alive`] is due: twice as often as the watchdog demands, or every 10 s without a
/// watchdog.
pub(crate) fn heartbeat() -> Duration {
    const AT_LEISURE: Duration = Duration::from_secs(10);
    // The environment may say anything. No service has so short a watchdog.
    const SHORTEST: Duration = Duration::from_millis(10);
    sd_notify::watchdog_enabled().map_or(AT_LEISURE, |timeout| (timeout / 2).max(SHORTEST))
}

fn notify(state: &[NotifyState]) {
    if let Err(error) = sd_notify::notify(state) {
        tracing::debug!(%error, "service manager cannot be told");
    }
}
