//! `hardnessd record --session`: one recording for each object, labelled with the user's answers.
//!
//! It asks on the terminal for the object's name and level, counts the presses as they come, and
//! continues with the next object. `hrn-train collect` takes the files as they are.

use std::fs::{self, File};
use std::future::Future;
use std::io::{self, ErrorKind, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::time::Duration;

use tokio::sync::{mpsc, watch};

use super::{Error, check_level, clear, create, levels, record, said};
use crate::daemon::Sockets;
use crate::daemon::config::Setup;
use crate::daemon::record::Progress;
use hardnessd_core::recording::{LabelError, Labels, check_label};

/// The list of what was recorded, in the directory of a session.
const LIST: &str = "session.csv";
/// The first line of the list.
const HEADING: &str = "object,name,level,presses,file\n";

/// The time between two updates of the progress.
const SHOWN_EVERY: Duration = Duration::from_millis(200);

/// The user at the terminal.
struct User<'a> {
    lines: mpsc::Receiver<String>,
    shutdown: Pin<&'a mut dyn Future<Output = ()>>,
    has_gone: bool,
}

impl User<'_> {
    /// Reads stdin on a thread of its own, which ends with the process.
    fn at_terminal<'a>(shutdown: Pin<&'a mut dyn Future<Output = ()>>) -> User<'a> {
        let (sender, lines) = mpsc::channel(1);
        std::thread::spawn(move || {
            for line in io::stdin().lines().map_while(Result::ok) {
                if sender.blocking_send(line).is_err() {
                    return;
                }
            }
        });
        User {
            lines,
            shutdown,
            has_gone: false,
        }
    }

    /// The next line, without the blanks around it. `None` if no more lines come.
    async fn line(&mut self) -> Option<String> {
        if self.has_gone {
            return None;
        }
        let line = tokio::select! {
            line = self.lines.recv() => line,
            () = &mut self.shutdown => None,
        };
        self.has_gone = line.is_none();
        line.map(|line| line.trim().to_owned())
    }

    /// Asks until the answer is usable. Returns `None` if the answer is `q` or no more answers
    /// come.
    async fn ask<T>(
        &mut self,
        question: &str,
        usable: impl Fn(&str) -> Result<T, Unusable>,
    ) -> Option<T> {
        loop {
            say(&format!("{question}: "));
            let answer = self.line().await?;
            if answer == "q" {
                return None;
            }
            match usable(&answer) {
                Ok(answer) => return Some(answer),
                Err(problem) => say(&format!("{problem}\n")),
            }
        }
    }
}

