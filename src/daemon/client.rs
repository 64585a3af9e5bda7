//! One subscriber's connection: events out, requests in.
//!
//! This is the protocol of lines, over both Unix sockets and TCP. A connection has two tasks. The
//! reader reads requests, and prepares or carries out what they ask for. The writer fetches lines
//! from the hub and writes them, with the answers in between. While the daemon carries out a
//! command, events are still sent and the next request waits. Only a connection with
//! [`Access::Control`] can change anything.
//!
//! The writer runs on the sensors' thread, so that real-time scheduling holds from a sensor's bytes
//! to its event in the socket. The reader of a connection that can change nothing runs on the
//! clients' thread, where requests without end delay no sensor.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, AsyncWriteExt, Interest};
use tokio::net::{TcpStream, UnixStream, tcp, unix};
use tokio::runtime::Handle;
use tokio::sync::oneshot::error::TryRecvError;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, oneshot};
use tracing::debug;

use super::accept::Serve;
use super::busy;
use super::hub::{self, Closed, Line};
use super::lines::{LineRead, Lines};
use super::record::NoBlackbox;
use super::request::motion::{Positions, ReportedPoint};
use super::request::{self, Context, Query, Request, Subscription, motion};
use super::sensor::{Command, SensorHandle, Sensors};
use super::snapshot::Snapshots;
use hardnessd_core::event::{Reply, Tared};
use hardnessd_core::motion::StepBack;
use hardnessd_core::tare::RetareError;

/// The longest line that a subscriber may send (`docs/protocol.md`).
const LONGEST_LINE_BYTES: usize = 64 * 1024;

/// The largest buffer that a connection keeps between two writes. A batch of the hub fits.
const KEPT_BYTES: usize = 64 * 1024;

/// The first and the longest pause between checks of a connection whose other end has stopped
/// sending. If that end is closed altogether, the runtime learns of it a moment after the last
/// read.
const HALF_CLOSED_CHECKS: (Duration, Duration) = (Duration::from_millis(1), Duration::from_secs(1));

/// The requests that a connection may send.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Access {
    /// Only subscriptions and queries.
    ReadOnly,
    /// Also commands that change something.
    Control,
}

/// A connection that carries lines.
pub(crate) trait Stream: Send + 'static {
    /// The reading direction.
    type Input: AsyncRead + Unpin + Send + Sync;
    /// The writing direction.
    type Output: Output;

    /// Splits the connection into its two directions. `runtime` learns when either is ready.
    fn split(self, runtime: &Handle) -> io::Result<(Self::Input, Self::Output)>;

    /// Sends a line if there is room for it, without waiting.
    fn write_line(self, line: &[u8]) -> io::Result<()>;
}

/// The writing direction.
pub(crate) trait Output: AsyncWrite + Unpin + Send + Sync {
    /// Whether the other end is closed, as far as this end knows.
    fn is_closed(&self) -> impl Future<Output = io::Result<bool>> + Send;
}

impl Stream for UnixStream {
    type Input = unix::OwnedReadHalf;
    type Output = unix::OwnedWriteHalf;

    fn split(self, runtime: &Handle) -> io::Result<(Self::Input, Self::Output)> {
        let stream = self.into_std()?;
        let _inside = runtime.enter();
        Ok(UnixStream::from_std(stream)?.into_split())
    }

    fn write_line(self, line: &[u8]) -> io::Result<()> {
        // Write directly, because the runtime does not know yet that the stream is writable.
        io::Write::write_all(&mut self.into_std()?, line)
    }
}

impl Stream for TcpStream {
    type Input = tcp::OwnedReadHalf;
    type Output = tcp::OwnedWriteHalf;

    fn split(self, runtime: &Handle) -> io::Result<(Self::Input, Self::Output)> {
        let stream = self.into_std()?;
        let _inside = runtime.enter();
        Ok(TcpStream::from_std(stream)?.into_split())
    }

    fn write_line(self, line: &[u8]) -> io::Result<()> {
        io::Write::write_all(&mut self.into_std()?, line)
    }
}

impl Output for unix::OwnedWriteHalf {
    async fn is_closed(&self) -> io::Result<bool> {
        Ok(self.ready(Interest::WRITABLE).await?.is_write_closed())
    }
}

impl Output for tcp::OwnedWriteHalf {
    async fn is_closed(&self) -> io::Result<bool> {
        Ok(self.ready(Interest::WRITABLE).await?.is_write_closed())
    }
}

