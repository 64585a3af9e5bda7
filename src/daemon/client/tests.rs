use serde_json::Value;
use tokio::io::{AsyncBufReadExt, BufReader};

use super::*;
use crate::daemon::hub::tests::{hello, press};
use crate::daemon::record::EventRecorder;
use crate::daemon::sensor::SensorHandle;

/// Far longer than any step of the test takes.
const PATIENCE: Duration = Duration::from_secs(60);

#[tokio::test]
async fn events_go_on_and_requests_wait_while_a_command_is_carried_out() {
    let hub = hub::start(hello(), EventRecorder::default());
    let (commands, mut inbox) = mpsc::channel(1);
    let name = "a".to_owned();
    let (_, sensors) = Sensors::new(vec![SensorHandle { name, commands }]);
    let service = Service {
        access: Access::Control,
        max_clients: 1,
        hub: hub.clone(),
        snapshots: Snapshots::new(hub.clone(), sensors.clone()),
        sensors,
        turns: Arc::new(Semaphore::new(1)),
        writers: Handle::current(),
    };
    let (ours, theirs) = UnixStream::pair().unwrap();
    tokio::spawn(service.serve(theirs));
    let (input, mut output) = ours.into_split();
    let mut lines = BufReader::new(input).lines();
    let mut next = async || -> Value {
        let line = tokio::time::timeout(PATIENCE, lines.next_line()).await;
        serde_json::from_str(&line.unwrap().unwrap().unwrap()).unwrap()
    };

    // A connection begins with the sensors' statuses. This sensor does not answer.
    let Some(Command::Status(_)) = inbox.recv().await else {
        panic!("another command");
    };
    assert_eq!(next().await["type"], "hello");
    let asked = b"{\"tare\":\"a\",\"id\":1}\n{\"get\":\"last\",\"id\":2}\n";
    output.write_all(asked).await.unwrap();
    let Some(Command::Tare(tare)) = inbox.recv().await else {
        panic!("another command");
    };
    hub.publish(vec![press("a")]).await;
    assert_eq!(next().await["type"], "press");
    tare.send(Err(RetareError::NotLive)).unwrap();
    for (kind, id) in [("error", 1), ("ok", 2)] {
        let answer = next().await;
        assert_eq!((&answer["type"], &answer["id"]), (&kind.into(), &id.into()));
    }
}
