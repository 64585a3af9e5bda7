//! `hardnessd tare`, `context` and `blackbox`: one command to the control socket of a running daemon,
//! and its answer.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::{Args as ClapArgs, Subcommand};
use serde_json::{Map, Value, json};

use super::answer::{labels, level_of};
use super::connect::{self, Connection};
use super::exit::{FAILED, Failure, USAGE};
use hardnessd_core::wording;

/// The sensor and the socket of a command.
#[derive(Debug, Clone, ClapArgs)]
pub struct Target {
    /// Name of the sensor
    #[arg(value_name = "SENSOR")]
    sensor: String,
    /// Control socket of the daemon [default: of the first daemon that answers]
    #[arg(long, value_name = "P")]
    socket: Option<PathBuf>,
}

/// Arguments of `context`.
#[derive(Debug, Clone, ClapArgs)]
pub struct Context {
    /// Sensor and socket.
    #[command(flatten)]
    target: Target,
    /// What presses and verdicts repeat from now on, such as tag=pick-17 or speed_mm_s=5. A value that is JSON
    /// is sent as JSON, any other as text. `level` may be the label of a level. Without any, the context is removed
    #[arg(value_name = "KEY=VALUE", value_parser = pair)]
    pairs: Vec<(String, Value)>,
}

/// A command to a daemon.
#[derive(Debug, Clone, Subcommand)]
pub enum Command {
    /// Take another tare of a sensor of a running daemon, and print the offsets before and after
    Tare(Target),
    /// Set what presses and verdicts of a sensor of a running daemon repeat
    Context(Context),
    /// Write the last minute of a sensor of a running daemon to a file, and print its path
    Blackbox(Target),
}

/// Reads `KEY=VALUE`. A value that is JSON is taken as JSON, any other as text, and that of `object` always.
fn pair(text: &str) -> Result<(String, Value), &'static str> {
    match text.split_once('=') {
        Some((key, value)) if !key.is_empty() => {
            let json: Option<Value> = serde_json::from_str(value).ok();
            let json = json.filter(|json| key != "object" || json.is_string());
            Ok((key.to_owned(), json.unwrap_or_else(|| value.into())))
        }
        _ => Err("expected KEY=VALUE, such as tag=pick-17"),
    }
}

/// The longest wait for an answer. The frames of a tare may take as long.
const ANSWER: Duration = Duration::from_secs(60);

/// Sends a command, and prints what the daemon did.
///
/// # Errors
///
/// Returns a [`Failure`] if no daemon answers, or the daemon refuses.
pub fn run(command: Command) -> Result<(), Failure> {
    let socket = match &command {
        Command::Tare(target) | Command::Blackbox(target) => &target.socket,
        Command::Context(context) => &context.target.socket,
    };
    let mut daemon = connect::control(socket.clone())?;
    let request = match command {
        Command::Tare(target) => json!({"tare": target.sensor}),
        Command::Blackbox(target) => json!({"blackbox": target.sensor}),
        Command::Context(Context { target, pairs }) => {
            let hello = daemon.meet()?;
            let mut context = Map::from_iter([("sensor".to_owned(), target.sensor.into())]);
            for (key, value) in pairs {
                if context.insert(key.clone(), value).is_some() {
                    let twice = format!("{key}: given twice: give it once");
                    return Err(Failure::new(USAGE, twice));
                }
            }
            // A label may be a number, such as 80.
            let word = |level: &Value| level.as_str().map_or(level.to_string(), str::to_owned);
            let level = context.get("level").map(word);
            if let Some(level) = level.and_then(|level| level_of(&level, &labels(&hello))) {
                context.insert("level".to_owned(), level.into());
            }
            json!({"context": context})
        }
    };
    let line = in_words(&ask(&mut daemon, request)?) + "\n";
    super::print(line.as_bytes())?;
    Ok(())
}

/// Sends a command to a control socket, and returns the answer. Other lines come before it.
///
/// # Errors
///
/// Returns a [`Failure`] if the daemon does not answer, or refuses.
pub(super) fn ask(daemon: &mut Connection, mut request: Value) -> Result<Value, Failure> {
    request["id"] = json!(1);
    daemon.send(&request.to_string())?;
    let end = Instant::now() + ANSWER;
    while let Some(line) = daemon.next_within(end.saturating_duration_since(Instant::now()))? {
        let answer: Value = serde_json::from_str(&line).unwrap_or_default();
        let is_refusal = answer["type"] == "error";
        if is_refusal && (answer["id"] == 1 || answer["id"].is_null()) {
            let message = answer["message"].as_str().unwrap_or_default();
            return Err(Failure::new(FAILED, message.to_owned()));
        }
        if answer["id"] == 1 {
            return Ok(answer);
        }
    }
    let mute = format!("no answer within {} s", ANSWER.as_secs());
    Err(Failure::new(FAILED, mute))
}

/// The answer in plain words.
fn in_words(answer: &Value) -> String {
    if let Some(path) = answer["blackbox"].as_str() {
        return format!("written to {}", wording::escaped(path));
    }
    let tare = &answer["tare"];
    let mean = |of: &str| tare[of]["mean_counts"].as_f64();
    match (mean("old"), mean("new")) {
        (Some(old), Some(new)) => {
            format!("tared: the mean offset was {old:.2} counts and is {new:.2} counts")
        }
        _ => "done".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_is_json_or_text() {
        for (text, value) in [
            ("tag=pick-17", json!("pick-17")),
            ("speed_mm_s=5.5", json!(5.5)),
            ("is_new=true", json!(true)),
            ("at=[1,2]", json!([1, 2])),
            ("formula=a=b", json!("a=b")),
            ("empty=", json!("")),
            ("object=5", json!("5")),
            ("object=\"a b\"", json!("a b")),
        ] {
            assert_eq!(pair(text).unwrap().1, value, "{text}");
        }
        assert!(pair("=5").is_err() && pair("tag").is_err());
    }
}
