//! What the service manager is told and what it hands over, where there is one.

use std::io;
use std::os::unix::net::UnixListener;
use std::time::Duration;

use listenfd::ListenFd;
use sd_notify::NotifyState;

use crate::event::{LinkState, Status};

/// The Unix sockets that the manager listens on for us (sd_listen_fds(3)).
///
/// # Errors
///
/// If it hands over anything else.
pub(crate) fn sockets() -> io::Result<Vec<UnixListener>> {
    let mut passed = ListenFd::from_env();
    let sockets = (0..passed.len()).map(|index| passed.take_unix_listener(index));
    sockets.filter_map(Result::transpose).collect()
}

/// The daemon serves: sockets answer, ports are being opened.
pub(crate) fn ready() {
    tell(&[NotifyState::Ready]);
}

/// The configuration is being read again; [`ready`] ends it.
pub(crate) fn reloading() {
    match NotifyState::monotonic_usec_now() {
        Ok(now) => tell(&[NotifyState::Reloading, now]),
        Err(_) => tell(&[NotifyState::Reloading]),
    }
}

/// The daemon is on its way out.
pub(crate) fn stopping() {
    tell(&[NotifyState::Stopping]);
}

/// Every sensor's task has answered: the pipelines turn, whatever the hardware does.
pub(crate) fn alive(statuses: &[Status]) {
    let live = statuses
        .iter()
        .filter(|status| status.state == LinkState::Live)
        .count();
    let line = format!("{live} of {} sensors live", statuses.len());
    tell(&[NotifyState::Watchdog, NotifyState::Status(&line)]);
}

/// How often [`alive`] is due: twice as often as the manager demands, or at leisure where it
/// demands nothing.
pub(crate) fn heartbeat() -> Duration {
    const AT_LEISURE: Duration = Duration::from_secs(10);
    sd_notify::watchdog_enabled().map_or(AT_LEISURE, |timeout| timeout / 2)
}

fn tell(state: &[NotifyState]) {
    if let Err(error) = sd_notify::notify(state) {
        tracing::debug!(%error, "service manager cannot be told");
    }
}
