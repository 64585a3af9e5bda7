//! One subscriber's connection: events out, requests in.
//!
//! This is the protocol of lines, over both Unix sockets and TCP. A task fetches lines from the hub
//! and writes them, and reads requests in between. Only a connection with [`Access::Control`] can
//! change anything. While the daemon carries out a command, events are still sent and the next
//! request waits.

mod pace;

use std::io;
use std::pin::Pin;
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, AsyncWriteExt, Interest};
use tokio::net::{TcpStream, UnixStream, tcp, unix};
use tokio::sync::oneshot;
use tokio::sync::oneshot::error::TryRecvError;
use tracing::debug;

use self::pace::Pace;
use super::accept::Serve;
use super::busy;
use super::hub::{self, Closed, Line};
use super::lane::Lane;
use super::lines::{Heard, Lines};
use super::record::NoBlackbox;
use super::request::motion::{Positions, Told};
use super::request::{self, Change, Request, motion};
use super::sensor::{Command, Sensors};
use hardnessd_core::event::{Reply, Tared};
use hardnessd_core::motion::StepBack;
use hardnessd_core::tare::RetareError;

/// The longest line that a subscriber may send (`docs/controller.md`).
const LONGEST_LINE_BYTES: usize = 64 * 1024;

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

    /// Splits the connection into its two directions.
    fn split(self) -> (Self::Input, Self::Output);

    /// Sends a line if there is room for it, without waiting.
    fn say(self, line: &[u8]) -> io::Result<()>;
}

/// The writing direction.
pub(crate) trait Output: AsyncWrite + Unpin + Send + Sync {
    /// Whether the other end is closed, as far as this end knows.
    fn is_closed(&self) -> impl Future<Output = io::Result<bool>> + Send;
}

impl Stream for UnixStream {
    type Input = unix::OwnedReadHalf;
    type Output = unix::OwnedWriteHalf;

    fn split(self) -> (Self::Input, Self::Output) {
        self.into_split()
    }

    fn say(self, line: &[u8]) -> io::Result<()> {
        // Write directly, because the runtime does not know yet that the stream is writable.
        io::Write::write_all(&mut self.into_std()?, line)
    }
}

impl Stream for TcpStream {
    type Input = tcp::OwnedReadHalf;
    type Output = tcp::OwnedWriteHalf;

    fn split(self) -> (Self::Input, Self::Output) {
        self.into_split()
    }

