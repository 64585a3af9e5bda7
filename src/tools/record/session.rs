//! `hardnessd record --session`: one recording for each object, labelled with the user's answers.
//!
//! It asks on the terminal for the object's name and its Shore hardness or level, shows the verdict on each
//! press as it comes, keeps the score, and continues with the next object. `hrn-train fit` takes the files as
//! they are.

use std::fs::{self, File};
use std::future::Future;
use std::io::{self, BufRead as _, IsTerminal};
use std::path::{Path, PathBuf};
use std::pin::Pin;

use tokio::sync::{mpsc, watch};

use super::{counted_in_words, create, record_waiting, unavailable};
use crate::daemon::config::Setup;
use crate::daemon::log::Log;
use crate::daemon::record::Progress;
use crate::daemon::serial;
use crate::score::Score;
use crate::thread::start;
use crate::tools::exit::{Fail as _, Failure, IO, USAGE};
use hardnessd_core::part;
use hardnessd_core::recording::{Labels, check_label, object_of};
use hardnessd_core::verdict::{Borders, Level};

/// The user at the terminal.
struct User<'a> {
    lines: mpsc::Receiver<String>,
    log: &'a Log,
    shutdown: Pin<&'a mut dyn Future<Output = ()>>,
}

impl User<'_> {
    /// Reads stdin on a thread of its own, which ends with the process.
    fn at_terminal<'a>(
        log: &'a Log,
        shutdown: Pin<&'a mut dyn Future<Output = ()>>,
    ) -> Result<User<'a>, Failure> {
        let (sender, lines) = mpsc::channel(1);
        start("answers", move || {
            // A terminal may send other bytes than UTF-8.
            for line in io::stdin().lock().split(b'\n').map_while(Result::ok) {
                let line = String::from_utf8_lossy(&line);
                if sender.blocking_send(line.trim().to_owned()).is_err() {
                    return;
                }
            }
        })?;
        Ok(User {
            lines,
            log,
            shutdown,
        })
    }

    /// Writes a text, between the lines of the log.
    fn say(&self, text: &str) {
        self.log.lines().say(text.as_bytes());
    }

    /// The next line. `None` if no more lines come: do not ask again then.
    async fn line(&mut self) -> Option<String> {
        tokio::select! {
            line = self.lines.recv() => line,
            () = &mut self.shutdown => None,
        }
    }

    /// Asks until the answer is usable. Returns `None` if the answer is `q` or no more answers
    /// come.
    async fn ask<T>(
        &mut self,
        question: &str,
        usable: impl Fn(&str) -> Result<T, String>,
    ) -> Option<T> {
        loop {
            self.say(&format!("{question}: "));
            let answer = self.line().await?;
            if answer == "q" {
                return None;
            }
            match usable(&answer) {
                Ok(answer) => return Some(answer),
                Err(problem) => self.say(&format!("{problem}\n")),
            }
        }
    }

    /// Asks which object comes next. Returns `None` if none does.
    async fn name_object(
        &mut self,
        directory: &Path,
        number: u32,
        levels: &[Level],
    ) -> Option<Object> {
        let named = |name: &str| {
            if name.is_empty() {
                return Err("the name is empty: write what you will press".to_owned());
            }
            check_label("name", name).map(|()| name.to_owned())
        };
        let question = format!("\nobject {number}: its name");
        let name = self.ask(&question, named).await?;
        let labels: Vec<&str> = levels.iter().map(|level| level.label.as_str()).collect();
        let labels = labels.join(", ");
        let question =
            format!("its Shore OO reading, or its level ({labels}), or Enter if unknown");
        let hardness = |answer: &str| hardness(answer, levels);
        let (shore, level) = self.ask(&question, hardness).await?;
        if let (Some(_), Some(level)) = (&shore, level) {
            let level = format!("level {} ({})\n", level.level, level.label);
            self.say(&level);
        }
        let level = level.map_or(0, |level| level.level);
        let path = directory.join(format!("{number:03}-{}.mcap", slug(&name)));
        let mut labels = Labels::from([
            // The same name in another session is the same object.
            ("object".to_owned(), object_of(&name).to_string()),
            ("name".to_owned(), name),
            ("level".to_owned(), level.to_string()),
        ]);
        labels.extend(shore.map(|shore| ("shore".to_owned(), shore)));
        Some(Object {
            path,
            labels,
            level,
        })
    }
}