/// The reason why an answer cannot be used.
#[derive(Debug, thiserror::Error)]
enum Unusable {
    #[error("the name is empty: write what you will press")]
    NoName,
    #[error(transparent)]
    Name(#[from] LabelError),
    #[error("there is no level {0:?}")]
    Level(String),
}

/// An object to press.
struct Object {
    number: u32,
    name: String,
    level: String,
}

/// What to do with a recording that the user has ended.
enum Next {
    Keep,
    Redo,
    KeepAndQuit,
}

/// Records object after object into `directory`, until the user quits or `shutdown` comes.
///
/// # Errors
///
/// Fails as [`super::run`] does, or if there is no terminal or the list cannot be read or written.
pub(super) async fn run(
    directory: &Path,
    labels: &Labels,
    setup: Setup,
    sockets: Sockets,
    shutdown: Pin<&mut dyn Future<Output = ()>>,
) -> Result<(), Error> {
    if !(io::stdin().is_terminal() && io::stderr().is_terminal()) {
        return Err(Error::NoTerminal);
    }
    fs::create_dir_all(directory).map_err(|source| listed(directory, source))?;
    let mut list = List::open(directory)?;
    let mut user = User::at_terminal(shutdown);
    say("One recording for each object. `q` ends the session.\n");
    while let Some(object) = ask_for_object(&mut user, list.next()?, &setup).await {
        if !record_object(
            &mut user, &object, directory, labels, &setup, sockets, &mut list,
        )
        .await?
        {
            break;
        }
    }
    let directory = said(directory);
    say(&format!(
        "\nrecorded {} object{} in this session; next: hrn-train collect --out D.npz {directory}/*.mcap\n",
        list.added,
        if list.added == 1 { "" } else { "s" },
    ));
    Ok(())
}

async fn ask_for_object(user: &mut User<'_>, number: u32, setup: &Setup) -> Option<Object> {
    let name = user
        .ask(&format!("\nobject {number}: its name"), |name| {
            if name.is_empty() {
                return Err(Unusable::NoName);
            }
            check_label("name", name)?;
            Ok(name.to_owned())
        })
        .await?;
    let known = &setup.hrn.card().levels;
    let question = format!("its level, {}, or 0 if you do not know", levels(known));
    let level = user
        .ask(&question, |level| {
            let label = [("level".to_owned(), level.to_owned())];
            check_level(&label, known).map_err(|_| Unusable::Level(level.to_owned()))?;
            Ok(level.to_owned())
        })
        .await?;
    Some(Object {
        number,
        name,
        level,
    })
}

/// Records presses of one object, and again if the user asks for it. Returns `false` if the user
/// quits.
async fn record_object(
    user: &mut User<'_>,
    object: &Object,
    directory: &Path,
    labels: &Labels,
    setup: &Setup,
    sockets: Sockets,
    list: &mut List,
) -> Result<bool, Error> {
    let name = format!("{:03}-{}.mcap", object.number, slug(&object.name));
    let path = directory.join(&name);
    let mut labels = labels.clone();
    labels.extend([
        ("object".to_owned(), object.number.to_string()),
        ("name".to_owned(), object.name.clone()),
        ("level".to_owned(), object.level.clone()),
    ]);
    loop {
        // From here on the file is this session's own, so it may be removed.
        let file = create(&path)?;
        say("do not touch the sensor until the zero is taken\n");
        let mut next = Next::KeepAndQuit;
        let (progress, mut counted) = watch::channel(Progress::default());
        let recorded = {
            let end = async {
                next = wait_for_user(user, &mut counted).await;
            };
            record(
                setup.clone(),
                sockets,
                &path,
                file,
                labels.clone(),
                progress,
                end,
            )
            .await
        };
        clear();
        let presses = counted.borrow().presses;
        if presses == 0 || matches!(next, Next::Redo) {
            // A recording without a press would stop `hrn-train collect`.
            let _ = fs::remove_file(&path);
        } else if recorded.is_err() {
            list.add(object, presses, &name)?;
        }
        recorded?;
        match next {
            Next::Redo => say(&format!("again: {}\n", said(Path::new(&object.name)))),
            Next::Keep if presses == 0 => say("no press was recorded: again\n"),
            Next::KeepAndQuit if presses == 0 => return Ok(false),
            Next::Keep | Next::KeepAndQuit => {
                list.add(object, presses, &name)?;
                return Ok(matches!(next, Next::Keep));
            }
        }
    }
}

/// Counts presses in one line until the user decides what to do next.
async fn wait_for_user(user: &mut User<'_>, counted: &mut watch::Receiver<Progress>) -> Next {
    loop {
        let Progress {
            frames,
            tared,
            presses,
        } = *counted.borrow_and_update();
        let line = if frames == 0 {
            "waiting for the sensor".to_owned()
        } else if tared == 0 {
            "taking the zero".to_owned()
        } else {
            format!("presses: {presses}; Enter: next object, r: redo this one, q: quit")
        };
        say(&format!("\r\x1b[K{line} "));
        tokio::select! {
            line = user.line() => match line.as_deref() {
                Some("") => return Next::Keep,
                Some("r") => return Next::Redo,
                Some("q") | None => return Next::KeepAndQuit,
                Some(_) => {}
            },
            () = tokio::time::sleep(SHOWN_EVERY) => {}
        }
    }
}

/// Writes to the terminal. Errors are ignored: if the terminal has gone, its signal ends the
/// session.
fn say(text: &str) {
    let mut stderr = io::stderr();
    let _ = stderr.write_all(text.as_bytes());
    let _ = stderr.flush();
}

/// A name as a part of a file's name.
fn slug(name: &str) -> String {
    let plain = |c: char| {
        if c.is_ascii_alphanumeric() {
            c.to_ascii_lowercase()
        } else {
            '-'
        }
    };
    let slug: String = name.chars().take(40).map(plain).collect();
    slug.trim_matches('-').to_owned()
}

/// `session.csv`: a line for each object.
struct List {
    path: PathBuf,
    added: u32,
}

impl List {
    fn open(directory: &Path) -> Result<Self, Error> {
        let path = directory.join(LIST);
        let text = match fs::read_to_string(&path) {
            Err(error) if error.kind() == ErrorKind::NotFound => {
                fs::write(&path, HEADING).map_err(|source| listed(&path, source))?;
                HEADING.to_owned()
            }
            read => read.map_err(|source| listed(&path, source))?,
        };
        if !text.starts_with(HEADING) {
            let strange = io::Error::new(ErrorKind::InvalidData, "not the list of a session");
            return Err(listed(&path, strange));
        }
        Ok(Self { path, added: 0 })
    }

