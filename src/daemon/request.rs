//! The requests of a subscriber: one JSON object per line.
//!
//! In: a line as it came. Out: a [`Request`], or an error with what was found and expected, in both
//! cases with the `id` to echo. This module does not decide whether the connection may send a
//! [`Change`].

pub(crate) mod motion;

use serde::Serialize;
use serde_json::{Map, Value};

use self::motion::Positions;
use hardnessd_core::event::{CONTEXT_BYTES, Kind};

/// A request that can be used.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Request {
    /// Set the subscription of the connection.
    Subscribe(Subscription),
    /// Get every sensor's current status.
    Status,
    /// Get every sensor's last final verdict.
    Last,
    /// Change something. Of all sockets, only the control socket may do this.
    Change(Change),
}

/// A command of the control socket.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Change {
    /// Take another tare.
    Tare { sensor: String },
    /// Set the context that the controller reports of its work. `None` clears it.
    Context {
        sensor: String,
        context: Option<Value>,
    },
    /// Take positions of the arm that the robot reports.
    Motion(Positions),
    /// Write the last minute of this sensor to a file.
    Blackbox { sensor: String },
}

impl Change {
    /// The key of the command in its request.
    pub(crate) fn key(&self) -> &'static str {
        match self {
            Change::Tare { .. } => "tare",
            Change::Context { .. } => "context",
            Change::Motion(_) => "motion",
            Change::Blackbox { .. } => "blackbox",
        }
    }
}

/// The events that a subscriber wants, and the policy if it is slow.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Subscription {
    pub(crate) kinds: Kinds,
    pub(crate) policy: Policy,
    /// The last event that the subscriber had in an earlier connection.
    pub(crate) since: Option<Since>,
}

impl Default for Subscription {
    fn default() -> Self {
        let kinds = [Kind::Hardness, Kind::Press, Kind::Status]
            .into_iter()
            .collect();
        Self {
            kinds,
            policy: Policy::Queue,
            since: None,
        }
    }
}

/// The events that are kept for a subscriber that is slow.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Policy {
    /// Every event. When the queue is full, the oldest is dropped.
    Queue,
    /// The newest event of each kind and sensor.
    Latest,
    /// The newest frame of each sensor, and every other event. This is for viewers, as on
    /// `/events`.
    LatestFrames,
}

/// A place in a run: `RUN:SEQ`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Since {
    pub(crate) run: String,
    pub(crate) seq: u64,
}

impl Since {
    /// Reads `RUN:SEQ`.
    pub(crate) fn parse(token: &str) -> Option<Self> {
        let (run, seq) = token.rsplit_once(':')?;
        Some(Self {
            run: run.to_owned(),
            seq: seq.parse().ok()?,
        })
    }
}

/// A set of event kinds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Kinds(u8);

impl Kinds {
    /// The kinds that carry a `seq`.
    pub(crate) const NUMBERED: [Kind; 3] = [Kind::Status, Kind::Press, Kind::Hardness];

    pub(crate) fn contains(self, kind: Kind) -> bool {
        self.0 & Self::bit(kind) != 0
    }

    fn bit(kind: Kind) -> u8 {
        1 << kind as u8
    }
}

impl FromIterator<Kind> for Kinds {
    fn from_iter<I: IntoIterator<Item = Kind>>(kinds: I) -> Self {
        Self(
            kinds
                .into_iter()
                .map(Self::bit)
                .fold(0, |set, bit| set | bit),
        )
    }
}

/// The reason a line cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum Unusable {
    #[error("found no JSON ({0}), expected an object")]
    NoJson(String),
    #[error("found JSON of another type, expected an object")]
    NoObject,
    #[error("found {found}, expected {expected}")]
    Key {
        found: String,
        expected: &'static str,
    },
    #[error("{key}: found {found}, expected {expected}")]
    Value {
        key: &'static str,
        found: String,
        expected: &'static str,
    },
    #[error("found {0}, which this request does not take")]
    Extra(String),
    #[error("context: found {0} bytes, expected fewer than {CONTEXT_BYTES}")]
    LongContext(usize),
    #[error("{0}")]
    Motion(#[from] motion::Unusable),
}

impl Unusable {
    /// The error of a value in JSON.
    fn value(key: &'static str, found: &Value, expected: &'static str) -> Self {
        let found = short(found);
        Self::Value {
            key,
            found,
            expected,
        }
    }
}

/// A line that was read.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Line {
    /// The `id` to echo in the answer.
    pub(crate) id: Option<Value>,
    /// The request, or the reason the line cannot be used.
    pub(crate) request: Result<Request, Unusable>,
}

