//! The processes that have a device open.

use std::fs;
use std::os::unix::fs::{FileTypeExt as _, MetadataExt as _};
use std::path::{Path, PathBuf};

/// The processes that have `device` open, on the system whose root directory is `root`. The process that made a
/// pty is none of them: it may keep the device open beside the other end. Only root sees other users' processes.
pub(crate) fn holders(root: &Path, device: &Path) -> impl Iterator<Item = u32> {
    // Another file may lead to the same device.
    let wanted = number_of(&under(root, device));
    let made = wanted.map(|number| format!("tty-index:\t{}", rustix::fs::minor(number)));
    let devices = [Path::new("/dev").to_owned(), root.join("dev")];
    processes(root).filter(move |pid| {
        let process = root.join("proc").join(pid.to_string());
        let (mut holds, mut is_maker) = (false, false);
        let files = fs::read_dir(process.join("fd"));
        for file in files.into_iter().flatten().flatten() {
            // Only devices are looked at further: a file of another user may be on a file system that hangs.
            let target = fs::read_link(file.path()).unwrap_or_default();
            if target.ends_with("ptmx") {
                let about = process.join("fdinfo").join(file.file_name());
                let about = fs::read_to_string(about).unwrap_or_default();
                is_maker |= about.lines().any(|line| Some(line) == made.as_deref());
            } else if target == device {
                holds = true;
            } else if devices.iter().any(|folder| target.starts_with(folder)) {
                holds |= wanted.is_some() && number_of(&file.path()) == wanted;
            }
        }
        holds && !is_maker
    })
}

/// The number of the character device that a file is.
fn number_of(path: &Path) -> Option<u64> {
    let file = fs::metadata(path).ok()?;
    file.file_type().is_char_device().then(|| file.rdev())
}

/// The processes of the system whose root directory is `root`, in order.
pub(crate) fn processes(root: &Path) -> impl Iterator<Item = u32> {
    let entries = fs::read_dir(root.join("proc")).into_iter().flatten();
    let names = entries.flatten().map(|entry| entry.file_name());
    let mut pids: Vec<u32> = names
        .filter_map(|name| name.to_str()?.parse().ok())
        .collect();
    pids.sort_unstable();
    pids.into_iter()
}

/// A path of the system whose root directory is `root`.
pub(crate) fn under(root: &Path, path: &Path) -> PathBuf {
    root.join(path.strip_prefix("/").unwrap_or(path))
}
