//! Who is asked next at a port: sensors that send a frame only when they are asked take turns.
//!
//! Bytes after a request go to the sensors that asked, because the answers of equal modules are alike. The
//! next one is asked when their frames came or the time for it is over. After a request without an answer, all
//! others have their turn, those first that are far from it: modules beside each other go silent together. A
//! sensor that is alone is asked at its own pace, whether it answers or not. This has no clock.

use std::cmp::Reverse;
use std::time::Duration;

use tokio::time::Instant;

use super::Settings;

/// How long an answer may take, beside its bytes on the line. It is also at most a third of the shortest stale time, so
/// that a module that is silent makes no other one stale.
const MOST_TIMEOUT: Duration = Duration::from_millis(100);

/// After a request without an answer, no module that is silent is asked for this share of the time in which
/// the answer may come. So silent modules take less than half of the time of the others, however many they are.
const REST: f64 = 1.5;
/// The module itself rests twice as long after each further request without an answer, up to this share. So
/// one that is silent for good takes a twentieth.
const LONGEST_REST: f64 = 20.0;

/// A request, whose answer is for the sensors that have it.
#[derive(Debug)]
struct Ask {
    request: Vec<u8>,
    every: Duration,
    due: Instant,
    timeout: Duration,
    /// When it was asked last.
    asked: Option<Instant>,
    /// Whether a frame came since the port was opened.
    is_heard: bool,
    /// The last rest, if the last request had no answer.
    rest: Option<Duration>,
}

/// The requests of the sensors at a port.
#[derive(Debug)]
pub(super) struct Turns {
    asks: Vec<Ask>,
    /// The request of each sensor, if it has one.
    of_sensors: Vec<Option<usize>>,
    /// Who is asked, and until when the answer may come.
    asking: Option<(usize, Instant)>,
    /// The sensors whose frame of the answer has not come.
    missing: Vec<usize>,
    /// Of each sensor without a frame in the last answer to its request: for how long, and until when, the port
    /// does not wait for it.
    absent: Vec<Option<(Duration, Instant)>>,
    /// The last one that was asked, for bytes that come late.
    last: Option<usize>,
    /// The last request without an answer, and when the time for it was over.
    failed: Option<(usize, Instant)>,
    /// From then on a silent module may be asked or waited for.
    may_try: Instant,
}

impl Turns {
    pub(super) fn new(sensors: &[Settings], now: Instant) -> Self {
        let mut asks: Vec<Ask> = Vec::new();
        let thirds = sensors.iter().map(|sensor| sensor.stale_after / 3);
        let most_timeout = thirds.fold(MOST_TIMEOUT, Duration::min);
        let mut of = |sensor: &Settings| {
            let (request, every) = sensor.request.as_ref()?;
            let timeout = sensor.on_the_line + most_timeout;
            let known = asks.iter().position(|ask| ask.request == *request);
            if let Some(ask) = known.map(|index| &mut asks[index]) {
                ask.every = ask.every.min(*every);
                ask.timeout += sensor.on_the_line;
            } else {
                asks.push(Ask {
                    request: request.clone(),
                    every: *every,
                    due: now,
                    timeout,
                    asked: None,
                    is_heard: false,
                    rest: None,
                });
            }
            Some(known.unwrap_or(asks.len() - 1))
        };
        Self {
            of_sensors: sensors.iter().map(&mut of).collect(),
            asks,
            asking: None,
            missing: Vec::new(),
            absent: vec![Some((Duration::ZERO, now)); sensors.len()],
            last: None,
            failed: None,
            may_try: now,
        }
    }

    /// The port was opened: all are asked anew.
    pub(super) fn begin(&mut self, now: Instant) {
        (self.asking, self.last) = (None, None);
        for ask in &mut self.asks {
            (ask.due, ask.is_heard) = (now, false);
        }
        self.absent.fill(Some((Duration::ZERO, now)));
    }

    /// Whether bytes are for this sensor: it was asked last, or it sends by itself.
    pub(super) fn hears(&self, sensor: usize) -> bool {
        let own = self.of_sensors[sensor];
        own.is_none() || self.last.is_none() || own == self.last
    }

    /// The sensors that share a request.
    fn sharing(&self, request: usize) -> impl Iterator<Item = usize> {
        let of_sensors = self.of_sensors.iter().enumerate();
        let sharing = of_sensors.filter(move |(_, of)| **of == Some(request));
        sharing.map(|(sensor, _)| sensor)
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
        let Some(index) = self.of_sensors[sensor] else {
            return;
        };
        self.asks[index].is_heard = true;
        // Whoever sends is not silent, even if it is late.
        if self.asks[index].rest.take().is_some() {
            self.asks[index].due = now;
        }
        self.absent[sensor] = None;
        self.missing.retain(|&missing| missing != sensor);
        let is_past = |moment: Instant| Some(moment) <= self.asks[index].asked;
        let is_awaited = |&sensor: &usize| {
            let absent = self.absent[sensor];
            absent.is_none_or(|(_, until)| is_past(until) && is_past(self.may_try))
        };
        let is_whole = !self.missing.iter().any(is_awaited);
        self.asking = self
            .asking
            .filter(|(asked, _)| *asked != index || !is_whole);
    }

