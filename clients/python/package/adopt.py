"""`python3 -m hardnessd.adopt IN.onnx --out M.onnx`: makes a model that hardnessd loads of what other programs export.

It gives the graph the names, shapes and the opset of a model of one frame, and adds the metadata: levels, pitch, range and
check frames of the data set that it learnt from (`--data`). What it changes in the graph never changes a
probability. The check frames hold what onnx's own reference computes with the original file, so the daemon shows that
it computes the same. `hrn-train check-model M.onnx` says whether the daemon takes the result.

It needs onnx and numpy: pip install './clients/python[adopt]'
"""

from __future__ import annotations

import argparse
import json
import os
from typing import Any, Dict, List, Optional, Sequence, Tuple

import numpy as np
import onnx
from onnx import AttributeProto, TensorProto, helper, numpy_helper
from onnx.reference import ReferenceEvaluator

from hardnessd.dataset import best_frames
from hardnessd.files import BadFile, ending, reading, save

OPSET = 17
LEARNERS = "ai.onnx.ml"
LEVELS = [
    {"level": 1, "label": "hard", "shore": ">70"},
    {"level": 2, "label": "firm", "shore": "61-70"},
    {"level": 3, "label": "soft", "shore": "51-60"},
    {"level": 4, "label": "very-soft", "shore": "<=50"},
]
# From opset 13 to 17 no operator that the daemon runs changed, and from 9 on only these.
CHANGED = {"Clip", "Dropout", "LogSoftmax", "Pad", "ReduceSum", "Scan", "Slice", "Softmax", "Split", "Squeeze", "Unsqueeze"}
# A force above which a taxel of 3.5 mm pitch is in contact. Others have one in proportion to their area.
CONTACT_N = 0.07


class Refused(Exception):
    """The file cannot be adopted. The message says what to change."""


def described(values: Sequence[Any]) -> str:
    """Inputs or outputs with type and shape."""
    texts = []
    for value in values:
        tensor = value.type.tensor_type
        kind = TensorProto.DataType.Name(tensor.elem_type).lower() if value.type.HasField("tensor_type") else "no tensor"
        lengths = ",".join(str(length or "?") for length in shape(value))
        texts.append(f"{value.name} {kind} [{lengths}]")
    return ", ".join(texts) or "none"


def shape(value: Any) -> List[int]:
    """The lengths of a value's axes; 0 where the file leaves one open."""
    return [dim.dim_value for dim in value.type.tensor_type.shape.dim]


def is_float(value: Any) -> bool:
    return bool(value.type.tensor_type.elem_type == TensorProto.FLOAT)


def rename(graph: Any, old: str, new: str) -> None:
    """Renames a value inside a graph and its loops."""
    for tensor in graph.initializer:
        if tensor.name == old:
            tensor.name = new
    for node in graph.node:
        for names in (node.input, node.output):
            names[:] = [new if name == old else name for name in names]
        for attribute in node.attribute:
            if attribute.HasField("g"):
                rename(attribute.g, old, new)


def keep_needed(graph: Any) -> None:
    """Removes what no output needs, such as the nodes that compute a label."""
    needed = {output.name for output in graph.output}
    kept = []
    for node in reversed(graph.node):
        if needed & set(node.output):
            needed.update(node.input)
            for attribute in node.attribute:
                needed.update(name for inner in attribute.g.node for name in inner.input)
            kept.append(node)
            number_classes(node)
    weights = [tensor for tensor in graph.initializer if tensor.name in needed]
    for old, new in ((graph.node, kept[::-1]), (graph.initializer, weights), (graph.value_info, [])):
        copies = [type(one).FromString(one.SerializeToString()) for one in new]
        del old[:]
        old.extend(copies)


