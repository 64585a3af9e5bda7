#!/usr/bin/env python3
"""The Python client's readers, on data sets and recordings that our programs write.

    python3 -m venv venv && venv/bin/pip install './clients/python[dataset,plot,recording]' mypy
    venv/bin/python tests/peers/readers.py target/debug

Claims: a data set reads as numpy reads it, and what is none is refused with the array's name; a recording
gives the very events that a subscriber read, the frames and the bytes; a damaged one is refused in one
line. `python3 -m hardnessd.plot` replaces no picture unless --out names it, and says in one line what it cannot draw or
write. The type hints are strict, and a program that installs the package is checked by them.
"""

import json
import pathlib
import re
import sys
import tempfile

import numpy as np
from bench import run, taken
from hardnessd import dataset, recording

ROOT = pathlib.Path(__file__).parents[2]
CLIENT = ROOT / "clients/python"


def refused(read, path, said):
    try:
        read(path)
    except ValueError as error:
        assert said in str(error) and str(path) in str(error) and "\n" not in str(error), error
    else:
        raise AssertionError(f"{path} is not refused: {said}")


def data_sets(binaries, directory):
    path = directory / "data.npz"
    sizes = ["--objects", "2", "--test-objects", "1", "--presses", "4", "--seed", "1"]
    run(binaries / "hrn-train", "simulate", "--out", path, *sizes)
    presses = dataset.load(path)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    for name in ("frames", "level", "object", "material", "force", "split", "shore"):
        found = getattr(presses, name)
        assert (found is None) == (name not in arrays), name
        assert found is None or np.array_equal(found, arrays[name], equal_nan=True), name
    assert presses.meta == json.loads(arrays["meta"].tobytes()) and "materials" in presses.meta
    test = presses.part("test")
    assert 0 < len(test) < len(presses) and len(test) + len(presses.part("train")) == len(presses)
    assert test.frames.shape == (len(test), 28, 28) and len(test.labelled()) == len(test)

    least = {"frames": arrays["frames"], "level": arrays["level"]}
    np.savez(directory / "least.npz", more=np.arange(3), **least)
    read = dataset.load(directory / "least.npz")
    assert read.object is None and read.meta == {} and len(read.part("train")) == len(read)
    assert list(read.others) == ["more"]
    for name, array, said in [
        ("level", arrays["level"].astype(np.int64), "level: found int64"),
        ("frames", arrays["frames"][:, :14], "frames: found float32 [48, 14, 28], expected float32 [48, 28, 28]"),
        ("split", arrays["split"][:-1], "split: found uint8 [47], expected uint8 [48]"),
        ("meta", np.frombuffer(b"{", np.uint8), "meta: not JSON"),
        ("frames", None, "frames: found none"),
        ("level", np.array([object()]), "not a data set"),
    ]:
        given = {key: value for key, value in {**arrays, name: array}.items() if value is not None}
        np.savez(directory / "wrong.npz", **given)
        refused(dataset.load, directory / "wrong.npz", said)
    for content in (b"", b"PK\x03\x04", b"frames\n", path.read_bytes()[:-200]):
        (directory / "wrong.npz").write_bytes(content)
        refused(dataset.load, directory / "wrong.npz", "not a data set")
    np.save(directory / "one.npy", arrays["level"])
    refused(dataset.load, directory / "one.npy", "not a data set")
    return len(presses)


def pictures(directory):
    def plot(*arguments, code=0):
        done = run(sys.executable, "-m", "hardnessd.plot", *arguments, code=code, cwd=directory)
        assert done.stderr.count("\n") == code, done.stderr
        return done.stdout + done.stderr

    picture = directory / "data.png"
    assert plot("data.npz") == "data.png\n"
    picture.write_text("of somebody")
    assert plot("data.npz", code=1) == "data.png: it exists already: name another file with --out\n"
    assert picture.read_text() == "of somebody"
    plot("data.npz", "--out", "data.png")
    assert picture.read_bytes().startswith(b"\x89PNG")
    data = (directory / "data.npz").read_bytes()
    (directory / "cut.npz").write_bytes(data[:-200])
    (directory / "damaged.npz").write_bytes(data[:2000] + bytes(100) + data[2100:])
    (directory / "empty.json").write_text("")
    (directory / "results.json").write_text("[{}]")
    (directory / "two.json").write_text('{"models":[],"difference":{}}')
    for name, said in [
        ("cut.npz", "not a data set"),
        ("damaged.npz", "not a data set"),
        ("empty.json", "not JSON"),
        ("results.json", "found a list, expected `hrn-train fit --json`"),
        ("two.json", "found the keys difference, models, expected"),
    ]:
        found = plot(name, code=1)
        assert found.startswith(f"{name}: ") and said in found, found
    assert plot("data.npz", "--out", "/dev/full", code=1) == "/dev/full: No space left on device\n"
    assert "not supported" in plot("data.npz", "--out", "data.pictures", code=1)


