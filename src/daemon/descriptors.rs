//! File descriptors: how many this process may have open, and how many it may need.
//!
//! Every subscriber takes one, and so does a sensor's port. If subscribers took all of them, a
//! sensor that is plugged in again could not be opened.

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tracing::debug;

use super::config::Config;
use super::http::Http;

/// The descriptors for the log, the runtime, listeners, recordings, and files that are read on a
/// reload.
const OTHERS: u64 = 64;

/// This process may need more descriptors than it may have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "{needed} file descriptors may be needed, {limit} are allowed: if subscribers take all, a sensor that \
     is lost cannot be opened again: lower publish.unix.max_clients, or raise LimitNOFILE of the service \
     (`ulimit -Hn` of a shell)"
)]
pub struct Shortage {
    /// The descriptors needed with the most subscribers that the configuration allows.
    pub needed: u64,
    /// The hard limit of descriptors.
    pub limit: u64,
}

/// Raises the soft limit to the hard limit. Nothing in this process fails on descriptors above
/// 1,023.
pub(super) fn raise() {
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    if current == maximum {
        return;
    }
    let raised = Rlimit {
        current: maximum,
        maximum,
    };
    if let Err(error) = setrlimit(Resource::Nofile, raised) {
        debug!(%error, "the limit of file descriptors stays as it is");
    }
}

/// The shortage, if `config` may need more descriptors than this process may have.
pub fn shortage(config: &Config) -> Option<Shortage> {
    let limit = getrlimit(Resource::Nofile).maximum?;
    let needed = needed(config);
    (needed > limit).then_some(Shortage { needed, limit })
}

fn needed(config: &Config) -> u64 {
    let unix = &config.publish.unix;
    // One socket is for events, the other for control.
    let sockets = if unix.enabled { 2 } else { 0 };
    let ways = sockets + usize::from(config.publish.tcp.is_some());
    let pages = config.http.as_ref().map_or(0, |_| Http::MOST_CONNECTIONS);
    let all = ways
        .saturating_mul(unix.max_clients)
        .saturating_add(pages + config.sensors.len());
    OTHERS.saturating_add(all as u64)
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::daemon::config::SensorTable;

    #[test]
    fn every_way_in_needs_its_subscribers() {
        let mut config = Config::new(vec![SensorTable::new(PathBuf::from("port"))]);
        assert_eq!(needed(&config), OTHERS + 2 * 256 + 1);
        config.publish.unix.max_clients = usize::MAX;
        assert_eq!(needed(&config), u64::MAX);
        assert!(shortage(&config).is_some() || getrlimit(Resource::Nofile).maximum.is_none());
        config.publish.unix.enabled = false;
        assert_eq!(needed(&config), OTHERS + 1);
        assert_eq!(shortage(&config), None);
    }
}