/// An object to press.
struct Object {
    path: PathBuf,
    labels: Labels,
    /// 0 if it is unknown.
    level: u8,
}

/// Records object after object into `directory`, until the user quits or `shutdown` comes.
///
/// # Errors
///
/// Fails if there is no terminal, a sensor is missing at the start, or the directory or a file cannot be read or
/// written.
pub(super) async fn run(
    directory: &Path,
    labels: &Labels,
    setup: &Setup,
    log: &Log,
    mut shutdown: Pin<&mut dyn Future<Output = ()>>,
) -> Result<(), Failure> {
    if !(io::stdin().is_terminal() && io::stderr().is_terminal()) {
        let problem = "`record --session` needs a terminal on stdin and stderr: use --out and \
                       --label instead";
        return Err(Failure::new(USAGE, problem));
    }
    let first = next_number(directory);
    let first = first.of(format!("--session: {}", directory.display()), IO)?;
    // The user must not answer questions in vain.
    for sensor in &setup.config.sensors {
        let opened = tokio::select! {
            opened = serial::try_port(&sensor.port, sensor.baud) => opened,
            () = &mut shutdown => return Ok(()),
        };
        opened.map_err(|reason| unavailable(sensor, reason))?;
    }
    let mut user = User::at_terminal(log, shutdown)?;
    user.say("One recording for each object. `q` ends the session.\n");
    let levels = &setup.hrn.card().levels;
    // The verdicts on objects whose level the user named.
    let mut score = Score::default();
    let (mut number, mut goes_on, mut ended) = (first, true, Ok(()));
    while goes_on && let Some(mut object) = user.name_object(directory, number, levels).await {
        object.labels.extend(labels.clone());
        let (recorded, is_kept) = match create(&object.path) {
            Ok(file) => record_object(&mut user, &object, &file, setup, &mut score).await,
            Err(error) => (Err(error), false),
        };
        goes_on = recorded.as_ref().is_ok_and(|goes_on| *goes_on);
        ended = recorded.map(drop);
        number = number.saturating_add(is_kept.into());
    }
    let count = number - first;
    let recorded = counted_in_words(count.into(), "object", "s");
    user.say(&format!("\nrecorded {recorded} in this session\n"));
    if score.verdicts > 0 {
        user.say(&format!("{}\n", score.in_words()));
    }
    if count > 0 {
        let directory = directory.to_string_lossy();
        // No path has the byte 0, which alone cannot be quoted.
        let directory = shlex::try_quote(&directory).unwrap_or_default();
        user.say(&format!(
            "to make a model of them: hrn-train fit {directory} --out own.onnx\n"
        ));
    }
    ended
}

/// The reading and the level that an answer says.
fn hardness<'a>(
    answer: &str,
    levels: &'a [Level],
) -> Result<(Option<String>, Option<&'a Level>), String> {
    if answer.is_empty() {
        return Ok((None, None));
    }
    let mut named = levels.iter();
    if let Some(level) = named.find(|level| level.label.eq_ignore_ascii_case(answer)) {
        return Ok((None, Some(level)));
    }
    let reading = check_label("shore", answer)
        .ok()
        .and_then(|()| answer.parse().ok());
    match (reading, Borders::of(levels)) {
        (Some(reading), Ok(borders)) => {
            let level = &levels[borders.place_of(reading)];
            Ok((Some(answer.to_owned()), Some(level)))
        }
        _ => Err(format!(
            "found {answer:?}, expected a Shore OO reading from 0 to 100, or the name of a level"
        )),
    }
}

