//! Writes entries and events as the bytes of an MCAP file.

use std::collections::BTreeMap;
use std::io::Write;

use mcap::records::{MessageHeader, Metadata};
use mcap::write::NoSeek;
use mcap::{Compression, WriteOptions};

use super::message::{self, TOPICS};
use super::{Entry, Error, Labels, RecordedSensor};
use crate::event::Event;
use crate::frame::Stamp;
use crate::ros::{self, Topic};

/// The description of a recording, for people. A replay reads only the [`super::State`]s.
#[derive(Debug, Clone, PartialEq)]
pub struct About {
    /// The name of the robot.
    pub robot: String,
    /// The token of this start of the daemon, as in `hello`.
    pub run: String,
    /// The kernel's boot id. Moments of CLOCK_MONOTONIC can only be compared within one boot.
    pub boot_id: String,
    /// The fault or request for which a black box was written. `None` for an ordinary recording.
    pub reason: Option<String>,
    /// The notes of the user, for example on the pressed object.
    pub labels: Labels,
    /// The sensors, in the order of their channels.
    pub sensors: Vec<RecordedSensor>,
}

/// Writes one recording.
///
/// # Example
///
/// ```
/// use std::time::Duration;
///
/// use hardnessd_core::frame::Stamp;
/// use hardnessd_core::pipeline::Input;
/// use hardnessd_core::recording::{About, Entry, Labels, Reader, RecordedSensor, Writer};
/// use hardnessd_core::sensor::{Description, Sensor};
/// use hardnessd_core::verdict::{BUILT_IN_HRN, Model};
///
/// let sensor = Sensor::new(Description::default())?;
/// let about = About {
///     robot: "arm-7".to_owned(),
///     run: "1".to_owned(),
///     boot_id: String::new(),
///     reason: None,
///     labels: Labels::new(),
///     sensors: vec![RecordedSensor::new(&sensor, &Model::load(BUILT_IN_HRN)?)],
/// };
/// let at = Stamp {
///     mono: Duration::from_secs(1),
///     wall: jiff::Timestamp::UNIX_EPOCH,
/// };
/// let mut writer = Writer::new(Vec::new(), &about)?;
/// writer.entry(0, at, &Entry::Input(Input::Opened))?;
/// let file = writer.finish()?;
///
/// let found = Reader::new(&file[..]).collect::<Result<Vec<_>, _>>()?;
/// assert_eq!(found.len(), 1);
/// assert_eq!(found[0].entry, Entry::Input(Input::Opened));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Writer<W: Write> {
    out: mcap::Writer<NoSeek<W>>,
    sensors: Vec<RecordedSensor>,
    sequence: u32,
}

/// The options of every recording. It is written in whole chunks, so a file that is cut off has
/// whole chunks up to the cut.
pub(super) fn options() -> WriteOptions {
    WriteOptions::new()
        .profile("ros2")
        .library(concat!("hardnessd ", env!("CARGO_PKG_VERSION")))
        .compression(Some(Compression::Zstd))
        .compression_threads(0)
        .disable_seeking(true)
}

/// The number of a channel. It follows from the sensor's index and the topic, so `recover` knows it
/// even if the record of the channel is lost.
pub(super) fn channel_id(sensor: usize, topic: Topic) -> u16 {
    let id = sensor * TOPICS.len() + usize::from(schema_id(topic));
    u16::try_from(id).expect("a daemon has few sensors")
}

/// The topic of the channel with this number.
pub(super) fn topic_of(channel_id: u16) -> Topic {
    TOPICS[usize::from(channel_id.wrapping_sub(1)) % TOPICS.len()]
}

/// The number of a topic's schema.
pub(super) fn schema_id(topic: Topic) -> u16 {
    let place = TOPICS.iter().position(|known| *known == topic);
    place.expect("every topic of a sensor is in TOPICS") as u16 + 1
}

