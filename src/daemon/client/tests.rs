use serde_json::Value;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, BufReader};

use super::*;
use crate::daemon::hub::tests::{hello, live, press};
use crate::daemon::record::EventRecorder;
use crate::daemon::sensor::{SensorHandle, Vitals};

/// Far longer than any step of the test takes.
const PATIENCE: Duration = Duration::from_secs(60);

/// A service for a sensor called "a", and the commands to the sensor.
fn service(access: Access) -> (Service, mpsc::Receiver<Command>) {
    let hub = hub::start(hello(), EventRecorder::default());
    let (commands, inbox) = mpsc::channel(1);
    let name = "a".to_owned();
    let (_, sensors) = Sensors::new(vec![SensorHandle { name, commands }]);
    let service = Service {
        access,
        max_clients: 1,
        snapshots: Snapshots::new(hub.clone(), sensors.clone()),
        hub,
        sensors,
        turns: Arc::new(Semaphore::new(1)),
        writers: Handle::current(),
    };
    (service, inbox)
}

/// Answers for the sensor.
async fn answer_statuses(mut inbox: mpsc::Receiver<Command>) {
    while let Some(Command::Status(reply)) = inbox.recv().await {
        let _ = reply.send(Vitals {
            status: live("a"),
            last_frame_age: None,
            contact_threshold_n: 0.0,
            unjudged: 0,
            motion: (0, 0),
        });
    }
}

/// The client's end of a connection.
struct Client {
    lines: tokio::io::Lines<BufReader<unix::OwnedReadHalf>>,
    output: unix::OwnedWriteHalf,
}

impl Client {
    fn connect(service: &Service) -> Self {
        let (ours, theirs) = UnixStream::pair().unwrap();
        tokio::spawn(service.serve(theirs));
        let (input, output) = ours.into_split();
        Self {
            lines: BufReader::new(input).lines(),
            output,
        }
    }

    async fn next(&mut self) -> Value {
        let line = tokio::time::timeout(PATIENCE, self.lines.next_line()).await;
        serde_json::from_str(&line.unwrap().unwrap().unwrap()).unwrap()
    }
}

#[tokio::test]
async fn events_go_on_and_requests_wait_while_a_command_is_carried_out() {
    let (service, mut inbox) = service(Access::Control);
    let mut client = Client::connect(&service);
    // A connection begins with the sensors' statuses. This sensor does not answer.
    let Some(Command::Status(_)) = inbox.recv().await else {
        panic!("another command");
    };
    assert_eq!(client.next().await["type"], "hello");
    let asked = b"{\"tare\":\"a\",\"id\":1}\n{\"get\":\"last\",\"id\":2}\n";
    client.output.write_all(asked).await.unwrap();
    let Some(Command::Tare(tare)) = inbox.recv().await else {
        panic!("another command");
    };
    service.hub.publish(vec![press("a")]).await;
    assert_eq!(client.next().await["type"], "press");
    tare.send(Err(RetareError::NotLive)).unwrap();
    for (kind, id) in [("error", 1), ("ok", 2)] {
        let answer = client.next().await;
        assert_eq!((&answer["type"], &answer["id"]), (&kind.into(), &id.into()));
    }
}

// The time is paused, so a timeout ends as soon as nobody can do more.
#[tokio::test(start_paused = true)]
async fn a_client_that_reads_nothing_keeps_no_other_from_its_answers() {
    for asked in [&b"{\"get\":\"status\"}\n"[..], b"{\"subscribe\":[]}\n"] {
        let (service, inbox) = service(Access::ReadOnly);
        tokio::spawn(answer_statuses(inbox));
        let mut deaf = Client::connect(&service);
        while let Ok(written) = tokio::time::timeout(PATIENCE, deaf.output.write_all(asked)).await {
            written.unwrap();
        }
        let mut other = Client::connect(&service);
        for kind in ["hello", "status"] {
            assert_eq!(other.next().await["type"], kind);
        }
        other.output.write_all(asked).await.unwrap();
        while other.next().await["type"] != "ok" {}
    }
}

#[tokio::test(start_paused = true)]
async fn a_connection_keeps_nothing_of_what_it_has_sent() {
    let (service, inbox) = service(Access::ReadOnly);
    tokio::spawn(answer_statuses(inbox));
    let mut client = Client::connect(&service);
    while client.next().await["type"] != "status" {}
    let sent = service.snapshots.recent().await.unwrap();
    assert_eq!(Arc::strong_count(&sent.statuses[0].json), 1);
    assert_eq!(sent.statuses[0].event, None, "only the text is sent");
}

#[tokio::test]
async fn a_buffer_that_has_grown_shrinks_again() {
    let (service, _inbox) = service(Access::ReadOnly);
    let (mut ours, theirs) = UnixStream::pair().unwrap();
    let (_, output) = theirs.into_split();
    let (_asked, inbox) = mpsc::channel(1);
    let mut writer = Writer {
        id: 0,
        service,
        output,
        outgoing: Vec::new(),
        inbox,
    };
    let message = "x".repeat(10 * KEPT_BYTES);
    let read = tokio::spawn(async move {
        let mut read = Vec::new();
        ours.read_to_end(&mut read).await.unwrap();
        read
    });
    writer.send(vec![error(message, None)]).await.unwrap();
    assert!(writer.outgoing.capacity() <= KEPT_BYTES);
    drop(writer);
    assert!(read.await.unwrap().len() > 10 * KEPT_BYTES);
}