/// Everything that serves the connections of one listener.
#[derive(Debug, Clone)]
pub(crate) struct Service {
    pub(crate) access: Access,
    pub(crate) max_clients: usize,
    pub(crate) hub: hub::Handle,
    pub(crate) sensors: Sensors,
    pub(crate) snapshots: Snapshots,
    /// The turns of the connections that can change nothing.
    pub(crate) turns: Arc<Semaphore>,
    /// The runtime of the writers.
    pub(crate) writers: Handle,
}

impl Service {
    /// Waits for a turn to ask the sensors' thread for something. Only the daemon's own user can
    /// connect to the control socket, and its robot must not wait.
    async fn turn(&self) -> Option<OwnedSemaphorePermit> {
        match self.access {
            Access::ReadOnly => Arc::clone(&self.turns).acquire_owned().await.ok(),
            Access::Control => None,
        }
    }

    /// The lines that a query gets, and how it ended.
    async fn get(&self, query: Query) -> Result<(Vec<Line>, Result<Done, Refused>), End> {
        Ok(match query {
            Query::Status => {
                let statuses = self.snapshots.current().await?.statuses.clone();
                (statuses, Ok(Done::default()))
            }
            Query::Last => {
                let finals = self.hub.survey().await?.finals;
                (finals.into_values().collect(), Ok(Done::default()))
            }
            Query::History(sensor) => {
                let history = self.hub.history(sensor.clone()).await?;
                let lines = history.iter().map(|history| history.line(&sensor));
                let found = find(&self.sensors, "history", &sensor);
                (lines.collect(), found.map(|_| Done::default()))
            }
        })
    }

    /// Carries out a request that changes something. Of all sockets, only the control socket may.
    async fn change(&self, request: Request) -> Result<Done, Refused> {
        let key = request.key();
        if self.access == Access::ReadOnly {
            return Err(Refused::ReadOnly(key));
        }
        let sensors = &self.sensors;
        let stopping = |_| Refused::Stopping(key);
        match request {
            Request::Tare(sensor) => {
                let (reply, outcome) = oneshot::channel();
                pass_on(sensors, key, &sensor, Command::Tare(reply)).await?;
                let tared = outcome.await.map_err(stopping)??;
                Ok(Done {
                    tare: Some(tared),
                    ..Done::default()
                })
            }
            Request::Context(Context { sensor, context }) => {
                let (reply, held) = oneshot::channel();
                let command = Command::Context(context, reply);
                pass_on(sensors, "context.sensor", &sensor, command).await?;
                held.await.map_err(stopping)?;
                Ok(Done::default())
            }
            Request::Motion(Positions { sensor, points }) => {
                move_arm(sensors, &sensor, &points).await?;
                Ok(Done::default())
            }
            Request::Blackbox(sensor) => {
                let (reply, written) = oneshot::channel();
                pass_on(sensors, key, &sensor, Command::Blackbox(reply)).await?;
                let path = written.await.map_err(|_| Refused::Busy)??;
                Ok(Done {
                    blackbox: Some(path.display().to_string()),
                    ..Done::default()
                })
            }
            // They change nothing.
            Request::Subscribe(_) | Request::Get(_) => Ok(Done::default()),
        }
    }
}

impl<S: Stream> Serve<S> for Service {
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
        // If the line cannot be sent, the client still sees the connection end.
        let _ = stream.write_line(Reply::Error { message, id: None }.to_line().as_bytes());
    }
}