    /// The number of the next object: above those in the list and those of all recordings in the
    /// directory. A session that was killed lists nothing, and another one may run beside this one.
    fn next(&self) -> Result<u32, Error> {
        let refused = |source| listed(&self.path, source);
        let listed = fs::read_to_string(&self.path).map_err(refused)?;
        let listed = listed.lines().filter_map(|line| line.split(',').next());
        let directory = self.path.parent().unwrap_or(Path::new("."));
        let files = fs::read_dir(directory).map_err(refused)?;
        let files = files
            .flatten()
            .filter_map(|file| file.file_name().into_string().ok());
        let files =
            files.filter_map(|name| name.split_once('-').map(|(number, _)| number.to_owned()));
        let files: Vec<String> = files.collect();
        let numbers = listed.chain(files.iter().map(String::as_str));
        let last: u32 = numbers
            .filter_map(|number| number.parse().ok())
            .max()
            .unwrap_or_default();
        Ok(last.saturating_add(1))
    }

    fn add(&mut self, object: &Object, presses: u64, file: &str) -> Result<(), Error> {
        let Object {
            number,
            name,
            level,
        } = object;
        let name = name.replace('"', "\"\"");
        let line = format!("{number},\"{name}\",{level},{presses},{file}\n");
        let written = File::options()
            .append(true)
            .open(&self.path)
            .and_then(|mut list| list.write_all(line.as_bytes()));
        written.map_err(|source| listed(&self.path, source))?;
        self.added += 1;
        Ok(())
    }
}

fn listed(path: &Path, source: io::Error) -> Error {
    Error::Session {
        path: path.to_owned(),
        source,
    }
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
    fn a_session_goes_on_with_the_numbers_of_the_one_before() {
        let directory = tempfile::tempdir().unwrap();
        let mut list = List::open(directory.path()).unwrap();
        assert_eq!(list.next().unwrap(), 1);
        let object = Object {
            number: 1,
            name: "a \"b\", c".to_owned(),
            level: "2".to_owned(),
        };
        list.add(&object, 20, "001-a.mcap").unwrap();
        assert_eq!(list.next().unwrap(), 2);
        // The list of a session that was killed lacks its last recording.
        fs::write(directory.path().join("007-foam.mcap"), "").unwrap();
        assert_eq!(list.next().unwrap(), 8);
        fs::remove_file(directory.path().join(LIST)).unwrap();
        let list = List::open(directory.path()).unwrap();
        assert_eq!(list.next().unwrap(), 8);
        let mut list = List::open(directory.path()).unwrap();
        list.add(&object, 20, "001-a.mcap").unwrap();
        let text = fs::read_to_string(directory.path().join(LIST)).unwrap();
        assert_eq!(
            text,
            format!("{HEADING}1,\"a \"\"b\"\", c\",2,20,001-a.mcap\n")
        );
        fs::write(directory.path().join(LIST), "x,y\n").unwrap();
        assert!(List::open(directory.path()).is_err());
    }
}
