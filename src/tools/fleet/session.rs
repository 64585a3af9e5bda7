//! The zenoh session of `fleet`.
//!
//! In: what daemons put, their tokens, and their answers. Out: [`News`], at most [`WAITING`] at a time. The
//! library has threads of its own and calls back on them. Questions are sent from one more thread,
//! because a callback must not wait.

use std::borrow::Cow;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc as std_mpsc;
use std::thread;
use std::time::Duration;

use jiff::Timestamp;
use serde::Deserialize;
use serde_json::Value;
use tokio::sync::{mpsc, oneshot};
use zenoh::Wait;
use zenoh::pubsub::Subscriber;
use zenoh::query::{ConsolidationMode, QueryTarget};
use zenoh::sample::{Sample, SampleKind};

use crate::daemon::config::Endpoint;
use crate::daemon::zenoh::searching;
use crate::event::Kind;

/// What is new of a robot. `site` is the robot's part of the keys.
#[derive(Debug)]
pub(super) struct News {
    pub(super) site: String,
    pub(super) what: What,
}

/// What is new.
#[derive(Debug)]
pub(super) enum What {
    /// Its token is there.
    Came,
    /// Its token is gone.
    Gone,
    /// It sent an event, or answered with one.
    Event(Heard),
    /// It answered with its `hello`.
    Hello(Hello),
    /// No more answers come to the last question.
    Asked,
}

/// An event.
#[derive(Debug)]
pub(super) struct Heard {
    pub(super) kind: Kind,
    pub(super) sensor: String,
    pub(super) seq: Option<u64>,
    /// Whether it is a press's last verdict.
    pub(super) is_final: bool,
    /// Whether it came as an answer. It may have been sent long ago.
    pub(super) is_answer: bool,
    /// When it came.
    pub(super) at: Timestamp,
    /// Its JSON on one line. Empty for what is only counted.
    pub(super) text: String,
}

/// The parts of a `hello` that are shown.
#[derive(Debug, Default, Deserialize)]
pub(super) struct Hello {
    pub(super) run: String,
    pub(super) version: String,
    pub(super) seq: u64,
    pub(super) model: Model,
}

/// The model that a robot judges with.
#[derive(Debug, Default, Deserialize)]
pub(super) struct Model {
    pub(super) sha256: String,
}

/// News that wait to be taken. One more is dropped and counted.
pub(super) const WAITING: usize = 4096;

/// Questions that wait to be sent. One more is dropped: it is asked again later.
const QUESTIONS: usize = 4096;

/// How long the router may take to answer at the beginning.
pub(super) const PATIENCE: Duration = Duration::from_secs(5);

/// How long a robot may take to answer.
const ANSWER: Duration = Duration::from_secs(10);

/// Before every key.
const ROOT: &str = "tactile/";

/// An event is shorter. Anyone who reaches the router could send more.
const LONGEST_EVENT_BYTES: usize = 8 * 1024;
/// A `hello` describes every sensor of a robot.
const LONGEST_HELLO_BYTES: usize = 256 * 1024;
/// The longest name of a robot in a key.
const LONGEST_SITE_BYTES: usize = 255;
/// The longest name of a sensor, as in a configuration.
const LONGEST_SENSOR_BYTES: usize = 64;
/// The longest of other texts that are kept.
const LONGEST_WORD_BYTES: usize = 64;

/// An open session. It ends with the process.
pub(super) struct Session {
    questions: std_mpsc::SyncSender<String>,
    dropped: Arc<AtomicU64>,
}

impl Session {
    /// Connects, and sends what is new to `news`. `None`: nobody answered within [`PATIENCE`].
    pub(super) async fn open(
        connect: &[Endpoint],
        news: mpsc::Sender<News>,
    ) -> io::Result<Option<Self>> {
        let (questions, asked) = std_mpsc::sync_channel(QUESTIONS);
        let (opened, outcome) = oneshot::channel();
        let connect = connect.to_vec();
        let dropped = Arc::new(AtomicU64::new(0));
        let outlet = Outlet {
            news,
            dropped: Arc::clone(&dropped),
        };
        let session = Self { questions, dropped };
        let asks = session.questions.clone();
        thread::Builder::new()
            .name("zenoh".to_owned())
            .spawn(move || match Link::open(&connect, &outlet, &asks) {
                Ok(link) => {
                    let _ = opened.send(true);
                    link.ask(&outlet, &asked);
                }
                // The library's error is pages long. It says that it could not connect.
                Err(_) => drop(opened.send(false)),
            })?;
        let outcome = outcome
            .await
            .expect("a thread that panics ends the process");
        Ok(outcome.then_some(session))
    }

