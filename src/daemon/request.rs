//! The requests of a subscriber: one JSON object per line.
//!
//! In: a line as it came. Out: a [`Request`], or an error with what was found and expected, in both
//! cases with the `id` to echo. This module does not decide whether the connection may change
//! something.

pub(crate) mod motion;

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use self::motion::Positions;
use hardnessd_core::event::{self, Kind};
use hardnessd_core::wording;

/// A request as it is written. The first key names it.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Request {
    /// Set the subscription of the connection.
    Subscribe(Subscription),
    /// Get something. It changes nothing.
    Get(Query),
    /// Take another tare of this sensor.
    Tare(String),
    /// Set the context that the controller reports of its work.
    Context(Context),
    /// Set some keys of that context.
    Merge(Merge),
    /// Take positions of the arm that the robot reports.
    Motion(Positions),
    /// Write the last minute of this sensor to a file.
    Blackbox(String),
}

/// What a request gets.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Query {
    /// Every sensor's current status.
    Status,
    /// Every sensor's last final verdict.
    Last,
}

/// The events that a subscriber wants, and the policy if it is slow.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Subscription {
    #[serde(rename = "subscribe")]
    pub(crate) kinds: BTreeSet<Kind>,
    #[serde(default)]
    pub(crate) policy: Policy,
    /// The last event that the subscriber had in an earlier connection.
    pub(crate) since: Option<Since>,
}

impl Default for Subscription {
    fn default() -> Self {
        Self {
            kinds: BTreeSet::from([Kind::Hardness, Kind::Press, Kind::Status]),
            policy: Policy::Queue,
            since: None,
        }
    }
}

/// The events that are kept for a subscriber that is slow.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Policy {
    /// Every event. When the queue is full, the oldest is dropped.
    #[default]
    Queue,
    /// The newest event of each kind and sensor.
    Latest,
    /// The newest frame of each sensor, and every other event. This is for viewers, as on
    /// `/events`.
    #[serde(skip)]
    LatestFrames,
}

/// A place in a run: `RUN:SEQ`.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(try_from = "String")]
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

impl TryFrom<String> for Since {
    type Error = String;

    fn try_from(token: String) -> Result<Self, String> {
        Self::parse(&token).ok_or_else(|| unusable("since", &token, "\"RUN:SEQ\""))
    }
}

/// A context as it came. It includes the key `sensor`, and without any other it is none.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(try_from = "Map<String, Value>")]
pub(crate) struct Context {
    pub(crate) sensor: String,
    /// `None` removes the context.
    pub(crate) context: Option<Value>,
}

impl TryFrom<Map<String, Value>> for Context {
    type Error = String;

    fn try_from(fields: Map<String, Value>) -> Result<Self, String> {
        let sensor = fields.get("sensor");
        let Some(Value::String(name)) = sensor else {
            return Err(unusable("sensor", &sensor, "a sensor's name"));
        };
        let (sensor, is_empty) = (name.clone(), fields.len() == 1);
        let context = Value::Object(fields);
        event::check_context(&context)?;
        Ok(Self {
            sensor,
            context: (!is_empty).then_some(context),
        })
    }
}

/// Keys of a context as they came. Those that are null are removed, and all others stay.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(expecting = "an object")]
pub(crate) struct Merge {
    pub(crate) sensor: String,
    #[serde(flatten)]
    pub(crate) keys: Map<String, Value>,
}

/// Reads one line, without its newline. Returns the `id` to echo in the answer, and the request, or the reason
/// the line cannot be used, in words.
pub(crate) fn parse(line: &[u8]) -> (Option<Value>, Result<Request, String>) {
    match serde_json::from_slice::<Map<String, Value>>(line) {
        Ok(mut fields) => (fields.remove("id"), request(fields)),
        Err(error) => (None, Err(format!("found no JSON object ({error})"))),
    }
}

fn request(mut fields: Map<String, Value>) -> Result<Request, String> {
    let mut key = fields
        .keys()
        .next()
        .map_or("request", String::as_str)
        .to_owned();
    // A subscription has its other keys beside `subscribe`, not within it.
    if fields.contains_key("subscribe") {
        key = "subscribe".to_owned();
        fields = Map::from_iter([(key.clone(), Value::Object(fields))]);
    }
    let request = serde_json::from_value(Value::Object(fields));
    request.map_err(|error| {
        let error = wording::cut_found(&error.to_string());
        format!("{}: {error}", wording::cut(&key))
    })
}

/// The message of a value that cannot be used.
pub(crate) fn unusable(key: &str, found: &(impl Serialize + ?Sized), expected: &str) -> String {
    let found = serde_json::to_string(found);
    let found = found.expect("what was read as JSON can be written as JSON");
    format!("{key}: found {}, expected {expected}", wording::cut(&found))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_context_is_kept_as_it_came_and_neither_long_nor_deep() {
        let context = |more: &str| {
            let line = format!(r#"{{"context":{{"sensor":"forearm"{more}}}}}"#);
            match parse(line.as_bytes()).1 {
                Ok(Request::Context(Context { context, .. })) => Ok(context),
                other => Err(other.unwrap_err()),
            }
        };
        assert_eq!(context("").unwrap(), None);
        let expected = serde_json::json!({"sensor": "forearm", "tag": "x"});
        assert_eq!(context(r#","tag":"x""#).unwrap(), Some(expected));
        let around = r#"{"sensor":"forearm","tag":""}"#.len();
        let long = |bytes: usize| context(&format!(r#","tag":"{}""#, "x".repeat(bytes - around)));
        assert!(long(1023).is_ok());
        let error = long(1024).unwrap_err();
        assert!(
            error.ends_with("found 1024 bytes, expected fewer than 1024"),
            "{error}"
        );
        // The context itself is a level.
        let lists = |count| format!("{}{}", "[".repeat(count), "]".repeat(count));
        let deep = |count| context(&format!(r#","at":{}"#, lists(count)));
        assert!(deep(15).is_ok());
        let error = deep(16).unwrap_err();
        assert!(
            error.ends_with("found 17 levels, expected at most 16"),
            "{error}"
        );
    }

    #[test]
    fn an_unusable_line_says_what_was_found_and_echoes_its_id() {
        // The fields of a line, and what is said of them.
        let cases = r#"
            "subscribe":["touch"] | subscribe: unknown variant `touch`
            "subscribe":[],"policy":"all" | `all`, expected `queue` or `latest`
            "subscribe":[],"since":"ab:-7" | since: found "ab:-7", expected "RUN:SEQ"
            "subscribe":[],"sinse":"ab:7" | unknown field `sinse`
            "tare":"a","context":{} | expected map with a single key
            "context":{"tag":"x"} | context: sensor: found null, expected a sensor's name
            "merge":{"tag":"x"} | merge: missing field `sensor`
            "retare":"a" | retare: unknown variant `retare`, expected one of `subscribe`
            "motion":{"sensor":"a"} | motion: missing field `at`"#;
        for case in cases.trim().lines() {
            let (fields, found) = case.trim().split_once(" | ").unwrap();
            let (id, request) = parse(format!(r#"{{{fields},"id":"a"}}"#).as_bytes());
            let message = request.unwrap_err();
            assert!(message.contains(found), "{message}");
            assert_eq!(id, Some(Value::from("a")));
        }
        for line in [&b"{\"get\":"[..], b"[1]", b"{\"id\":1}", b"\xff\xfe", b""] {
            assert!(parse(line).1.is_err());
        }
    }
}
