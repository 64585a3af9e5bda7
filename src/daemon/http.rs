//! HTTP: the live page, events as server-sent events, status, metrics, health. Read-only.
//!
//! Every request passes the same door: a method that reads, a Host header that names this machine
//! by its address, a route. No route changes anything, none waits for a slow one, and connections
//! are bounded. `/events` stands on the hub like any subscriber.

mod events;
mod host;
mod metrics;
mod status;

use std::convert::Infallible;
use std::io::Write;
use std::net::SocketAddr;
use std::pin::{Pin, pin};
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use base64::prelude::{BASE64_STANDARD, Engine};
use hyper::body::{Bytes, Frame, Incoming};
use hyper::header::{self, HeaderMap, HeaderName, HeaderValue};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Method, Request, Response, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use sha2::{Digest, Sha256};
use tokio::net::TcpStream;
use tokio::sync::mpsc;
use tracing::debug;

use super::accept::{Serve, Stop, stopped};
use super::hub;
use super::sensor::Sensors;
use crate::event::LinkState;

/// The live page: one file, nothing loaded from elsewhere.
const PAGE: &str = include_str!("page.html");

/// How long the head of a request may take, and a connection may idle between two.
const HEAD_PATIENCE: Duration = Duration::from_secs(15);

/// Bytes that wait in a connection, either way.
const BUFFER_BYTES: usize = 64 * 1024;

/// How long the pipelines may take to answer.
const PATIENCE: Duration = Duration::from_secs(1);

/// The answer to a path that there is not.
const NOT_FOUND: &str =
    "not found: the paths are /, /events, /api/status, /metrics, /livez and /readyz\n";