    /// Asks a robot for its `hello`, its statuses and its last verdicts.
    pub(super) fn ask(&self, site: &str) {
        let _ = self.questions.try_send(site.to_owned());
    }

    /// How many news were dropped, because they came faster than they were taken.
    pub(super) fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }
}

/// Where callbacks put what is new.
#[derive(Clone)]
struct Outlet {
    news: mpsc::Sender<News>,
    dropped: Arc<AtomicU64>,
}

impl Outlet {
    fn put(&self, site: &str, what: What) {
        let site = site.to_owned();
        if self.news.try_send(News { site, what }).is_err() {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// What the library keeps open.
struct Link {
    session: zenoh::Session,
    _events: Vec<Subscriber<()>>,
    _tokens: Subscriber<()>,
}

impl Link {
    fn open(
        connect: &[Endpoint],
        outlet: &Outlet,
        asks: &std_mpsc::SyncSender<String>,
    ) -> Result<Self, zenoh::Error> {
        let session = zenoh::open(searching(connect, PATIENCE)?).wait()?;
        // All that has a number, so that a number that does not come tells of an event that was
        // missed. Frames have none, and are too many.
        let events = [Kind::Hardness, Kind::Press, Kind::Status].map(|kind| {
            let outlet = outlet.clone();
            session
                .declare_subscriber(format!("{ROOT}**/{}", kind.name()))
                .callback(move |sample| take(&sample, &outlet, false))
                .wait()
        });
        let (outlet, asks) = (outlet.clone(), asks.clone());
        let tokens = session
            .liveliness()
            .declare_subscriber(format!("{ROOT}**"))
            .history(true)
            .callback(move |sample| {
                let Some(site) = site(sample.key_expr().as_str()) else {
                    return;
                };
                match sample.kind() {
                    SampleKind::Put => {
                        outlet.put(site, What::Came);
                        let _ = asks.try_send(site.to_owned());
                    }
                    SampleKind::Delete => outlet.put(site, What::Gone),
                }
            })
            .wait()?;
        Ok(Self {
            session,
            _events: events.into_iter().collect::<Result<_, _>>()?,
            _tokens: tokens,
        })
    }

    /// Sends questions until the program ends.
    fn ask(self, outlet: &Outlet, asked: &std_mpsc::Receiver<String>) {
        while let Ok(site) = asked.recv() {
            let last = Last {
                site: site.clone(),
                outlet: outlet.clone(),
            };
            let question = self
                .session
                .get(format!("{ROOT}{site}/**"))
                // A storage that answers too must not answer in the robot's place.
                .target(QueryTarget::All)
                .consolidation(ConsolidationMode::None)
                .timeout(ANSWER)
                .callback(move |reply| {
                    if let Ok(sample) = reply.result() {
                        take(sample, &last.outlet, true);
                    }
                });
            // A robot that cannot be asked is known by what it sends next.
            let _ = question.wait();
        }
    }
}

/// Says that a question has its last answer: the library drops it with the callback.
struct Last {
    site: String,
    outlet: Outlet,
}

impl Drop for Last {
    fn drop(&mut self) {
        self.outlet.put(&self.site, What::Asked);
    }
}

/// The robot in a token's key, if it can be one.
fn site(key: &str) -> Option<&str> {
    let site = key.strip_prefix(ROOT)?;
    (site.len() <= LONGEST_SITE_BYTES).then_some(site)
}

/// Takes an event or a `hello`. What is neither is left out.
fn take(sample: &Sample, outlet: &Outlet, is_answer: bool) {
    let key = sample.key_expr().as_str();
    let bytes = sample.payload().to_bytes();
    if let Some((site, heard)) = event(key, &bytes, is_answer) {
        outlet.put(site, What::Event(heard));
    } else if let Some((site, hello)) = hello(key, &bytes).filter(|_| is_answer) {
        outlet.put(site, What::Hello(hello));
    }
}

/// The event in a value at `tactile/SITE/SENSOR/KIND`.
fn event<'a>(key: &'a str, bytes: &[u8], is_answer: bool) -> Option<(&'a str, Heard)> {
    #[derive(Deserialize)]
    struct Said<'a> {
        #[serde(borrow, rename = "type")]
        kind: Cow<'a, str>,
        #[serde(borrow)]
        sensor: Cow<'a, str>,
        seq: Option<u64>,
        #[serde(borrow, default)]
        phase: Cow<'a, str>,
    }
    let (rest, kind) = key.rsplit_once('/')?;
    let (rest, sensor) = rest.rsplit_once('/')?;
    let site = site(rest)?;
    let kind = Kind::named(kind).filter(|kind| *kind != Kind::Frame)?;
    if bytes.len() > LONGEST_EVENT_BYTES || sensor.len() > LONGEST_SENSOR_BYTES {
        return None;
    }
    let said: Said = serde_json::from_slice(bytes).ok()?;
    if said.kind != kind.name() || said.sensor != sensor {
        return None;
    }
    let is_final = kind == Kind::Hardness && said.phase == "final";
    let text = match is_final || kind == Kind::Status {
        // Without its line breaks, if it has some.
        true => serde_json::from_slice::<Value>(bytes).ok()?.to_string(),
        false => String::new(),
    };
    let heard = Heard {
        kind,
        sensor: sensor.to_owned(),
        seq: said.seq,
        is_final,
        is_answer,
        at: Timestamp::now(),
        text,
    };
    Some((site, heard))
}

/// The `hello` in an answer at `tactile/SITE`.
fn hello<'a>(key: &'a str, bytes: &[u8]) -> Option<(&'a str, Hello)> {
    let site = site(key)?;
    if bytes.len() > LONGEST_HELLO_BYTES {
        return None;
    }
    let hello: Hello = serde_json::from_slice(bytes).ok()?;
    let words = [&hello.run, &hello.version, &hello.model.sha256];
    let are_short = words.iter().all(|word| word.len() <= LONGEST_WORD_BYTES);
    are_short.then_some((site, hello))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_event_is_taken_only_from_its_own_key() {
        let verdict = br#"{"type":"hardness","phase":"final",
            "sensor":"palm","seq":7,"label":"firm"}"#;
        let (site, heard) = event("tactile/hall/3/palm/hardness", verdict, false).unwrap();
        assert_eq!(
            (site, &*heard.sensor, heard.seq),
            ("hall/3", "palm", Some(7))
        );
        assert!(heard.is_final && !heard.text.contains('\n'), "{heard:?}");
        for key in [
            "tactile/hall/3/thumb/hardness",
            "tactile/hall/3/palm/status",
            "tactile/hall/3/palm/frame",
            "tactile/palm/hardness",
            "palm/hardness",
            "tactile",
        ] {
            assert!(event(key, verdict, false).is_none(), "{key}");
        }
        let long = format!("tactile/{}/palm/hardness", "a".repeat(256));
        assert!(event(&long, verdict, false).is_none());
    }

    #[test]
    fn what_is_no_event_is_left_out() {
        let deep = "[".repeat(8000);
        let long = format!(
            r#"{{"type":"status","sensor":"palm","x":"{}"}}"#,
            "x".repeat(8192)
        );
        for bytes in [
            "",
            "null",
            "\u{0}",
            r#"{"type":"status"}"#,
            r#"{"type":"status","sensor":5}"#,
            r#"{"type":"status","sensor":"palm","seq":-1}"#,
            &deep,
            &long,
        ] {
            assert!(event("tactile/a/palm/status", bytes.as_bytes(), true).is_none());
            assert!(hello("tactile/a", bytes.as_bytes()).is_none());
        }
    }
}