/// Reads one line, without its newline.
pub(crate) fn parse(line: &[u8]) -> Line {
    let unusable = |reason| Line {
        id: None,
        request: Err(reason),
    };
    let mut fields: Map<String, Value> = match serde_json::from_slice(line) {
        Ok(Value::Object(fields)) => fields,
        Ok(_) => return unusable(Unusable::NoObject),
        Err(error) => return unusable(Unusable::NoJson(error.to_string())),
    };
    let id = fields.remove("id");
    Line {
        id,
        request: request(fields),
    }
}

fn request(mut fields: Map<String, Value>) -> Result<Request, Unusable> {
    let request = if let Some(kinds) = fields.remove("subscribe") {
        Request::Subscribe(Subscription {
            kinds: self::kinds(&kinds)?,
            policy: fields
                .remove("policy")
                .map_or(Ok(Policy::Queue), |value| policy(&value))?,
            since: fields
                .remove("since")
                .map(|value| since(&value))
                .transpose()?,
        })
    } else if let Some(what) = fields.remove("get") {
        match what.as_str() {
            Some("status") => Request::Status,
            Some("last") => Request::Last,
            _ => return Err(Unusable::value("get", &what, "\"status\" or \"last\"")),
        }
    } else if let Some(sensor) = fields.remove("tare") {
        let sensor = name("tare", &sensor)?;
        Request::Change(Change::Tare { sensor })
    } else if let Some(context) = fields.remove("context") {
        Request::Change(self::context(context)?)
    } else if let Some(motion) = fields.remove("motion") {
        Request::Change(self::motion(&motion)?)
    } else if let Some(sensor) = fields.remove("blackbox") {
        let sensor = name("blackbox", &sensor)?;
        Request::Change(Change::Blackbox { sensor })
    } else {
        let found = fields.keys().next().map_or("no key".to_owned(), short);
        let expected = "\"subscribe\" or \"get\", or on the control socket \"tare\", \"context\", \
                        \"motion\" or \"blackbox\"";
        return Err(Unusable::Key { found, expected });
    };
    match fields.keys().next() {
        Some(key) => Err(Unusable::Extra(short(key))),
        None => Ok(request),
    }
}

fn name(key: &'static str, value: &Value) -> Result<String, Unusable> {
    let name = value.as_str().map(str::to_owned);
    name.ok_or_else(|| Unusable::value(key, value, NAME))
}

/// The expected value of a key that names a sensor.
const NAME: &str = "a sensor's name";

/// The sensor in the object of a command.
fn sensor(key: &'static str, fields: &Map<String, Value>) -> Result<String, Unusable> {
    fields.get("sensor").map_or_else(
        || {
            Err(Unusable::Value {
                key,
                found: "none".to_owned(),
                expected: NAME,
            })
        },
        |sensor| name(key, sensor),
    )
}

fn motion(value: &Value) -> Result<Change, Unusable> {
    let Value::Object(fields) = value else {
        return Err(Unusable::value("motion", value, "an object"));
    };
    let sensor = sensor("motion.sensor", fields)?;
    let mut others = fields
        .keys()
        .filter(|key| !["sensor", "at"].contains(&key.as_str()));
    if let Some(other) = others.next() {
        return Err(Unusable::Extra(short(&format!("motion.{other}"))));
    }
    let points = motion::points(fields.get("at").unwrap_or(&Value::Null))?;
    Ok(Change::Motion(Positions { sensor, points }))
}

fn context(value: Value) -> Result<Change, Unusable> {
    let Value::Object(fields) = &value else {
        return Err(Unusable::value("context", &value, "an object"));
    };
    let sensor = sensor("context.sensor", fields)?;
    let bytes = value.to_string().len();
    if bytes >= CONTEXT_BYTES {
        return Err(Unusable::LongContext(bytes));
    }
    let says_something = fields.len() > 1;
    Ok(Change::Context {
        sensor,
        context: says_something.then_some(value),
    })
}

/// The value found as JSON, cut to a length that fits in a message.
pub(crate) fn short(found: &(impl Serialize + ?Sized)) -> String {
    const CHARS: usize = 60;
    let text = serde_json::to_string(found).expect("what was read as JSON can be written as JSON");
    match text.char_indices().nth(CHARS) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text,
    }
}

fn kinds(value: &Value) -> Result<Kinds, Unusable> {
    let unusable = |found| {
        let expected = "a list of \"hardness\", \"press\", \"status\", \"frame\"";
        Unusable::value("subscribe", found, expected)
    };
    let Value::Array(names) = value else {
        return Err(unusable(value));
    };
    let kind = |name: &Value| name.as_str().and_then(Kind::named);
    names
        .iter()
        .map(|name| kind(name).ok_or_else(|| unusable(name)))
        .collect()
}

