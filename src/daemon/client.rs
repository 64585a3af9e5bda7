//! One subscriber's connection: events out, requests in.
//!
//! This is the protocol of lines, over both Unix sockets and TCP. A connection has two tasks. The
//! writer reads the log and writes its lines, with the answers in between. It runs on the sensors'
//! thread, so that real-time scheduling holds from a sensor's bytes to its event in the socket. The
//! reader reads requests, and prepares or carries out what they ask for. Unless the connection may
//! change something, the reader runs on the clients' thread, where requests without end delay no
//! sensor. While the daemon carries out a command, events are still sent and the next request waits.

mod requests;

use std::io::{self, ErrorKind, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixStream as StdStream;
use std::sync::Arc;

use futures_util::StreamExt as _;
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::net::unix::pipe::Receiver;
use tokio::sync::mpsc;
use tokio::task::coop::consume_budget;
use tracing::debug;

pub(super) use self::requests::set_context;
#[cfg(feature = "ros2")]
pub(super) use self::requests::try_move_arm;
use super::accept::Serve;
use super::hub::{Hub, Line, Subscriber};
use super::lines::{LineError, Lines, lines};
use super::realtime;
use super::request::{self, Request, Subscription};
use super::sensor::Sensors;

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
        let line = requests::end(Err(message), None);
        // If the line cannot be sent, the client still sees the connection end.
        let _ = socket_of(stream).and_then(|mut socket| socket.write_all(line.json().as_bytes()));
    }
}

/// What the reader has for the writer.
enum Asked {
    /// A subscription, and the `id` of its request. The writer makes it, because its answer comes
    /// between the lines of the old and of the new one.
    Subscribe(Subscription, Option<serde_json::Value>),
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
                let answer = requests::answer(service, Err(message), None).await;
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
            request => Asked::Answer(requests::answer(service, request, id).await),
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
                let done = subscribed.map(|()| requests::Done::default());
                self.write(&[requests::end(done, id)]).await
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

#[cfg(test)]
mod tests;
