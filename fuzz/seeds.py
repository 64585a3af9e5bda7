#!/usr/bin/env python3
"""Writes the first bytes that each target begins with, from fixtures/, config/, models/ and a recording.

    pip install mcap mcap-ros2-support numpy onnx
    python3 fuzz/seeds.py RECORDING

RECORDING is one of `hardnessd record`.

They are small, because a fuzzer tries small changes fastest. `fuzz/corpus` holds them, with what the fuzzer
found to reach more code.
"""

import io
import json
import os
import pathlib
import struct
import sys

import mcap.reader
import mcap.writer
import numpy
import onnx
from onnx import TensorProto, helper, numpy_helper

TOP = pathlib.Path(__file__).parent.parent
CORPUS = TOP / "fuzz" / "corpus"
FRAME_BYTES = 790


def keep(target, name, content):
    folder = CORPUS / target
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(content)


def wire():
    fixture = (TOP / "fixtures/foam.5hz.bin").read_bytes()
    # Three sizes of chunks, then the preset: see `layout` in tests/daemon/properties.rs.
    keep("wire", "jx255n", bytes([7, 63, 255, 0]) + fixture[: 2 * FRAME_BYTES])
    cells = bytes([1, 2, 3, 250])
    for number, name in enumerate("jx255n jx255n-u16 jq jq-tail jq-u16 csv flexitac m1616".split()):
        for two in (2 + 5 * 2, 4 + 5 * 4):
            keep("wire", f"small-{name}-{two}", bytes([1, 2, 5, number | 8, two]) + cells * 8)
    keep("wire", "jq-2x2", bytes([1, 9, 2, 2 | 8, 12]) + (b"\xaa\x55\x03\x99" + cells) * 3)
    keep("wire", "jq-tail-2x2", bytes([1, 9, 2, 3 | 8, 12]) + (cells + b"\xaa\x55\x03\x99") * 3)
    keep("wire", "rows-2x2", bytes([1, 9, 2, 5 | 8, 12]) + b"1 2\n30 4\n\n" * 3)
    keep("wire", "csv-2x2", bytes([1, 9, 2, 5 | 8, 12]) + b"t 5: 1,2;30 [4]\nready\n" * 3)
    packets = bytes([32 | 64 | 8, 0, 1, 0, 0, 2, 0, 1, 12])
    keep("wire", "packets-2x2", bytes([1, 9, 2]) + packets + b"\xaa\x55\1\1\2\xaa\x55\2\3\4" * 3)
    free = bytes([8 | 16, 12, 2, 0xBB, 0xAA, 1, 0xEE, 1, 0, 2, 0, 0xFF, 0xFF, 0])
    keep("wire", "free", bytes([3, 1, 4]) + free + b"\xbb\xaa\4\1\2\3\4\0\xee" * 2)


def lines():
    requests = [
        '{"subscribe":["hardness","press","status","frame"],"policy":"latest","since":"ab:7","id":1}',
        '{"get":"status"}\n{"get":"last","id":[1]}',
        '{"tare":"a","id":"x"}',
        '{"context":{"sensor":"a","tag":"pick"}}',
        '{"motion":{"sensor":"a","at":[[1000000000,1.5],[1010000000,1.6]]}}',
        '{"motion":{"sensor":"a","at":[["2026-01-01T00:00:00Z",1.5]]}}',
        '{"blackbox":"a"}',
        '{"get":"frames"}\n[1]\n\xff',
    ]
    for index, request in enumerate(requests):
        for control in (0, 1):
            keep("lines", f"{index}-{control}", bytes([control]) + request.encode("latin1"))


def http():
    heads = [
        "GET / HTTP/1.1\r\nHost: localhost\r\n\r\n",
        "GET /events?types=frame,hardness&policy=latest&since=ab:7 HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
        "HEAD /events HTTP/1.1\r\nHost: [::1]:80\r\nLast-Event-ID: ab:7\r\n\r\n",
        "GET /api/status HTTP/1.1\r\nhost: localhost\r\n\r\nGET /metrics HTTP/1.1\r\nhost: localhost\r\n\r\n",
        "POST /livez HTTP/1.1\r\nhost: localhost\r\ncontent-length: 3\r\n\r\nabc",
        "POST / HTTP/1.1\r\nhost: localhost\r\ntransfer-encoding: chunked\r\n\r\n3\r\nabc\r\n0\r\n\r\n",
        "GET http://localhost/readyz HTTP/1.1\r\nhost: localhost\r\n\r\n",
        "GET /livez HTTP/1.0\r\nHost: evil.example\r\n\r\n",
        "GET /events?types=frame HTTP/1.1\r\nhost: localhost\r\n\r\nGET /metrics HTTP\nhost\n\n",
        "OPTIONS * HTTP/1.1\r\nhost: a@localhost\r\nconnection: upgrade\r\nupgrade: h2c\r\n\r\n",
    ]
    for index, head in enumerate(heads):
        keep("http", str(index), head.encode())


def configuration():
    whole = (TOP / "config/hardnessd.toml").read_text()
    keep("configuration", "whole", whole.encode())
    bare = "\n".join(line for line in whole.splitlines() if line and not line.startswith("#"))
    keep("configuration", "bare", bare.encode())
    keep("configuration", "least", b'[[sensor]]\nname = "a"\nport = "p"\n')
    keep(
        "configuration",
        "free",
        b'[[sensor]]\nname = "a"\nport = "p"\ndead_taxels = [[0, 1]]\n[sensor.frame]\nsync = "BB AA"\ncell = "u16le"\n'
        b'checksum = "sum8"\nlength = "u8"\nrows = 2\ncols = 2\n[publish.tcp]\nlisten = "[::1]:0"\n[record]\n',
    )


