"""Train a network of your own in PyTorch and let hardnessd judge with it.

    pip install torch numpy './clients/python[datasets]'
    cargo build --release --features train
    PATH=$PWD/target/release:$PATH python3 examples/own_model.py DIRECTORY

DIRECTORY must be there and gets all files. Each numbered part is a cell: you can paste it into a notebook. The
whole takes 20 s of one core. The data are simulated: replace part 1 by your own presses (docs/own-objects.md).
"""

# %% 0. What you need
import json
import os
import pathlib
import subprocess
import sys

import numpy as np
import torch
from hardnessd import datasets
from torch import nn

torch.manual_seed(1)
torch.set_num_threads(1)
os.chdir(sys.argv[1])  # in a notebook: the path of a directory


def run(*command, show=True):
    """Runs a command, shows it with what it printed, and gives that back."""
    print("$", *command, flush=True)
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    if show:
        print(done.stdout, flush=True)
    return done.stdout


# %% 1. Make a data set: presses of simulated objects of eight materials, two for each level
run("hrn-train", "simulate", "--out", "data.npz", "--objects", "16", "--test-objects", "8", "--presses", "24")

# %% 2. Look at it
data = datasets.load("data.npz")
train, test = data.part("train").labelled(), data.part("test").labelled()
print("materials:", ", ".join(data.meta["materials"]))
for level in (1, 2, 3, 4):
    of = train.where(train.level == level)
    area = (of.frames > 0.07).sum(axis=(1, 2))
    print(f"level {level}: {len(of)} presses, {of.force.mean():.1f} N and {area.mean():.0f} taxels on average")
print("a press of level 4, of each taxel its share of the greatest force in tenths:")
of = train.where(train.level == 4)
frame = of.frames[(of.frames > 0.07).sum(axis=(1, 2)).argmax()]
rows, columns = np.nonzero(frame)
for row in frame[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]:
    print(" ", "".join(f"{tenth or '.'}" for tenth in (9.99 * row / frame.max()).astype(int)))


# %% 3. A small network. The model format has newtons as input, so the network does any scaling itself
class Net(nn.Module):
    def __init__(self):
        super().__init__()
        self.features = nn.Sequential(
            nn.Conv2d(1, 16, 5, padding=2), nn.ReLU(), nn.MaxPool2d(2),
            nn.Conv2d(16, 32, 3, padding=1), nn.ReLU(), nn.MaxPool2d(2),
            nn.Conv2d(32, 32, 3, padding=1), nn.ReLU(),
        )
        self.classify = nn.Sequential(nn.Flatten(), nn.Linear(32 * 7 * 7, 64), nn.ReLU(), nn.Linear(64, 4))

    def forward(self, frame):  # [batch, 1, 28, 28], newtons
        logits = self.classify(self.features(torch.log1p(20 * frame)))
        return logits, torch.softmax(logits, dim=1)


def tensors(presses):
    return torch.from_numpy(presses.frames)[:, None], torch.from_numpy(presses.level.astype(np.int64)) - 1


# %% 4. Train it
frames, levels = tensors(train)
net = Net()
optimizer = torch.optim.AdamW(net.parameters(), lr=1e-3, weight_decay=1e-2)
for epoch in range(12):
    losses = []
    for batch in torch.randperm(len(frames)).split(32):
        # A press is the same mirrored, and turned by a quarter.
        turned = torch.rot90(frames[batch], int(torch.randint(4, ())), (2, 3))
        if torch.rand(()) < 0.5:
            turned = turned.flip(3)
        loss = nn.functional.cross_entropy(net(turned)[0], levels[batch])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    print(f"epoch {epoch + 1:2}: loss {np.mean(losses):.3f}", flush=True)

net.eval()
frames, levels = tensors(test)
with torch.no_grad():
    mine = (net(frames)[1].argmax(1) == levels).double().mean().item()
print(f"PyTorch {torch.__version__}: {mine:.1%} of {len(test)} presses of the test materials recognised")

# %% 5. Export it: one frame in, logits and probabilities out. This exporter needs no further package. PyTorch calls
# it the legacy one. The new one needs `pip install onnxscript`, dynamo=True and external_data=False
torch.onnx.export(
    net,
    (torch.zeros(1, 1, 28, 28),),
    "net.onnx",
    input_names=["frame"],
    output_names=["logits", "probabilities"],
    opset_version=17,
    dynamo=False,
)

# %% 6. Add what the daemon needs to know of it, and check it
run("hrn-train", "adopt", "net.onnx", "--data", "data.npz", "--out", "own.onnx", "--method", "a small PyTorch network")
run("hrn-train", "check-model", "own.onnx")

# %% 7. The daemon's inference library recognises as many as PyTorch
evaluated = json.loads(run("hrn-train", "evaluate", "--model", "own.onnx", "--data", "data.npz", "--json"))
assert abs(evaluated["accuracy"] - mine) < 0.002, (evaluated["accuracy"], mine)

# %% 8. Judge a recording with it, as the daemon would
run("hardnessd", "simulate", "--to", "take.bin", "--fps", "50", "--presses", "8", "--material", "wood")
pathlib.Path("own.toml").write_text(
    '[[sensor]]\nname = "forearm"\nport = "forearm"\nframe_rate_hz = 50\n[model]\npath = "own.onnx"\n'
)
lines = run("hardnessd", "replay", "take.bin", "--config", "own.toml", show=False).splitlines()
events = [json.loads(line) for line in lines]
verdicts = [event for event in events if event["type"] == "hardness" and event["phase"] == "final"]
for verdict in verdicts:
    print(f"press {verdict['press']}: level {verdict['level']}, {verdict['label']}, by {verdict['model']}")
