"""Makes data.npz: sixty presses of each level, as round dents, the wider the softer. float32, in newtons."""

import json
import numpy as np

random = np.random.default_rng(1)
rows, cols = np.mgrid[0:28, 0:28]
frames, level, objects = [], [], []
for true_level in (1, 2, 3, 4):
    for press in range(60):
        row, col = random.uniform(10, 18, 2)
        radius = 1.5 + true_level + random.normal(0, 0.3)
        dent = np.clip(1 - ((rows - row) ** 2 + (cols - col) ** 2) / radius**2, 0, None)
        force_n = random.uniform(5, 25)
        frames.append(force_n * dent / dent.sum())
        level.append(true_level)
        objects.append(10 * true_level + press // 10)  # ten presses an object
objects = np.array(objects, np.uint32)
shore = {"hard": ">70", "firm": "61-70", "soft": "51-60", "very-soft": "<=50"}
levels = [
    {"level": number, "label": label, "shore": of}
    for number, (label, of) in enumerate(shore.items(), 1)
]
meta = {"levels": levels, "seed": 1, "generator": "data.py"}
np.savez_compressed(
    "data.npz",
    frames=np.array(frames, np.float32),
    level=np.array(level, np.uint8),
    object=objects,
    split=(objects % 10 >= 4).astype(np.uint8),  # the last two objects of each level
    meta=np.frombuffer(json.dumps(meta).encode(), np.uint8),
)
