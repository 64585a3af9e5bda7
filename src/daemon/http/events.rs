//! `/events`: the lines of a subscriber on a socket, as server-sent events.
//!
//! The ID of an event is `RUN:SEQ`. A browser that connects again sends its last ID in
//! `Last-Event-ID`, which is the hub's `since`. Frames are sent only on request, and only the
//! newest of each sensor, because a page shows the present.

use std::collections::BTreeSet;
use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::{Request, State};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::stream::{self, StreamExt as _};
use hyper::StatusCode;
use tokio::sync::mpsc;

use super::refusal;
use crate::daemon::hub::{Hub, Line};
use crate::daemon::request::{Policy, Since, Subscription, unusable};
use hardnessd_core::event::Kind;
use hardnessd_core::wording::{cut, named};

const LAST_EVENT_ID: &str = "Last-Event-ID";

/// After a silence of this length the server sends a comment. Without it, a lost connection would
/// not be noticed: hyper reads nothing while a further request waits in its buffer.
const HEARTBEAT: Duration = Duration::from_secs(3);

/// How soon a browser that has lost the connection connects again.
const RETRY: Duration = Duration::from_secs(1);

/// Answers a request.
pub(super) async fn answer(State(hub): State<Hub>, request: Request) -> Response {
    let wanted = wanted(&request);
    let subscribed = async { subscribe(&hub, wanted?).await };
    let refused = |why| refusal(StatusCode::BAD_REQUEST, why);
    subscribed.await.unwrap_or_else(refused)
}

/// The events of a subscription. The error is for the subscriber.
async fn subscribe(hub: &Hub, wanted: Subscription) -> Result<Response, String> {
    let since = wanted.since.clone();
    let (subscriber, now) = hub.join(wanted).await?;
    let run = now.hello.run.clone();
    // If the connection breaks before its first event, the browser resumes from here.
    let from = match since {
        None => Some(now.hello.seq),
        Some(since) if since.run == run => None,
        Some(_) => Some(0),
    };
    let mut greeting = now.greeting().into_iter();
    let hello = greeting.next().expect("a greeting begins with hello");
    let hello = event(&run, from, &hello).retry(RETRY);
    // The statuses grow with the number of sensors. All that follows waits in the log.
    let (lines, mut batches) = mpsc::channel(1);
    subscriber.feed(lines);
    let batches = stream::poll_fn(move |context| batches.poll_recv(context));
    let lines = stream::iter(greeting).chain(batches.flat_map(stream::iter));
    let events = lines.map(move |line: Arc<Line>| event(&run, line.seq(), &line));
    let events = stream::iter([hello]).chain(events).map(Ok::<_, Infallible>);
    let beat = KeepAlive::new().interval(HEARTBEAT);
    // Without it, nginx and its like hold events back.
    let unbuffered = [("x-accel-buffering", "no")];
    Ok((unbuffered, Sse::new(events).keep_alive(beat)).into_response())
}

/// Reads the subscription that a request asks for: `types` and `since` of its query, and
/// `Last-Event-ID`. If a request has both `since` and `Last-Event-ID`, `Last-Event-ID` is newer and
/// takes precedence.
fn wanted<B>(request: &Request<B>) -> Result<Subscription, String> {
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
                return Err(format!(
                    "found {:?}, expected \"types\" or \"since\"",
                    cut(&key)
                ));
            }
        }
    }
    if let Some(last) = request.headers().get(LAST_EVENT_ID) {
        let last = last.to_str().map_err(|_| {
            format!("{LAST_EVENT_ID}: found bytes that are not ASCII, expected \"RUN:SEQ\"")
        })?;
        wanted.since = Some(since(LAST_EVENT_ID, last)?);
    }
    Ok(wanted)
}

fn kinds(names: &str) -> Result<BTreeSet<Kind>, String> {
    let kind = |name: &str| {
        let expected = "hardness, press, status or frame";
        named::<Kind>(name).map_err(|_| unusable("types", name, expected))
    };
    names.split(',').map(kind).collect()
}

fn since(key: &str, token: &str) -> Result<Since, String> {
    Since::parse(token).ok_or_else(|| unusable(key, token, "\"RUN:SEQ\""))
}

fn event(run: &str, seq: Option<u64>, line: &Line) -> Event {
    let event = match seq {
        Some(seq) => Event::default().id(format!("{run}:{seq}")),
        None => Event::default(),
    };
    event.data(line.json().trim_end())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ask(uri: &str, last: Option<&[u8]>) -> Result<Subscription, String> {
        let mut request = Request::builder().uri(uri);
        if let Some(last) = last {
            request = request.header("Last-Event-ID", last);
        }
        wanted(&request.body(()).unwrap())
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
            let message = ask(uri, last).unwrap_err();
            assert!(message.contains(found), "{message}");
        }
    }
}
