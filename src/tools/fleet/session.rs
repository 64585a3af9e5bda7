//! The zenoh session of `fleet`.
//!
//! In: what daemons put, their tokens, and their answers. Out: [`News`], at most [`WAITING`] at a time. The
//! library has threads of its own and calls back on them. Questions are sent from one more thread,
//! because a callback must not wait.

use std::borrow::Cow;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc as std_mpsc;
use std::thread;
use std::time::Duration;

use serde::Deserialize;
use serde_json::Value;
use tokio::sync::{mpsc, oneshot};
use zenoh::Wait;
use zenoh::pubsub::Subscriber;
use zenoh::query::{ConsolidationMode, QueryTarget};
use zenoh::sample::{Sample, SampleKind};

use crate::daemon::config::Endpoint;
use crate::daemon::now;
use crate::daemon::zenoh::searching;
use hardnessd_core::event::{self, Kind};
use hardnessd_core::frame::Stamp;
use hardnessd_core::wording::named;

/// What is new.
#[derive(Debug)]
pub(super) enum News {
    /// Of one robot.
    Robot {
        /// The robot's part of the keys.
        site: String,
        what: What,
        /// When it came. For [`What::There`], when it was asked.
        at: Stamp,
    },
    /// The tokens were asked for at this time, and each one that was there has come as [`What::There`].
    Tokens(Stamp),
}

/// What is new of a robot.
#[derive(Debug)]
pub(super) enum What {
    /// Its token came.
    Came,
    /// Its token is gone.
    Gone,
    /// Its token was there when it was asked.
    There,
    /// It sent an event, or answered with one.
    Event(FleetEvent),
    /// It answered with its `hello`.
    Hello(Hello),
    /// No more answers come to the last question.
    Asked,
}

/// An event.
#[derive(Debug)]
pub(super) struct FleetEvent {
    pub(super) kind: Kind,
    pub(super) sensor: String,
    pub(super) seq: Option<u64>,
    /// Whether it is a press's last verdict.
    pub(super) is_final: bool,
    /// Whether it came as an answer. It may have been sent long ago.
    pub(super) is_answer: bool,
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
    #[serde(default)]
    pub(super) levels: Vec<Level>,
}

/// A level that a model knows.
#[derive(Debug, Default, Deserialize)]
pub(super) struct Level {
    pub(super) label: String,
}

/// News that wait to be taken. One more is dropped and counted.
pub(super) const WAITING: usize = 4096;

/// Questions that wait to be sent. One more is dropped: it is asked again later.
const QUESTIONS: usize = 4096;

/// Tokens that wait to be taken after a question for all of them. If there are more, it is asked again.
const TOKENS: usize = 65_536;

/// How long the router may take to answer at the beginning, and with its tokens. The library says only that there
/// are no more tokens, if it gives up first, after 10 s.
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
    questions: std_mpsc::SyncSender<Question>,
    dropped: Arc<Dropped>,
}

/// What is asked.
enum Question {
    /// A robot's `hello`, its statuses and its last verdicts.
    Robot(String),
    /// Which tokens are there.
    Tokens,
}

/// What was dropped, because it came faster than it was taken.
#[derive(Default)]
struct Dropped {
    news: AtomicU64,
    /// Whether a token that came or went was dropped since the tokens were last asked for.
    is_token: AtomicBool,
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
        let dropped = Arc::new(Dropped::default());
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
        let _ = self.questions.try_send(Question::Robot(site.to_owned()));
    }

    /// Asks which tokens are there, if one that came or went was dropped.
    pub(super) fn ask_for_lost_tokens(&self) {
        if self.dropped.is_token.swap(false, Ordering::Relaxed)
            && self.questions.try_send(Question::Tokens).is_err()
        {
            self.dropped.is_token.store(true, Ordering::Relaxed);
        }
    }

    /// How many news were dropped, because they came faster than they were taken.
    pub(super) fn dropped(&self) -> u64 {
        self.dropped.news.load(Ordering::Relaxed)
    }
}