def number_classes(node: Any) -> None:
    """Replaces classes that are texts by numbers: only the label, which no output needs, depends on them, and the
    daemon computes no texts."""
    for attribute in node.attribute:
        if attribute.name == "classlabels_strings":
            numbers = list(range(len(attribute.strings)))
            attribute.name = "classlabels_ints" if node.op_type == "LinearClassifier" else "classlabels_int64s"
            attribute.type = AttributeProto.INTS
            del attribute.strings[:]
            attribute.ints.extend(numbers)


def refuse_types(graph: Any) -> None:
    """Refuses weights of half precision and of quantised networks."""
    for tensor in graph.initializer:
        if tensor.data_type in (TensorProto.FLOAT16, TensorProto.BFLOAT16):
            raise Refused(f"weight {tensor.name!r} has 16 bits: export the network in 32 bits (PyTorch: `network.float()`)")
        if tensor.data_type in (TensorProto.INT8, TensorProto.UINT8):
            raise Refused(f"weight {tensor.name!r} has 8 bits: export the network before it is quantised")


def mend_opset(model: Any, done: List[str]) -> None:
    """Claims the oldest opset that the daemon takes, if the operators mean the same in it."""
    found = next((opset for opset in model.opset_import if opset.domain in ("", "ai.onnx")), None)
    if found is None:
        # A file of trees alone, as XGBoost, LightGBM and CatBoost write it, needs no plain operator.
        model.opset_import.append(helper.make_opsetid("", OPSET))
        return done.append(f"opset: it is {OPSET}")
    if found.version >= OPSET:
        return None
    plain = [node.op_type for node in model.graph.node if node.domain in ("", "ai.onnx")]
    changed = [name for name in plain if found.version < 9 or (found.version < 13 and name in CHANGED)]
    if changed:
        raise Refused(
            f"opset {found.version}: {changed[0]} changed since: export with opset {OPSET} (skl2onnx: "
            f"`target_opset={OPSET}`, PyTorch: `opset_version={OPSET}`, tf2onnx: `--opset {OPSET}`)"
        )
    done.append(f"opset {found.version}: it is {OPSET}, with the same operators")
    found.version = OPSET
    return None


def plain_scalers(graph: Any, done: List[str]) -> None:
    """Writes the scaler of scikit-learn as a difference and a product."""
    for place, node in reversed(list(enumerate(graph.node))):
        if (node.op_type, node.domain) != ("Scaler", LEARNERS):
            continue
        (source,), (result,) = node.input, node.output
        numbers = {attribute.name: np.array(attribute.floats, np.float32) for attribute in node.attribute}
        names = [f"{result}/{name}" for name in ("offset", "scale", "moved")]
        graph.initializer.append(numpy_helper.from_array(numbers["offset"], names[0]))
        graph.initializer.append(numpy_helper.from_array(numbers["scale"], names[1]))
        graph.node.remove(node)
        graph.node.insert(place, helper.make_node("Mul", [names[2], names[1]], [result]))
        graph.node.insert(place, helper.make_node("Sub", [source, names[0]], [names[2]]))
        done.append("Scaler: it is a difference and a product")


def mend_input(graph: Any, done: List[str]) -> Tuple[str, List[int]]:
    """Makes the input a frame. Returns its old name and shape."""
    weights = {tensor.name for tensor in graph.initializer}
    inputs = [value for value in graph.input if value.name not in weights]
    lengths = shape(inputs[0]) if inputs else []
    rest = [length for length in lengths[1:] if length != 1]
    if len(inputs) != 1 or lengths[:1] not in ([0], [1]) or rest not in ([784], [28, 28]):
        raise Refused(
            f"inputs: found {described(inputs)}, expected one, f32 [N,784], [N,28,28], [N,1,28,28] or [N,28,28,1]; a model of "
            "whole presses needs its metadata from you (docs/formats.md)"
        )
    if not is_float(inputs[0]):
        raise Refused(
            f"inputs: found {described(inputs)}, expected f32 (skl2onnx: `to_onnx(model, X[:1].astype(numpy.float32))`)"
        )
    name, lengths = inputs[0].name, [1, *lengths[1:]]
    del graph.input[:]
    graph.input.append(helper.make_tensor_value_info("frame", TensorProto.FLOAT, [1, 1, 28, 28]))
    if (name, lengths) == ("frame", [1, 1, 28, 28]):
        return name, lengths
    rename(graph, name, "frame/file")
    graph.initializer.append(numpy_helper.from_array(np.array(lengths, np.int64), "frame/shape"))
    graph.node.insert(0, helper.make_node("Reshape", ["frame", "frame/shape"], ["frame/file"]))
    done.append(f"input {name!r}: it is called `frame`, [1,1,28,28]")
    return name, lengths


