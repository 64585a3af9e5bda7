//! `hardnessd record --session`: one recording for each object, labelled with the user's answers.
//!
//! It asks on the terminal for the object's name and its Shore hardness or level, counts the presses
//! as they come, and continues with the next object. `hrn-train collect` takes the files as they are.

use std::fs::{self, File};
use std::future::Future;
use std::io::{self, ErrorKind, IsTerminal, Read, Seek, Write};
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::time::Duration;

use rustix::termios::{LocalModes, OptionalActions, Termios};
use tokio::sync::{mpsc, watch};

use super::{Error, clear, levels, record, shown};
use crate::apart::NoThread;
use crate::daemon::Sockets;
use crate::daemon::config::Setup;
use crate::daemon::log::Log;
use crate::daemon::record::Progress;
use hardnessd_core::part;
use hardnessd_core::recording::{LabelError, Labels, check_label};
use hardnessd_core::verdict::Level;

/// The list of what was recorded, in the directory of a session.
const LIST: &str = "session.csv";
/// The first line of the list.
const HEADING: &str = "object,name,shore,level,presses,file\n";

/// The time between two updates of the progress.
const SHOWN_EVERY: Duration = Duration::from_millis(200);

/// The user at the terminal.
struct User<'a> {
    input: mpsc::Receiver<Vec<u8>>,
    /// The input that no answer has used.
    unused: Vec<u8>,
    shutdown: Pin<&'a mut dyn Future<Output = ()>>,
    has_gone: bool,
}

/// A terminal that passes single keys on and does not show them. It passes lines on again when this
/// is dropped.
struct Keys {
    before: Option<Termios>,
}

impl Keys {
    fn begin() -> Self {
        let stdin = rustix::stdio::stdin();
        let before = rustix::termios::tcgetattr(stdin).ok();
        if let Some(before) = &before {
            let mut keys = before.clone();
            keys.local_modes -= LocalModes::ICANON | LocalModes::ECHO;
            let _ = rustix::termios::tcsetattr(stdin, OptionalActions::Now, &keys);
        }
        Self { before }
    }
}

impl Drop for Keys {
    fn drop(&mut self) {
        if let Some(before) = &self.before {
            // A key that was pressed twice must not answer the next question.
            let _ =
                rustix::termios::tcsetattr(rustix::stdio::stdin(), OptionalActions::Flush, before);
        }
    }
}

/// Ctrl-D where it is a key.
const END_OF_INPUT: u8 = 4;