fn policy(value: &Value) -> Result<Policy, Unusable> {
    match value.as_str() {
        Some("queue") => Ok(Policy::Queue),
        Some("latest") => Ok(Policy::Latest),
        _ => Err(Unusable::value("policy", value, "\"queue\" or \"latest\"")),
    }
}

fn since(value: &Value) -> Result<Since, Unusable> {
    let since = value.as_str().and_then(Since::parse);
    since.ok_or_else(|| Unusable::value("since", value, "\"RUN:SEQ\""))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_request_of_the_protocol_is_understood() {
        let subscription = |text: &str| match parse(text.as_bytes()).request {
            Ok(Request::Subscribe(subscription)) => subscription,
            other => panic!("{text}: {other:?}"),
        };
        let all = subscription(r#"{"subscribe":["hardness","press","status","frame"]}"#);
        assert!(all.kinds.contains(Kind::Frame) && all.kinds.contains(Kind::Status));
        assert_eq!(all.policy, Policy::Queue);
        let resumed = subscription(r#"{"subscribe":["press"],"policy":"latest","since":"ab:7"}"#);
        assert!(!resumed.kinds.contains(Kind::Hardness));
        assert_eq!(resumed.policy, Policy::Latest);
        assert_eq!(
            resumed.since,
            Some(Since {
                run: "ab".to_owned(),
                seq: 7
            })
        );
        assert_eq!(parse(br#"{"get":"status"}"#).request, Ok(Request::Status));
        assert_eq!(
            parse(br#"{"get":"last","id":4}"#).request,
            Ok(Request::Last)
        );
        let sensor = "forearm".to_owned();
        assert_eq!(
            parse(br#"{"tare":"forearm"}"#).request,
            Ok(Request::Change(Change::Tare { sensor }))
        );
    }

    #[test]
    fn a_context_is_kept_as_it_came_and_below_a_kibibyte() {
        let context = |more: &str| {
            let line = format!(r#"{{"context":{{"sensor":"forearm"{more}}}}}"#);
            match parse(line.as_bytes()).request {
                Ok(Request::Change(Change::Context { context, .. })) => Ok(context),
                other => Err(other.unwrap_err()),
            }
        };
        assert_eq!(context("").unwrap(), None);
        let expected = serde_json::json!({"sensor": "forearm", "tag": "x"});
        assert_eq!(context(r#","tag":"x""#).unwrap(), Some(expected));
        let long = |bytes: usize| {
            let around = r#"{"sensor":"forearm","tag":""}"#.len();
            context(&format!(r#","tag":"{}""#, "x".repeat(bytes - around)))
        };
        assert!(long(1023).is_ok());
        assert_eq!(long(1024), Err(Unusable::LongContext(1024)));
    }

    #[test]
    fn an_unusable_line_says_what_was_found_and_echoes_its_id() {
        for (line, found) in [
            (&br#"{"subscribe":["touch"],"id":"a"}"#[..], "\"touch\""),
            (br#"{"subscribe":"press","id":"a"}"#, "\"press\""),
            (br#"{"subscribe":[],"policy":"all","id":"a"}"#, "\"all\""),
            (br#"{"subscribe":[],"since":"7","id":"a"}"#, "\"7\""),
            (br#"{"subscribe":[],"since":"ab:-7","id":"a"}"#, "\"ab:-7\""),
            (br#"{"subscribe":[],"sinse":"ab:7","id":"a"}"#, "\"sinse\""),
            (br#"{"get":"frames","id":"a"}"#, "\"frames\""),
            (br#"{"tare":7,"id":"a"}"#, "tare"),
            (br#"{"tare":"a","context":{},"id":"a"}"#, "\"context\""),
            (br#"{"context":"pick","id":"a"}"#, "\"pick\""),
            (br#"{"context":{"tag":"x"},"id":"a"}"#, "context.sensor"),
            (br#"{"id":"a"}"#, "no key"),
            (
                br#"{"retare":"a","id":"a"}"#,
                "\"tare\", \"context\", \"motion\" or \"blackbox\"",
            ),
            (br#"{"motion":[],"id":"a"}"#, "motion: found []"),
            (br#"{"motion":{"at":[]},"id":"a"}"#, "motion.sensor"),
            (
                br#"{"motion":{"sensor":"a"},"id":"a"}"#,
                "motion.at: found null",
            ),
            (
                br#"{"motion":{"sensor":"a","at":[],"mm":1},"id":"a"}"#,
                "\"motion.mm\"",
            ),
        ] {
            let read = parse(line);
            let message = read.request.unwrap_err().to_string();
            assert!(message.contains(found), "{message}");
            assert_eq!(read.id, Some(Value::from("a")));
        }
        for line in [&b"{\"get\":"[..], b"[1]", b"\xff\xfe", b""] {
            assert!(parse(line).request.is_err());
        }
    }
}
