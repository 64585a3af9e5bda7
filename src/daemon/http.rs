//! The read-only HTTP server: the live page, server-sent events, status, metrics and health.
//!
//! Every request passes the same checks: its Host header names this machine by an address, its
//! target is short, and its method only reads. No route changes anything or waits for a slow
//! reader, and the number of connections is bounded. `/events` subscribes to the hub as any
//! subscriber does.

mod events;
mod host;
mod metrics;
mod status;

use std::convert::Infallible;
use std::fmt::Display;
use std::io::{self, ErrorKind, Write as _};
use std::net::SocketAddr;
use std::os::fd::AsFd as _;
use std::pin::pin;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use axum::Router;
use axum::extract::State;
use axum::response::{Html, IntoResponse, Response};
use axum::routing::get;
use base64::prelude::{BASE64_STANDARD, Engine};
use bytes::Bytes;
use hyper::body::Incoming;
use hyper::header::{self, HeaderName, HeaderValue};
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper::{Method, Request, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use rustix::net::sockopt;
use sha2::{Digest, Sha256};
use tokio::io::Interest;
use tokio::net::TcpStream;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tracing::debug;

use super::accept::{Serve, Stop, stopped};
use super::hub::{self, Closed};
use super::sensor::{Sensors, Vitals};
use super::snapshot::{Snapshot, Snapshots};
use hardnessd_core::event::LinkState;

/// The live page: one file, which loads nothing from elsewhere.
const PAGE: &str = include_str!("page.html");

/// How long the head of a request may take, and how long a connection may idle between two
/// requests.
const HEAD_PATIENCE: Duration = Duration::from_secs(15);

/// The most bytes that wait in a connection, in each direction.
const BUFFER_BYTES: usize = 64 * 1024;

/// The most bytes of texts that connections may keep waiting together. All who ask at about the same
/// time share one text, so a client that reads never needs much of this.
const MOST_TEXT_BYTES: usize = 16 << 20;

/// A connection whose other end takes nothing for this long is closed.
const UNREAD_PATIENCE: Duration = Duration::from_secs(30);

/// How long the pipelines may take to answer.
const PATIENCE: Duration = Duration::from_secs(1);

/// The headers of every answer. A browser must not guess the answer's type, store the answer, or
/// let a page from elsewhere use it.
const HEADERS: [(HeaderName, &str); 4] = [
    (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (header::REFERRER_POLICY, "no-referrer"),
    (header::CACHE_CONTROL, "no-store"),
    (
        HeaderName::from_static("cross-origin-resource-policy"),
        "same-origin",
    ),
];

/// The Content-Security-Policy of every answer except the page.
const POLICY: &str = "default-src 'none'; frame-ancestors 'none'";

/// Answers requests.
#[derive(Debug, Clone)]
pub(crate) struct Http {
    /// The address that the server listens on.
    listen: SocketAddr,
    routes: TowerToHyperService<Router>,
    stop: Stop,
}

/// The sources of the answers.
#[derive(Debug, Clone)]
struct Sources {
    hub: hub::Handle,
    snapshots: Snapshots,
    turns: Arc<Semaphore>,
    /// The snapshots of `/metrics` and `/api/status`.
    texts: Snapshots,
    /// One permit for each byte of the texts that exist.
    text_bytes: Arc<Semaphore>,
}

impl Http {
    /// The most connections at a time. A page has two or three.
    pub(crate) const MOST_CONNECTIONS: usize = 128;

    pub(crate) fn new(
        listen: SocketAddr,
        hub: hub::Handle,
        sensors: Sensors,
        snapshots: Snapshots,
        turns: Arc<Semaphore>,
        stop: Stop,
    ) -> Self {
        let policy = HeaderValue::try_from(page_policy(PAGE)).expect("base64 is ASCII");
        let page = ([(header::CONTENT_SECURITY_POLICY, policy)], Html(PAGE));
        let routes = Router::new()
            .route("/", get(async || page))
            .route("/events", get(events::answer))
            .route("/api/status", get(status))
            .route("/api/history", get(history))
            .route("/metrics", get(metrics))
            .route("/livez", get(live))
            .route("/readyz", get(ready))
            .fallback(async || {
                refusal(
                    StatusCode::NOT_FOUND,
                    "not found: the paths are /, /events, /api/status, /api/history, /metrics, /livez and /readyz",
                )
            })
            .with_state(Sources {
                texts: Snapshots::new(hub.clone(), sensors),
                hub,
                snapshots,
                turns,
                text_bytes: Arc::new(Semaphore::new(MOST_TEXT_BYTES)),
            });
        Self {
            listen,
            routes: TowerToHyperService::new(routes),
            stop,
        }
    }

    /// Answers a request. `local` is this machine's address of the connection.
    async fn respond(&self, request: Request<Incoming>, local: SocketAddr) -> Response {
        let mut response = if !host::is_ours(&request, self.listen, local) {
            let message = "the Host header is not an address of this machine: use localhost or \
                           the address in [http] listen";
            refusal(StatusCode::MISDIRECTED_REQUEST, message)
        } else if head_bytes(&request) > BUFFER_BYTES {
            let message = format!("the head is longer than {BUFFER_BYTES} bytes");
            refusal(StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE, message)
        } else if ![Method::GET, Method::HEAD].contains(request.method()) {
            let message = "method not allowed: this server is read-only: use GET or HEAD";
            let allow = [(header::ALLOW, "GET, HEAD")];
            (allow, refusal(StatusCode::METHOD_NOT_ALLOWED, message)).into_response()
        } else {
            let Ok(response) = self.routes.call(request).await;
            response
        };
        let headers = response.headers_mut();
        for (name, value) in HEADERS {
            headers.insert(name, HeaderValue::from_static(value));
        }
        headers
            .entry(header::CONTENT_SECURITY_POLICY)
            .or_insert(HeaderValue::from_static(POLICY));
        response
    }
}

/// The bytes of a request's head. hyper's own bound holds for what it has not parsed yet, so a head
/// that comes in one piece may be a little longer.
fn head_bytes(request: &Request<Incoming>) -> usize {
    let target = request.uri();
    let target = target.path().len() + target.query().map_or(0, str::len);
    let headers = request.headers().iter();
    // `: ` and the end of the line.
    let headers = headers.map(|(name, value)| name.as_str().len() + value.len() + 4);
    target + headers.sum::<usize>()
}

/// A second handle of the socket of a request's connection. An answer without end watches it.
#[derive(Debug, Clone)]
struct Client(Arc<TcpStream>);

impl Client {
    fn of(stream: &TcpStream) -> io::Result<Self> {
        let socket = stream.as_fd().try_clone_to_owned()?;
        Ok(Self(Arc::new(TcpStream::from_std(socket.into())?)))
    }

    /// Waits until the client has closed its end. hyper does not notice it while bytes of a further
    /// request wait in its buffer.
    async fn gone(&self) -> io::Error {
        loop {
            match self.0.ready(Interest::READABLE).await {
                Ok(ready) if ready.is_read_closed() => return ErrorKind::ConnectionAborted.into(),
                Ok(_) => {}
                Err(error) => return error,
            }
            // These bytes are for hyper. This waits for the next change of the socket.
            let pass = || Err::<(), _>(ErrorKind::WouldBlock.into());
            let _ = self.0.try_io(Interest::READABLE, pass);
        }
    }
}

/// An answer with an error code and one line with the reason.
fn refusal(code: StatusCode, why: impl Display) -> Response {
    (code, format!("{why}\n")).into_response()
}

impl IntoResponse for Closed {
    fn into_response(self) -> Response {
        refusal(StatusCode::SERVICE_UNAVAILABLE, self)
    }
}

/// A text that all who asked for it at about the same time share.
#[derive(Debug)]
pub(super) struct Text {
    text: String,
    /// The text's share of [`MOST_TEXT_BYTES`].
    _bytes: OwnedSemaphorePermit,
}

impl Text {
    /// Returns `None` if the connections keep too many texts waiting.
    fn new(text: String, text_bytes: &Arc<Semaphore>) -> Option<Self> {
        let bytes = reserve(text.len(), text_bytes)?;
        Some(Self {
            text,
            _bytes: bytes,
        })
    }
}

/// The share of a text of this length. `None` if the connections keep too many texts waiting.
fn reserve(bytes: usize, text_bytes: &Arc<Semaphore>) -> Option<OwnedSemaphorePermit> {
    let bytes = u32::try_from(bytes).ok()?;
    Arc::clone(text_bytes).try_acquire_many_owned(bytes).ok()
}

impl AsRef<[u8]> for Text {
    fn as_ref(&self) -> &[u8] {
        self.text.as_bytes()
    }
}

/// An answer with the text in `place`, which `encode` makes of the snapshot once.
fn shared(
    content_type: &'static str,
    snapshot: &Snapshot,
    place: &OnceLock<Option<Bytes>>,
    encode: fn(&Snapshot) -> String,
    text_bytes: &Arc<Semaphore>,
) -> Response {
    let made = place.get_or_init(|| Text::new(encode(snapshot), text_bytes).map(Bytes::from_owner));
    match made {
        Some(text) => ([(header::CONTENT_TYPE, content_type)], text.clone()).into_response(),
        None => full(),
    }
}

async fn status(State(of): State<Sources>) -> Result<Response, Closed> {
    let now = of.texts.recent().await?;
    let encode = |now: &Snapshot| status::json(&now.survey, &now.vitals);
    Ok(shared(
        "application/json",
        &now,
        &now.status,
        encode,
        &of.text_bytes,
    ))
}

/// The force and contact area of one sensor in the last two minutes. The query names the sensor.
async fn history(
    State(of): State<Sources>,
    request: axum::extract::Request,
) -> Result<Response, Closed> {
    let query = request.uri().query().unwrap_or_default();
    let mut pairs = form_urlencoded::parse(query.as_bytes());
    let sensor = pairs.find(|(key, _)| key == "sensor");
    let sensor = sensor.map_or(String::new(), |(_, sensor)| sensor.into_owned());
    let _turn = of.turns.acquire().await;
    let Some(history) = of.hub.history(sensor.clone()).await? else {
        let why = format!("sensor: found {sensor:?}, expected the name of a sensor");
        return Ok(refusal(StatusCode::NOT_FOUND, why));
    };
    let line = history.line(&sensor).json.to_string();
    let text = Text::new(line, &of.text_bytes).map(Bytes::from_owner);
    let content_type = [(header::CONTENT_TYPE, "application/json")];
    Ok(match text {
        Some(text) => (content_type, text).into_response(),
        None => full(),
    })
}

/// The refusal when the connections keep too many texts waiting.
fn full() -> Response {
    refusal(
        StatusCode::SERVICE_UNAVAILABLE,
        "too many answers wait to be read: try later",
    )
}

async fn metrics(State(of): State<Sources>) -> Result<Response, Closed> {
    let now = of.texts.recent().await?;
    let encode = |now: &Snapshot| metrics::encode(&now.survey, &now.vitals);
    Ok(shared(
        metrics::CONTENT_TYPE,
        &now,
        &now.metrics,
        encode,
        &of.text_bytes,
    ))
}

/// Makes the same check as the watchdog.
async fn live(State(of): State<Sources>) -> Response {
    match tokio::time::timeout(PATIENCE, of.snapshots.current()).await {
        Ok(Ok(now)) if now.is_whole => "ok: every pipeline answers\n".into_response(),
        _ => refusal(
            StatusCode::SERVICE_UNAVAILABLE,
            "a pipeline does not answer",
        ),
    }
}

async fn ready(State(of): State<Sources>) -> Result<impl IntoResponse, Closed> {
    let now = of.snapshots.current().await?;
    let mut lines = String::new();
    let mut ready = now.is_whole;
    for Vitals { status, .. } in &now.vitals {
        ready &= status.state == LinkState::Live;
        let state = hardnessd_core::event::name(&status.state);
        lines += &format!("{} {state}\n", status.sensor);
    }
    let code = if ready {
        StatusCode::OK
    } else {
        StatusCode::SERVICE_UNAVAILABLE
    };
    Ok((code, lines))
}

impl Serve<TcpStream> for Http {
    fn serve(&self, stream: TcpStream) -> impl Future<Output = ()> + Send + 'static {
        let http = self.clone();
        async move {
            let (Ok(local), Ok(client)) = (stream.local_addr(), Client::of(&stream)) else {
                return;
            };
            // The system closes it then. On failure it stays open.
            let _ = sockopt::set_tcp_user_timeout(&stream, UNREAD_PATIENCE.as_millis() as u32);
            let mut stop = http.stop.clone();
            let service = service_fn(async |mut request: Request<Incoming>| {
                request.extensions_mut().insert(client.clone());
                Ok::<_, Infallible>(http.respond(request, local).await)
            });
            let mut connection = pin!(
                http1::Builder::new()
                    .timer(TokioTimer::new())
                    .header_read_timeout(HEAD_PATIENCE)
                    .max_buf_size(BUFFER_BYTES)
                    // hyper panics while it writes a date before 1970.
                    .auto_date_header(false)
                    .serve_connection(TokioIo::new(stream), service)
            );
            let served = tokio::select! {
                served = connection.as_mut() => served,
                () = stopped(&mut stop) => {
                    connection.as_mut().graceful_shutdown();
                    connection.await
                }
            };
            if let Err(error) = served {
                debug!(%error, "connection gone");
            }
        }
    }

    fn refuse(&self, stream: TcpStream) {
        let answer = b"HTTP/1.1 503 Service Unavailable\r\ncontent-length: 0\r\n\
                       retry-after: 1\r\nconnection: close\r\n\r\n";
        // If the answer cannot be sent, the client still sees the connection end.
        let _ = stream
            .into_std()
            .and_then(|mut stream| stream.write_all(answer));
    }
}

/// The Content-Security-Policy of the page. It allows the page's own script and style, by their
/// hashes, images in `data:` URLs, and connections to the page's origin. It allows nothing else.
fn page_policy(page: &str) -> String {
    let hash = |tag: &str| {
        let (open, close) = (format!("<{tag}>"), format!("</{tag}>"));
        let start = page.find(&open).map_or(0, |at| at + open.len());
        let end = page.find(&close).unwrap_or(page.len());
        let hash = BASE64_STANDARD.encode(Sha256::digest(&page[start..end]));
        format!("'sha256-{hash}'")
    };
    format!(
        "default-src 'none'; script-src {}; style-src {}; connect-src 'self'; img-src data:; \
         base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
        hash("script"),
        hash("style")
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_has_one_script_one_style_and_loads_nothing() {
        for part in ["<script>", "</script>", "<style>", "</style>"] {
            assert_eq!(PAGE.matches(part).count(), 1, "{part}");
        }
        for part in ["http:/", "https:/", "@import", " src=", "url(", "innerHTML"] {
            assert!(!PAGE.contains(part), "{part}");
        }
    }

    #[test]
    fn the_page_has_the_one_colour_map() {
        let table = format!("const VIRIDIS = {:?};", hardnessd_core::colour::VIRIDIS);
        assert!(PAGE.contains(&table), "{table}");
    }
}
