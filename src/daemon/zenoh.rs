//! Zenoh: each event is put under the key `tactile/SITE/SENSOR/KIND`, as the same JSON as on a
//! socket.
//!
//! In: lines of the hub. Out: puts; the `hello`, the last final verdict and the status of each
//! sensor as answers to queries; and the liveliness token `tactile/SITE`, which ends with the
//! daemon. The session talks only to addresses that the configuration names. Nothing that comes in
//! changes anything.

use std::net::TcpListener;

use tracing::{info, warn};
use zenoh::bytes::Encoding;
use zenoh::liveliness::LivelinessToken;
use zenoh::qos::CongestionControl;
use zenoh::query::{Query, Queryable};
use zenoh::{Session, Wait};

use super::Error;
use super::config::{self, Config};
use super::hub::{Hub, Line, Snapshot};
use super::relay::Worker;
use hardnessd_core::event::{self, Event, Kind, Reply};

/// Opens a session as `settings` say, with keys below `tactile/SITE`.
///
/// # Errors
///
/// Fails if the daemon cannot listen on an address, or the library fails. A peer that cannot be
/// reached is not an error, because the library tries again.
pub(super) fn open(settings: &config::Zenoh, config: &Config, hub: &Hub) -> Result<Worker, Error> {
    check_listen("publish.zenoh.listen", &settings.listen)?;
    let site = settings.site(&config.robot).to_owned();
    let (listen, connect) = (&settings.listen, &settings.connect);
    info!(way = "zenoh", site, ?listen, ?connect, "publishing");
    let (settings, hub) = (settings.clone(), hub.clone());
    Worker::publishing(
        "zenoh",
        move || Zenoh::open(&settings, site, hub),
        |session, event, line| session.publish(event, line),
    )
}

/// An open session.
struct Zenoh {
    site: String,
    // Dropping one of these ends it. The session must be dropped last.
    _queries: Queryable<()>,
    _alive: LivelinessToken,
    session: Session,
}

impl Zenoh {
    fn open(settings: &config::Zenoh, site: String, hub: Hub) -> Result<Self, zenoh::Error> {
        let mut config = configuration(&settings.listen, &settings.connect)?;
        // Without gossip, a peer behind a router gets events twice. Autoconnect would connect to
        // peers that the configuration does not name.
        config.insert_json5("scouting/gossip/autoconnect", "[]")?;
        let session = zenoh::open(config).wait()?;
        let queries = session
            .declare_queryable(format!("tactile/{site}/**"))
            .callback({
                let site = site.clone();
                // When the daemon is stopping, a query gets no answer.
                move |query| {
                    if let Some(now) = hub.snapshot_blocking() {
                        answer(&query, &site, now);
                    }
                }
            })
            .wait()?;
        let alive = session
            .liveliness()
            .declare_token(format!("tactile/{site}"))
            .wait()?;
        Ok(Self {
            site,
            _queries: queries,
            _alive: alive,
            session,
        })
    }

    fn publish(&self, event: &Event, line: &Line) {
        let kind = event.kind();
        let key = key(&self.site, event.sensor(), kind);
        // A frame is soon out of date. Any other event may wait for the network a while, because nothing else
        // waits for this thread.
        let put = self
            .session
            .put(key.as_str(), text(line))
            .encoding(Encoding::APPLICATION_JSON)
            .congestion_control(match kind {
                Kind::Frame => CongestionControl::Drop,
                _ => CongestionControl::Block,
            })
            .express(kind == Kind::Hardness);
        if let Err(error) = put.wait() {
            warn!(key, %error, "not published on zenoh");
        }
    }
}

/// Answers a query with what is true now.
fn answer(query: &Query, site: &str, now: Snapshot) {
    let hello = Line::reply(&Reply::Hello(now.hello));
    let mut known = vec![(format!("tactile/{site}"), hello)];
    for sensor in now.sensors {
        let name = sensor.state.status.sensor.clone();
        known.extend(
            sensor
                .last
                .map(|last| (key(site, &name, Kind::Hardness), last)),
        );
        let status = Line::status(sensor.state.status);
        known.push((key(site, &name, Kind::Status), status));
    }
    for (key, line) in &known {
        let asked =
            zenoh::key_expr::keyexpr::new(key).is_ok_and(|key| query.key_expr().intersects(key));
        if asked {
            let reply = query
                .reply(key, text(line))
                .encoding(Encoding::APPLICATION_JSON);
            if let Err(error) = reply.wait() {
                warn!(key, %error, "not answered on zenoh");
            }
        }
    }
}

fn key(site: &str, sensor: &str, kind: Kind) -> String {
    format!("tactile/{site}/{sensor}/{}", event::name(&kind))
}

/// The JSON without its newline, because each message is one event.
fn text(line: &Line) -> &str {
    line.json().trim_end()
}

/// Tries to listen on the endpoints, because the library's error is a page long and names paths of its sources.
pub(super) fn check_listen(key: &str, endpoints: &[String]) -> Result<(), Error> {
    for endpoint in endpoints {
        let tried = TcpListener::bind(config::Zenoh::address(endpoint).unwrap_or_default());
        tried
            .map_err(|error| Error::io(format!("{key}: cannot listen on {endpoint:?}: {error}")))?;
    }
    Ok(())
}

/// A session of the daemon. An address in use is an error. If a router is not there yet, the library tries
/// again. By default zenoh listens on every interface and looks for peers by multicast. This configuration
/// does neither.
pub(super) fn configuration(
    listen: &[String],
    connect: &[String],
) -> Result<zenoh::Config, zenoh::Error> {
    let json =
        |endpoints: &[String]| serde_json::to_string(endpoints).expect("a list of strings is JSON");
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"peer\"".to_owned()),
        ("listen/endpoints", json(listen)),
        ("listen/exit_on_failure", "true".to_owned()),
        ("connect/endpoints", json(connect)),
        ("connect/exit_on_failure", "false".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
    ] {
        config.insert_json5(key, &value)?;
    }
    Ok(config)
}