impl User<'_> {
    /// Reads stdin on a thread of its own, which ends with the process.
    fn at_terminal<'a>(
        shutdown: Pin<&'a mut dyn Future<Output = ()>>,
    ) -> Result<User<'a>, NoThread> {
        let (sender, input) = mpsc::channel(1);
        std::thread::Builder::new().spawn(move || {
            let mut bytes = [0; 1024];
            while let Ok(read @ 1..) = rustix::io::read(rustix::stdio::stdin(), &mut bytes) {
                if sender.blocking_send(bytes[..read].to_vec()).is_err() {
                    return;
                }
            }
        })?;
        Ok(User {
            input,
            unused: Vec::new(),
            shutdown,
            has_gone: false,
        })
    }

    /// Waits for input. Returns `false` if no more comes.
    async fn wait(&mut self) -> bool {
        if self.has_gone {
            return false;
        }
        let input = tokio::select! {
            input = self.input.recv() => input,
            () = &mut self.shutdown => None,
        };
        self.has_gone = input.is_none();
        self.unused.extend(input.into_iter().flatten());
        !self.has_gone
    }

    /// The next line, without the blanks around it. `None` if no more lines come.
    async fn line(&mut self) -> Option<String> {
        loop {
            if let Some(end) = self.unused.iter().position(|&byte| byte == b'\n') {
                let line: Vec<u8> = self.unused.drain(..=end).collect();
                return Some(String::from_utf8_lossy(&line).trim().to_owned());
            }
            if !self.wait().await {
                return None;
            }
        }
    }

    /// The next key. `None` if no more keys come. The terminal must pass [`Keys`] on.
    async fn key(&mut self) -> Option<char> {
        while self.unused.is_empty() {
            if !self.wait().await {
                return None;
            }
        }
        let key = self.unused.remove(0);
        (key != END_OF_INPUT).then(|| char::from(key).to_ascii_lowercase())
    }

    /// Asks until the answer is usable. Returns `None` if the answer is `q` or no more answers
    /// come.
    async fn ask<T>(
        &mut self,
        question: &str,
        usable: impl Fn(&str) -> Result<T, Unusable>,
    ) -> Option<T> {
        loop {
            print(&format!("{question}: "));
            let answer = self.line().await?;
            if answer == "q" {
                return None;
            }
            match usable(&answer) {
                Ok(answer) => return Some(answer),
                Err(problem) => print(&format!("{problem}\n")),
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
    #[error("no level has the Shore OO reading {0:?}: expected a number from 0 to 100")]
    Shore(String),
}

/// An object to press.
struct Object {
    name: String,
    shore: Option<String>,
    level: u8,
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
    log: &Log,
    shutdown: Pin<&mut dyn Future<Output = ()>>,
) -> Result<(), Error> {
    if !(io::stdin().is_terminal() && io::stderr().is_terminal()) {
        return Err(Error::NoTerminal);
    }
    fs::create_dir_all(directory).map_err(|source| listed(directory, source))?;
    let mut list = List::open(directory)?;
    let mut user = User::at_terminal(shutdown)?;
    print("One recording for each object. `q` ends the session.\n");
    let levels = setup.hrn.card().levels.clone();
    let has_limits = levels
        .iter()
        .all(|level| !upper_limit(&level.shore).is_nan());
    let mut asked = if has_limits {
        ask_for_durometer(&mut user).await
    } else {
        Some(false)
    };
    while let Some(has_durometer) = asked
        && let expected = list.next()?
        && let Some(object) = ask_for_object(&mut user, expected, has_durometer, &levels).await
    {
        let place = list.take(&object.name)?;
        if place.number != expected {
            print(&format!(
                "it is object {}, because another session took a number\n",
                place.number
            ));
        }
        let is_next = record_object(
            &mut user, &object, place, labels, &setup, sockets, &mut list,
        )
        .await?;
        // A late line would cut through the next question.
        log.flush();
        asked = asked.filter(|_| is_next);
    }
    let next = match list.added {
        0 => String::new(),
        _ => format!(
            "; next: hrn-train collect --out D.npz {}/*.mcap",
            shown(directory)
        ),
    };
    print(&format!(
        "\nrecorded {} object{} in this session{next}\n",
        list.added,
        if list.added == 1 { "" } else { "s" },
    ));
    Ok(())
}

/// Whether the levels come from a durometer. `None` if the user quits.
async fn ask_for_durometer(user: &mut User<'_>) -> Option<bool> {
    print("\nDo you have a Shore OO durometer? y: it asks for readings, n: it asks for levels ");
    let _keys = Keys::begin();
    loop {
        let answer = match user.key().await? {
            'y' => Some(true),
            'n' => Some(false),
            'q' => None,
            _ => continue,
        };
        print("\n");
        return answer;
    }
}

async fn ask_for_object(
    user: &mut User<'_>,
    number: u32,
    has_durometer: bool,
    levels: &[Level],
) -> Option<Object> {
    let name = user
        .ask(&format!("\nobject {number}: its name"), |name| {
            if name.is_empty() {
                return Err(Unusable::NoName);
            }
            check_label("name", name)?;
            Ok(name.to_owned())
        })
        .await?;
    let (shore, level) = if has_durometer {
        let (shore, level) = user
            .ask("its Shore OO reading", |reading| {
                let level = level_of_reading(reading, levels);
                let level = level.ok_or_else(|| Unusable::Shore(reading.to_owned()))?;
                Ok((reading.to_owned(), level))
            })
            .await?;
        print(&format!("level {} ({})\n", level.level, level.label));
        (Some(shore), level.level)
    } else {
        let question = format!(
            "its level, {}, or 0 if you do not know",
            self::levels(levels)
        );
        let level = user
            .ask(&question, |level| {
                level_named(level, levels).ok_or_else(|| Unusable::Level(level.to_owned()))
            })
            .await?;
        (None, level)
    };
    Some(Object { name, shore, level })
}

/// A level by its number or its name; 0 means that it is unknown.
fn level_named(text: &str, levels: &[Level]) -> Option<u8> {
    let is_meant =
        |level: &&Level| level.label.eq_ignore_ascii_case(text) || level.level.to_string() == text;
    match text {
        "0" => Some(0),
        _ => levels.iter().find(is_meant).map(|level| level.level),
    }
}

/// The level of a durometer's reading: the one with the least upper limit that is not below the
/// reading. So 60.5 belongs to `61-70`. `None` if the text is no reading.
fn level_of_reading<'a>(text: &str, levels: &'a [Level]) -> Option<&'a Level> {
    let reading: f64 = text.parse().ok()?;
    if !(0.0..=100.0).contains(&reading) {
        return None;
    }
    let limits = levels
        .iter()
        .map(|level| (upper_limit(&level.shore), level));
    let fitting = limits.filter(|&(limit, _)| limit >= reading);
    let least = fitting.min_by(|one, other| one.0.total_cmp(&other.0));
    least.map(|(_, level)| level)
}

