#!/usr/bin/env python3
"""The Debian package, unpacked and used from where it was unpacked.

    .ci/deb trial
    python3 tests/peers/package.py target/package-debug/debian/hardnessd_*.deb

Claims: all is root's, with the modes that lintian asks for; the configuration is a conffile and
passes `check`; the installed binary shows a press; man pages and completions render and name every
command; the units name what is installed; every link and picture of a page is there; the crates that it is built of are listed; no script stumbles.
machine.py installs it.
"""

import json
import os
import pathlib
import re
import subprocess
import sys
import tempfile

import bench


def run(*command, **more):
    return bench.run(*command, **more).stdout


def main(package):
    with tempfile.TemporaryDirectory() as place:
        root, control = os.path.join(place, "root"), os.path.join(place, "control")
        run("dpkg-deb", "-x", package, root)
        run("dpkg-deb", "-e", package, control)
        files = listing(package)
        scripts(control)
        configuration(root, control)
        commands = binary(root)
        pages(root, commands)
        completions(root, commands)
        units(root, files)
        linked = links(root)
        crates = parts(root)
    print(f"package: {len(files)} files, {len(commands)} commands with page and completion, {linked} links, {crates} crates")


def parts(root):
    """The crates that it is built of are those of Cargo.lock, and none of the trainer's."""
    with open(os.path.join(root, "usr/share/doc/hardnessd/hardnessd.cdx.json")) as file:
        sbom = json.load(file)
    assert sbom["bomFormat"] == "CycloneDX" and "serialNumber" not in sbom
    found = {(crate["name"], crate["version"]) for crate in sbom["components"]}
    lock = pathlib.Path(__file__).parent.parent.parent.joinpath("Cargo.lock").read_text()
    locked = set(re.findall(r'^name = "(.+)"\nversion = "(.+)"$', lock, re.MULTILINE))
    assert found <= locked, found - locked
    names = {name for name, _ in found}
    assert {"tract-onnx", "tokio", "mcap"} <= names and not {"burn-core", "zenoh", "ros2-client", "foxglove"} & names, names
    return len(found)


def listing(package):
    files = {}
    for line in run("dpkg-deb", "-c", package).splitlines():
        mode, owner, _, _, _, name = line.split(None, 5)
        assert owner in ("root/root", "0/0"), line
        if mode.startswith("d"):
            assert mode == "drwxr-xr-x", line
            continue
        is_program = name == "./usr/bin/hardnessd"
        assert mode == ("-rwxr-xr-x" if is_program else "-rw-r--r--"), line
        files[name[1:]] = mode
    for path in [
        "/usr/lib/systemd/system/hardnessd.service",
        "/usr/lib/sysusers.d/hardnessd.conf", "/usr/lib/tmpfiles.d/hardnessd.conf",
        "/usr/lib/udev/rules.d/99-hardnessd.rules", "/etc/hardnessd.toml",
        "/usr/share/doc/hardnessd/copyright", "/usr/share/doc/hardnessd/LICENSE-MIT",
    ]:
        assert path in files, path
    return files


def scripts(control):
    for name in ("postinst", "prerm", "postrm"):
        path = os.path.join(control, name)
        assert os.stat(path).st_mode & 0o777 == 0o755, name
        text = open(path).read()
        assert text.startswith("#!/bin/sh\n") and "set -e" in text and "#DEBHELPER#" not in text, name
        run("sh", "-n", path)
    assert "systemd-sysusers" in open(os.path.join(control, "postinst")).read()


def configuration(root, control):
    assert open(os.path.join(control, "conffiles")).read().split() == ["/etc/hardnessd.toml"]
    run(f"{root}/usr/bin/hardnessd", "check", "--config", f"{root}/etc/hardnessd.toml")


def binary(root):
    program = f"{root}/usr/bin/hardnessd"
    events = run(program, "demo", "--presses", "1", "--speed", "4").splitlines()
    assert json.loads(events[-1])["phase"] == "final", events[-1]
    listed = run(program, "--help").split("Commands:\n")[1].split("\n\n")[0]
    # A description that is too long goes on in a line with a deeper indent.
    commands = re.findall(r"^  (\S+)", listed, re.MULTILINE)
    assert "run" in commands, commands
    commands.remove("help")
    return commands


def pages(root, commands):
    folder = f"{root}/usr/share/man/man1"
    for name in ["hardnessd", *(f"hardnessd-{command}" for command in commands)]:
        page = f"{folder}/{name}.1.gz"
        assert os.path.exists(page), sorted(os.listdir(folder))
        shown = subprocess.run(
            ["man", "--warnings", "-E", "UTF-8", "-l", page], capture_output=True, text=True,
            env={**os.environ, "MANWIDTH": "80", "LC_ALL": "C.UTF-8"},
        )
        assert shown.returncode == 0 and not shown.stderr, (name, shown.stderr)
        assert "SYNOPSIS" in shown.stdout and name.replace("-", " ") in shown.stdout.replace("-", " ")
    top = run("man", "-l", f"{folder}/hardnessd.1.gz", env={**os.environ, "MANWIDTH": "80"})
    assert all(f"hardnessd-{command}(1)" in top for command in commands), top
    assert "78 bad configuration" in re.sub(r"\s+", " ", top), top


def completions(root, commands):
    completion = f"{root}/usr/share/bash-completion/completions/hardnessd"
    script = f"""
        source {completion}
        complete -p hardnessd >/dev/null
        COMP_WORDS=(hardnessd "") COMP_CWORD=1
        _hardnessd hardnessd "" hardnessd
        echo "${{COMPREPLY[@]}}"
    """
    offered = run("bash", "-eu", "-c", script).split()
    assert set(commands) <= set(offered), (commands, offered)
    for name in ["zsh/vendor-completions/_hardnessd", "fish/vendor_completions.d/hardnessd.fish"]:
        text = open(f"{root}/usr/share/{name}").read()
        assert all(command in text for command in commands), name


def links(root):
    folder, count = pathlib.Path(root, "usr/share/doc/hardnessd"), 0
    for page in folder.rglob("*.md"):
        prose = re.sub(r"^ *```.*?^ *```", "", page.read_text(), flags=re.M | re.S)
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", prose):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.relative_to(folder)}: {target}"
                count += 1
    assert count > 100, count
    return count


def units(root, files):
    unit = open(f"{root}/usr/lib/systemd/system/hardnessd.service").read()
    program, config = re.search(r"ExecStart=(\S+) run --config (\S+)", unit).groups()
    assert program in files and config in files, unit
    assert "RuntimeDirectory=hardnessd" in unit


if __name__ == "__main__":
    main(sys.argv[1])
