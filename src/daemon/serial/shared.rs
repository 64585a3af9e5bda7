//! One port of several sensors: it has one owner, which hands each sensor what is for it.
//!
//! In: a link, and what each sensor wants to be sent. Out: the inputs of the link, to each sensor that they
//! concern. The sensors that ask for their frames take turns: the owner sends a request, and its sensor
//! says when a frame came, or the time for it runs out. Bytes after a request go to the sensor that asked,
//! because the answers of equal modules are alike. A sensor that does not ask gets all bytes.

use std::time::Duration;

use tokio::sync::{mpsc, watch};
use tokio::time::Instant;

use super::{Link, Settings};
use crate::maybe;
use hardnessd_core::pipeline::Input;

/// The most inputs that wait for a sensor. When the queue is full, the owner waits.
const INPUTS: usize = 64;

/// How long an answer may take, beside its bytes on the line: so many times as long as the slowest of late, ...
const TIMES_AS_SLOW: u32 = 8;
/// ... but at least and at most this time, which is also the time for the first answer.
const LEAST_TIMEOUT: Duration = Duration::from_millis(30);
const MOST_TIMEOUT: Duration = Duration::from_millis(100);

/// After a request without an answer, no module that is silent is asked for this time. So silent modules
/// take less than half of the time of the others, however many they are.
const REST: Duration = Duration::from_millis(150);
/// The module itself rests twice as long after each further request without an answer, up to this time. So
/// one that is silent for good takes a twentieth.
const LONGEST_REST: Duration = Duration::from_secs(2);

/// A sensor's share of a port.
#[derive(Debug)]
pub(crate) struct Share {
    index: usize,
    inputs: mpsc::Receiver<Input>,
    /// Tells the owner that a frame of this sensor came.
    frames: mpsc::Sender<usize>,
    /// Changes when the owner has closed the port.
    ended: watch::Receiver<()>,
}

impl Share {
    /// Waits for the next input. Cancelling the wait loses nothing.
    pub(super) async fn next(&mut self) -> Input {
        match self.inputs.recv().await {
            Some(input) => input,
            // The owner ends after its sensors.
            None => std::future::pending().await,
        }
    }

    /// Records that frames come.
    pub(super) fn proven(&self) {
        // The owner notices the next one.
        let _ = self.frames.try_send(self.index);
    }

    /// Gives the share back. The port is closed when all have done so, and then this returns.
    pub(super) async fn close(self) {
        let mut ended = self.ended;
        drop((self.inputs, self.frames));
        let _ = ended.changed().await;
    }
}

/// A request, and the sensors that read its answer.
#[derive(Debug)]
struct Ask {
    request: Vec<u8>,
    every: Duration,
    members: Vec<usize>,
    due: Instant,
    /// How long the bytes of the answer take at least.
    on_the_line: Duration,
    /// How long an answer took of late.
    slowest: Option<Duration>,
    /// The last rest, if the last request had no answer.
    rest: Option<Duration>,
}

/// Who is asked, and until when the answer may come.
#[derive(Debug, Clone, Copy)]
struct Asking {
    ask: usize,
    since: Instant,
    until: Instant,
}

/// The owner of a port.
#[derive(Debug)]
struct Owner {
    link: Link,
    members: Vec<mpsc::Sender<Input>>,
    asks: Vec<Ask>,
    /// The members that do not ask.
    listeners: Vec<usize>,
    asking: Option<Asking>,
    /// The last one that was asked, for bytes that come late.
    last: Option<usize>,
    is_open: bool,
    /// From then on a silent module may be asked.
    may_try: Instant,
}

/// Shares `link` among sensors with these settings. The owner runs until all shares are given back.
pub(super) fn share(link: Link, settings: &[Settings]) -> Vec<Share> {
    let (frames, frames_in) = mpsc::channel(INPUTS);
    let (ending, ended) = watch::channel(());
    let (members, inputs): (Vec<_>, Vec<_>) =
        settings.iter().map(|_| mpsc::channel(INPUTS)).unzip();
    let owner = Owner::new(link, members, settings, Instant::now());
    tokio::spawn(async move {
        owner.serve(frames_in).await;
        drop(ending);
    });
    let shares = inputs.into_iter().enumerate();
    shares
        .map(|(index, inputs)| Share {
            index,
            inputs,
            frames: frames.clone(),
            ended: ended.clone(),
        })
        .collect()
}