def columns(classes: List[str], levels: List[Dict[str, Any]]) -> List[int]:
    """The column of each level. The classes are the levels' numbers, from 1 or from 0, or their labels."""
    numbers = [level["level"] for level in levels]
    for names in (
        [str(number) for number in numbers], [str(number - 1) for number in numbers], [level["label"] for level in levels],
    ):
        if sorted(names) == sorted(classes):
            return [classes.index(name) for name in names]
    raise Refused(
        f"outputs: found the classes {', '.join(classes)}, expected 1 to {len(levels)}, 0 to {len(levels) - 1} or "
        f"{', '.join(level['label'] for level in levels)}"
    )


def classes_of(node: Any) -> List[str]:
    """The classes of a ZipMap or a classifier of `ai.onnx.ml`."""
    names = []
    for attribute in node.attribute:
        if attribute.name.startswith("classlabels"):
            names += [str(number) for number in attribute.ints] + [text.decode() for text in attribute.strings]
    return names


def take_probabilities(graph: Any, levels: List[Dict[str, Any]], done: List[str]) -> Optional[List[int]]:
    """Finds the output of probabilities by its ZipMap, its classifier or its softmax, and renames it. Returns the order of
    its columns, if a file says it."""
    zip_map = next((node for node in graph.node if node.op_type == "ZipMap"), None)
    classifiers = [node for node in graph.node if node.op_type.endswith("Classifier") and node.domain == LEARNERS]
    source, classes = None, []
    if zip_map is not None:
        source, classes = zip_map.input[0], classes_of(zip_map)
        graph.node.remove(zip_map)
        done.append(f"output {zip_map.output[0]!r}: `probabilities`, without their ZipMap")
    elif any(value.type.tensor_type.elem_type == TensorProto.STRING for value in graph.output):
        if any(value.name == "probabilities" for value in graph.output) or not classifiers:
            raise Refused("outputs: the classes are texts, whose order is lost: export without the option `zipmap`")
    if source is None:
        if {"logits", "probabilities"} & {value.name for value in graph.output}:
            return None
        found = [value for value in graph.output if is_float(value) and len(shape(value)) == 2]
        by = {name: node for node in graph.node for name in node.output}
        ends = by.get(found[0].name) if len(found) == 1 else None
        while ends is not None and ends.op_type == "Identity":
            ends = by.get(ends.input[0])
        if ends is None or ends.op_type not in ("Softmax", "TreeEnsembleClassifier"):
            raise Refused(
                f"outputs: found {described(graph.output)}, expected `logits` or `probabilities`, f32 [1,L], by these names "
                '(PyTorch: `output_names=["logits"]`; Keras: end the model in a softmax; skl2onnx: no options for the outputs)'
            )
        source = found[0].name
        classes = classes_of(ends) if ends.op_type != "Softmax" else []
        done.append(f"output {source!r}: it is called `probabilities`")
    order = columns(classes, levels) if classes else None
    if source != "probabilities":
        rename(graph, "probabilities", "probabilities/file")
        rename(graph, source, "probabilities")
    del graph.output[:]
    graph.output.append(helper.make_tensor_value_info("probabilities", TensorProto.FLOAT, [1, len(levels)]))
    return order