/// The upper limit of an interval such as `>70`, `61-70` or `<=50`.
fn upper_limit(shore: &str) -> f64 {
    if shore.starts_with('>') {
        return f64::INFINITY;
    }
    let last = shore
        .rsplit(|c: char| !(c.is_ascii_digit() || c == '.'))
        .next();
    last.and_then(|last| last.parse().ok()).unwrap_or(f64::NAN)
}

/// Records presses of one object, and again if the user asks for it. Returns `false` if the user
/// quits.
async fn record_object(
    user: &mut User<'_>,
    object: &Object,
    place: Place,
    labels: &Labels,
    setup: &Setup,
    sockets: Sockets,
    list: &mut List,
) -> Result<bool, Error> {
    let Place { number, path, file } = place;
    let failed = |source| listed(&path, source);
    let mut labels = labels.clone();
    labels.extend([
        ("object".to_owned(), number.to_string()),
        ("name".to_owned(), object.name.clone()),
        ("level".to_owned(), object.level.to_string()),
    ]);
    let shore = object.shore.clone();
    labels.extend(shore.map(|shore| ("shore".to_owned(), shore)));
    loop {
        print("do not touch the sensor until the zero is taken\n");
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
                file.try_clone().map_err(failed)?,
                labels.clone(),
                progress,
                end,
            )
            .await
        };
        clear();
        let presses = counted.borrow().presses;
        let is_kept = presses > 0 && !matches!(next, Next::Redo);
        if is_kept {
            list.add(number, object, presses, &path)?;
        } else if recorded.is_err() || matches!(next, Next::KeepAndQuit) {
            // A recording without a press would stop `hrn-train collect`.
            part::remove(&path, &file);
        }
        recorded?;
        match next {
            _ if is_kept => return Ok(matches!(next, Next::Keep)),
            Next::KeepAndQuit => return Ok(false),
            Next::Redo => print(&format!("again: {}\n", shown(Path::new(&object.name)))),
            Next::Keep => print("no press was recorded: again\n"),
        }
        // The file stays, because it keeps the number from other sessions.
        let emptied = file.set_len(0).and_then(|()| (&file).rewind());
        emptied.map_err(failed)?;
    }
}

/// Counts presses in one line until the user presses a key that says what to do next.
async fn wait_for_user(user: &mut User<'_>, counted: &mut watch::Receiver<Progress>) -> Next {
    let _keys = Keys::begin();
    user.unused.clear();
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
        print(&format!("\r\x1b[K{line} "));
        tokio::select! {
            key = user.key() => match key {
                Some('\n') => return Next::Keep,
                Some('r') => return Next::Redo,
                Some('q') | None => return Next::KeepAndQuit,
                Some(_) => {}
            },
            () = tokio::time::sleep(SHOWN_EVERY) => {}
        }
    }
}