/// Where callbacks put what is new.
#[derive(Clone)]
struct Outlet {
    news: mpsc::Sender<News>,
    dropped: Arc<Dropped>,
}

impl Outlet {
    fn put(&self, site: &str, what: What) {
        let is_token = matches!(what, What::Came | What::Gone);
        let (site, at) = (site.to_owned(), now());
        if self.news.try_send(News::Robot { site, what, at }).is_err() {
            self.dropped.news.fetch_add(1, Ordering::Relaxed);
            self.dropped.is_token.fetch_or(is_token, Ordering::Relaxed);
        }
    }

    /// Waits until there is room.
    fn put_in_turn(&self, news: News) {
        // An error says that the program ends.
        let _ = self.news.blocking_send(news);
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
        asks: &std_mpsc::SyncSender<Question>,
    ) -> Result<Self, zenoh::Error> {
        let session = zenoh::open(searching(connect, PATIENCE)?).wait()?;
        // All that has a number, so that a number that does not come tells of an event that was
        // missed. Frames have none, and are too many.
        let events = [Kind::Hardness, Kind::Press, Kind::Status].map(|kind| {
            let outlet = outlet.clone();
            session
                .declare_subscriber(format!("{ROOT}**/{}", event::name(&kind)))
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
                        let _ = asks.try_send(Question::Robot(site.to_owned()));
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
    fn ask(self, outlet: &Outlet, asked: &std_mpsc::Receiver<Question>) {
        while let Ok(question) = asked.recv() {
            match question {
                Question::Robot(site) => self.ask_robot(site, outlet),
                Question::Tokens => self.ask_for_tokens(outlet),
            }
        }
    }

    fn ask_robot(&self, site: String, outlet: &Outlet) {
        let question = self.session.get(format!("{ROOT}{site}/**"));
        let outlet = outlet.clone();
        let last = Last { site, outlet };
        let question = question
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

    /// Asks which tokens are there, and waits for the answers.
    fn ask_for_tokens(&self, outlet: &Outlet) {
        let asked = now();
        let (there, answers) = std_mpsc::sync_channel(TOKENS);
        let is_whole = Arc::new(AtomicBool::new(true));
        let whole = Arc::clone(&is_whole);
        let question = self
            .session
            .liveliness()
            .get(format!("{ROOT}**"))
            .timeout(PATIENCE)
            // It is dropped after the last answer, and `there` with it.
            .callback(move |reply| {
                let is_taken = match reply.result() {
                    Ok(token) => site(token.key_expr().as_str())
                        .is_none_or(|site| there.try_send(site.to_owned()).is_ok()),
                    // More answers would come too late.
                    Err(_) => false,
                };
                whole.fetch_and(is_taken, Ordering::Relaxed);
            });
        let is_sent = question.wait().is_ok();
        for site in answers {
            let what = What::There;
            outlet.put_in_turn(News::Robot {
                site,
                what,
                at: asked,
            });
        }
        match is_sent && is_whole.load(Ordering::Relaxed) {
            true => outlet.put_in_turn(News::Tokens(asked)),
            false => outlet.dropped.is_token.store(true, Ordering::Relaxed),
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
    if let Some((site, incoming)) = event(key, &bytes, is_answer) {
        outlet.put(site, What::Event(incoming));
    } else if let Some((site, hello)) = hello(key, &bytes).filter(|_| is_answer) {
        outlet.put(site, What::Hello(hello));
    }
}

/// The event in a value at `tactile/SITE/SENSOR/KIND`.
fn event<'a>(key: &'a str, bytes: &[u8], is_answer: bool) -> Option<(&'a str, FleetEvent)> {
    #[derive(Deserialize)]
    struct Said<'a> {
        #[serde(rename = "type")]
        kind: Kind,
        #[serde(borrow)]
        sensor: Cow<'a, str>,
        seq: Option<u64>,
        #[serde(borrow, default)]
        phase: Cow<'a, str>,
    }
    let (rest, kind) = key.rsplit_once('/')?;
    let (rest, sensor) = rest.rsplit_once('/')?;
    let site = site(rest)?;
    let kind = named::<Kind>(kind).ok()?;
    if kind == Kind::Frame {
        return None;
    }
    if bytes.len() > LONGEST_EVENT_BYTES || sensor.len() > LONGEST_SENSOR_BYTES {
        return None;
    }
    let said: Said = serde_json::from_slice(bytes).ok()?;
    if said.kind != kind || said.sensor != sensor {
        return None;
    }
    let is_final = kind == Kind::Hardness && said.phase == "final";
    let text = match is_final || kind == Kind::Status {
        // Without its line breaks, if it has some.
        true => serde_json::from_slice::<Value>(bytes).ok()?.to_string(),
        false => String::new(),
    };
    let incoming = FleetEvent {
        kind,
        sensor: sensor.to_owned(),
        seq: said.seq,
        is_final,
        is_answer,
        text,
    };
    Some((site, incoming))
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
    use std::net::TcpListener;
    use std::time::Instant;

    use super::super::robots::Fleet;
    use super::*;

    fn wait_for(what: &str, mut there: impl FnMut() -> bool) {
        let start = Instant::now();
        while !there() {
            assert!(start.elapsed() < Duration::from_secs(30), "{what}");
            thread::sleep(Duration::from_millis(5));
        }
    }

    #[test]
    fn a_token_that_was_dropped_is_asked_for() {
        let address = TcpListener::bind("127.0.0.1:0").and_then(|free| free.local_addr());
        let endpoint = format!("tcp/{}", address.unwrap());
        let mut config = zenoh::Config::default();
        for (key, value) in [
            ("mode", r#""router""#),
            ("listen/endpoints", &format!("[{endpoint:?}]")),
            ("scouting/multicast/enabled", "false"),
        ] {
            config.insert_json5(key, value).unwrap();
        }
        let router = zenoh::open(config).wait().unwrap();
        let token = |name: &str| {
            let key = format!("{ROOT}{name}");
            router.liveliness().declare_token(key).wait().unwrap()
        };
        let [stays, goes, goes_too] = ["stays", "goes", "goes/too"].map(token);
        // There is room for one.
        let (sender, mut news) = mpsc::channel(1);
        let runtime = tokio::runtime::Builder::new_current_thread();
        let endpoints = [Endpoint::try_from(endpoint).unwrap()];
        let opened = Session::open(&endpoints, sender.clone());
        let opened = { runtime }.build().unwrap().block_on(opened);
        let session = opened.unwrap().unwrap();
        let is_lost = || session.dropped.is_token.load(Ordering::Relaxed);
        let mut fleet = Fleet::default();
        let mut mended = |expected: &[&str]| {
            wait_for("a token that is dropped", is_lost);
            wait_for("all tokens", || {
                session.ask_for_lost_tokens();
                while let Ok(news) = news.try_recv() {
                    fleet.learn(news);
                }
                let there = fleet.robots().filter(|(_, robot)| robot.is_there);
                there.map(|(site, _)| &**site).eq(expected.iter().copied())
            });
        };
        mended(&["goes", "goes/too", "stays"]);
        // There is none for what comes now.
        let (site, what, at) = (String::new(), What::Asked, now());
        let _ = sender.try_send(News::Robot { site, what, at });
        drop((goes, goes_too));
        let comes = token("comes");
        mended(&["comes", "stays"]);
        drop((stays, comes));
    }

    #[test]
    fn an_event_is_taken_only_from_its_own_key() {
        let verdict = br#"{"type":"hardness","phase":"final",
            "sensor":"palm","seq":7,"label":"firm"}"#;
        let (site, incoming) = event("tactile/hall/3/palm/hardness", verdict, false).unwrap();
        assert_eq!(
            (site, &*incoming.sensor, incoming.seq),
            ("hall/3", "palm", Some(7))
        );
        assert!(
            incoming.is_final && !incoming.text.contains('\n'),
            "{incoming:?}"
        );
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