def mend_outputs(graph: Any, levels: List[Dict[str, Any]], done: List[str]) -> None:
    """Gives the graph the outputs `logits` and `probabilities`, and leaves out all others."""
    order = take_probabilities(graph, levels, done)
    names = [value.name for value in graph.output]
    found = {value.name: shape(value)[-1] for value in graph.output if value.name in ("logits", "probabilities")}
    if any(length != len(levels) for length in found.values()):
        raise Refused(f"outputs: found {described(graph.output)}, expected {len(levels)} levels, those of the data set")
    if order is not None and order != sorted(order):
        rename(graph, "probabilities", "probabilities/unordered")
        graph.initializer.append(numpy_helper.from_array(np.array(order, np.int64), "order"))
        graph.node.append(helper.make_node("Gather", ["probabilities/unordered", "order"], ["probabilities"], axis=1))
        done.append("output `probabilities`: the columns in the order of the levels")
    if "logits" not in found:
        # The probabilities of a forest may be 0.
        graph.initializer.append(numpy_helper.from_array(np.array([1e-30], np.float32), "least"))
        graph.node.append(helper.make_node("Max", ["probabilities", "least"], ["above"]))
        graph.node.append(helper.make_node("Log", ["above"], ["logits"]))
    if "probabilities" not in found:
        graph.node.append(helper.make_node("Softmax", ["logits"], ["probabilities"], axis=1))
    left_out = [name for name in names if name not in ("logits", "probabilities")]
    done.extend(f"output {name!r}: left out" for name in left_out)
    del graph.output[:]
    for name in ("logits", "probabilities"):
        graph.output.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, len(levels)]))
    keep_needed(graph)


def data_of(path: Optional[str]) -> Dict[str, Any]:
    """Levels, frames and what else the metadata need of a data set; of made-up presses without one."""
    if path is None:
        places = np.indices((28, 28))
        away = [((places - 13.5) ** 2).sum(axis=0) / (2 * (1 + number) ** 2) for number in range(8)]
        frames = np.array([4 * np.exp(-one) for one in away], np.float32)
        open_range = {"force_n": [0, 1e6], "contact_area_taxels": [0, 784]}
        return {"levels": LEVELS, "frames": frames, "pitch_mm": 3.5, "range": open_range, "data": "not stated"}
    arrays, meta = best_frames(path)
    frames, level, split = arrays["frames"], arrays["level"], arrays["split"]
    levels = meta.get("levels") or LEVELS
    with reading(path, "meta: levels: expected a number `level` and a text `label` of each"):
        for one in levels:
            if not (isinstance(one, dict) and isinstance(one.get("level"), int) and isinstance(one.get("label"), str)):
                raise ValueError(f"found {one}")
    train = frames[(split == 0) & (level > 0)].astype(np.float32)
    if len(train) == 0:
        raise BadFile(f"{path}: no press of the train split has a level")
    pitch_mm = meta.get("pitch_mm") or 3.5
    contact_n = CONTACT_N * (pitch_mm / 3.5) ** 2
    force, area = train.sum(axis=(1, 2)), (train >= contact_n).sum(axis=(1, 2))
    spread = np.linspace(0, len(train) - 1, 8).astype(int)
    return {
        "levels": levels,
        "frames": np.maximum(train[spread], 0),
        "pitch_mm": pitch_mm,
        "range": {
            "force_n": [float(force.min()), float(force.max())], "contact_area_taxels": [int(area.min()), int(area.max())],
        },
        "data": json.dumps({"name": os.path.basename(path), "seed": meta.get("seed")}),
    }