impl Owner {
    fn new(
        link: Link,
        members: Vec<mpsc::Sender<Input>>,
        settings: &[Settings],
        now: Instant,
    ) -> Self {
        let mut asks: Vec<Ask> = Vec::new();
        let mut listeners = Vec::new();
        for (index, settings) in settings.iter().enumerate() {
            let Some((request, every)) = &settings.request else {
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
                    on_the_line: settings.on_the_line,
                    slowest: None,
                    rest: None,
                }),
            }
        }
        Self {
            link,
            members,
            asks,
            listeners,
            asking: None,
            last: None,
            is_open: false,
            may_try: now,
        }
    }

    async fn serve(mut self, mut frames: mpsc::Receiver<usize>) {
        loop {
            let due = self.due();
            let input = tokio::select! {
                input = self.link.next() => input,
                frame = frames.recv() => {
                    let Some(member) = frame else {
                        return;
                    };
                    self.link.proven();
                    self.answered(member, Instant::now());
                    continue;
                }
                () = maybe::until(due) => {
                    self.ask(Instant::now());
                    continue;
                }
            };
            if !matches!(input, Input::Bytes(_) | Input::Skipped(_)) {
                self.is_open = matches!(input, Input::Opened);
                self.asking = None;
            }
            for member in self.audience(&input) {
                // A sensor that has ended takes nothing.
                let _ = self.members[member].send(input.clone()).await;
            }
            // A sensor that never pauses leaves the others their turns.
            tokio::task::yield_now().await;
        }
    }

    /// The members that something concerns.
    fn audience(&self, input: &Input) -> Vec<usize> {
        let Some(asked) = self.last.filter(|_| matches!(input, Input::Bytes(_))) else {
            return (0..self.members.len()).collect();
        };
        [self.asks[asked].members.as_slice(), &self.listeners].concat()
    }

    /// When there is something to do.
    fn due(&self) -> Option<Instant> {
        let due = |ask: &Ask| match ask.rest {
            Some(_) => ask.due.max(self.may_try),
            None => ask.due,
        };
        match self.asking {
            _ if !self.is_open => None,
            Some(asking) => Some(asking.until),
            None => self.asks.iter().map(due).min(),
        }
    }

    /// A frame of a member came.
    fn answered(&mut self, member: usize, now: Instant) {
        let mut asks = self.asks.iter_mut().enumerate();
        let Some((index, ask)) = asks.find(|(_, ask)| ask.members.contains(&member)) else {
            return;
        };
        // Whoever sends is not silent, even if it is late.
        if ask.rest.take().is_some() {
            ask.due = now;
        }
        if let Some(asking) = self.asking.filter(|asking| asking.ask == index) {
            let took = now.saturating_duration_since(asking.since);
            ask.slowest = Some(ask.slowest.unwrap_or_default().mul_f64(0.95).max(took));
            self.asking = None;
        }
    }

    /// Ends the wait for an answer, or asks the next one.
    fn ask(&mut self, now: Instant) {
        if let Some(asking) = self.asking.take() {
            let ask = &mut self.asks[asking.ask];
            let rest = ask.rest.map_or(REST, |rest| LONGEST_REST.min(2 * rest));
            ask.rest = Some(rest);
            ask.due = now + rest;
            self.may_try = now + REST;
        }
        let may_try = self.may_try <= now;
        let asks = self.asks.iter_mut().enumerate();
        let next = asks
            .filter(|(_, ask)| ask.due <= now && (may_try || ask.rest.is_none()))
            .min_by_key(|(_, ask)| ask.due);
        let Some((index, ask)) = next else {
            return;
        };
        self.link.request(&ask.request);
        ask.due = (ask.due + ask.every).max(now);
        let usual = ask.slowest.map(|slowest| slowest * TIMES_AS_SLOW);
        let timeout = usual.unwrap_or(MOST_TIMEOUT);
        let timeout = ask.on_the_line + timeout.clamp(LEAST_TIMEOUT, MOST_TIMEOUT);
        self.last = Some(index);
        self.asking = Some(Asking {
            ask: index,
            since: now,
            until: now + timeout,
        });
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
            described.sensor.frame_rate_hz = 50.0;
            described.sensor.port = "tcp://localhost:1".parse().unwrap();
            Settings {
                request: Some((request.to_vec(), Duration::from_millis(20))),
                ..Settings::of(&Sensor::new(described).unwrap())
            }
        };
        let both = [settings(b"1"), settings(b"2")];
        let begin = Instant::now();
        let port = "tcp://localhost:1".parse().unwrap();
        let link = Link::new(&port, 115_200, both[0].clone());
        let (member, _inputs) = mpsc::channel(INPUTS);
        let mut owner = Owner::new(link, vec![member.clone(), member], &both, begin);
        owner.is_open = true;
        // The first module answers within 2 ms. The second one is silent, and answers once at the end.
        let (mut answers, mut now) = (0, begin);
        while now < begin + Duration::from_secs(30) {
            now = now.max(owner.due().unwrap());
            owner.ask(now);
            if owner.asking.is_some_and(|asking| asking.ask == 0) {
                now += Duration::from_millis(2);
                owner.answered(0, now);
                answers += 1;
            }
        }
        assert!((1400..=1500).contains(&answers), "{answers}");
        owner.answered(1, now);
        assert!(owner.asks[1].rest.is_none() && owner.asks[1].due <= now);
    }
}
