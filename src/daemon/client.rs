//! One subscriber's connection: events out, requests in.
//!
//! This is the protocol of lines, over both Unix sockets and TCP. A connection has two tasks. The
//! writer reads the log and writes its lines, with the answers in between. It runs on the sensors'
//! thread, so that real-time scheduling holds from a sensor's bytes to its event in the socket. The
//! reader reads requests, and prepares or carries out what they ask for. Unless the connection may
//! change something, the reader runs on the clients' thread, where requests without end delay no
//! sensor. While the daemon carries out a command, events are still sent and the next request waits.

use std::io::{self, ErrorKind, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixStream as StdStream;
use std::sync::Arc;

use futures_util::StreamExt as _;
use serde_json::Value;
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::net::unix::pipe::Receiver;
use tokio::sync::{mpsc, oneshot};
use tokio::task::coop::consume_budget;
use tracing::debug;

use super::accept::Serve;
use super::hub::{Hub, Line, Subscriber};
use super::lines::{LineError, Lines, lines};
use super::request::motion::{self, Positions};
use super::request::{self, Context, Merge, Query, Request, Subscription};
use super::sensor::{Answer, Command, Done, Sensors};
use super::{now, realtime};
use hardnessd_core::event::Reply;
use hardnessd_core::pipeline::Input;

/// The longest line that a subscriber may send (`docs/protocol.md`).
const LONGEST_LINE_BYTES: usize = 64 * 1024;

/// The socket of a connection, which no runtime watches. Bytes go in and out of every kind of stream
/// socket in the same way, so from here on each is served as a Unix socket.
fn socket_of(stream: impl AsFd) -> io::Result<StdStream> {
    Ok(stream.as_fd().try_clone_to_owned()?.into())
}

/// Everything that serves the connections of one listener.
#[derive(Debug, Clone)]
pub(crate) struct Service {
    pub(crate) max_clients: usize,
    pub(crate) hub: Hub,
    /// The sensors that a connection may change. Without them, it has only subscriptions and queries.
    pub(crate) control: Option<Sensors>,
}

impl<S: AsFd + Send + 'static> Serve<S> for Service {
    fn serve(&self, stream: S) -> impl Future<Output = ()> + Send + 'static {
        let service = self.clone();
        async move {
            if let Err(end) = serve(stream, service).await {
                debug!(%end, "subscriber gone");
            }
        }
    }

    fn refuse(&self, stream: S) {
        let found = self.max_clients;
        let message = format!(
            "too many subscribers ({found}): try later, or raise max_clients in the configuration"
        );
        let line = end(Err(message), None);
        // If the line cannot be sent, the client still sees the connection end.
        let _ = socket_of(stream).and_then(|mut socket| socket.write_all(line.json().as_bytes()));
    }
}

/// What the reader has for the writer.
enum Asked {
    /// A subscription, and the `id` of its request. The writer makes it, because its answer comes
    /// between the lines of the old and of the new one.
    Subscribe(Subscription, Option<Value>),
    /// The lines of an answer.
    Answer(Vec<Arc<Line>>),
}

/// Serves a connection until it ends.
async fn serve(stream: impl AsFd, service: Service) -> io::Result<()> {
    let output = socket_of(stream)?;
    // The socket is read like a pipe. So the runtime watches it for one direction alone: else each read of the
    // client would wake the clients' thread.
    let input = Receiver::from_owned_fd_unchecked(output.try_clone()?.into())?;
    let joined = service.hub.join(Subscription::default()).await;
    let (subscriber, now) = joined.expect("only a `since` can be refused");
    let (asked, inbox) = mpsc::channel(1);
    let writer = Writer {
        subscriber,
        output,
        inbox,
    };
    let written = service.hub.thread.spawn(writer.run(now.greeting()));
    let read = read(lines(input, LONGEST_LINE_BYTES), asked, &service).await;
    // The writer ends soon after the reader.
    let written = written.await.map_err(io::Error::other)?;
    written.and(read)
}

/// Reads requests until the writer has ended, or the other end sends no more.
async fn read(
    mut lines: Lines<Receiver>,
    asked: mpsc::Sender<Asked>,
    service: &Service,
) -> io::Result<()> {
    loop {
        // The place is taken before the request is read: the writer waits for its answer, even
        // when the log is closed.
        let Ok(place) = asked.reserve().await else {
            return Ok(());
        };
        let line = tokio::select! {
            line = lines.next() => line,
            () = asked.closed() => return Ok(()),
        };
        let line = match line {
            Some(Ok(line)) => line,
            Some(Err(LineError::Io(error))) => return Err(error),
            Some(Err(LineError::MaxChunkLengthExceeded)) => {
                let message =
                    format!("found a line over {LONGEST_LINE_BYTES} bytes, expected a shorter one");
                let answer = answer(service, Err(message), None).await;
                place.send(Asked::Answer(answer));
                return Ok(());
            }
            // The writer ends when it has sent the answers so far.
            None => return Ok(()),
        };
        let (id, request) = request::parse(&line);
        place.send(match request {
            Ok(Request::Subscribe(subscription)) => Asked::Subscribe(subscription, id),
            // A command may take long, because it may wait for frames or for a file to be written.
            request => Asked::Answer(answer(service, request, id).await),
        });
    }
}

/// The socket, which the runtime watches until it can be written to.
#[expect(
    deprecated,
    reason = "the replacement is unsafe, because it trusts that the socket stays open: this one does"
)]
fn watched(socket: &StdStream) -> io::Result<AsyncFd<BorrowedFd<'_>>> {
    AsyncFd::with_interest(socket.as_fd(), Interest::WRITABLE)
}