def a_recording(binary, directory, built_in):
    """The daemon's own recording, beside what a subscriber read. `built_in` is the name of the model."""
    live = taken(binary, directory / "take.mcap", more=f'[model]\nbuilt_in = "{built_in}"\n')
    with recording.open(directory / "take.mcap") as take:
        assert take.about["robot"] == "arm-7" and take.sensors["forearm"]["name"] == "forearm"
        events = {event["seq"]: event for event in take.events()}
        numbered = [event for event in live if "seq" in event]
        assert len(numbered) >= 8 and list(events) == sorted(events), numbered
        assert {seq: event["type"] for seq, event in events.items()}.items() >= {
            event["seq"]: event["type"] for event in numbered
        }.items()
        verdicts = list(take.events(types=["hardness"]))
        assert {event["type"] for event in verdicts} == {"hardness"}
        judged = [event for event in verdicts if event["probabilities"]]
        whole = [event for event in judged if event["shore"] and event["levels"] and event["course"] == "none"]
        assert judged and len(whole) == (len(judged) if built_in == "course" else 0), verdicts
        frames = list(take.frames())
        shown = {event["frame"]: event["newtons"] for event in live if event["type"] == "frame"}
        assert len(shown) > 50 and len(frames) >= len(shown)
        for number, newtons in shown.items():
            assert np.allclose(frames[number].newtons, newtons, atol=0.0006), number
        sent = b"".join(chunk.data for chunk in take.chunks())
        assert 0 <= len(sent) - 790 * len(frames) < 2 * 790
    return len(verdicts), len(frames)


def damaged(directory):
    """What is damaged is refused with what to do."""
    whole = (directory / "take.mcap").read_bytes()
    broken = directory / "broken.mcap"

    def read(path):
        with recording.open(path) as take:
            return len(list(take.events())) + len(list(take.frames()))

    for content in (b"", b"not one"):
        broken.write_bytes(content)
        refused(read, broken, "no MCAP recording")
    for content in (whole[: len(whole) // 2], whole[:-1]):
        broken.write_bytes(content)
        refused(read, broken, "hardnessd recover")


def types(directory):
    """The hints are strict, and reach whoever installs the package."""
    def mypy(*options, code=0):
        command = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", directory / "mypy", *options]
        return run(*command, code=code, cwd=directory).stdout.replace("builtins.", "")

    sources = [CLIENT / "hardnessd.py", *sorted((CLIENT / "package").glob("*.py"))]
    for source in sources:
        mypy("--config-file", CLIENT / "pyproject.toml", source)
    program = directory / "program.py"
    blocks = re.findall(r"```python\n(.*?)```", (CLIENT / "README.md").read_text(), re.S)
    program.write_text("\n\n".join(blocks).replace("async def main():", "async def main() -> None:"))
    mypy(program)
    program.write_text(
        "import hardnessd\n"
        "for event in hardnessd.Client():\n"
        "    if event['type'] == 'hardness':\n"
        "        reveal_type(event['force_n'])\n"
        "        print(event['forse_n'])\n"
    )
    said = mypy(program, code=1)
    assert 'Revealed type is "float"' in said and '"Hardness" has no key "forse_n"' in said, said
    return len(sources)


def readme(directory):
    blocks = re.findall(r"```python\n(.*?)```", (CLIENT / "README.md").read_text(), re.S)
    (block,) = [block for block in blocks if "recording.open" in block]
    run(sys.executable, "-c", block, cwd=directory)


def main(binaries):
    with tempfile.TemporaryDirectory() as name:
        directory = pathlib.Path(name)
        print("a data set of", data_sets(binaries, directory), "presses")
        pictures(directory)
        for built_in in ["course", "hrn"]:
            found = a_recording(binaries / "hardnessd", directory, built_in)
            print("a recording of %d verdicts and %d frames" % found)
        damaged(directory)
        readme(directory)
        print("type hints of", types(directory), "files")


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]).resolve())