impl<W: Write> Writer<W> {
    /// Begins a recording.
    ///
    /// # Errors
    ///
    /// Returns an error if `out` cannot be written.
    pub fn new(out: W, about: &About) -> Result<Self, Error> {
        let mut out = options().create(NoSeek::new(out))?;
        let text = |key: &str, value: &str| (key.to_owned(), value.to_owned());
        let mut recording = BTreeMap::from([
            text("robot", &about.robot),
            text("run", &about.run),
            text("boot_id", &about.boot_id),
            text("version", env!("CARGO_PKG_VERSION")),
        ]);
        recording.extend(about.reason.iter().map(|reason| text("reason", reason)));
        let mut metadata = vec![("hardnessd.recording", recording)];
        if !about.labels.is_empty() {
            metadata.push(("hardnessd.labels", about.labels.clone()));
        }
        for sensor in &about.sensors {
            let settings = serde_json::to_string(sensor)
                .expect("plain structs of numbers and strings always serialise");
            let sensor = BTreeMap::from([
                text("name", sensor.name()),
                text("model", &sensor.model_sha256),
                text("settings", &settings),
            ]);
            metadata.push(("hardnessd.sensor", sensor));
        }
        for (name, metadata) in metadata {
            let name = name.to_owned();
            out.write_metadata(&Metadata { name, metadata })?;
        }
        for topic in TOPICS {
            let text = topic.text();
            out.add_schema_with_id(schema_id(topic), topic.schema, "ros2msg", text.as_bytes())?;
        }
        for (index, sensor) in about.sensors.iter().enumerate() {
            for topic in TOPICS {
                let name = topic.of(sensor.name());
                let id = channel_id(index, topic);
                out.add_channel_with_id(id, schema_id(topic), &name, "cdr", &BTreeMap::new())?;
            }
        }
        out.flush()?;
        Ok(Self {
            out,
            sensors: about.sensors.clone(),
            sequence: 0,
        })
    }

    /// Adds an entry of the `sensor`-th sensor.
    ///
    /// # Errors
    ///
    /// Returns an error if the entry cannot be written. The writer must not be used after that.
    pub fn entry(&mut self, sensor: usize, at: Stamp, entry: &Entry) -> Result<(), Error> {
        if let Entry::State(state) = entry {
            self.sensors[sensor].clone_from(&state.sensor);
        }
        let bytes = message::encode_entry(self.sensors[sensor].name(), at, entry);
        let topic = message::topic_of(entry);
        self.write(channel_id(sensor, topic), at.wall, &bytes)
    }

    /// Adds an event. An event of a sensor that is not in the recording is left out.
    ///
    /// # Errors
    ///
    /// Returns an error if the event cannot be written. The writer must not be used after that.
    pub fn event(&mut self, event: &Event) -> Result<(), Error> {
        let mut sensors = self.sensors.iter();
        let Some(sensor) = sensors.position(|sensor| sensor.name() == event.sensor()) else {
            return Ok(());
        };
        for (topic, time, bytes) in ros::encode_all(event) {
            self.write(channel_id(sensor, topic), time, &bytes)?;
        }
        Ok(())
    }

    fn write(&mut self, channel_id: u16, time: jiff::Timestamp, data: &[u8]) -> Result<(), Error> {
        let log_time = u64::try_from(time.as_nanosecond()).unwrap_or(0);
        let header = MessageHeader {
            channel_id,
            sequence: self.sequence,
            log_time,
            publish_time: log_time,
        };
        self.sequence = self.sequence.wrapping_add(1);
        Ok(self.out.write_to_known_channel(&header, data)?)
    }

    /// Ends the current chunk and writes it. If the process dies, only later entries are lost.
    ///
    /// # Errors
    ///
    /// Returns an error if the chunk cannot be written. The writer must not be used after that.
    pub fn flush(&mut self) -> Result<(), Error> {
        Ok(self.out.flush()?)
    }

    /// Ends the recording and returns the `out` of [`Self::new`].
    ///
    /// # Errors
    ///
    /// Returns an error if the end cannot be written.
    pub fn finish(mut self) -> Result<W, Error> {
        self.out.finish()?;
        let mut inner = self.out.into_inner().into_inner();
        inner.flush()?;
        Ok(inner)
    }
}
