//! `/api/status`: all that is true now, as one JSON object.

use serde_json::{Value, json};

use crate::daemon::hub::Survey;
use crate::daemon::sensor::Vitals;
use crate::event::{Event, Reply};

/// `hello` and, by sensor, `status` and `last` (its last final verdict, or null) as on a socket;
/// beside them `last_frame_age_s` (null before the first frame) and the `contact_threshold_n` in
/// force; and `subscribers`.
pub(super) fn json(survey: &Survey, vitals: &[Vitals]) -> String {
    let read = |line: &str| -> Value {
        serde_json::from_str(line).expect("what was written as JSON can be read as JSON")
    };
    let sensors: Vec<Value> = vitals
        .iter()
        .map(|vitals| {
            let last = survey.finals.get(&vitals.status.sensor);
            json!({
                "status": read(&Event::Status(vitals.status.clone()).to_line()),
                "last_frame_age_s": vitals.last_frame_age.map(|age| age.as_secs_f64()),
                // As it stands in the configuration: the digits of an f32, not those of an f64.
                "contact_threshold_n": read(&vitals.contact_threshold_n.to_string()),
                "last": last.map(|line| read(&line.json)),
            })
        })
        .collect();
    json!({
        "hello": read(&Reply::Hello(survey.hello.clone()).to_line()),
        "sensors": sensors,
        "subscribers": survey.subscribers,
    })
    .to_string()
}
