//! `/api/status`: the present state as one JSON object.

use serde_json::{Value, json};

use crate::daemon::hub::Snapshot;
use hardnessd_core::event::{Event, Reply};

/// An object of `hello` as on a socket, `subscribers`, `sets_context` (whether the page may say what is
/// being pressed), and a list of `sensors`. A sensor has its `status` and `last` (its last final
/// verdict, or null) as on a socket, `last_frame_age_s` (null before the first frame) and the
/// current `contact_threshold_n`.
pub(super) fn json(now: &Snapshot, sets_context: bool) -> String {
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