/// Records presses of one object into its file, which is removed if there is none. Returns `false` if the user quits,
/// and whether the file is kept.
async fn record_object(
    user: &mut User<'_>,
    object: &Object,
    file: &File,
    setup: &Setup,
    score: &mut Score,
) -> (Result<bool, Failure>, bool) {
    let path = &object.path;
    user.say("do not touch the sensor until the zero is taken\n");
    let mut goes_on = false;
    let levels = &setup.hrn.card().levels;
    let end = async |counted| goes_on = wait_for_user(user, counted, object, levels).await;
    let (setup, labels) = (setup.clone(), object.labels.clone());
    let (recorded, progress) = record_waiting(setup, path, file, labels, end).await;
    if progress.presses == 0 {
        // It would stop `hrn-train collect`.
        part::remove(path, file);
        user.say("no press was recorded\n");
    } else if object.level > 0 {
        score.add(progress.score);
    }
    (recorded.map(|()| goes_on), progress.presses > 0)
}

/// Shows the verdict on each press, until the user says what to do next. Returns `false` if the user quits.
async fn wait_for_user(
    user: &mut User<'_>,
    mut counted: watch::Receiver<Progress>,
    object: &Object,
    levels: &[Level],
) -> bool {
    let label = |level: u8| {
        let known = levels.iter().find(|known| known.level == level);
        known.map_or("no level", |known| known.label.as_str())
    };
    let (mut shown, mut is_tared, mut is_missing, mut lost_before) = (0, false, false, 0);
    loop {
        tokio::select! {
            answer = user.line() => match answer.as_deref() {
                Some("") => return true,
                Some("q") | None => return false,
                Some(_) => {}
            },
            Ok(()) = counted.changed() => {
                let Progress { tared, lost, missing, score, said, .. } = *counted.borrow_and_update();
                if (missing > 0) != is_missing {
                    is_missing = missing > 0;
                    user.say(match is_missing {
                        true => "a sensor is missing: waiting for it (q: quit)\n",
                        false => "the sensor is back\n",
                    });
                }
                if lost > lost_before {
                    lost_before = lost;
                    user.say("the press under way is lost: press again\n");
                }
                if tared > 0 && !is_tared {
                    is_tared = true;
                    user.say("the zero is taken: press now (Enter: next object, q: quit)\n");
                }
                if score.verdicts > shown {
                    shown = score.verdicts;
                    let beside = match object.level {
                        0 => String::new(),
                        level => format!(", you said {}; {}", label(level), score.in_words()),
                    };
                    user.say(&format!("verdict {shown}: {}{beside}\n", label(said.unwrap_or(0))));
                }
            }
        }
    }
}

/// A name as a part of a file's name.
fn slug(name: &str) -> String {
    let letters = name
        .chars()
        .take(40)
        .collect::<String>()
        .to_ascii_lowercase();
    let slug = letters.replace(|c: char| !c.is_ascii_alphanumeric(), "-");
    slug.trim_matches('-').to_owned()
}

/// The number of the next object in a directory: one more than the greatest that a file's name begins with.
/// Makes the directory if it is missing.
fn next_number(directory: &Path) -> io::Result<u32> {
    fs::create_dir_all(directory)?;
    let mut last: u32 = 0;
    for file in fs::read_dir(directory)? {
        let name = file?.file_name();
        let number = name.to_str().and_then(|name| name.split('-').next());
        last = last.max(number.and_then(|number| number.parse().ok()).unwrap_or(0));
    }
    Ok(last.saturating_add(1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_becomes_a_part_of_a_files_name() {
        for (name, expected) in [
            ("Yoga mat #2", "yoga-mat--2"),
            ("../../etc", "etc"),
            ("Gummi-Bärchen", "gummi-b-rchen"),
            ("???", ""),
        ] {
            assert_eq!(slug(name), expected);
        }
    }

    #[test]
    fn a_reading_and_a_name_have_the_level_that_a_verdict_has() {
        let four = [
            Level::new(1, "hard", ">70"),
            Level::new(2, "firm", "61-70"),
            Level::new(3, "soft", "51-60"),
            Level::new(4, "very-soft", "<=50"),
        ];
        for (answer, expected) in [
            ("70", Some((true, 2))),
            ("Very-Soft", Some((false, 4))),
            ("", Some((false, 0))),
            ("101", None),
            ("NaN", None),
            ("softish", None),
        ] {
            let found = hardness(answer, &four).ok();
            let found =
                found.map(|(shore, level)| (shore.is_some(), level.map_or(0, |level| level.level)));
            assert_eq!(found, expected, "{answer}");
        }
    }
}
