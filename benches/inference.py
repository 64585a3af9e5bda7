#!/usr/bin/env python3
"""A verdict beside onnxruntime's, on one thread: same file, same frames or presses, in turns.

    pip install numpy onnx onnxruntime
    cargo build --release
    python3 benches/inference.py target/release/hardnessd models/hrn.onnx models/course.onnx

Ours is what the daemon's own trial of a model says: the median of the processor time of 15 verdicts. That of
onnxruntime is the median of as many calls, its call from Python included. Rounds alternate. The floor is the
multiplications and additions of the graph at the speed that numpy's matrix product has here.
"""

import argparse
import itertools
import json
import os
import statistics
import subprocess
import time

for library in ("OPENBLAS", "OMP", "MKL"):
    os.environ[f"{library}_NUM_THREADS"] = "1"

import numpy  # noqa: E402
import onnx  # noqa: E402
import onnxruntime  # noqa: E402

VERDICTS = 15


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("binary")
    parser.add_argument("models", nargs="+")
    parser.add_argument("--rounds", type=int, default=40)
    arguments = parser.parse_args()
    peak = multiply_adds_per_s()
    print(f"numpy's matrix product: {peak / 1e9:.1f} G multiply-adds/s on one core")
    for path in arguments.models:
        compare(arguments.binary, path, arguments.rounds, peak)


def compare(binary, path, rounds, peak):
    with open(path, "rb") as file:
        content = file.read()
    model = onnx.load_from_string(content)
    calls, expected = inputs(model)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    # The daemon computes the features of a press for a model with bins.
    apart = "not compared"
    if any(output.name == "probabilities" for output in session.get_outputs()):
        apart = max(
            numpy.abs(session.run(["probabilities"], call)[0][0] - probabilities).max()
            for call, probabilities in zip(calls, expected, strict=True)
        )
    theirs, ours = [], []
    for _ in range(rounds):
        theirs.append(their_us(session, calls))
        ours.append(our_us(binary, content))
    work = multiply_adds(model)
    floor = work / peak * 1e6
    their, our = statistics.median(theirs), statistics.median(ours)
    ratios = sorted(a / b for a, b in zip(theirs, ours, strict=True))
    print(
        f"{path}: onnxruntime {onnxruntime.__version__} {their:.0f} us (least {min(theirs):.0f}),"
        f" ours {our:.0f} us (least {min(ours):.0f}); its time over ours {statistics.median(ratios):.2f}"
        f" ({ratios[len(ratios) // 10]:.2f} to {ratios[-1 - len(ratios) // 10]:.2f});"
        f" floor {floor:.1f} us for {work / 1e6:.2f} M multiply-adds, ours over it {our / floor:.1f};"
        f" greatest difference to the file's probabilities: {apart}"
    )


def their_us(session, calls):
    times = []
    for call in itertools.islice(itertools.cycle(calls), VERDICTS + 2):
        begun = time.thread_time_ns()
        session.run(None, call)
        times.append(time.thread_time_ns() - begun)
    # Ours has reproduced its check frames before it is timed.
    return statistics.median(times[2:]) / 1e3


def our_us(binary, content):
    # By this name the program tries a model and says how long a verdict takes.
    trial = subprocess.run(["hardnessd-trial"], executable=binary, input=content, capture_output=True)
    return json.loads(trial.stdout)["Ok"]


def inputs(model):
    """The check frames or presses as inputs, and the probabilities that the file has for them."""
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    check = json.loads(metadata["hrn.check"])
    if "frames" in check:
        frames = numpy.array(check["frames"], numpy.float32).reshape(-1, 1, 1, 28, 28)
        return [{"frame": frame} for frame in frames], numpy.array(check["probabilities"])
    shapes = {value.name: [dim.dim_value for dim in value.type.tensor_type.shape.dim] for value in model.graph.input}
    calls = []
    for number, press in enumerate(check["presses"]):
        call = {name: numpy.zeros(shape, numpy.float32) for name, shape in shapes.items()}
        # The daemon computes the features. The time of a product does not depend on its numbers.
        call["features"][:] = numpy.random.default_rng(number).normal(size=shapes["features"])
        calls.append(call)
    return calls, numpy.array([press["probabilities"] for press in check["presses"]])


def multiply_adds(model):
    """Of the convolutions and matrix products."""
    typed = onnx.shape_inference.infer_shapes(model, data_prop=True)
    values = [*typed.graph.value_info, *typed.graph.input, *typed.graph.output]
    shapes = {value.name: [dim.dim_value for dim in value.type.tensor_type.shape.dim] for value in values}
    shapes |= {tensor.name: list(tensor.dims) for tensor in typed.graph.initializer}
    total = 0
    for node in typed.graph.node:
        if node.op_type == "Conv":
            # Output channels, then input channels of a group and the kernel.
            total += numpy.prod(shapes[node.output[0]]) * numpy.prod(shapes[node.input[1]][1:])
        elif node.op_type in ("Gemm", "MatMul"):
            inner = shapes[node.input[0]][-1]
            total += numpy.prod(shapes[node.output[0]]) * inner
    return float(total)


def multiply_adds_per_s():
    size = 512
    left = numpy.ones((size, size), numpy.float32)
    left @ left
    times = []
    for _ in range(20):
        begun = time.thread_time_ns()
        left @ left
        times.append(time.thread_time_ns() - begun)
    return size**3 / (min(times) / 1e9)


if __name__ == "__main__":
    main()
