//! All that happens to a pipeline: the alphabet of live operation, of recordings and of replays.

use serde_json::Value;

use super::Pipeline;
use crate::event::Event;
use crate::frame::Stamp;
use crate::motion::{Point, StepBack};
use crate::press::End;
use crate::tare::RetareError;

/// One thing that happens to a pipeline. Nothing else changes what a pipeline does.
///
/// # Example
///
/// The port is opened, and then lost.
///
/// ```
/// use std::sync::Arc;
/// use std::time::Duration;
///
/// use hardnessd_core::event::{Event, LinkState};
/// use hardnessd_core::frame::Stamp;
/// use hardnessd_core::pipeline::{Clock, Input, Pipeline};
/// use hardnessd_core::sensor::{Description, Sensor};
/// use hardnessd_core::verdict::{BUILT_IN_HRN, Model};
///
/// let sensor = Sensor::new(Description::default())?;
/// let mut pipeline = Pipeline::new(sensor, Arc::new(Model::load(BUILT_IN_HRN)?), Clock::Arrival);
/// let at = Stamp {
///     mono: Duration::from_secs(1),
///     wall: jiff::Timestamp::UNIX_EPOCH,
/// };
/// assert!(pipeline.take(Input::Opened, at)?.is_empty());
/// let events = pipeline.take(Input::Lost("unplugged".into()), at)?;
/// assert!(matches!(&events[..], [Event::Status(status)] if status.state == LinkState::Lost));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub enum Input {
    /// The port is open.
    Opened,
    /// The port could not be opened, for this reason.
    Unavailable(String),
    /// Bytes came.
    Bytes(Vec<u8>),
    /// This many bytes came that were too many to be read. The next bytes do not continue the earlier
    /// ones.
    Skipped(u64),
    /// Time has passed.
    Tick,
    /// The device is gone, for this reason.
    Lost(String),
    /// A tare was requested.
    Tare,
    /// The controller's context.
    Context(Option<Value>),
    /// Positions of the arm from the robot.
    Motion(Vec<Point>),
    /// The daemon stops.
    Shutdown,
}

/// An input that was not taken as it came. It has no events.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum Refused {
    /// No tare can be taken now. Nothing has changed.
    #[error(transparent)]
    Tare(#[from] RetareError),
    /// A position was not later than the one before it. All positions were taken nevertheless.
    #[error(transparent)]
    Motion(#[from] StepBack),
}

impl Pipeline {
    /// Takes an input that came at `at`, and returns its events. The outcome of a tare follows in
    /// [`Pipeline::retared`]. Positions are finite.
    ///
    /// # Errors
    ///
    /// Returns [`Refused`] for a tare that cannot be taken and for positions that step back in time.
    pub fn take(&mut self, input: Input, at: Stamp) -> Result<Vec<Event>, Refused> {
        let mut events = Vec::new();
        match input {
            Input::Opened => events.extend(self.opened(at)),
            // A changed reason is a status, also of a sensor that is lost.
            Input::Unavailable(reason) => {
                self.link.unavailable(reason);
                events.extend(self.status_if_changed(at));
            }
            Input::Bytes(bytes) => events = self.push(&bytes, at),
            Input::Skipped(bytes) => events = self.skip(bytes, at),
            Input::Tick => events = self.tick(at),
            Input::Lost(reason) => events = self.lost(reason, at),
            Input::Shutdown => self.abort(End::Shutdown, &mut events),
            Input::Tare => self.retare()?,
            Input::Context(context) => self.judge.context = context,
            Input::Motion(points) => self.judge.track.push(&points)?,
        }
        Ok(events)
    }
}