/// Writes to the terminal. Errors are ignored: if the terminal has gone, its signal ends the
/// session.
fn print(text: &str) {
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

/// The place of an object's recording: an empty file, and the number in its name.
struct Place {
    number: u32,
    path: PathBuf,
    file: File,
}

/// `session.csv`: a line for each object.
struct List {
    path: PathBuf,
    added: u32,
}

impl List {
    fn open(directory: &Path) -> Result<Self, Error> {
        let path = directory.join(LIST);
        let begin = || {
            File::options().append(true).create(true).open(&path)?;
            let mut list = locked(&path)?;
            let mut text = String::new();
            list.read_to_string(&mut text)?;
            if text.is_empty() {
                list.write_all(HEADING.as_bytes())?;
            } else if !text.starts_with(HEADING) {
                let strange = "not the list of a session";
                return Err(io::Error::new(ErrorKind::InvalidData, strange));
            }
            Ok(())
        };
        begin().map_err(|source| listed(&path, source))?;
        Ok(Self { path, added: 0 })
    }

    /// Makes the file of the next object. Its number is decided now, because another session may have
    /// taken the one that was next before the questions.
    fn take(&self, name: &str) -> Result<Place, Error> {
        let _locked = locked(&self.path).map_err(|source| listed(&self.path, source))?;
        let mut number = self.next()?;
        loop {
            let file = format!("{number:03}-{}.mcap", slug(name));
            let path = self.path.with_file_name(file);
            match File::create_new(&path) {
                Ok(file) => return Ok(Place { number, path, file }),
                Err(error) if error.kind() == ErrorKind::AlreadyExists && number < u32::MAX => {
                    number += 1;
                }
                Err(source) => return Err(listed(&path, source)),
            }
        }
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

    fn add(
        &mut self,
        number: u32,
        object: &Object,
        presses: u64,
        recording: &Path,
    ) -> Result<(), Error> {
        let Object { name, shore, level } = object;
        let file = recording.file_name().unwrap_or_default().display();
        let name = name.replace('"', "\"\"");
        let shore = shore.as_deref().unwrap_or_default();
        let line = format!("{number},\"{name}\",{shore},{level},{presses},{file}\n");
        let written = locked(&self.path).and_then(|mut list| list.write_all(line.as_bytes()));
        written.map_err(|source| listed(&self.path, source))?;
        self.added += 1;
        Ok(())
    }
}

/// Opens a list to read it and to add to it, while no other session does.
fn locked(path: &Path) -> io::Result<File> {
    let list = File::options().read(true).append(true).open(path)?;
    // Some file systems have no locks. There, one session at a time may run.
    let _ = list.lock();
    Ok(list)
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
    fn a_reading_and_a_name_have_a_level() {
        let level = |level, label: &str, shore: &str| Level {
            level,
            label: label.to_owned(),
            shore: shore.to_owned(),
        };
        let levels = [
            level(1, "hard", ">70"),
            level(2, "firm", "61-70"),
            level(3, "soft", "51-60"),
            level(4, "very-soft", "<=50"),
        ];
        for (reading, expected) in [
            ("100", Some(1)),
            ("70.5", Some(1)),
            ("70", Some(2)),
            ("60.5", Some(2)),
            ("60", Some(3)),
            ("50", Some(4)),
            ("0", Some(4)),
            ("101", None),
            ("-1", None),
            ("NaN", None),
            ("soft", None),
        ] {
            let found = level_of_reading(reading, &levels).map(|level| level.level);
            assert_eq!(found, expected, "{reading}");
        }
        for (name, expected) in [
            ("0", Some(0)),
            ("4", Some(4)),
            ("Very-Soft", Some(4)),
            ("5", None),
            ("", None),
        ] {
            assert_eq!(level_named(name, &levels), expected, "{name}");
        }
    }

    #[test]
    fn a_session_goes_on_with_the_numbers_of_the_one_before() {
        let directory = tempfile::tempdir().unwrap();
        let path = |name: &str| directory.path().join(name);
        let mut list = List::open(directory.path()).unwrap();
        assert_eq!(list.next().unwrap(), 1);
        let object = Object {
            name: "a \"b\", c".to_owned(),
            shore: Some("63.5".to_owned()),
            level: 2,
        };
        list.add(1, &object, 20, &path("001-a.mcap")).unwrap();
        assert_eq!(list.next().unwrap(), 2);
        // The list of a session that was killed lacks its last recording.
        fs::write(path("007-foam.mcap"), "").unwrap();
        assert_eq!(list.next().unwrap(), 8);
        fs::remove_file(path(LIST)).unwrap();
        let mut list = List::open(directory.path()).unwrap();
        assert_eq!(list.next().unwrap(), 8);
        list.add(1, &object, 20, &path("001-a.mcap")).unwrap();
        let text = fs::read_to_string(path(LIST)).unwrap();
        assert_eq!(
            text,
            format!("{HEADING}1,\"a \"\"b\"\", c\",63.5,2,20,001-a.mcap\n")
        );
        fs::write(path(LIST), "x,y\n").unwrap();
        assert!(List::open(directory.path()).is_err());
    }

    #[test]
    fn each_object_of_many_sessions_has_a_number_of_its_own() {
        let directory = tempfile::tempdir().unwrap();
        let lists = ["foam", "rubber", "foam"].map(|name| {
            let list = List::open(directory.path()).unwrap();
            assert_eq!(list.next().unwrap(), 1);
            (list, name)
        });
        let taken = lists.map(|(list, name)| list.take(name).unwrap());
        assert_eq!(taken.each_ref().map(|place| place.number), [1, 2, 3]);
        let names = taken.map(|place| place.path.file_name().unwrap().to_owned());
        assert_eq!(names, ["001-foam.mcap", "002-rubber.mcap", "003-foam.mcap"]);
    }
}
