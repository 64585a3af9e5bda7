//! The commit that a trainer is built from, for its runs to name: `HARDNESSD_REVISION`.

use std::process::Command;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    // A change to the sources is one to "-dirty", a commit or a checkout is one to the log.
    for sources in ["src", "../core/src", "../simulator/src", "../../Cargo.lock"] {
        println!("cargo::rerun-if-changed={sources}");
    }
    if let Some(log) = git(&["rev-parse", "--git-path", "logs/HEAD"]) {
        println!("cargo::rerun-if-changed={log}");
    }
    let commit = git(&["describe", "--always", "--dirty", "--abbrev=12"]);
    let commit = commit.as_deref().unwrap_or("no checkout");
    println!("cargo::rustc-env=HARDNESSD_REVISION={commit}");
}

/// The one line that git prints here; `None` where it is not, or this is no checkout.
fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok()?;
    let line = String::from_utf8(output.stdout).ok()?;
    output.status.success().then(|| line.trim().to_owned())
}
