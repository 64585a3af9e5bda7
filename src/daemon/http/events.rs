//! `/events`: the lines of a subscriber on a socket, as server-sent events.
//!
//! The ID of an event is `RUN:SEQ`. A browser that connects again sends its last ID in
//! `Last-Event-ID`, which is the hub's `since`. Frames are sent only on request, and only the
//! newest of each sensor, because a page shows the present.

use std::collections::BTreeSet;
use std::io;
use std::time::Duration;

use axum::Extension;
use axum::extract::{Request, State};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::stream::{self, Stream, TryStreamExt as _};
use hyper::StatusCode;
use tokio::sync::{OwnedSemaphorePermit, SemaphorePermit, mpsc, oneshot};

use super::{Client, Sources, full, refusal, reserve};
use crate::daemon::hub::{Ahead, Closed, Line};
use crate::daemon::request::{Policy, Since, Subscription, Unusable};
use hardnessd_core::event::Kind;
use hardnessd_core::wording::named;

const LAST_EVENT_ID: &str = "Last-Event-ID";

/// After a silence of this length the server sends a comment. Without it, a lost connection would
/// not be noticed.
const HEARTBEAT: Duration = Duration::from_secs(15);

/// How soon a browser that has lost the connection connects again.
const RETRY: Duration = Duration::from_secs(1);

/// Events that go to the connection together. Events that the connection does not take stay in the
/// hub, whose queue is bounded.
struct Batch {
    events: Vec<Event>,
    /// The share of [`super::MOST_TEXT_BYTES`] of the first batch. It grows with the number of sensors, and the
    /// hub bounds all others.
    bytes: Option<OwnedSemaphorePermit>,
}

impl Batch {
    /// The events. The last one gives the share back.
    fn events(self) -> impl Stream<Item = io::Result<Event>> {
        let Self { events, bytes } = self;
        let events = events.into_iter().inspect(move |_| {
            let _held = &bytes;
        });
        stream::iter(events.map(Ok))
    }
}

/// The reason a subscription is refused.
enum Refused {
    Ahead(Ahead),
    /// The connections keep too many texts waiting.
    Full,
}

/// Answers a request.
pub(super) async fn answer(
    State(sources): State<Sources>,
    Extension(client): Extension<Client>,
    request: Request,
) -> Result<Response, Closed> {
    let wanted = match wanted(&request) {
        Ok(wanted) => wanted,
        Err(unusable) => return Ok(refusal(StatusCode::BAD_REQUEST, unusable)),
    };
    Ok(match open(sources, wanted).await? {
        Ok(batches) => {
            let batches = stream::unfold((batches, client), async |(mut batches, client)| {
                let next = tokio::select! {
                    gone = client.gone() => Err(gone),
                    batch = batches.recv() => Ok(batch?),
                };
                Some((next, (batches, client)))
            });
            let events = batches.map_ok(Batch::events).try_flatten();
            let beat = KeepAlive::new().interval(HEARTBEAT);
            // Without it, nginx and its like hold events back.
            let unbuffered = [("x-accel-buffering", "no")];
            (unbuffered, Sse::new(events).keep_alive(beat)).into_response()
        }
        Err(Refused::Ahead(ahead)) => refusal(StatusCode::BAD_REQUEST, ahead),
        Err(Refused::Full) => full(),
    })
}

/// Reads the subscription that a request asks for: `types` and `since` of its query, and
/// `Last-Event-ID`. If a request has both `since` and `Last-Event-ID`, `Last-Event-ID` is newer and
/// takes precedence.
fn wanted<B>(request: &Request<B>) -> Result<Subscription, Unusable> {
    let mut wanted = Subscription {
        policy: Policy::LatestFrames,
        ..Subscription::default()
    };
    let query = request.uri().query().unwrap_or_default();
    for (key, value) in form_urlencoded::parse(query.as_bytes()) {
        match &*key {
            "types" => wanted.kinds = kinds(&value)?,
            "since" => wanted.since = Some(since("since", &value)?),
            _ => {
                return Err(Unusable::Key {
                    found: format!("{key:?}"),
                    expected: "\"types\" or \"since\"",
                });
            }
        }
    }
    if let Some(last) = request.headers().get(LAST_EVENT_ID) {
        let last = last.to_str().map_err(|_| Unusable::Value {
            key: LAST_EVENT_ID,
            found: "bytes that are not ASCII".to_owned(),
            expected: "\"RUN:SEQ\"",
        })?;
        wanted.since = Some(since(LAST_EVENT_ID, last)?);
    }
    Ok(wanted)
}

