#!/usr/bin/env python3
"""Classifiers of scikit-learn and networks as other programs export them, in onnxruntime and adopted.

    python tests/peers/learners.py target/debug

It needs the client with its extra `adopt`, numpy, onnxruntime, scikit-learn and skl2onnx, and skips all without the last
two. Claims: `python3 -m hardnessd.adopt` takes each file as skl2onnx writes it by default, and `hrn-train check-model`
takes the result; its probabilities differ from onnxruntime's by less than 1e-5 on 288 frames; the same holds with classes
that are texts, and for graphs as PyTorch and Keras write them with any batch. What cannot be adopted is
refused in one line that says what to change, and so is a file that is no model or no data set. A model that cannot be
written whole is removed.
"""

import csv
import os
import pathlib
import resource
import sys
import tempfile
import warnings

import numpy as np
import onnx
import onnxruntime
from bench import run
from onnx import TensorProto, helper, numpy_helper

try:
    import sklearn  # noqa: F401
    import skl2onnx
except ImportError as missing:
    sys.exit(print(f"skipped: {missing} (pip install scikit-learn skl2onnx)"))

from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.ensemble import (AdaBoostClassifier, ExtraTreesClassifier, GradientBoostingClassifier,
                              RandomForestClassifier, StackingClassifier)
from sklearn.linear_model import LogisticRegression, SGDClassifier
from sklearn.neighbors import KNeighborsClassifier
from sklearn.neural_network import MLPClassifier
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import Normalizer, StandardScaler
from sklearn.svm import LinearSVC
from sklearn.tree import DecisionTreeClassifier

LABELS = np.array(["hard", "firm", "soft", "very-soft"])
TOLERANCE = 1e-5


def logistic():
    return LogisticRegression(max_iter=200)


def kinds():
    """One of each kind of classifier, by name."""
    return {
        "logistic regression": logistic(),
        "Normalizer": make_pipeline(Normalizer(), logistic()),
        "SGD": SGDClassifier(loss="log_loss"),
        "LDA": LinearDiscriminantAnalysis(),
        "forest": RandomForestClassifier(),
        "extra trees": ExtraTreesClassifier(),
        "gradient boosting": GradientBoostingClassifier(n_estimators=10, max_features=50),
        "AdaBoost": AdaBoostClassifier(n_estimators=10),
        "MLP": make_pipeline(StandardScaler(), MLPClassifier((32,), max_iter=60)),
        "stacking": StackingClassifier([("a", logistic()), ("b", DecisionTreeClassifier(max_depth=4))], cv=3),
    }


def adopt(path, data, out, code=0, **more):
    """Adopts a file anew. Gives what was said."""
    pathlib.Path(out).unlink(missing_ok=True)
    command = [sys.executable, "-m", "hardnessd.adopt", path, "--data", data, "--out", out]
    return run(*command, code=code, **more).stderr


def adopted(path, data):
    """What `adopt` makes of the file: for each frame of the data set its probabilities."""
    adopt(path, data, "adopted.onnx")
    run("hrn-train", "check-model", "adopted.onnx", "--fps", "100")
    found = []
    for split in ("train", "test"):
        pathlib.Path("verdicts.csv").unlink(missing_ok=True)
        options = ["--model", "adopted.onnx", "--data", data, "--split", split, "--verdicts", "verdicts.csv"]
        run("hrn-train", "evaluate", *options)
        with open("verdicts.csv") as lines:
            rows = csv.DictReader(lines)
            found += [[float(value) for key, value in row.items() if key.startswith("prob")] for row in rows]
    return np.array(found)


def expected(path, frames, order=None):
    """The same of onnxruntime with the original file."""
    session = onnxruntime.InferenceSession(path)
    given = session.get_inputs()[0]
    shape = [length if isinstance(length, int) else 1 for length in given.shape]
    found = []
    for frame in frames:
        last = session.run(None, {given.name: frame.reshape(shape)})[-1]
        if isinstance(last, list):
            last = [[last[0][column] for column in (order or sorted(last[0]))]]
        if session.get_outputs()[-1].name == "logits":
            powers = np.exp(last - np.max(last))
            last = powers / powers.sum()
        found.append(last[0])
    return np.array(found)