    fn say(self, line: &[u8]) -> io::Result<()> {
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
    /// The turns of the connections that ask much.
    pub(crate) lane: Lane,
}

impl Service {
    /// Carries out a command.
    async fn change(&self, change: Change) -> Result<Done, Refused> {
        let key = change.key();
        if self.access == Access::ReadOnly {
            return Err(Refused::ReadOnly(key));
        }
        let sensors = &self.sensors;
        let stopping = |_| Refused::Stopping(key);
        match change {
            Change::Tare { sensor } => {
                let (reply, outcome) = oneshot::channel();
                tell(sensors, key, &sensor, Command::Tare(reply)).await?;
                let tared = outcome.await.map_err(stopping)??;
                Ok(Done {
                    tare: Some(tared),
                    ..Done::default()
                })
            }
            Change::Context { sensor, context } => {
                let (reply, held) = oneshot::channel();
                let command = Command::Context(context, reply);
                tell(sensors, "context.sensor", &sensor, command).await?;
                held.await.map_err(stopping)?;
                Ok(Done::default())
            }
            Change::Motion(Positions { sensor, points }) => {
                move_arm(sensors, &sensor, &points).await?;
                Ok(Done::default())
            }
            Change::Blackbox { sensor } => {
                let (reply, written) = oneshot::channel();
                tell(sensors, key, &sensor, Command::Blackbox(reply)).await?;
                let path = written.await.map_err(|_| Refused::Busy)??;
                Ok(Done {
                    blackbox: Some(path.display().to_string()),
                    ..Done::default()
                })
            }
        }
    }
}

impl<S: Stream> Serve<S> for Service {
    fn serve(&self, stream: S) -> impl Future<Output = ()> + Send + 'static {
        let client = Client::new(stream, self.clone());
        async move {
            if let Err(end) = client.serve().await {
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
        let _ = stream.say(Reply::Error { message, id: None }.to_line().as_bytes());
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

/// One connection.
struct Client<S: Stream> {
    input: Lines<S::Input>,
    output: S::Output,
    /// The bytes being written. One call writes a whole batch.
    outgoing: Vec<u8>,
    service: Service,
}

/// The content of the answer to a command.
#[derive(Default)]
struct Done {
    tare: Option<Tared>,
    blackbox: Option<String>,
}

/// A command that is being carried out. Its result is the answer.
type Doing = Pin<Box<dyn Future<Output = Line> + Send>>;

impl<S: Stream> Client<S> {
    fn new(stream: S, service: Service) -> Self {
        let (input, output) = stream.split();
        Self {
            input: Lines::new(input, LONGEST_LINE_BYTES),
            output,
            outgoing: Vec::new(),
            service,
        }
    }

    async fn serve(mut self) -> Result<(), End> {
        let (id, hello) = self.service.hub.join().await?;
        let served = self.converse(id, hello).await;
        self.service.hub.leave(id).await;
        served
    }

    async fn converse(&mut self, id: u64, hello: Line) -> Result<(), End> {
        let hub = self.service.hub.clone();
        let mut lines = vec![hello];
        lines.extend(statuses(&self.service.sensors).await);
        self.send(&lines).await?;
        let mut next = hub.take(id).await?;
        let mut hearing = true;
        let mut doing: Option<Doing> = None;
        let mut pause = HALF_CLOSED_CHECKS.0;
        let mut pace = Pace::new(self.service.lane.clone());
        loop {
            tokio::select! {
                biased;
                lines = &mut next => {
                    let Ok(lines) = lines else {
                        // The hub has closed. Only the answer to a command still has to be sent.
                        if let Some(doing) = doing {
                            self.send(&[doing.await]).await?;
                        }
                        return Ok(());
                    };
                    self.send(&lines).await?;
                    next = hub.take(id).await?;
                }
                answer = done(&mut doing) => {
                    doing = None;
                    self.send(&[answer]).await?;
                }
                heard = hear(&mut self.input, &pace), if hearing && doing.is_none() => match heard? {
                    Heard::Line(line) => {
                        pace.count(line.len());
                        doing = self.heed(id, &line, &mut next).await?;
                        busy::rest();
                    }
                    Heard::TooLong => {
                        let message = format!(
                            "found a line over {LONGEST_LINE_BYTES} bytes, expected a shorter one"
                        );
                        self.send(&[error(message, None)]).await?;
                        return Err(End::TooLong);
                    }
                    // The other end sends no more, but it may still read.
                    Heard::End => {
                        hearing = false;
                        self.stay().await?;
                    }
                },
                () = tokio::time::sleep(pause), if !hearing => {
                    pause = HALF_CLOSED_CHECKS.1.min(2 * pause);
                    self.stay().await?;
                }
            }
        }
    }

    /// Fails if the other end is closed.
    async fn stay(&self) -> Result<(), End> {
        if self.output.is_closed().await? {
            Err(End::HungUp)
        } else {
            Ok(())
        }
    }

    /// Answers a request, or begins to carry out a command. `next` is the pending `take` of the
    /// hub.
    async fn heed(
        &mut self,
        id: u64,
        line: &[u8],
        next: &mut oneshot::Receiver<Vec<Line>>,
    ) -> Result<Option<Doing>, End> {
        let Service { hub, sensors, .. } = self.service.clone();
        let line = request::parse(line);
        let answered = match line.request {
            Ok(Request::Subscribe(subscription)) => {
                let subscribed = hub.subscribe(id, subscription).await?;
                subscribed.map(|()| Vec::new()).map_err(Refused::from)
            }
            Ok(Request::Status) => Ok(statuses(&sensors).await),
            Ok(Request::Last) => Ok(hub.finals().await?),
            Ok(Request::Change(change)) => {
                // A command may take long, because it may wait for frames or for a file to be
                // written.
                let service = self.service.clone();
                return Ok(Some(Box::pin(async move {
                    answer(service.change(change).await, line.id)
                })));
            }
            Err(unusable) => Err(unusable.into()),
        };
        // Lines that the hub gave before it answered are sent before the answer.
        let given = next.try_recv();
        if let Ok(lines) = &given {
            self.send(lines).await?;
        }
        let (mut lines, answered) = match answered {
            Ok(lines) => (lines, Ok(Done::default())),
            Err(refused) => (Vec::new(), Err(refused)),
        };
        lines.push(answer(answered, line.id));
        self.send(&lines).await?;
        // Either the pending `take` gave its lines, or another subscription ended it.
        if given != Err(TryRecvError::Empty) {
            *next = hub.take(id).await?;
        }
        Ok(None)
    }

    async fn send(&mut self, lines: &[Line]) -> Result<(), End> {
        self.outgoing.clear();
        for line in lines {
            self.outgoing.extend_from_slice(line.json.as_bytes());
        }
        Ok(self.output.write_all(&self.outgoing).await?)
    }
}

/// Waits until another line may be read, and reads it.
async fn hear<I: AsyncRead + Unpin>(lines: &mut Lines<I>, pace: &Pace) -> io::Result<Heard> {
    pace.wait().await;
    lines.next().await
}

/// Passes a command on to the sensor called `name`. `key` is the request's key for that name.
async fn tell(
    sensors: &Sensors,
    key: &'static str,
    name: &str,
    command: Command,
) -> Result<(), Refused> {
    let Some(sensor) = sensors.0.iter().find(|sensor| sensor.name == name) else {
        return Err(Refused::NoSensor {
            key,
            found: request::short(name),
            names: sensors.0.iter().map(|s| s.name.clone()).collect(),
        });
    };
    let stopping = |_| Refused::Stopping(key);
    sensor.commands.send(command).await.map_err(stopping)
}

/// Passes positions of the arm on to the task of `sensor`, which also records them. Positions from
/// every source pass through this function.
pub(super) async fn move_arm(
    sensors: &Sensors,
    sensor: &str,
    points: &[Told],
) -> Result<(), Refused> {
    // Read the clocks now, because the sensor's task may have other work to do first.
    let placed = motion::placed(points, crate::daemon::now())?;
    let (reply, taken) = oneshot::channel();
    let command = Command::Motion(placed, reply);
    tell(sensors, "motion.sensor", sensor, command).await?;
    taken.await.map_err(|_| Refused::Stopping("motion"))??;
    Ok(())
}

/// Every sensor's current status.
pub(super) async fn statuses(sensors: &Sensors) -> Vec<Line> {
    let statuses = sensors.statuses().await;
    statuses.into_iter().map(Line::from).collect()
}

/// Waits for the answer to a command. If no command is being carried out, this waits forever.
async fn done(doing: &mut Option<Doing>) -> Line {
    match doing {
        Some(doing) => doing.await,
        None => std::future::pending().await,
    }
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
