//! `/api/status`: the present state as one JSON object.

use std::path::Path;

use serde_json::{Value, json};

use crate::daemon::hub::Survey;
use crate::daemon::realtime::Standing;
use crate::daemon::sensor::Vitals;
use hardnessd_core::event::{Event, Reply};

/// An object of `hello` as on a socket, `subscribers`, `process` (how the kernel runs the daemon,
/// [`Standing`]), and a list of `sensors`. A sensor has its `status` and `last` (its last final
/// verdict, or null) as on a socket, `last_frame_age_s` (null before the first frame) and the
/// current `contact_threshold_n`.
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
                // The threshold is written with the digits of the configuration, which are those of
                // an f32.
                "contact_threshold_n": read(&vitals.contact_threshold_n.to_string()),
                "last": last.map(|line| read(&line.json)),
            })
        })
        .collect();
    json!({
        "hello": read(&Reply::Hello(survey.hello.clone()).to_line()),
        "sensors": sensors,
        "subscribers": survey.subscribers,
        "process": Standing::of(Path::new("/proc/self")),
    })
    .to_string()
}