/// The writing half of a connection.
struct Writer {
    subscriber: Subscriber,
    output: StdStream,
    inbox: mpsc::Receiver<Asked>,
}

impl Writer {
    /// Writes `lines`, then what the log and the reader have, until the log is closed or the reader
    /// has ended.
    async fn run(mut self, lines: Vec<Arc<Line>>) -> io::Result<()> {
        self.write(&lines).await?;
        loop {
            tokio::select! {
                lines = self.subscriber.next() => match lines {
                    Some(lines) => self.write(&lines).await?,
                    None => break,
                },
                asked = self.inbox.recv() => match asked {
                    Some(asked) => {
                        self.answer(asked).await?;
                        realtime::rest();
                    }
                    None => return Ok(()),
                }
            }
        }
        // The log is closed. Only the answer to a command that is being carried out is still sent.
        self.inbox.close();
        while let Some(asked) = self.inbox.recv().await {
            self.answer(asked).await?;
        }
        Ok(())
    }

    async fn answer(&mut self, asked: Asked) -> io::Result<()> {
        match asked {
            Asked::Answer(lines) => self.write(&lines).await,
            Asked::Subscribe(subscription, id) => {
                let subscribed = self.subscriber.subscribe(&subscription);
                let done = subscribed.map(|()| Done::default());
                self.write(&[end(done, id)]).await
            }
        }
    }

    async fn write(&mut self, lines: &[Arc<Line>]) -> io::Result<()> {
        // One call writes a whole batch.
        let batch: String = lines.iter().map(|line| line.json()).collect();
        let mut rest = batch.as_bytes();
        while !rest.is_empty() {
            match self.output.write(rest) {
                Ok(written) => rest = &rest[written..],
                Err(error) if error.kind() == ErrorKind::WouldBlock => {
                    // The runtime watches the socket only now. If it always did, each read of the
                    // client would wake this thread.
                    let waiting = watched(&self.output)?;
                    let _writable = waiting.writable().await?;
                }
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        // A client that reads as fast as this thread writes must not keep it from others.
        consume_budget().await;
        Ok(())
    }
}

/// The answer to a query or a command.
async fn answer(
    service: &Service,
    request: Result<Request, String>,
    id: Option<Value>,
) -> Vec<Arc<Line>> {
    let mut lines = Vec::new();
    let done = match request {
        Ok(Request::Get(query)) => {
            let now = service.hub.snapshot().await;
            match query {
                Query::Status => lines.extend(now.statuses()),
                Query::Last => lines.extend(now.sensors.into_iter().filter_map(|one| one.last)),
            }
            Ok(Done::default())
        }
        Ok(request) => change(service.control.as_ref(), request).await,
        Err(unusable) => Err(unusable),
    };
    lines.push(end(done, id));
    lines
}

/// The last line of an answer.
fn end(done: Result<Done, String>, id: Option<Value>) -> Arc<Line> {
    Line::reply(&match done {
        Ok(Done { tare, blackbox }) => Reply::Ok {
            id,
            tare,
            blackbox: blackbox.map(|path| path.display().to_string()),
        },
        Err(message) => Reply::Error { message, id },
    })
}

/// Carries out a request that changes something. Of all sockets, only the control socket may.
pub(super) async fn change(sensors: Option<&Sensors>, request: Request) -> Result<Done, String> {
    let Some(sensors) = sensors else {
        return Err("this socket changes nothing: send it to the control socket".to_owned());
    };
    match request {
        Request::Tare(sensor) => ask(sensors, "tare", &sensor, Command::Tare).await,
        Request::Context(Context { sensor, context }) => {
            let command = |reply| Command::Take(Input::Context(context), reply);
            ask(sensors, "context.sensor", &sensor, command).await
        }
        Request::Merge(Merge { sensor, keys }) => {
            let command = |reply| Command::Merge(keys, reply);
            ask(sensors, "merge.sensor", &sensor, command).await
        }
        Request::Motion(Positions { sensor, points }) => {
            // Read the clocks now, because the sensor's task may have other work to do first.
            let input = Input::Motion(motion::placed(&points, now())?);
            let command = |reply| Command::Take(input, reply);
            ask(sensors, "motion.sensor", &sensor, command).await
        }
        Request::Blackbox(sensor) => ask(sensors, "blackbox", &sensor, Command::Blackbox).await,
        // They change nothing.
        Request::Subscribe(_) | Request::Get(_) => Ok(Done::default()),
    }
}

/// Passes a command on to the sensor called `name`, and waits for the answer. `key` is the request's
/// key for that name.
async fn ask(
    sensors: &Sensors,
    key: &str,
    name: &str,
    command: impl FnOnce(Answer) -> Command,
) -> Result<Done, String> {
    let sensor = sensors.iter().find(|sensor| sensor.name == name);
    let sensor = sensor.ok_or_else(|| {
        let names: Vec<&str> = sensors.iter().map(|sensor| sensor.name.as_str()).collect();
        request::unusable(key, name, &format!("one of {}", names.join(", ")))
    })?;
    let (reply, answer) = oneshot::channel();
    // An answer that does not come is dropped by a sensor's task that ends, or by a recorder whose
    // queue is full.
    let _ = sensor.commands.send(command(reply)).await;
    let none = |_| {
        Err(format!(
            "{key}: the daemon is stopping, or has no time for it"
        ))
    };
    answer.await.unwrap_or_else(none)
}

#[cfg(test)]
mod tests;
