//! The HTTP server: the live page, server-sent events, status, metrics and health.
//!
//! Every request passes the same checks: its Host header names this machine by an address, and its method
//! only reads. No route waits for a slow reader, and the number of
//! connections is bounded. No route changes anything, but for the context of a sensor, where the
//! configuration allows it. `/events` subscribes to the hub as any
//! subscriber does.

mod events;
mod host;
mod metrics;

use std::convert::Infallible;
use std::fmt::Display;
use std::io::Write as _;
use std::net::SocketAddr;
use std::pin::pin;
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::extract::State;
use axum::response::{Html, IntoResponse, Response};
use axum::routing::{get, post};
use base64::prelude::{BASE64_STANDARD, Engine};
use futures_util::StreamExt as _;
use hyper::body::Incoming;
use hyper::header::{self, HeaderMap, HeaderName, HeaderValue};
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper::{Request, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use serde::Deserialize;
use serde_json::{Map, Value, json};
use sha2::{Digest, Sha256};
use tokio::net::TcpStream;
use tracing::debug;

use super::accept::{Serve, Stop, stopped};
use super::client::change;
use super::hub::{Hub, Snapshot};
use super::request::{self, Merge};
use super::sensor::Sensors;
use hardnessd_core::event::{self, Event, LinkState, Reply, Status};
use hardnessd_core::wording::cut_found;

/// The live page: one file, which loads nothing from elsewhere.
const PAGE: &str = include_str!("page.html");

/// How long the head of a request may take, and its body, and how long a connection may idle between two
/// requests.
const HEAD_PATIENCE: Duration = Duration::from_secs(15);

/// The most bytes that wait in a connection, in each direction.
const BUFFER_BYTES: usize = 64 * 1024;

/// The longest body of a request: a context has less than 1 KiB.
const BODY_BYTES: usize = 2048;

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

impl Http {
    /// The most connections at a time. A page has two or three.
    pub(crate) const MOST_CONNECTIONS: usize = 128;

    /// The server at `listen`. The page may set the context of `sensors`, if they are given.
    pub(crate) fn new(listen: SocketAddr, hub: Hub, sensors: Option<Sensors>, stop: Stop) -> Self {
        let sets_context = sensors.is_some();
        let policy = HeaderValue::try_from(page_policy(PAGE)).expect("base64 is ASCII");
        let page = ([(header::CONTENT_SECURITY_POLICY, policy)], Html(PAGE));
        let mut routes = Router::new()
            .route("/", get(async || page))
            .route("/events", get(events::answer))
            .route("/api/status", get(async move |State(hub): State<Hub>| {
                text("application/json", status(&hub.snapshot().await, sets_context))
            }))
            .route("/metrics", get(metrics))
            .route("/livez", get(live))
            .route("/readyz", get(ready))
            .fallback(async || {
                refusal(
                    StatusCode::NOT_FOUND,
                    "not found: the paths are /, /events, /api/status, /metrics, /livez and /readyz",
                )
            });
        if let Some(sensors) = sensors {
            let set = post(async move |headers, body| context(&sensors, headers, body).await);
            routes = routes.route("/api/context", set);
        }
        let routes = routes.method_not_allowed_fallback(async move || {
            let message = match sets_context {
                true => "method not allowed: use GET or HEAD, and POST for /api/context alone",
                false => "method not allowed: this server is read-only: use GET or HEAD",
            };
            refusal(StatusCode::METHOD_NOT_ALLOWED, message)
        });
        Self {
            listen,
            routes: TowerToHyperService::new(routes.with_state(hub)),
            stop,
        }
    }

    /// Answers a request. `local` is this machine's address of the connection.
    async fn respond(&self, request: Request<Incoming>, local: SocketAddr) -> Response {
        let mut response = if !host::is_ours(&request, self.listen, local) {
            let message = "the Host header is not an address of this machine: use localhost or \
                           the address in [http] listen";
            refusal(StatusCode::MISDIRECTED_REQUEST, message)
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

/// What is being pressed at a sensor. What is missing is no longer said.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, expecting = "an object")]
struct Pressed {
    sensor: String,
    #[serde(default)]
    object: Value,
    #[serde(default)]
    level: Value,
}

/// Sets what is being pressed. A page from elsewhere cannot send this type of content without a question first, and
/// gets no answer to that.
async fn context(sensors: &Sensors, headers: HeaderMap, body: Body) -> Response {
    let kind = headers.get(header::CONTENT_TYPE);
    let kind = kind.and_then(|kind| kind.to_str().ok()).unwrap_or_default();
    let (kind, _parameters) = kind.split_once(';').unwrap_or((kind, ""));
    if !kind.trim().eq_ignore_ascii_case("application/json") {
        let why = "Content-Type: expected application/json";
        return refusal(StatusCode::UNSUPPORTED_MEDIA_TYPE, why);
    }
    let body = match tokio::time::timeout(HEAD_PATIENCE, read_body(body)).await {
        Ok(Some(body)) => body,
        read => {
            let (code, why) = match read {
                Ok(_) => (
                    StatusCode::PAYLOAD_TOO_LARGE,
                    "the body is too long or cut off",
                ),
                Err(_) => (StatusCode::REQUEST_TIMEOUT, "the body did not come in time"),
            };
            let closes = [(header::CONNECTION, "close")];
            return (closes, refusal(code, why)).into_response();
        }
    };
    let read = serde_json::from_slice(&body).map_err(|error| cut_found(&error.to_string()));
    let done = async {
        let Pressed {
            sensor,
            object,
            level,
        } = read?;
        let keys = [("object", object), ("level", level)];
        let keys = keys.map(|(key, value)| (key.to_owned(), value));
        let keys = Map::from_iter(keys);
        let request = request::Request::Merge(Merge { sensor, keys });
        change(Some(sensors), request).await
    };
    match done.await {
        Ok(_) => text("application/json", "{}".to_owned()),
        Err(why) => refusal(StatusCode::BAD_REQUEST, why),
    }
}

/// The body of a request. `None` if it is too long or cut off. Each piece is copied: alone it would keep the buffer into
/// which it was read.
async fn read_body(body: Body) -> Option<Vec<u8>> {
    let mut pieces = body.into_data_stream();
    let mut bytes = Vec::new();
    while let Some(piece) = pieces.next().await {
        bytes.extend_from_slice(&piece.ok()?);
        if bytes.len() > BODY_BYTES {
            return None;
        }
    }
    Some(bytes)
}

/// An answer with an error code and one line with the reason.
fn refusal(code: StatusCode, why: impl Display) -> Response {
    (code, format!("{why}\n")).into_response()
}

fn text(content_type: &'static str, text: String) -> Response {
    ([(header::CONTENT_TYPE, content_type)], text).into_response()
}

/// An object of `hello` as on a socket, `subscribers`, `sets_context` (whether the page may say what is
/// being pressed), and a list of `sensors`. A sensor has its `status` and `last` (its last final
/// verdict, or null) as on a socket, `last_frame_age_s` (null before the first frame) and the
/// current `contact_threshold_n`.
fn status(now: &Snapshot, sets_context: bool) -> String {
    let read = |line: &str| -> Value {
        serde_json::from_str(line).expect("what was written as JSON can be read as JSON")
    };
    let sensors = now.sensors.iter().map(|sensor| {
        let state = &sensor.state;
        json!({
            "status": read(&Event::Status(state.status.clone()).to_line()),
            "last_frame_age_s": sensor.last_frame_age.map(|age| age.as_secs_f64()),
            // The threshold is written with the digits of the configuration, which are those of
            // an f32.
            "contact_threshold_n": read(&state.contact_threshold_n.to_string()),
            "last": sensor.last.as_ref().map(|line| read(line.json())),
        })
    });
    json!({
        "hello": read(&Reply::Hello(now.hello.clone()).to_line()),
        "sensors": sensors.collect::<Vec<Value>>(),
        "subscribers": now.subscribers,
        "sets_context": sets_context,
    })
    .to_string()
}

async fn metrics(State(hub): State<Hub>) -> Response {
    let metrics = metrics::encode(&hub.snapshot().await);
    text(metrics::CONTENT_TYPE, metrics)
}

/// Makes the same check as the watchdog: the sensors' thread works.
async fn live(State(hub): State<Hub>) -> Response {
    match tokio::time::timeout(PATIENCE, hub.snapshot()).await {
        Ok(_) => "ok: the pipelines answer\n".into_response(),
        Err(_) => refusal(
            StatusCode::SERVICE_UNAVAILABLE,
            "the pipelines do not answer",
        ),
    }
}

async fn ready(State(hub): State<Hub>) -> impl IntoResponse {
    let now = hub.snapshot().await;
    let statuses = || now.sensors.iter().map(|sensor| &sensor.state.status);
    let code = match statuses().all(|status| status.state == LinkState::Live) {
        true => StatusCode::OK,
        false => StatusCode::SERVICE_UNAVAILABLE,
    };
    let line = |status: &Status| format!("{} {}\n", status.sensor, event::name(&status.state));
    (code, statuses().map(line).collect::<String>())
}

impl Serve<TcpStream> for Http {
    fn serve(&self, stream: TcpStream) -> impl Future<Output = ()> + Send + 'static {
        let http = self.clone();
        async move {
            let Ok(local) = stream.local_addr() else {
                return;
            };
            let mut stop = http.stop.clone();
            let service =
                service_fn(async |request| Ok::<_, Infallible>(http.respond(request, local).await));
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