/// The reason a request is answered with an `error`.
#[derive(Debug, thiserror::Error)]
pub(super) enum Refused {
    #[error(transparent)]
    Unusable(#[from] request::Unusable),
    #[error(transparent)]
    Ahead(#[from] hub::Ahead),
    #[error("{0}: this socket changes nothing: send it to the control socket")]
    ReadOnly(&'static str),
    #[error("{key}: found {found}, expected one of {}", names.join(", "))]
    NoSensor {
        key: &'static str,
        found: String,
        names: Vec<String>,
    },
    #[error("tare: {0}")]
    Tare(#[from] RetareError),
    #[error("{0}")]
    Motion(#[from] motion::Unusable),
    #[error("motion.at[{}]: {source}", .source.index)]
    StepBack {
        #[from]
        source: StepBack,
    },
    #[error("blackbox: {0}")]
    Blackbox(#[from] NoBlackbox),
    #[error("blackbox: the recorder has no time for it")]
    Busy,
    #[error("{0}: the daemon is stopping")]
    Stopping(&'static str),
}

/// The reason a connection ended.
#[derive(Debug, thiserror::Error)]
enum End {
    #[error(transparent)]
    Closed(#[from] Closed),
    #[error("{0}")]
    Io(#[from] io::Error),
    #[error("hung up")]
    HungUp,
    #[error("a line over {LONGEST_LINE_BYTES} bytes")]
    TooLong,
}

/// The content of the answer to a command.
#[derive(Default)]
struct Done {
    tare: Option<Tared>,
    blackbox: Option<String>,
}

/// What the reader has for the writer.
enum Asked {
    /// A subscription, and the `id` of its request. The writer makes it, because its answer comes
    /// between the lines of the old and of the new one.
    Subscribe(Subscription, Option<serde_json::Value>),
    /// The lines of an answer.
    Answer(Vec<Line>),
    /// The other end sent a line that is too long.
    TooLong,
}

/// Serves a connection until it ends.
async fn serve<S: Stream>(stream: S, service: Service) -> Result<(), End> {
    let turn = service.turn().await;
    // A writer that waits for room in the socket must not wait for the clients' thread too.
    let (input, output) = stream.split(&service.writers)?;
    let (id, hello) = service.hub.join().await?;
    let mut lines = vec![hello];
    lines.extend(service.snapshots.current().await?.statuses.clone());
    drop(turn);
    let (asked, inbox) = mpsc::channel(1);
    let mut writer = Writer {
        id,
        service: service.clone(),
        output,
        outgoing: Vec::new(),
        inbox,
    };
    let written = service.writers.spawn(async move {
        let written = writer.write(lines).await;
        writer.service.hub.leave(id).await;
        written
    });
    let lines = Lines::new(input, LONGEST_LINE_BYTES);
    let read = read(lines, asked, &service).await;
    // The writer ends soon after the reader, unless the other end only stopped sending.
    let written = written.await.map_err(io::Error::other)?;
    written.and(read)
}

/// Reads requests until the writer has ended or the other end sends no more.
async fn read<I: AsyncRead + Unpin>(
    mut lines: Lines<I>,
    asked: mpsc::Sender<Asked>,
    service: &Service,
) -> Result<(), End> {
    loop {
        // The place is taken before the request is read: the writer waits for its answer, even
        // when the hub has closed.
        let Ok(place) = asked.reserve().await else {
            return Ok(());
        };
        let line = tokio::select! {
            line = lines.next() => match line? {
                LineRead::Line(line) => line,
                LineRead::TooLong => {
                    place.send(Asked::TooLong);
                    return Ok(());
                }
                LineRead::End => return Ok(()),
            },
            () = asked.closed() => return Ok(()),
        };
        // The turn ends before the writer has the answer: a client that reads nothing keeps its
        // writer waiting for as long as it likes.
        let _turn = service.turn().await;
        let line = request::parse(&line);
        let id = line.id;
        let request = match line.request {
            Ok(Request::Subscribe(subscription)) => Asked::Subscribe(subscription, id),
            Ok(Request::Get(query)) => {
                let (mut lines, done) = service.get(query).await?;
                lines.push(answer(done, id));
                Asked::Answer(lines)
            }
            // A command may take long, because it may wait for frames or for a file to be written.
            Ok(request) => Asked::Answer(vec![answer(service.change(request).await, id)]),
            Err(unusable) => Asked::Answer(vec![answer(Err(unusable.into()), id)]),
        };
        place.send(request);
    }
}

/// The writing half of a connection.
struct Writer<O> {
    /// The number of the subscriber.
    id: u64,
    service: Service,
    output: O,
    /// The bytes being written. One call writes a whole batch.
    outgoing: Vec<u8>,
    inbox: mpsc::Receiver<Asked>,
}

impl<O: Output> Writer<O> {
    /// Writes `lines`, then what the hub and the reader have, until the hub has closed or the other
    /// end is gone.
    async fn write(&mut self, lines: Vec<Line>) -> Result<(), End> {
        self.send(lines).await?;
        let mut next = self.service.hub.take(self.id).await?;
        let mut reading = true;
        let mut pause = HALF_CLOSED_CHECKS.0;
        loop {
            tokio::select! {
                biased;
                lines = &mut next => {
                    let Ok(lines) = lines else {
                        return self.finish().await;
                    };
                    self.send(lines).await?;
                    next = self.service.hub.take(self.id).await?;
                }
                asked = self.inbox.recv(), if reading => match asked {
                    Some(asked) => {
                        self.answer(asked, &mut next).await?;
                        busy::rest();
                    }
                    // The other end sends no more, but it may still read.
                    None => {
                        reading = false;
                        self.stay().await?;
                    }
                },
                () = tokio::time::sleep(pause), if !reading => {
                    pause = HALF_CLOSED_CHECKS.1.min(2 * pause);
                    self.stay().await?;
                }
            }
        }
    }

    /// The hub has closed. Only the answer to a command that is being carried out is still sent.
    async fn finish(&mut self) -> Result<(), End> {
        self.inbox.close();
        while let Some(asked) = self.inbox.recv().await {
            if let Asked::Answer(lines) = asked {
                self.send(lines).await?;
            }
        }
        Ok(())
    }

    /// Fails if the other end is closed.
    async fn stay(&self) -> Result<(), End> {
        if self.output.is_closed().await? {
            Err(End::HungUp)
        } else {
            Ok(())
        }
    }

    /// Answers a request. `next` is the pending `take` of the hub.
    async fn answer(
        &mut self,
        asked: Asked,
        next: &mut oneshot::Receiver<Vec<Line>>,
    ) -> Result<(), End> {
        let answer = match asked {
            Asked::Subscribe(subscription, id) => {
                let turn = self.service.turn().await;
                let subscribed = self.service.hub.subscribe(self.id, subscription).await?;
                drop(turn);
                let done = subscribed.map(|()| Done::default());
                vec![answer(done.map_err(Refused::from), id)]
            }
            Asked::Answer(lines) => lines,
            Asked::TooLong => {
                let message =
                    format!("found a line over {LONGEST_LINE_BYTES} bytes, expected a shorter one");
                self.send(vec![error(message, None)]).await?;
                return Err(End::TooLong);
            }
        };
        // Lines that the hub gave before it answered are sent before the answer.
        let given = next.try_recv();
        let is_pending = given == Err(TryRecvError::Empty);
        if let Ok(lines) = given {
            self.send(lines).await?;
        }
        self.send(answer).await?;
        // Either the pending `take` gave its lines, or another subscription ended it.
        if !is_pending {
            *next = self.service.hub.take(self.id).await?;
        }
        Ok(())
    }

    async fn send(&mut self, lines: Vec<Line>) -> Result<(), End> {
        for line in lines {
            self.outgoing.extend_from_slice(line.json.as_bytes());
        }
        self.output.write_all(&self.outgoing).await?;
        self.outgoing.clear();
        self.outgoing.shrink_to(KEPT_BYTES);
        Ok(())
    }
}

/// Passes a command on to the sensor called `name`. `key` is the request's key for that name.
async fn pass_on(
    sensors: &Sensors,
    key: &'static str,
    name: &str,
    command: Command,
) -> Result<(), Refused> {
    let sensor = find(sensors, key, name)?;
    let stopping = |_| Refused::Stopping(key);
    sensor.commands.send(command).await.map_err(stopping)
}

fn find(sensors: &Sensors, key: &'static str, name: &str) -> Result<SensorHandle, Refused> {
    let sensors = sensors.current();
    let found = sensors.iter().find(|sensor| sensor.name == name).cloned();
    found.ok_or_else(|| Refused::NoSensor {
        key,
        found: request::short(name),
        names: sensors.iter().map(|s| s.name.clone()).collect(),
    })
}

/// Passes positions of the arm on to the task of `sensor`, which also records them. Positions from
/// every source pass through this function.
pub(super) async fn move_arm(
    sensors: &Sensors,
    sensor: &str,
    points: &[ReportedPoint],
) -> Result<(), Refused> {
    // Read the clocks now, because the sensor's task may have other work to do first.
    let placed = motion::placed(points, crate::daemon::now())?;
    let (reply, taken) = oneshot::channel();
    let command = Command::Motion(placed, reply);
    pass_on(sensors, "motion.sensor", sensor, command).await?;
    taken.await.map_err(|_| Refused::Stopping("motion"))??;
    Ok(())
}

fn answer(answered: Result<Done, Refused>, id: Option<serde_json::Value>) -> Line {
    match answered {
        Ok(Done { tare, blackbox }) => Reply::Ok { id, tare, blackbox }.into(),
        Err(refused) => error(refused.to_string(), id),
    }
}

fn error(message: String, id: Option<serde_json::Value>) -> Line {
    Reply::Error { message, id }.into()
}

#[cfg(test)]
mod tests;
