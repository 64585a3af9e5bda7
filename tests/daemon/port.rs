//! `sniff` and `doctor` in use: the real binary, with recordings and ptys of the simulator.

use crate::bench::{Bench, command, ran};
use rustix::process::Signal;

#[test]
fn sniff_says_why_it_has_no_proposal() {
    let bench = Bench::new();
    // A port in place of a file would be read for ever.
    let _sensor = bench.sensor("");
    bench.fails_each(
        "
        sniff /no/such.bin | 66 | /no/such.bin
        sniff port | 66 | found a serial port or a terminal
        replay port | 66 | found a serial port or a terminal
        recover --out new.mcap port | 66 | found a serial port or a terminal
        sniff /etc/passwd | 1 | text, but no array
        sniff --port /dev/no-such | 69 | /dev/no-such: no such device
        sniff x.bin --port y | 2 | cannot be used with",
    );
}

#[test]
fn doctor_names_what_is_missing_and_who_holds_a_port() {
    let bench = Bench::new();
    // The port's name cannot split the line, nor send codes to the terminal.
    let (code, stdout, _) = ran(command("doctor --port").arg("/dev/no\nsuch\u{1b}[2J"));
    assert_eq!((code, stdout.lines().count()), (1, 1), "{stdout}");
    let missing = "/dev/no\\nsuch\\u{1b}[2J: no such device";
    assert!(stdout.starts_with(missing), "{stdout}");

    // One line says that this is not a port, whatever else is reported.
    for port in ["/dev/null", "/tmp", "/etc/passwd"] {
        let (code, stdout, _) = bench.run(&format!("doctor --port {port}"));
        assert_eq!((code, stdout.lines().count()), (1, 1), "{stdout}");
        assert!(stdout.contains("not a serial port"), "{stdout}");
    }

    let _sensor = bench.sensor("");
    let daemon = bench.daemon();
    bench.subscriber().state("live");
    let (code, stdout, stderr) = bench.run("doctor --port port");
    assert_eq!(code, 1);
    let process = daemon.process.0.id();
    let holder = format!("held by process {process}, the daemon (hardnessd run");
    for part in [&holder, ": sudo systemctl stop hardnessd"] {
        assert!(stdout.contains(part), "{part:?} not in {stdout}");
    }
    assert!(stderr.contains("1 fault found"), "{stderr}");
}

#[test]
fn a_simulated_sensor_ends_at_a_signal_and_takes_its_link_along() {
    let bench = Bench::new();
    for signal in [Signal::INT, Signal::TERM, Signal::HUP] {
        bench.sensor("").ends_at(signal, 0);
        assert!(!bench.path("port").is_symlink(), "{signal:?}");
    }
}

#[test]
fn a_simulation_leaves_files_and_links_of_others_alone() {
    let bench = Bench::new();
    bench.write("theirs.bin", "theirs");
    let there = "a file or link is there already";
    bench.fails("simulate --presses 1 --to theirs.bin", 74, &[there]);
    assert_eq!(bench.read("theirs.bin"), "theirs");

    let _sensor = bench.sensor("");
    let first = bench.path("port").read_link().unwrap();
    let another = "another `hardnessd simulate`";
    bench.fails("simulate --link port", 74, &[another]);
    assert_eq!(bench.path("port").read_link().unwrap(), first);

    // Of the links that lead nowhere, only that of a killed simulation is replaced.
    for (target, code) in [("/dev/ttyUSB99", 74), ("/dev/pts/99999", 0)] {
        let link = bench.path(&format!("dead{code}"));
        std::os::unix::fs::symlink(target, &link).unwrap();
        let simulate = "simulate --presses 1 --speed 100 --link";
        let (found, _, error) = bench.run(&format!("{simulate} dead{code}"));
        assert_eq!(found, code, "{target}: {error}");
        assert_eq!(link.is_symlink(), code == 74, "{target}");
    }
}

#[test]
fn the_user_chooses_between_two_pictures() {
    let bench = Bench::new();
    // 12x8 u8. One press on a part of one row shows how long that part is, not how long a row is.
    let frames = (0..60_u8).flat_map(|time| {
        let mut frame = [&[0xAA, 0x55][..], &[0; 96]].concat();
        if time / 20 == 1 {
            frame[42..46].copy_from_slice(&[60, 90, 90, 60].map(|value| value + time));
        }
        frame
    });
    bench.write("open.bin", frames.collect::<Vec<u8>>());
    let (code, toml, stderr) = bench.run("sniff open.bin");
    assert_eq!((code, toml.as_str()), (1, ""), "{stderr}");
    let mut drawn = stderr.lines().filter(|line| line.trim().starts_with('|'));
    assert!(drawn.any(|line| line.contains('@')), "{stderr}");
    let message = stderr.lines().last().unwrap();
    assert!(
        message.contains("not sure: choose with `--rows "),
        "{stderr}"
    );
    let known = "sniff open.bin --rows 12 --cols 8 --cell u8";
    let toml = bench.succeeds(known);
    assert!(toml.ends_with("rows = 12\ncols = 8\n"), "{toml}");
    // A file that exists is not overwritten.
    assert_eq!(bench.run(&format!("{known} --out open.bin")).0, 74);
    bench.fails("sniff open.bin --rows 65", 2, &["65 is not in 1..=64"]);
}
