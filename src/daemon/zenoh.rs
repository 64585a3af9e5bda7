//! Zenoh: each event is put under the key `tactile/SITE/SENSOR/KIND`, as the same JSON as on a
//! socket.
//!
//! In: lines of the hub. Out: puts; the `hello`, the last final verdict and the status of each
//! sensor as answers to queries; and the liveliness token `tactile/SITE`, which ends with the
//! daemon. The session talks only to addresses that the configuration names. If the configuration
//! names a key with positions of the arm, the session subscribes to it. Nothing else that comes in
//! changes anything.

use std::collections::BTreeMap;
use std::io;
use std::net::TcpListener;
use std::time::Duration;

use tokio::sync::mpsc::{self, WeakSender};
use tracing::{info, warn};
use zenoh::bytes::Encoding;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::CongestionControl;
use zenoh::query::{Query, Queryable};
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

use super::config;
use super::hub::Line;
use super::relay::{Door, Worker};
use super::request::{self, Request};
use hardnessd_core::event::{self, Hello, Kind, Reply, Status};

/// The reason the session could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The daemon cannot listen on an address.
    #[error("publish.zenoh.listen: cannot listen on {endpoint:?}: {source}")]
    Listen {
        /// The configured endpoint.
        endpoint: config::Endpoint,
        /// The system's error.
        source: io::Error,
    },
    /// The library failed. The message is the library's own.
    #[error("publish.zenoh: {0}")]
    Session(#[from] zenoh::Error),
    /// The system could not start the thread.
    #[error("no thread for publish.zenoh: {0}")]
    Thread(#[from] io::Error),
}

/// A job for the thread.
pub(super) enum Job {
    Lines(Vec<Line>),
    Query(Query),
    Vitals(Hello, Vec<Status>),
}

impl From<Vec<Line>> for Job {
    fn from(lines: Vec<Line>) -> Self {
        Self::Lines(lines)
    }
}

/// Opens a session as `settings` say, with keys below `tactile/SITE`.
///
/// # Errors
///
/// Fails if the daemon cannot listen on an address, or the library fails. A peer that cannot be
/// reached is not an error, because the library tries again.
pub(super) fn open(
    settings: &config::Zenoh,
    robot: &str,
    sensors: Vec<String>,
) -> Result<Worker<Job>, Error> {
    // Try the addresses here first, because the library's error is a page long and names paths of
    // its sources.
    for endpoint in &settings.listen {
        TcpListener::bind(endpoint.address()).map_err(|source| Error::Listen {
            endpoint: endpoint.clone(),
            source,
        })?;
    }
    let site = settings.site(robot).to_owned();
    let (listen, connect) = (&settings.listen, &settings.connect);
    info!(way = "zenoh", site, ?listen, ?connect, "publishing");
    let settings = settings.clone();
    let worker = Worker::start(
        "zenoh",
        move |jobs, door| Zenoh::open(&settings, site, &sensors, jobs.downgrade(), door),
        Zenoh::work,
    );
    Ok(worker?.with_vitals(Job::Vitals))
}

/// An open session.
struct Zenoh {
    publishers: BTreeMap<String, Publisher<'static>>,
    site: String,
    /// The answers to queries, by key.
    last: BTreeMap<String, Line>,
    // Dropping one of these ends it. The session must be dropped last.
    _queries: Queryable<()>,
    _motion: Option<Subscriber<()>>,
    _alive: LivelinessToken,
    _session: Session,
}

impl Zenoh {
    fn open(
        settings: &config::Zenoh,
        site: String,
        sensors: &[String],
        jobs: WeakSender<Job>,
        door: Door,
    ) -> Result<Self, Error> {
        let session = zenoh::open(configuration(settings)?).wait()?;
        let mut publishers = BTreeMap::new();
        for sensor in sensors {
            for kind in Kind::ALL {
                let key = key(&site, sensor, kind);
                // A frame is soon out of date. Any other event may wait for the network a while,
                // because nothing else waits for this thread.
                let publisher = session
                    .declare_publisher(key.clone())
                    .encoding(Encoding::APPLICATION_JSON)
                    .congestion_control(match kind {
                        Kind::Frame => CongestionControl::Drop,
                        _ => CongestionControl::Block,
                    })
                    .express(kind == Kind::Hardness)
                    .wait()?;
                publishers.insert(key, publisher);
            }
        }
        let queries = session
            .declare_queryable(format!("tactile/{site}/**"))
            // When the thread is busy, a query gets no answer. The peer may ask again.
            .callback(move |query| {
                if let Some(jobs) = jobs.upgrade() {
                    drop(jobs.try_send(Job::Query(query)));
                }
            })
            .wait()?;
        let motion = settings.motion.as_ref().map(|key| {
            let subscriber = session.declare_subscriber(key.clone());
            subscriber
                .callback(move |sample| take_positions(&sample, &door))
                .wait()
        });
        let alive = session
            .liveliness()
            .declare_token(format!("tactile/{site}"))
            .wait()?;
        Ok(Self {
            publishers,
            site,
            last: BTreeMap::new(),
            _queries: queries,
            _motion: motion.transpose()?,
            _alive: alive,
            _session: session,
        })
    }

    fn work(mut self, mut jobs: mpsc::Receiver<Job>) {
        while let Some(job) = jobs.blocking_recv() {
            match job {
                Job::Lines(lines) => lines.into_iter().for_each(|line| self.publish(line)),
                Job::Query(query) => self.answer(&query),
                Job::Vitals(hello, statuses) => self.hold(hello, statuses),
            }
        }
    }

    /// Keeps what is true now, for answers: totals and rates change without an event.
    fn hold(&mut self, hello: Hello, statuses: Vec<Status>) {
        let hello = Line::from(Reply::Hello(hello));
        self.last.insert(format!("tactile/{}", self.site), hello);
        for status in statuses {
            let key = key(&self.site, &status.sensor, Kind::Status);
            if self.publishers.contains_key(&key) {
                self.last.insert(key, status.into());
            }
        }
    }

    fn publish(&mut self, line: Line) {
        let Some(event) = &line.event else {
            warn!(gap = line.json.trim_end(), "zenoh is too slow");
            return;
        };
        let key = key(&self.site, event.sensor(), event.kind());
        let Some(publisher) = self.publishers.get(&key) else {
            return;
        };
        if let Err(error) = publisher.put(text(&line)).wait() {
            warn!(key, %error, "not published on zenoh");
        }
        if event.lasts() {
            self.last.insert(key, line);
        }
    }

    fn answer(&self, query: &Query) {
        for (key, line) in &self.last {
            let asked = zenoh::key_expr::keyexpr::new(key)
                .is_ok_and(|key| query.key_expr().intersects(key));
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
}

/// The longest value with positions, as long as the longest line of the control socket.
const LONGEST_VALUE_BYTES: usize = 64 * 1024;

/// Takes positions of the arm, in the same line as on the control socket. No other request is
/// accepted.
fn take_positions(sample: &Sample, door: &Door) {
    let key = sample.key_expr();
    let bytes = sample.payload().to_bytes();
    if bytes.len() > LONGEST_VALUE_BYTES {
        warn!(%key, "found {} bytes on zenoh, expected {LONGEST_VALUE_BYTES} at most", bytes.len());
        return;
    }
    match request::parse(&bytes).request {
        Ok(Request::Motion(positions)) => door.put(positions),
        Ok(_) => warn!(%key, "found another request on zenoh, expected motion"),
        Err(unusable) => warn!(%key, %unusable, "positions refused"),
    }
}

fn key(site: &str, sensor: &str, kind: Kind) -> String {
    format!("tactile/{site}/{sensor}/{}", event::name(&kind))
}

/// The JSON without its newline, because each message is one event.
fn text(line: &Line) -> &str {
    line.json.trim_end()
}

/// The daemon's session. An address in use is an error. A router that is not there yet is none: the
/// library tries again.
fn configuration(settings: &config::Zenoh) -> Result<zenoh::Config, zenoh::Error> {
    let mut config = quiet("peer", &settings.listen, &settings.connect)?;
    config.insert_json5("connect/exit_on_failure", "false")?;
    Ok(config)
}

/// The session of a client of the first router or peer in `connect` that answers. It is an error if none answers
/// within `timeout`. A router brokers between a client and everyone else, but not between two peers.
///
/// # Errors
///
/// If the library refuses an endpoint.
pub(crate) fn searching(
    connect: &[config::Endpoint],
    timeout: Duration,
) -> Result<zenoh::Config, zenoh::Error> {
    let mut config = quiet("client", &[], connect)?;
    config.insert_json5("connect/exit_on_failure", "true")?;
    config.insert_json5("connect/timeout_ms", &timeout.as_millis().to_string())?;
    Ok(config)
}

/// By default zenoh listens on every interface and looks for peers by multicast. This configuration
/// does neither.
fn quiet(
    mode: &str,
    listen: &[config::Endpoint],
    connect: &[config::Endpoint],
) -> Result<zenoh::Config, zenoh::Error> {
    let json = |endpoints: &[config::Endpoint]| {
        serde_json::to_string(endpoints).expect("a list of strings is JSON")
    };
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", format!("\"{mode}\"")),
        ("listen/endpoints", json(listen)),
        ("listen/exit_on_failure", "true".to_owned()),
        ("connect/endpoints", json(connect)),
        ("scouting/multicast/enabled", "false".to_owned()),
        // Without gossip, a peer behind a router gets events twice. Autoconnect would connect to
        // peers that the configuration does not name.
        ("scouting/gossip/autoconnect", "[]".to_owned()),
    ] {
        config.insert_json5(key, &value)?;
    }
    Ok(config)
}