def compare(name, path, data, order=None):
    arrays = np.load(data)
    by_split = np.argsort(arrays["split"], kind="stable")
    wanted = expected(path, arrays["frames"][by_split], order)
    difference = np.abs(adopted(path, data) - wanted).max()
    print(f"{name:28} {len(by_split)} frames, {difference:.1e}")
    assert difference < TOLERANCE, (name, difference)


def refuse(path, data, wanted, code=1, **more):
    said = adopt(path, data, "refused.onnx", code, **more)
    assert wanted in said and said.count("\n") == 1 and not os.path.exists("refused.onnx"), (wanted, said)
    print(f"refused: {said.strip()}")


def export(classifier, inputs, classes, options=None, **more):
    """The file of a fitted classifier, as skl2onnx writes it by default or with an option of the classifier."""
    classifier.fit(inputs, classes)
    given = {} if options is None else {"options": {id(classifier): options}}
    model = skl2onnx.to_onnx(classifier, inputs[:1], **given, **more)
    onnx.save(model, "classifier.onnx")
    return "classifier.onnx"


def classifiers(data):
    arrays = np.load(data)
    train = arrays["split"] == 0
    inputs = arrays["frames"].reshape(-1, 784)[train]
    level = arrays["level"][train].astype(np.int64)
    for name, classifier in kinds().items():
        compare(name, export(classifier, inputs, level), data)
    compare("levels from 0", export(logistic(), inputs, level - 1), data)
    compare("without ZipMap", export(logistic(), inputs, level, {"zipmap": False}), data)
    texts = LABELS[level - 1]
    compare("texts", export(logistic(), inputs, texts), data, list(LABELS))

    def refused(wanted, classifier, classes=level, options=None, values=inputs, **more):
        refuse(export(classifier, values, classes, options, **more), data, wanted)

    refused("without the option `zipmap`", logistic(), texts, {"zipmap": False})
    refused("found the classes 10, 20, 30, 40", logistic(), 10 * level)
    refused("no options for the outputs", logistic(), options={"zipmap": "columns"})
    refused("expected f32 (skl2onnx: `to_onnx(", logistic(), values=inputs.astype(np.float64))
    refused("`target_opset=17`", MLPClassifier((8,), max_iter=20), target_opset=12)
    refused("with `predict_proba`", LinearSVC())
    # What has operators that the daemon does not run, `check-model` names.
    adopt(export(KNeighborsClassifier(), inputs, level), data, "adopted.onnx")
    said = run("hrn-train", "check-model", "adopted.onnx", code=78)
    assert "integers that depend on an input" in said.stdout + said.stderr, said


def bad_files(data):
    """What is no model, what is no data set, and no place for the model."""
    arrays = dict(np.load(data))
    inputs = arrays["frames"].reshape(-1, 784)
    model = export(logistic(), inputs, arrays["level"].astype(np.int64))
    whole = pathlib.Path(model).read_bytes()
    for content in (b"no model\n", whole[: len(whole) // 2]):
        pathlib.Path("bad.onnx").write_bytes(content)
        refuse("bad.onnx", data, "bad.onnx: not an ONNX file: ")
    refuse(model, model, f"{model}: not a data set (.npz): no zip archive")
    with_nan = arrays["frames"].copy()
    with_nan[3, 4, 5] = np.nan
    for name, array, wanted in [
        ("meta", np.frombuffer(b"{", np.uint8), "meta: not JSON"),
        ("meta", np.frombuffer(b'{"levels":[1,2,3,4]}', np.uint8), "a number `level` and a text `label` of each: found 1"),
        ("level", None, "it has no 'level'"),
        ("level", arrays["level"][1:], "frames: found float32 [288, 28, 28], expected numbers [287, 28, 28]"),
        ("frames", inputs, "frames: found float32 [288, 784], expected numbers [288, 28, 28]"),
        ("frames", with_nan, "frames: found nan, expected -1000000 to 1000000"),
        ("split", None, ""),
    ]:
        given = {key: value for key, value in {**arrays, name: array}.items() if value is not None}
        np.savez("bad.npz", **given)
        if wanted:
            refuse(model, "bad.npz", wanted)
        else:
            # Without a split all presses are for training.
            adopt(model, "bad.npz", "adopted.onnx")

    def small_files():
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))

    refuse(model, data, "refused.onnx: File too large", preexec_fn=small_files)