def recording(whole):
    """The beginning of a recording, and its first messages without chunks, compression or checksums."""
    out = io.BytesIO()
    writer = mcap.writer.Writer(
        out, use_chunking=False, enable_crcs=False, enable_data_crcs=False, index_types=mcap.writer.IndexType.NONE
    )
    writer.start(profile="", library="")
    channels = {}
    counts = {}
    with io.BytesIO(whole) as source:
        for schema, channel, message in mcap.reader.make_reader(source).iter_messages():
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data if len(schema.data) < 64 else b"")
                channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, number)
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
            if counts[channel.topic] <= 2:
                writer.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
    writer.finish()
    plain = out.getvalue()
    for target in ("recording", "recover"):
        keep(target, "plain", plain)
        keep(target, "cut", plain[: len(plain) * 2 // 3])
        keep(target, "magic", plain[:8])
        keep(target, "chunk", whole[:6000])


def model():
    """Two small graphs that the loader takes, and one that it refuses."""
    original = onnx.load(TOP / "models/hrn.onnx")
    # All weights are zero, so all levels are equally likely.
    check = {"frames": [[0] * 784] * 8, "probabilities": [[0.25] * 4] * 8}
    value = helper.make_tensor_value_info
    ends = (
        [value("frame", TensorProto.FLOAT, [1, 1, 28, 28])],
        [value(name, TensorProto.FLOAT, [1, 4]) for name in ("logits", "probabilities")],
    )
    softmax = helper.make_node("Softmax", ["logits"], ["probabilities"], axis=1)

    def keep_graph(name, nodes, weights):
        weights = [numpy_helper.from_array(weight, key) for key, weight in weights.items()]
        small = helper.make_model(
            helper.make_graph([*nodes, softmax], "g", *ends, weights),
            opset_imports=original.opset_import,
            ir_version=original.ir_version,
        )
        for entry in original.metadata_props:
            text = json.dumps(check, separators=(",", ":")) if entry.key == "hrn.check" else entry.value
            text = "{}" if entry.key == "hrn.metrics" else text
            small.metadata_props.add(key=entry.key, value=text)
        keep("model", name, small.SerializeToString())

    zeros = lambda *shape: numpy.zeros(shape, dtype=numpy.float32)  # noqa: E731
    linear = [
        helper.make_node("Flatten", ["frame"], ["flat"]),
        helper.make_node("MatMul", ["flat", "w"], ["logits"]),
    ]
    keep_graph("linear", linear, {"w": zeros(784, 4)})
    convolution = [
        helper.make_node("Conv", ["frame", "k"], ["c"], kernel_shape=[3, 3], pads=[1, 1, 1, 1], strides=[2, 2]),
        helper.make_node("LeakyRelu", ["c"], ["r"], alpha=0.2),
        helper.make_node("GlobalAveragePool", ["r"], ["p"]),
        helper.make_node("Reshape", ["p", "s"], ["logits"]),
    ]
    weights = {"k": zeros(4, 1, 3, 3), "s": numpy.array([-1, 4], dtype=numpy.int64)}
    keep_graph("convolution", convolution, weights)
    wrong = [helper.make_node("Hardmax", ["frame"], ["logits"])]
    keep_graph("refused", wrong, {})


def npz():
    members = {
        "frames": numpy.zeros((3, 28, 28), dtype=numpy.float32),
        "level": numpy.array([0, 1, 2], dtype=numpy.uint8),
        "object": numpy.arange(3, dtype=numpy.uint32),
        "split": numpy.array([0, 0, 1], dtype=numpy.uint8),
    }
    for name, save in (("stored", numpy.savez), ("deflated", numpy.savez_compressed)):
        out = io.BytesIO()
        save(out, **members)
        keep("npz", name, out.getvalue())


def references():
    flat = {"time_s": [0, 0.1], "approach_mm": [0, 0.5], "arm_n_per_mm": 12.5, "frames": ["", "AAAAAIA/"]}
    flat["piece"] = {"flat": {"width_mm": 20.0}}
    known = {"time_s": [0], "approach_mm": [None], "arm_n_per_mm": 0, "frames": [""]}
    known["piece"] = {"shore": {"range": [61, 70]}}
    texts = [json.dumps(press).encode() for press in (flat, known)]
    members = {str(number): numpy.frombuffer(text, dtype=numpy.uint8) for number, text in enumerate(texts)}
    for name, save in (("stored", numpy.savez), ("deflated", numpy.savez_compressed)):
        out = io.BytesIO()
        save(out, **members)
        keep("references", name, out.getvalue())


def motion():
    keep("motion", "table", b"\0time_s,approach_mm\n0,0\n0.1,0.5\n0.2,1e0\n0.15,1\n")
    steps = b"".join(bytes([10, mm]) for mm in range(40))
    keep("motion", "points", b"\1" + struct.pack("<q", 10**9) + steps)
    keep("motion", "back", b"\1" + struct.pack("<q", 10**9) + steps + b"\0" + struct.pack("<q", -(10**8)) + b"\3" + steps)


def main():
    whole = pathlib.Path(sys.argv[1]).read_bytes()
    os.chdir(TOP)
    for make in (wire, lines, http, configuration, model, npz, references, motion):
        make()
    recording(whole)
    total = sum(path.stat().st_size for path in CORPUS.rglob("*") if path.is_file())
    print(f"{total} bytes in {CORPUS}", file=sys.stderr)


if __name__ == "__main__":
    main()
