#!/usr/bin/env python3
"""What the daemon sends, against docs/events.schema.json.

    python -m venv venv && venv/bin/pip install jsonschema
    venv/bin/python tests/peers/schema.py target/debug/hardnessd

Claims: the frozen lines of crates/core/tests/core/event_format.rs, all types of live lines and those of a replay are
valid. The schema names every field there is, and so do docs/protocol.md and the type hints of the Python client.
"""

import json
import pathlib
import re
import sys

from bench import Bench, run
from jsonschema import Draft202012Validator

ROOT = pathlib.Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "clients/python"))
import hardnessd  # noqa: E402  (found by the line above)

SCHEMA = json.loads((ROOT / "docs/events.schema.json").read_text())
VALIDATOR = Draft202012Validator(SCHEMA)


def check(line):
    """Valid, and nothing in it is missing from the schema."""
    event = json.loads(line) if isinstance(line, str) else line
    VALIDATOR.validate(event)
    unknown(event, SCHEMA["$defs"][event["type"]])
    return event["type"]


def unknown(value, schema):
    if "$ref" in schema:
        schema = SCHEMA["$defs"][schema["$ref"].rsplit("/", 1)[1]]
    if isinstance(value, dict) and "properties" in schema:
        more = set(value) - set(schema["properties"])
        assert not more, f"the schema does not name {more}"
        for key, inner in value.items():
            unknown(inner, schema["properties"][key])
    elif isinstance(value, list):
        for inner in value:
            unknown(inner, schema.get("items", {}))


def frozen():
    text = (ROOT / "crates/core/tests/core/event_format.rs").read_text()
    # A frame of three taxels and a hash of two digits are not meant to be real.
    lines = [line for line in re.findall(r'r#"(\{"type".*?\})"#', text)]
    real = [line for line in lines if '"newtons"' not in line and '"sha256":"00"' not in line]
    types = {check(line) for line in real}
    assert len(real) >= 8 and {"status", "press", "hardness", "gap", "error", "ok"} <= types, types
    return len(real)


def live(binary):
    with Bench(binary) as bench:
        bench.daemon()
        client = hardnessd.Connection(bench.path("control.sock"), 60)
        client.send({"subscribe": ["hardness", "press", "status", "frame"], "id": [1]})
        client.send({"get": "touch"})
        client.send({"context": {"sensor": "forearm", "tag": "x"}})
        client.send({"get": "status"})
        sensor = bench.sensor("forearm", "--force", "15", "--presses", "3")
        seen = {}
        finals = 0
        while finals < 3:
            event = client.receive()
            kind = check(event)
            seen[kind] = seen.get(kind, 0) + 1
            if kind == "press" and event["state"] == "end":
                client.send({"tare": "forearm"})
            finals += event.get("phase") == "final"
        sensor.kill()
        while event.get("state") != "lost":
            event = client.receive()
            check(event)
    missing = {"hello", "status", "press", "hardness", "frame", "error", "ok"} - set(seen)
    assert not missing, f"no {missing} was seen"
    return seen


def replayed(binary):
    lines = 0
    for recording in sorted((ROOT / "fixtures").glob("*.5hz.bin")):
        for line in run(binary, "replay", recording).stdout.splitlines():
            check(line)
            lines += 1
    assert lines
    return lines


def documented():
    """docs/protocol.md has every field of the schema, and no other."""
    page = (ROOT / "docs/protocol.md").read_text()
    for kind in (*hardnessd.TYPES, "hello"):
        section = re.search(rf"^### `{kind}`\n(.*?)^##", page, re.M | re.S)[1]
        fields = set(re.findall(r"`(\w+)`", " ".join(re.findall(r"^\|([^|]*)\|", section, re.M))))
        # The fields of all events are in a table of their own. The `seq` of `hello` has another meaning.
        shared = {"type", "sensor", "time", "seq"} - ({"seq"} if kind == "hello" else set())
        assert fields == set(SCHEMA["$defs"][kind]["properties"]) - shared, (kind, fields)


def hinted():
    """The Python client's types have the schema's fields, required and optional alike."""
    for kind in hardnessd.TYPES + ("gap",):
        hint, schema = getattr(hardnessd, kind.capitalize()), SCHEMA["$defs"][kind]
        assert set(hint.__annotations__) == set(schema["properties"]), kind
        optional = set(schema["properties"]) - set(schema["required"])
        assert optional <= {"seq"}, f"{kind}: mark {optional} as optional in hardnessd.py"


def main(binary):
    hinted()
    Draft202012Validator.check_schema(SCHEMA)
    documented()
    print(f"{frozen()} frozen lines, {replayed(binary)} replayed lines, live: {live(binary)}")


if __name__ == "__main__":
    main(*sys.argv[1:])