def networks(data):
    """Graphs as exporters write them: PyTorch's for a batch that may change, and Keras's through tf2onnx."""
    random = np.random.default_rng(1)

    def weight(name, *shape):
        spread = np.sqrt(np.prod(shape) / 4)
        return numpy_helper.from_array((random.normal(size=shape) / spread).astype(np.float32), name)

    def indices(name, *values):
        return numpy_helper.from_array(np.array(values, np.int64), name)

    weights = [
        weight("conv.weight", 8, 1, 5, 5), weight("conv.bias", 8), weight("fc.weight", 4, 8 * 14 * 14),
        weight("fc.bias", 4), weight("w", 8 * 14 * 14, 4), indices("rest", 8 * 14 * 14),
        indices("image", -1, 1, 28, 28), indices("flat", -1, 8 * 14 * 14),
    ]

    def convolved(source):
        return [
            helper.make_node("Conv", [source, "conv.weight", "conv.bias"], ["conv"], pads=[2] * 4),
            helper.make_node("Relu", ["conv"], ["relu"]),
            helper.make_node("MaxPool", ["relu"], ["pool"], kernel_shape=[2, 2], strides=[2, 2]),
        ]

    def gemm(output):
        return helper.make_node("Gemm", ["view", "fc.weight", "fc.bias"], [output], transB=1)

    flat = helper.make_node("Concat", ["batch", "rest"], ["shape"], axis=0)
    view = helper.make_node("Reshape", ["pool", "shape"], ["view"])
    newer = [helper.make_node("Shape", ["x"], ["batch"], start=0, end=1), *convolved("x"), flat, view]
    keras = [
        helper.make_node("Reshape", ["x", "image"], ["nchw"]), *convolved("nchw"),
        helper.make_node("Reshape", ["pool", "flat"], ["view"]),
        helper.make_node("MatMul", ["view", "w"], ["dense"]), helper.make_node("Add", ["dense", "fc.bias"], ["sum"]),
        helper.make_node("Softmax", ["sum"], ["Identity:0"]),
    ]

    def save(nodes, shape, output, opset):
        graph = helper.make_graph(
            nodes,
            "main_graph",
            [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["batch", *shape])],
            [helper.make_tensor_value_info(output, TensorProto.FLOAT, ["batch", 4])],
            weights,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)
        onnx.checker.check_model(model, full_check=True)
        onnx.save(model, "network.onnx")
        return "network.onnx"

    compare("PyTorch", save([*newer, gemm("logits")], [1, 28, 28], "logits", 18), data)
    compare("Keras", save(keras, [28, 28, 1], "Identity:0", 15), data)
    refuse(save([*newer, gemm("linear_1")], [1, 28, 28], "linear_1", 18), data, '`output_names=["logits"]`')


def main(binaries):
    warnings.filterwarnings("ignore")
    # scikit-learn takes its random numbers from here.
    np.random.seed(1)
    onnxruntime.set_default_logger_severity(3)
    os.environ["PATH"] = f"{os.path.abspath(binaries)}:{os.environ['PATH']}"
    with tempfile.TemporaryDirectory() as directory:
        os.chdir(directory)
        few = "--objects 4 --test-objects 2 --presses 12".split()
        run("hrn-train", "simulate", "--out", "data.npz", *few)
        classifiers("data.npz")
        networks("data.npz")
        bad_files("data.npz")
        os.chdir("/")


if __name__ == "__main__":
    main(*sys.argv[1:])
