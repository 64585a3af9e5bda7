//! The directory of a demonstration, with its port and its socket, and the search for such sockets.

use std::env;
use std::fs::{self, Permissions};
use std::io;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::PathBuf;

use tempfile::TempDir;

/// The first part of the name of every demonstration's directory.
const PREFIX: &str = "hardnessd-demo-";

/// The name of the daemon's socket in it.
pub(super) const SOCKET: &str = "events.sock";

/// Makes the demonstration's own directory. A killed demonstration may have left one, so a part of the name is
/// random.
pub(super) fn place() -> io::Result<TempDir> {
    let mut named = tempfile::Builder::new();
    let named = named
        .prefix(PREFIX)
        .permissions(Permissions::from_mode(0o700));
    named.tempdir_in(directory())
}

/// Where demonstrations have their directories: the user's runtime directory, else that for temporary files.
fn directory() -> PathBuf {
    let runtime = env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from);
    let there = runtime.filter(|directory| directory.is_dir());
    there.unwrap_or_else(env::temp_dir)
}

/// Sockets of this user's demonstrations, the newest first. A killed demonstration may have left
/// one.
pub(in crate::tools) fn sockets() -> Vec<PathBuf> {
    let uid = rustix::process::geteuid().as_raw();
    let mut found = Vec::new();
    for entry in fs::read_dir(directory()).into_iter().flatten().flatten() {
        let name = entry.file_name();
        // Anyone may put a directory among the temporary files: only the user's own are trusted.
        let ours = name.to_string_lossy().starts_with(PREFIX)
            && fs::symlink_metadata(entry.path())
                .is_ok_and(|file| file.is_dir() && file.uid() == uid);
        let socket = entry.path().join(SOCKET);
        if ours && let Ok(made) = fs::symlink_metadata(&socket).and_then(|file| file.modified()) {
            found.push((made, socket));
        }
    }
    found.sort_unstable_by(|a, b| b.cmp(a));
    found.into_iter().map(|(_, socket)| socket).collect()
}