fn kinds(names: &str) -> Result<BTreeSet<Kind>, Unusable> {
    let kind = |name: &str| {
        named::<Kind>(name).map_err(|_| Unusable::Value {
            key: "types",
            found: format!("{name:?}"),
            expected: "hardness, press, status or frame",
        })
    };
    names.split(',').map(kind).collect()
}

fn since(key: &'static str, token: &str) -> Result<Since, Unusable> {
    Since::parse(token).ok_or_else(|| Unusable::Value {
        key,
        found: format!("{token:?}"),
        expected: "\"RUN:SEQ\"",
    })
}

/// Subscribes. The inner error is for the client.
///
/// This runs in a separate task. When a browser disconnects, its request is dropped wherever it
/// waits, but a subscriber that has joined the hub must leave it.
async fn open(
    sources: Sources,
    wanted: Subscription,
) -> Result<Result<mpsc::Receiver<Batch>, Refused>, Closed> {
    let (reply, opened) = oneshot::channel();
    tokio::spawn(async move {
        let turn = sources.turns.acquire().await;
        if let Ok((id, hello)) = sources.hub.join().await {
            // The client, the hub and the connection may each end the subscription.
            let _ = serve(&sources, id, hello, wanted, reply, turn.ok()).await;
            sources.hub.leave(id).await;
        }
    });
    opened.await.map_err(|_| Closed)
}

/// Answers the request of a subscriber that has joined, and serves the subscriber until its
/// connection or the hub has ended.
async fn serve(
    Sources {
        hub,
        snapshots,
        text_bytes,
        ..
    }: &Sources,
    id: u64,
    hello: Line,
    wanted: Subscription,
    opened: oneshot::Sender<Result<mpsc::Receiver<Batch>, Refused>>,
    turn: Option<SemaphorePermit<'_>>,
) -> Option<()> {
    let now = snapshots.current().await.ok()?;
    let run = now.survey.hello.run.clone();
    // If the connection breaks before its first event, the browser resumes from here.
    let from = match &wanted.since {
        None => hello.seq,
        Some(since) if since.run == run => None,
        Some(_) => Some(0),
    };
    if let Err(ahead) = hub.subscribe(id, wanted).await.ok()? {
        return opened.send(Err(Refused::Ahead(ahead))).ok();
    }
    drop(turn);
    let first = now.statuses.iter().chain([&hello]);
    let Some(bytes) = reserve(first.map(|line| line.json.len()).sum(), text_bytes) else {
        return opened.send(Err(Refused::Full)).ok();
    };
    let hello = event(&run, &Line { seq: from, ..hello }).retry(RETRY);
    let statuses = now.statuses.iter().map(|line| event(&run, line));
    let mut batch = Batch {
        events: [hello].into_iter().chain(statuses).collect(),
        bytes: Some(bytes),
    };
    // The snapshot may hold long texts, and a connection may be open for days.
    drop(now);
    let (connection, batches) = mpsc::channel(1);
    opened.send(Ok(batches)).ok()?;
    let mut next = hub.take(id).await.ok()?;
    loop {
        connection.send(batch).await.ok()?;
        let lines = tokio::select! {
            lines = &mut next => lines.ok()?,
            () = connection.closed() => return None,
        };
        batch = Batch {
            events: lines.iter().map(|line| event(&run, line)).collect(),
            bytes: None,
        };
        next = hub.take(id).await.ok()?;
    }
}