/// On every answer: what it is may not be guessed, kept, or used by a page from elsewhere.
const HEADERS: [(HeaderName, &str); 5] = [
    (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (header::REFERRER_POLICY, "no-referrer"),
    (header::CACHE_CONTROL, "no-store"),
    (header::X_FRAME_OPTIONS, "DENY"),
    (
        HeaderName::from_static("cross-origin-resource-policy"),
        "same-origin",
    ),
];

/// What requests are answered with.
#[derive(Debug, Clone)]
pub(crate) struct Http {
    /// As configured.
    listen: SocketAddr,
    /// What the page may do: run its own script and talk to this daemon.
    page_policy: HeaderValue,
    hub: hub::Handle,
    sensors: Sensors,
    stop: Stop,
}

/// An answer's body.
enum Body {
    Whole(Bytes),
    /// Server-sent events, until the daemon ends.
    Events(mpsc::Receiver<Bytes>),
}

impl hyper::body::Body for Body {
    type Data = Bytes;
    type Error = Infallible;

    fn poll_frame(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
        let chunk = match self.get_mut() {
            Body::Whole(bytes) if bytes.is_empty() => None,
            Body::Whole(bytes) => Some(std::mem::take(bytes)),
            Body::Events(events) => std::task::ready!(events.poll_recv(context)),
        };
        Poll::Ready(chunk.map(|chunk| Ok(Frame::data(chunk))))
    }

    fn is_end_stream(&self) -> bool {
        matches!(self, Body::Whole(bytes) if bytes.is_empty())
    }

    fn size_hint(&self) -> hyper::body::SizeHint {
        match self {
            Body::Whole(bytes) => hyper::body::SizeHint::with_exact(bytes.len() as u64),
            Body::Events(_) => hyper::body::SizeHint::default(),
        }
    }
}

impl Http {
    /// Connections at a time; a page has two or three.
    pub(crate) const MOST_CONNECTIONS: usize = 128;

    pub(crate) fn new(listen: SocketAddr, hub: hub::Handle, sensors: Sensors, stop: Stop) -> Self {
        let policy = page_policy(PAGE);
        Self {
            listen,
            page_policy: HeaderValue::from_str(&policy).expect("hashes in base64 are ASCII"),
            hub,
            sensors,
            stop,
        }
    }

    /// `local`: where the connection came in.
    async fn respond(&self, request: &Request<Incoming>, local: SocketAddr) -> Response<Body> {
        let mut response = self.route(request, local).await;
        if request.method() == Method::HEAD {
            *response.body_mut() = Body::Whole(Bytes::new());
        }
        let headers = response.headers_mut();
        for (name, value) in HEADERS {
            headers.insert(name, HeaderValue::from_static(value));
        }
        headers
            .entry(header::CONTENT_SECURITY_POLICY)
            .or_insert(HeaderValue::from_static(
                "default-src 'none'; frame-ancestors 'none'",
            ));
        response
    }

    async fn route(&self, request: &Request<Incoming>, local: SocketAddr) -> Response<Body> {
        let reads = [Method::GET, Method::HEAD].contains(request.method());
        if !host::is_ours(request, self.listen, local) {
            let message = "the Host header is not an address of this machine: use localhost or \
                           the address in [http] listen\n";
            return text(StatusCode::MISDIRECTED_REQUEST, message.to_owned());
        }
        if !reads {
            let message = "method not allowed: this server is read-only: use GET or HEAD\n";
            let mut response = text(StatusCode::METHOD_NOT_ALLOWED, message.to_owned());
            let allow = HeaderValue::from_static("GET, HEAD");
            response.headers_mut().insert(header::ALLOW, allow);
            return response;
        }
        match request.uri().path() {
            "/" => {
                let mut page = whole(StatusCode::OK, "text/html; charset=utf-8", PAGE);
                let policy = self.page_policy.clone();
                let headers = page.headers_mut();
                headers.insert(header::CONTENT_SECURITY_POLICY, policy);
                page
            }
            "/events" => self.events(request).await,
            "/api/status" => match self.hub.survey().await {
                Ok(survey) => {
                    let vitals = self.sensors.vitals().await;
                    let json = status::json(&survey, &vitals);
                    whole(StatusCode::OK, "application/json", json)
                }
                Err(hub::Closed) => stopping(),
            },
            "/metrics" => match self.hub.survey().await {
                Ok(survey) => {
                    let vitals = self.sensors.vitals().await;
                    let metrics = metrics::encode(&survey, &vitals);
                    whole(StatusCode::OK, metrics::CONTENT_TYPE, metrics)
                }
                Err(hub::Closed) => stopping(),
            },
            "/livez" => match tokio::time::timeout(PATIENCE, self.alive()).await {
                Ok(true) => text(StatusCode::OK, "ok: every pipeline answers\n".to_owned()),
                _ => text(
                    StatusCode::SERVICE_UNAVAILABLE,
                    "a pipeline does not answer\n".to_owned(),
                ),
            },
            "/readyz" => self.ready().await,
            _ => text(StatusCode::NOT_FOUND, NOT_FOUND.to_owned()),
        }
    }

    /// The question that feeds the watchdog, too.
    async fn alive(&self) -> bool {
        super::alive(&self.hub, &self.sensors).await.is_some()
    }

    async fn ready(&self) -> Response<Body> {
        let statuses = self.sensors.statuses().await;
        let mut lines = String::new();
        let mut ready = statuses.len() == self.sensors.0.len();
        for status in &statuses {
            ready &= status.state == LinkState::Live;
            let state = crate::event::name(&status.state);
            lines += &format!("{} {state}\n", status.sensor);
        }
        let code = if ready {
            StatusCode::OK
        } else {
            StatusCode::SERVICE_UNAVAILABLE
        };
        text(code, lines)
    }

    async fn events(&self, request: &Request<Incoming>) -> Response<Body> {
        let wanted = match events::wanted(request) {
            Ok(wanted) => wanted,
            Err(unusable) => return text(StatusCode::BAD_REQUEST, format!("{unusable}\n")),
        };
        if request.method() == Method::HEAD {
            return typed(
                StatusCode::OK,
                events::CONTENT_TYPE,
                Body::Whole(Bytes::new()),
            );
        }
        match events::open(&self.hub, &self.sensors, wanted).await {
            Ok(Ok(events)) => typed(StatusCode::OK, events::CONTENT_TYPE, Body::Events(events)),
            Ok(Err(ahead)) => text(StatusCode::BAD_REQUEST, format!("{ahead}\n")),
            Err(hub::Closed) => stopping(),
        }
    }
}

impl Serve<TcpStream> for Http {
    fn serve(&self, stream: TcpStream) -> impl Future<Output = ()> + Send + 'static {
        let http = Arc::new(self.clone());
        async move {
            let Ok(local) = stream.local_addr() else {
                return;
            };
            let mut stop = http.stop.clone();
            let service = service_fn(|request: Request<Incoming>| {
                let http = http.clone();
                async move { Ok::<_, Infallible>(http.respond(&request, local).await) }
            });
            let mut connection = pin!(
                http1::Builder::new()
                    .timer(TokioTimer::new())
                    .header_read_timeout(HEAD_PATIENCE)
                    .max_buf_size(BUFFER_BYTES)
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
        // One that does not take it learns of it by the end of the connection.
        let _ = stream
            .into_std()
            .and_then(|mut stream| stream.write_all(answer));
    }
}

fn typed(code: StatusCode, content_type: &'static str, body: Body) -> Response<Body> {
    let mut response = Response::new(body);
    *response.status_mut() = code;
    let headers: &mut HeaderMap = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(content_type));
    response
}

fn whole(code: StatusCode, content_type: &'static str, body: impl Into<Bytes>) -> Response<Body> {
    typed(code, content_type, Body::Whole(body.into()))
}

fn text(code: StatusCode, line: String) -> Response<Body> {
    whole(code, "text/plain; charset=utf-8", line)
}

fn stopping() -> Response<Body> {
    text(
        StatusCode::SERVICE_UNAVAILABLE,
        "the daemon is stopping\n".to_owned(),
    )
}

/// The Content-Security-Policy of the page: its own script and style, by their hashes, and
/// connections to where it came from. Nothing else, from nowhere.
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
        let table = format!("const VIRIDIS = {:?};", crate::colour::VIRIDIS);
        assert!(PAGE.contains(&table), "{table}");
    }
}
