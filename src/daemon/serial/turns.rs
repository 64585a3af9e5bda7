//! Who is asked next at a port: sensors that send a frame only when they are asked take turns.
//!
//! Bytes after a request go to the sensors that asked, because the answers of equal modules are alike. The
//! next one is asked when a frame came or the time for it is over. A sensor that is alone is asked at its own
//! pace, whether it answers or not. This has no clock.

use std::time::Duration;

use tokio::time::Instant;

use super::Settings;

/// How long an answer may take, beside its bytes on the line.
const MOST_TIMEOUT: Duration = Duration::from_millis(100);

/// After a request without an answer, no module that is silent is asked for this time. So silent modules
/// take less than half of the time of the others, however many they are.
const REST: Duration = Duration::from_millis(150);
/// The module itself rests twice as long after each further request without an answer, up to this time. So
/// one that is silent for good takes a twentieth.
const LONGEST_REST: Duration = Duration::from_secs(2);

/// A request, and the sensors that read its answer.
#[derive(Debug)]
struct Ask {
    request: Vec<u8>,
    every: Duration,
    members: Vec<usize>,
    due: Instant,
    timeout: Duration,
    /// The last rest, if the last request had no answer.
    rest: Option<Duration>,
}

/// The requests of the sensors at a port.
#[derive(Debug)]
pub(super) struct Turns {
    asks: Vec<Ask>,
    /// All sensors at the port, and those that do not ask.
    members: Vec<usize>,
    listeners: Vec<usize>,
    /// Who is asked, and until when the answer may come.
    asking: Option<(usize, Instant)>,
    /// The last one that was asked, for bytes that come late.
    last: Option<usize>,
    /// From then on a silent module may be asked.
    may_try: Instant,
}

impl Turns {
    pub(super) fn new(sensors: &[Settings], now: Instant) -> Self {
        let mut asks: Vec<Ask> = Vec::new();
        let mut listeners = Vec::new();
        for (index, sensor) in sensors.iter().enumerate() {
            let Some((request, every)) = &sensor.request else {
                listeners.push(index);
                continue;
            };
            match asks.iter_mut().find(|ask| ask.request == *request) {
                Some(ask) => {
                    ask.every = ask.every.min(*every);
                    ask.members.push(index);
                }
                None => asks.push(Ask {
                    request: request.clone(),
                    every: *every,
                    members: vec![index],
                    due: now,
                    timeout: sensor.on_the_line + MOST_TIMEOUT,
                    rest: None,
                }),
            }
        }
        Self {
            asks,
            members: (0..sensors.len()).collect(),
            listeners,
            asking: None,
            last: None,
            may_try: now,
        }
    }

    /// The port was opened: all are asked anew.
    pub(super) fn begin(&mut self, now: Instant) {
        self.asking = None;
        self.asks.iter_mut().for_each(|ask| ask.due = now);
    }

    /// The sensors that bytes are for.
    pub(super) fn audience(&self) -> Vec<usize> {
        match self.last {
            Some(asked) => [self.asks[asked].members.as_slice(), &self.listeners].concat(),
            None => self.members.clone(),
        }
    }

    /// When there is something to do.
    pub(super) fn due(&self) -> Option<Instant> {
        let due = |ask: &Ask| match ask.rest {
            Some(_) => ask.due.max(self.may_try),
            None => ask.due,
        };
        match self.asking {
            Some((_, until)) => Some(until),
            None => self.asks.iter().map(due).min(),
        }
    }

    /// A frame of a sensor came.
    pub(super) fn answered(&mut self, sensor: usize, now: Instant) {
        let mut asks = self.asks.iter_mut().enumerate();
        let Some((index, ask)) = asks.find(|(_, ask)| ask.members.contains(&sensor)) else {
            return;
        };
        // Whoever sends is not silent, even if it is late.
        if ask.rest.take().is_some() {
            ask.due = now;
        }
        self.asking = self.asking.filter(|(asked, _)| *asked != index);
    }

    /// Ends the wait for an answer, and returns the next request, if one is due.
    pub(super) fn ask(&mut self, now: Instant) -> Option<&[u8]> {
        if let Some((silent, _)) = self.asking.take() {
            let ask = &mut self.asks[silent];
            let rest = ask.rest.map_or(REST, |rest| LONGEST_REST.min(2 * rest));
            ask.rest = Some(rest);
            ask.due = now + rest;
            self.may_try = now + REST;
        }
        let (may_try, is_alone) = (self.may_try <= now, self.asks.len() == 1);
        let asks = self.asks.iter_mut().enumerate();
        let (index, ask) = asks
            .filter(|(_, ask)| ask.due <= now && (may_try || ask.rest.is_none()))
            .min_by_key(|(_, ask)| ask.due)?;
        ask.due = (ask.due + ask.every).max(now);
        self.last = Some(index);
        self.asking = (!is_alone).then_some((index, now + ask.timeout));
        Some(&ask.request)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hardnessd_core::sensor::{Description, Sensor};

    #[test]
    fn a_module_that_is_silent_for_good_takes_a_twentieth_of_the_others_time() {
        let settings = |request: &[u8]| {
            let mut described = Description::default();
            described.sensor.port = "tcp://localhost:1".parse().unwrap();
            Settings {
                request: Some((request.to_vec(), Duration::from_millis(20))),
                ..Settings::of(&Sensor::new(described).unwrap())
            }
        };
        let begin = Instant::now();
        let mut turns = Turns::new(&[settings(b"1"), settings(b"2")], begin);
        // The first module answers within 2 ms. The second one is silent, and answers once at the end.
        let (mut answers, mut now) = (0, begin);
        while now < begin + Duration::from_secs(30) {
            now = now.max(turns.due().unwrap());
            if turns.ask(now) == Some(b"1") {
                now += Duration::from_millis(2);
                turns.answered(0, now);
                answers += 1;
            }
        }
        assert!((1400..=1500).contains(&answers), "{answers}");
        turns.answered(1, now);
        assert!(turns.asks[1].rest.is_none() && turns.asks[1].due <= now);
    }
}
