//! `/events`: what a subscriber on a socket reads, as server-sent events.
//!
//! An event's id is `RUN:SEQ`, so that a browser that comes back names in `Last-Event-ID` where it
//! stopped, which is the hub's `since`. Frames come only when asked for, and only the newest: who
//! looks on wants the present.

use std::time::Duration;

use hyper::Request;
use hyper::body::Bytes;
use tokio::sync::{mpsc, oneshot};

use crate::daemon::hub::{self, Ahead, Closed, Line};
use crate::daemon::request::{Kinds, Policy, Since, Subscription, Unusable};
use crate::daemon::sensor::Sensors;
use crate::event::Kind;

pub(super) const CONTENT_TYPE: &str = "text/event-stream";

const LAST_EVENT_ID: &str = "Last-Event-ID";

/// A silence this long is broken by a comment: without it a lost connection would not be noticed.
const HEARTBEAT: Duration = Duration::from_secs(15);

/// How soon a browser that has lost the connection comes back.
const RETRY: Duration = Duration::from_secs(1);

/// Reads what a request asks for: `types` and `since` of its query, and `Last-Event-ID`, which is
/// newer than the query when both are there.
pub(super) fn wanted<B>(request: &Request<B>) -> Result<Subscription, Unusable> {
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

fn kinds(names: &str) -> Result<Kinds, Unusable> {
    let kind = |name: &str| {
        Kind::named(name).ok_or_else(|| Unusable::Value {
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

/// Subscribes; the inner error is for the asker.
///
/// All of it is a task of its own: a request whose browser goes away is dropped wherever it waits,
/// and a subscriber that has joined the hub must leave it.
pub(super) async fn open(
    hub: &hub::Handle,
    sensors: &Sensors,
    wanted: Subscription,
) -> Result<Result<mpsc::Receiver<Bytes>, Ahead>, Closed> {
    let (reply, opened) = oneshot::channel();
    let (hub, sensors) = (hub.clone(), sensors.clone());
    tokio::spawn(async move {
        if let Ok((id, hello)) = hub.join().await {
            // Any end of it is a reason to stop: the asker's, the hub's, or the connection's.
            let _ = serve(&hub, &sensors, id, hello, wanted, reply).await;
            hub.leave(id).await;
        }
    });
    opened.await.map_err(|_| Closed)
}

/// Serves one that has joined, from the answer to its request on.
async fn serve(
    hub: &hub::Handle,
    sensors: &Sensors,
    id: u64,
    hello: Line,
    wanted: Subscription,
    opened: oneshot::Sender<Result<mpsc::Receiver<Bytes>, Ahead>>,
) -> Option<()> {
    let run = hub.survey().await.ok()?.hello.run;
    // Where a connection that breaks before its first event is to go on.
    let from = match &wanted.since {
        None => hello.seq,
        Some(since) if since.run == run => None,
        Some(_) => Some(0),
    };
    if let Err(ahead) = hub.subscribe(id, wanted).await.ok()? {
        return opened.send(Err(ahead)).ok();
    }
    let mut first = format!("retry: {}\n", RETRY.as_millis()).into_bytes();
    write(&mut first, &run, &Line { seq: from, ..hello });
    for status in sensors.statuses().await {
        write(&mut first, &run, &Line::from(status));
    }
    // What the connection does not take stays in the hub, whose queue is bounded.
    let (sender, events) = mpsc::channel(1);
    opened.send(Ok(events)).ok()?;
    pass_on(hub, id, &run, first, &sender).await
}

/// Hands events to the connection until it is gone or the hub has ended.
async fn pass_on(
    hub: &hub::Handle,
    id: u64,
    run: &str,
    first: Vec<u8>,
    connection: &mpsc::Sender<Bytes>,
) -> Option<()> {
    connection.send(first.into()).await.ok()?;
    let mut next = hub.take(id).await.ok()?;
    loop {
        let mut chunk = Vec::new();
        tokio::select! {
            lines = &mut next => {
                for line in lines.ok()? {
                    write(&mut chunk, run, &line);
                }
                next = hub.take(id).await.ok()?;
            }
            () = connection.closed() => return None,
            () = tokio::time::sleep(HEARTBEAT) => chunk.extend_from_slice(b":\n\n"),
        }
        connection.send(chunk.into()).await.ok()?;
    }
}

/// One event, in the format of the HTML standard, section 9.2.6.
fn write(out: &mut Vec<u8>, run: &str, line: &Line) {
    if let Some(seq) = line.seq {
        out.extend_from_slice(format!("id: {run}:{seq}\n").as_bytes());
    }
    out.extend_from_slice(b"data: ");
    // It ends with its newline; another ends the event.
    out.extend_from_slice(line.json.as_bytes());
    out.push(b'\n');
}

#[cfg(test)]
mod tests {
    use super::*;

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
        assert!(plain.kinds.contains(Kind::Hardness) && !plain.kinds.contains(Kind::Frame));
        assert_eq!(plain.policy, Policy::LatestFrames);
        let asked = ask("/events?types=press%2Cframe&since=ab%3A7", None).unwrap();
        assert!(asked.kinds.contains(Kind::Frame) && !asked.kinds.contains(Kind::Status));
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
            // A percent sign before anything but two hex digits stands for itself.
            ("/events?types=%+1", None, "\"% 1\""),
        ] {
            let message = ask(uri, last).unwrap_err().to_string();
            assert!(message.contains(found), "{message}");
        }
    }
}
