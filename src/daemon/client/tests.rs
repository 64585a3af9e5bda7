use std::time::Duration;

use serde_json::Value;
use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader};
use tokio::net::{UnixStream, unix};

use super::*;
use crate::daemon::hub::tests::{hello, press, state};
use crate::daemon::sensor::{Command, SensorHandle};

/// Far longer than any step of the test takes.
const PATIENCE: Duration = Duration::from_secs(60);

/// A service for a live sensor called "a", and the commands to the sensor.
fn service() -> (Service, mpsc::Receiver<Command>) {
    let hub = Hub::new(hello());
    hub.log().report(state("a"));
    let (commands, inbox) = mpsc::channel(1);
    let name = "a".to_owned();
    let sensors = [SensorHandle { name, commands }].into();
    let service = Service {
        max_clients: 1,
        hub,
        control: Some(sensors),
    };
    (service, inbox)
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
    let (service, mut inbox) = service();
    let mut client = Client::connect(&service);
    for kind in ["hello", "status"] {
        assert_eq!(client.next().await["type"], kind);
    }
    let asked = b"{\"tare\":\"a\",\"id\":1}\n{\"get\":\"last\",\"id\":2}\n";
    client.output.write_all(asked).await.unwrap();
    let Some(Command::Tare(tare)) = inbox.recv().await else {
        panic!("another command");
    };
    service.hub.publish(vec![press("a")]);
    assert_eq!(client.next().await["type"], "press");
    tare.send(Err("tare: refused".to_owned())).unwrap();
    for (kind, id) in [("error", 1), ("ok", 2)] {
        let answer = client.next().await;
        assert_eq!((&answer["type"], &answer["id"]), (&kind.into(), &id.into()));
    }
}

// The time is paused, so a timeout ends as soon as nobody can do more.
#[tokio::test(start_paused = true)]
async fn a_client_that_reads_nothing_keeps_no_other_from_its_answers() {
    for asked in [&b"{\"get\":\"status\"}\n"[..], b"{\"subscribe\":[]}\n"] {
        let (service, _inbox) = service();
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
