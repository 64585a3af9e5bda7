//! What holds of a data set from a stranger.
#![allow(unreachable_pub, reason = "the fuzz targets include this file too")]

use hrn_train::data::presses::Presses;

/// A data set is read, or refused in one line.
pub fn npz(bytes: &[u8]) {
    let directory = tempfile::tempdir().expect("a directory for temporary files");
    let path = directory.path().join("fuzzed.npz");
    std::fs::write(&path, bytes).expect("room for a file");
    if let Err(error) = Presses::read(&[path]) {
        assert!(!error.to_string().contains('\n'), "{error}");
    }
}
