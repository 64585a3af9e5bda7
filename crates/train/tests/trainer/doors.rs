//! Data sets from strangers: the inputs that the fuzzer kept.

#[test]
fn a_data_set_that_the_fuzzer_kept_is_read_or_refused() {
    let corpus = concat!(env!("CARGO_MANIFEST_DIR"), "/../../fuzz/corpus/npz");
    let files = std::fs::read_dir(corpus).expect("a corpus of data sets");
    let mut tried = 0;
    for file in files {
        crate::property::npz(&std::fs::read(file.unwrap().path()).unwrap());
        tried += 1;
    }
    assert!(tried > 1, "{tried}");
}

#[test]
fn a_user_who_may_have_no_more_threads_is_told_so() {
    use std::os::unix::process::CommandExt;

    let program = std::fs::File::open(env!("CARGO_BIN_EXE_hrn-train")).unwrap();
    // A user may execute an open file, wherever it lies.
    let mut shell = std::process::Command::new("prlimit");
    shell.args(["--nproc=3", "/proc/self/fd/0", "inspect", "x"]);
    if rustix::process::getuid().is_root() {
        // No limit holds for root.
        shell.uid(65_534).gid(65_534);
    }
    let output = shell.current_dir("/").stdin(program).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(74), "{said}");
    assert!(said.starts_with("hrn-train: threads: "), "{said}");
    assert_eq!(said.lines().count(), 1, "{said}");
}