    /// Ends the wait for an answer, and returns the next request, if one is due.
    pub(super) fn ask(&mut self, now: Instant) -> Option<&[u8]> {
        if let Some((asked, _)) = self.asking.take() {
            let timeout = self.asks[asked].timeout;
            let [least, most] = [REST, LONGEST_REST].map(|share| timeout.mul_f64(share));
            let longer = |rest: Option<Duration>| (2 * rest.unwrap_or_default()).clamp(least, most);
            if self.missing.len() == self.sharing(asked).count() {
                let ask = &mut self.asks[asked];
                let rest = longer(ask.rest);
                (ask.rest, ask.due) = (Some(rest), now + rest);
            } else {
                for &sensor in &self.missing {
                    let absent = &mut self.absent[sensor];
                    let rest = longer(absent.map(|(rest, _)| rest));
                    *absent = Some((rest, now + rest));
                }
            }
            self.may_try = now + least;
            self.failed = Some((asked, now));
        }
        let (may_try, is_alone) = (self.may_try <= now, self.asks.len() == 1);
        let (failed, failed_at) = self.failed.unzip();
        let most = self.asks.len();
        let apart = |index: usize| {
            let apart = index.abs_diff(failed.unwrap_or(index));
            apart.min(most - apart)
        };
        let asks = self.asks.iter_mut().enumerate();
        let (index, ask) = asks
            .filter(|(_, ask)| ask.due <= now && (may_try || ask.rest.is_none()))
            .min_by_key(|(index, ask)| match ask.asked < failed_at {
                true if ask.rest.is_none() => {
                    (false, !ask.is_heard, Reverse(apart(*index)), ask.due)
                }
                _ => (true, false, Reverse(0), ask.due),
            })?;
        ask.asked = Some(now);
        ask.due = (ask.due + ask.every).max(now);
        self.last = Some(index);
        self.asking = (!is_alone).then_some((index, now + ask.timeout));
        self.missing = self.sharing(index).collect();
        Some(&self.asks[index].request)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hardnessd_core::tests::support::sensor_of;

    fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    /// A sensor of 50 frames a second, at a port whose line takes no time.
    fn settings(request: &[u8]) -> Settings {
        let sensor = sensor_of(|described| {
            described.sensor.port = "tcp://localhost:1".parse().unwrap();
        });
        Settings {
            request: Some((request.to_vec(), Duration::from_millis(20))),
            stale_after: Duration::from_millis(150),
            ..Settings::of(&sensor)
        }
    }

    /// The longest time between two answers of one of the first `speaking` of `modules`, which take so long for an
    /// answer. The others never answer, or not after `silent_after`.
    fn longest_gap(
        modules: usize,
        speaking: usize,
        answer: Duration,
        silent_after: Duration,
    ) -> Duration {
        let all: Vec<Settings> = (0..modules)
            .map(|module| settings(&[module as u8]))
            .collect();
        let begin = Instant::now();
        let mut turns = Turns::new(&all, begin);
        let (mut now, mut last, mut longest) = (begin, vec![begin; speaking], Duration::ZERO);
        while now < begin + Duration::from_secs(10) {
            now = now.max(turns.due().unwrap());
            let Some(asked) = turns.ask(now).map(|request| usize::from(request[0])) else {
                continue;
            };
            if asked < speaking || now < begin + silent_after {
                now += answer;
                turns.answered(asked, now);
            }
            if let Some(last) = last.get_mut(asked) {
                longest = longest.max(now - *last);
                *last = now;
            }
        }
        longest
    }

    #[test]
    fn silent_modules_make_no_other_one_stale() {
        for (modules, speaking, answer, silent_after) in [
            (3, 2, ms(30), ms(0)),
            (4, 1, ms(1), ms(0)),
            (6, 2, ms(1), ms(0)),
            (17, 14, ms(1), ms(3000)),
            (17, 14, ms(1), ms(3010)),
            (17, 12, ms(3), ms(0)),
            (17, 1, ms(1), ms(0)),
        ] {
            let longest = longest_gap(modules, speaking, answer, silent_after);
            assert!(longest < ms(150), "{speaking} of {modules}: {longest:?}");
        }
    }

    #[test]
    fn sensors_that_share_a_request_have_their_frames_of_its_answer() {
        let begin = Instant::now();
        let mut turns = Turns::new(&[settings(b"1"), settings(b"1"), settings(b"2")], begin);
        assert_eq!(turns.ask(begin), Some(&b"1"[..]));
        turns.answered(0, begin);
        assert!(turns.due().unwrap() > begin + ms(30));
        assert!(turns.hears(1) && !turns.hears(2));
        turns.answered(1, begin + ms(30));
        assert_eq!(turns.ask(begin + ms(30)), Some(&b"2"[..]));
    }

    #[test]
    fn sensors_that_are_silent_beside_others_make_none_stale() {
        let begin = Instant::now();
        // Four requests, each of two sensors. The second ones were never there, or come 30 ms after the first ones.
        for is_there in [false, true] {
            let all: Vec<Settings> = (0..8).map(|sensor| settings(&[sensor / 2])).collect();
            let mut turns = Turns::new(&all, begin);
            let (mut now, mut last, mut longest) = (begin, [begin; 8], Duration::ZERO);
            let mut hear = |turns: &mut Turns, sensor: usize, now: Instant| {
                turns.answered(sensor, now);
                longest = longest.max(now - std::mem::replace(&mut last[sensor], now));
            };
            while now < begin + Duration::from_secs(4) {
                now = now.max(turns.due().unwrap());
                let Some(asked) = turns.ask(now).map(|request| usize::from(request[0])) else {
                    continue;
                };
                now += ms(1);
                hear(&mut turns, 2 * asked, now);
                if is_there && turns.due().is_some_and(|due| due >= now + ms(30)) {
                    now += ms(30);
                    hear(&mut turns, 2 * asked + 1, now);
                }
            }
            assert!(longest < ms(150), "{is_there}: {longest:?}");
        }
    }

    #[test]
    fn a_module_that_is_silent_for_good_takes_a_twentieth_of_the_others_time() {
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
