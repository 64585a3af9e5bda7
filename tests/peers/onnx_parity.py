#!/usr/bin/env python3
"""Runs a model file with onnxruntime on a data set and compares with `hrn-train evaluate --json`.

    python -m venv venv && venv/bin/pip install numpy onnx onnxruntime
    venv/bin/python tests/peers/onnx_parity.py MODEL.onnx DATA.npz HRN_TRAIN

Claims: the file passes ONNX's full check, its metadata is complete, onnxruntime reproduces the
check frames within 1e-4, and both runtimes count the same confusion matrix on the test split.
"""

import json
import subprocess
import sys

import numpy as np
import onnx
import onnxruntime

KEYS = ["format", "levels", "pitch_mm", "method", "data", "metrics", "validation", "range", "check"]


def main(model_path, data_path, hrn_train):
    model = onnx.load(model_path)
    onnx.checker.check_model(model, full_check=True)
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    missing = [key for key in KEYS if f"hrn.{key}" not in metadata]
    assert not missing, f"metadata without {missing}"
    assert metadata["hrn.format"] == "1"
    levels = json.loads(metadata["hrn.levels"])

    session = onnxruntime.InferenceSession(model_path, providers=["CPUExecutionProvider"])

    def judge(newtons):
        frame = np.asarray(newtons, np.float32).reshape(1, 1, 28, 28)
        return [out[0] for out in session.run(["logits", "probabilities"], {"frame": frame})]

    check = json.loads(metadata["hrn.check"])
    worst = max(
        float(np.abs(judge(frame)[1] - np.asarray(expected)).max())
        for frame, expected in zip(check["frames"], check["probabilities"], strict=True)
    )
    assert len(check["frames"]) == 2 * len(levels) and worst <= 1e-4, worst

    data = np.load(data_path)
    chosen = (data["split"] == 1) & (data["level"] > 0)
    confusion = np.zeros((len(levels), len(levels)), int)
    for newtons, level in zip(data["frames"][chosen], data["level"][chosen], strict=True):
        confusion[level - 1, int(np.argmax(judge(newtons)[1]))] += 1

    command = [hrn_train, "evaluate", "--model", model_path, "--data", data_path, "--json"]
    ours = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    assert ours["confusion"] == confusion.tolist(), f"{ours['confusion']}\n{confusion.tolist()}"
    print(f"full check passed; {len(check['frames'])} check frames within {worst:.1e}")
    print(f"{chosen.sum()} samples, the same confusion matrix: {confusion.tolist()}")


if __name__ == "__main__":
    main(*sys.argv[1:])