fn event(run: &str, line: &Line) -> Event {
    let event = match line.seq {
        Some(seq) => Event::default().id(format!("{run}:{seq}")),
        None => Event::default(),
    };
    event.data(line.json.trim_end())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use axum::body::Body;
    use futures_util::StreamExt as _;
    use tokio::net::{TcpListener, TcpStream};
    use tokio::sync::Semaphore;

    use super::*;
    use crate::daemon::hub::{self, tests::hello};
    use crate::daemon::record::EventRecorder;
    use crate::daemon::sensor::Sensors;
    use crate::daemon::snapshot::Snapshots;

    fn ask(uri: &str, last: Option<&[u8]>) -> Result<Subscription, Unusable> {
        let mut request = Request::builder().uri(uri);
        if let Some(last) = last {
            request = request.header("Last-Event-ID", last);
        }
        wanted(&request.body(()).unwrap())
    }

    #[test]
    fn a_query_names_types_and_a_place_and_the_header_is_newer() {
        let plain = ask("/events", None).unwrap();
        assert!(plain.kinds.contains(&Kind::Hardness) && !plain.kinds.contains(&Kind::Frame));
        assert_eq!(plain.policy, Policy::LatestFrames);
        let asked = ask("/events?types=press%2Cframe&since=ab%3A7", None).unwrap();
        assert!(asked.kinds.contains(&Kind::Frame) && !asked.kinds.contains(&Kind::Status));
        assert_eq!(asked.since.unwrap().seq, 7);
        let newer = ask("/events?since=ab:7", Some(b"ab:9")).unwrap();
        assert_eq!(newer.since.unwrap().seq, 9);
    }

    #[test]
    fn a_query_that_cannot_be_meant_is_refused_by_name() {
        for (uri, last, found) in [
            ("/events?types=touch", None, "touch"),
            ("/events?type=press", None, "type"),
            ("/events?since=7", None, "since"),
            ("/events", Some(&b"7"[..]), "Last-Event-ID"),
            (
                "/events",
                Some(b"\xff\xfe"),
                "found bytes that are not ASCII",
            ),
            ("/events?types=%ff", None, "types"),
            // A percent sign that two hex digits do not follow is an ordinary character.
            ("/events?types=%+1", None, "\"% 1\""),
        ] {
            let message = ask(uri, last).unwrap_err().to_string();
            assert!(message.contains(found), "{message}");
        }
    }

    #[tokio::test]
    async fn the_first_events_of_clients_that_never_read_are_bounded() {
        const ROOM: usize = 64 << 10;
        let hub = hub::start(hello(), EventRecorder::default());
        let (_, sensors) = Sensors::new(Vec::new());
        let snapshots = Snapshots::new(hub.clone(), sensors);
        let room = Arc::new(Semaphore::new(ROOM));
        let sources = Sources {
            hub,
            texts: snapshots.clone(),
            snapshots,
            turns: Arc::new(Semaphore::new(1)),
            text_bytes: Arc::clone(&room),
        };
        let listener = TcpListener::bind("localhost:0").await.unwrap();
        let browser = TcpStream::connect(listener.local_addr().unwrap());
        let client = Client::of(&browser.await.unwrap()).unwrap();
        let ask = async || {
            let request = Request::get("/events").body(Body::empty()).unwrap();
            let client = Extension(client.clone());
            answer(State(sources.clone()), client, request)
                .await
                .unwrap()
        };
        let mut asleep = Vec::new();
        let full = loop {
            assert!(asleep.len() < ROOM, "no client is refused");
            match ask().await {
                refused if refused.status() != StatusCode::OK => break refused,
                served => asleep.push(served),
            }
        };
        assert_eq!(full.status(), StatusCode::SERVICE_UNAVAILABLE);
        assert!(!asleep.is_empty());

        // One that leaves makes room, and so does one that reads.
        drop(asleep.pop());
        let mut reading = ask().await.into_body().into_data_stream();
        let hello = reading.next().await.unwrap().unwrap();
        assert!(hello.starts_with(b"id: "), "{hello:?}");
        drop(asleep);
        let waits = tokio::time::timeout(Duration::from_millis(1), reading.next());
        assert!(waits.await.is_err(), "nothing has happened yet");
        assert_eq!(room.available_permits(), ROOM);
    }
}
