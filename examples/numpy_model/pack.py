"""Adds to graph.onnx the metadata that hardnessd needs, and makes model.onnx."""

import hashlib
import json
import numpy as np
import onnx
from onnx.reference import ReferenceEvaluator

model = onnx.load("graph.onnx")
data = np.load("data.npz")
learnt = data["frames"][data["split"] == 0]
level = data["level"][data["split"] == 0]
check = np.concatenate([learnt[level == true_level][:2] for true_level in (1, 2, 3, 4)])
run = ReferenceEvaluator(model)
probabilities = [
    run.run(["probabilities"], {"frame": frame.reshape(1, 1, 28, 28)})[0][0] for frame in check
]
force_n = learnt.sum(axis=(1, 2))
area = (learnt >= 0.07).sum(axis=(1, 2))
shore = {"hard": ">70", "firm": "61-70", "soft": "51-60", "very-soft": "<=50"}
metadata = {
    "hrn.format": "1",
    "hrn.levels": [
        {"level": number, "label": label, "shore": of}
        for number, (label, of) in enumerate(shore.items(), 1)
    ],
    "hrn.pitch_mm": "3.5",
    "hrn.method": "linear",
    "hrn.data": [{"name": "data.npz", "sha256": hashlib.sha256(open("data.npz", "rb").read()).hexdigest()}],
    "hrn.validation": "round dents only",
    "hrn.metrics": {},
    "hrn.range": {
        "force_n": [float(force_n.min()), float(force_n.max())],
        "contact_area_taxels": [int(area.min()), int(area.max())],
    },
    "hrn.check": {
        "frames": check.reshape(8, 784).tolist(),
        "probabilities": np.array(probabilities).tolist(),
    },
}
onnx.helper.set_model_props(
    model,
    {key: value if isinstance(value, str) else json.dumps(value) for key, value in metadata.items()},
)
onnx.save(model, "model.onnx")