def probabilities_of(original: Any, given: Tuple[str, List[int]], data: Dict[str, Any]) -> List[List[float]]:
    """What onnx's reference computes with the original file. It has no ZipMap, so that one's input is taken."""
    model = onnx.ModelProto.FromString(original.SerializeToString())
    order = None
    for node in [node for node in model.graph.node if node.op_type == "ZipMap"]:
        order = columns(classes_of(node), data["levels"])
        model.graph.node.remove(node)
        del model.graph.output[:]
        model.graph.output.append(helper.make_tensor_value_info(node.input[0], TensorProto.FLOAT, None))
    evaluator = ReferenceEvaluator(model)
    name, lengths = given
    rows = []
    for frame in data["frames"]:
        outputs = dict(zip(evaluator.output_names, evaluator.run(None, {name: frame.reshape(lengths)})))
        found = outputs.get("probabilities", outputs.get("logits"))
        row = found if found is not None else list(outputs.values())[-1]
        row = np.asarray(row, np.float64).reshape(-1)
        if "probabilities" not in outputs and "logits" in outputs:
            row = np.exp(row - row.max()) / np.exp(row - row.max()).sum()
        if not np.isfinite(row).all():
            raise Refused(
                "outputs: a probability of a check frame is no number: did the network learn, and does it take newtons "
                "below 0 (PyTorch: `frame.clamp(min=0)`)?"
            )
        if abs(row.sum() - 1) > 1e-3:
            raise Refused(
                f"outputs: the probabilities of a check frame add up to {row.sum():.3g}, expected 1: these are scores "
                "(scikit-learn: take a classifier with `predict_proba`, such as `LogisticRegression`)"
            )
        rows.append([float(row[place]) for place in order or range(len(row))])
    return rows


def adopt(original: Any, data: Dict[str, Any], stated: Dict[str, str]) -> Tuple[Any, List[str]]:
    """The adopted model, and what changed."""
    model = onnx.ModelProto.FromString(original.SerializeToString())
    done: List[str] = []
    refuse_types(model.graph)
    mend_opset(model, done)
    plain_scalers(model.graph, done)
    given = mend_input(model.graph, done)
    mend_outputs(model.graph, data["levels"], done)
    check = {
        "frames": [[float(newtons) for newtons in frame.reshape(-1)] for frame in data["frames"]],
        "probabilities": probabilities_of(original, given, data),
    }
    model.ir_version = max(model.ir_version, 8)
    kept = [entry for entry in model.metadata_props if not entry.key.startswith("hrn.")]
    metadata = {entry.key: entry.value for entry in kept}
    metadata |= {
        "hrn.format": "1", "hrn.levels": json.dumps(data["levels"]), "hrn.pitch_mm": str(data["pitch_mm"]),
        "hrn.data": data["data"], "hrn.metrics": "{}", "hrn.range": json.dumps(data["range"]),
        "hrn.check": json.dumps(check), **{f"hrn.{key}": text for key, text in stated.items()},
    }
    helper.set_model_props(model, metadata)
    return model, done


def main() -> None:
    parser = argparse.ArgumentParser(prog="python3 -m hardnessd.adopt", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("model", help="the ONNX file")
    parser.add_argument("--out", required=True, metavar="M.onnx", help="new file for the model")
    parser.add_argument("--data", metavar="D.npz", help="the data set that it learnt from: its levels, pitch and range")
    parser.add_argument("--method", metavar="TEXT", help="how it was made, in a few words")
    parser.add_argument("--validation", metavar="TEXT", default="not validated", help="what it was tried on")
    given = parser.parse_args()
    stated = {"method": given.method or f"adopted from {os.path.basename(given.model)}", "validation": given.validation}
    with ending(given.out):
        with reading(given.model, "not an ONNX file"):
            original = onnx.load(given.model)
        data = data_of(given.data)
        with reading(given.model, "not adopted"):
            model, done = adopt(original, data, stated)
        save(given.out, model.SerializeToString())
    for change in done:
        print(f"changed  {change}")
    print(f"{given.out}: check it with `hrn-train check-model {given.out}`")


if __name__ == "__main__":
    main()
