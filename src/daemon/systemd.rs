//! Notifications to systemd, and the sockets that systemd passes to the daemon. Without systemd,
//! nothing here does anything.

use std::io;
use std::os::unix::net::UnixListener;
use std::time::Duration;

use listenfd::ListenFd;
use sd_notify::NotifyState;

use hardnessd_core::event::{LinkState, Status};

/// The Unix sockets that systemd listens on for us (sd_listen_fds(3)).
///
/// # Errors
///
/// Fails if systemd passes anything else.
pub(crate) fn sockets() -> io::Result<Vec<UnixListener>> {
    let mut passed = ListenFd::from_env();
    let sockets = (0..passed.len()).map(|index| passed.take_unix_listener(index));
    sockets.filter_map(Result::transpose).collect()
}

/// Notifies systemd that the daemon serves: sockets answer, and ports are being opened.
pub(crate) fn ready() {
    notify(&[NotifyState::Ready]);
}

/// Notifies systemd that the configuration is being read again, until [`ready`] is called.
pub(crate) fn reloading() {
    match NotifyState::monotonic_usec_now() {
        Ok(now) => notify(&[NotifyState::Reloading, now]),
        Err(_) => notify(&[NotifyState::Reloading]),
    }
}

/// Notifies systemd that the daemon is about to end.
pub(crate) fn stopping() {
    notify(&[NotifyState::Stopping]);
}

/// Feeds the watchdog, because every sensor's task has answered. The state of the hardware does not
/// matter.
pub(crate) fn alive(statuses: &[Status]) {
    let live = statuses
        .iter()
        .filter(|status| status.state == LinkState::Live)
        .count();
    let line = format!("{live} of {} sensors live", statuses.len());
    notify(&[NotifyState::Watchdog, NotifyState::Status(&line)]);
}

/// How often [`alive`] is due: twice as often as the watchdog demands, or every 10 s without a
/// watchdog.
pub(crate) fn heartbeat() -> Duration {
    const AT_LEISURE: Duration = Duration::from_secs(10);
    sd_notify::watchdog_enabled().map_or(AT_LEISURE, |timeout| timeout / 2)
}

fn notify(state: &[NotifyState]) {
    if let Err(error) = sd_notify::notify(state) {
        tracing::debug!(%error, "service manager cannot be told");
    }
}
