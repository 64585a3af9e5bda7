//! Clients: the events that they read, and how long after sending they read them.

use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpStream, UnixStream};
use tokio::task::JoinSet;

use crate::sensors::{Sent, now_ns};
use crate::{Args, Kind, PATIENCE, What};

/// The record of all clients.
#[derive(Default)]
pub(crate) struct Received {
    /// The number of clients that are connected and have an answer.
    ready: AtomicUsize,
    /// Events sent from this moment on are measured. 0: nothing is measured yet.
    since_ns: AtomicU64,
    /// The delay of each event in microseconds.
    late: Mutex<Vec<f32>>,
}

impl Received {
    pub(crate) fn ready(&self) -> usize {
        self.ready.load(Relaxed)
    }

    /// Measures the events that are sent from now on.
    pub(crate) fn begin(&self) {
        self.since_ns.store(now_ns(), Relaxed);
    }

    fn add(&self, sent_ns: u64, now_ns: u64) {
        let since_ns = self.since_ns.load(Relaxed);
        if since_ns > 0 && sent_ns >= since_ns {
            let mut late = self.late.lock().unwrap_or_else(PoisonError::into_inner);
            late.push(now_ns.saturating_sub(sent_ns) as f32 / 1e3);
        }
    }

    /// The number of events, of lost ones, and quantiles of their delay.
    pub(crate) fn figures(&self, args: &Args, sent: &Sent) -> String {
        let mut late = self.late.lock().unwrap_or_else(PoisonError::into_inner);
        late.sort_by(f32::total_cmp);
        let of = |share: f64| {
            let place = (share * late.len() as f64) as usize;
            late.get(place.min(late.len().saturating_sub(1))).copied()
        };
        let [p50, p99, p999, most] =
            [0.5, 0.99, 0.999, 1.0].map(|share| of(share).unwrap_or(f32::NAN));
        let expected = sent.count(args.event, self.since_ns.load(Relaxed)) * args.clients;
        let (events, lost) = (late.len(), expected as i64 - late.len() as i64);
        format!(
            "{events} events, {lost} lost; us p50 {p50:.0} p99 {p99:.0} p99.9 {p999:.0} max {most:.0}"
        )
    }
}

/// Reads until the server ends. Returns the problem, if there was one.
#[tokio::main(flavor = "current_thread")]
pub(crate) async fn listen(
    args: &Args,
    place: &Result<u16, PathBuf>,
    sent: &Arc<Sent>,
    received: &Arc<Received>,
) -> Option<String> {
    let mut clients = JoinSet::new();
    for _ in 0..args.clients {
        let (args, place) = (args.clone(), place.clone());
        let (sent, received) = (Arc::clone(sent), Arc::clone(received));
        clients.spawn(async move {
            let stream = connect(&place).await?;
            client(&args, stream, &sent, &received).await
        });
    }
    let ends = clients.join_all().await;
    let problems = ends.into_iter().filter_map(Result::err);
    let mut problems = problems.filter(|end| end.kind() != io::ErrorKind::ConnectionReset);
    problems.next().map(|problem| problem.to_string())
}

trait Duplex: AsyncRead + AsyncWrite + Send + Unpin {}
impl<S: AsyncRead + AsyncWrite + Send + Unpin> Duplex for S {}

/// Connects as soon as the server listens.
async fn connect(place: &Result<u16, PathBuf>) -> io::Result<Box<dyn Duplex>> {
    let start = Instant::now();
    loop {
        let stream: io::Result<Box<dyn Duplex>> = match place {
            Ok(port) => TcpStream::connect(("127.0.0.1", *port))
                .await
                .map(|stream| Box::new(stream) as _),
            Err(path) => UnixStream::connect(path)
                .await
                .map(|stream| Box::new(stream) as _),
        };
        if stream.is_ok() || start.elapsed() > PATIENCE {
            return stream;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

async fn client(
    args: &Args,
    mut stream: Box<dyn Duplex>,
    sent: &Sent,
    received: &Received,
) -> io::Result<()> {
    let request: &[u8] = match (args.server, args.event) {
        (Kind::Gpsd, _) => b"?WATCH={\"enable\":true,\"json\":true};\n",
        (Kind::Hardnessd, What::Frame) => b"{\"subscribe\":[\"frame\"]}\n",
        (Kind::Hardnessd, What::Verdict) => b"{\"subscribe\":[\"hardness\"]}\n",
    };
    stream.write_all(request).await?;
    let (mut unread, mut is_ready) = (Vec::new(), false);
    loop {
        if stream.read_buf(&mut unread).await? == 0 {
            return Ok(());
        }
        let now = now_ns();
        if !is_ready {
            is_ready = true;
            received.ready.fetch_add(1, Relaxed);
        }
        let mut rest = unread.as_slice();
        while let Some(end) = rest.iter().position(|&byte| byte == b'\n') {
            let sent = match args.server {
                Kind::Gpsd => fix(&rest[..end]).and_then(|cycle| sent.frame(0, cycle)),
                Kind::Hardnessd => sent_at(args.event, &rest[..end], sent),
            };
            if let Some(sent) = sent {
                received.add(sent, now);
            }
            rest = &rest[end + 1..];
        }
        let done = unread.len() - rest.len();
        unread.drain(..done);
    }
}

/// When the frame of the event in `line` was sent.
fn sent_at(what: What, line: &[u8], sent: &Sent) -> Option<u64> {
    // The fields needed are at the beginning of the line.
    let head = std::str::from_utf8(&line[..line.len().min(400)]).ok()?;
    let sensor = value(head, "\"sensor\":\"s")?;
    match what {
        What::Frame => {
            head.starts_with("{\"type\":\"frame\"").then_some(())?;
            sent.frame(sensor, value(head, "\"frame\":")?)
        }
        What::Verdict => {
            head.contains("\"phase\":\"final\"").then_some(())?;
            sent.end(sensor, value(head, "\"press\":")?)
        }
    }
}

fn value(text: &str, key: &str) -> Option<usize> {
    let (_, rest) = text.split_once(key)?;
    let end = rest.find(|found: char| !found.is_ascii_digit())?;
    rest[..end].parse().ok()
}

/// The cycle of a line from gpsd, by the line's time.
fn fix(line: &[u8]) -> Option<usize> {
    let line = std::str::from_utf8(line).ok()?;
    line.starts_with("{\"class\":\"TPV\"").then_some(())?;
    let (_, time) = line.split_once("\"time\":\"")?;
    let (_, time) = time.split_once('T')?;
    let mut parts = time.get(..12)?.split([':', '.']);
    let mut part = || parts.next()?.parse::<usize>().ok();
    let (hours, minutes, seconds, thousandths) = (part()?, part()?, part()?, part()?);
    Some(((hours * 60 + minutes) * 60 + seconds) * 100 + thousandths / 10)
}
