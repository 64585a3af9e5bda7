"""A model of your own, from the first press to the daemon's verdicts.

    python3 -m venv venv
    venv/bin/pip install scikit-learn torch onnxscript matplotlib './clients/python[adopt,dataset,recording]'
    cargo build --release --workspace
    PATH=$PWD/target/release:$PATH venv/bin/python examples/own_model.py DIRECTORY

DIRECTORY is made, and gets all files. Each `# %%` begins a cell: VS Code, Spyder and Jupyter (with
jupytext) open this file as a notebook. PyTorch takes 5 GB of the disk: without torch, the script leaves out part 8.
Without matplotlib it draws no picture.

The presses are simulated. To press your own objects on your own sensor:

1. Write your [[sensor]] table into a file, such as sensor.toml (docs/configuration.md). Use absolute paths in it.
2. Name your objects in part 1.
3. Stop the daemon that reads the sensor, because only one program can open the port.
4. Add the file to the command: own_model.py DIRECTORY sensor.toml
"""

# %% 0. The programs
# `hardnessd` and `hrn-train` must be on the PATH.
import contextlib
import importlib.util
import itertools
import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import hardnessd
import numpy as np
from hardnessd import dataset, recording

if len(sys.argv) < 2:
    sys.exit(__doc__)
# In a notebook, write the directory and the text of sensor.toml here.
DIRECTORY = sys.argv[1]
SENSOR = pathlib.Path(sys.argv[2]).read_text() if len(sys.argv) > 2 else None
os.makedirs(DIRECTORY)
os.chdir(DIRECTORY)


def run(*command):
    """Runs a command, shows it with what it printed, and gives that back."""
    print("$", *command, flush=True)
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    print(done.stdout, flush=True)
    return done.stdout


@contextlib.contextmanager
def running(*command):
    """A program that runs until the end of the `with`, and then gets SIGINT, as from Ctrl-C."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env={"RUST_LOG": "error", **os.environ})
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(timeout=20)
    if process.returncode != 0:
        raise RuntimeError(f"{' '.join(command)}: exit code {process.returncode}")


# %% 1. The objects and the sensor
# Level 1 is the hardest, 4 the softest. Take at least three objects of each level. No model is trained on the last
# object of each level: these objects show how good a model is on objects that it does not know.
OBJECTS = [  # name, level, number
    (name, level, 10 * level + number)
    for number in (1, 2, 3)
    for level, name in enumerate(["wood", "rubber", "plasticine", "sponge"], 1)
]
TRAIN, TEST = OBJECTS[:8], OBJECTS[8:]
PRESSES = 12  # of each object

SIMULATED = '[[sensor]]\nname = "forearm"\nport = "forearm"\nframe_rate_hz = 20\n'
CONFIGURATION = f'{SENSOR or SIMULATED}\n[publish.unix]\npath = "events.sock"\n'
pathlib.Path("own.toml").write_text(CONFIGURATION)


@contextlib.contextmanager
def pressed(name, seed):
    """The sensor, while an object is pressed again and again."""
    if SENSOR:
        input(f"\nLet nothing touch the sensor and press Enter. Then press {name} {PRESSES} times ")
        yield
        return
    # The simulated robot presses twenty times as fast as a real one. That is too fast for the built-in model, which
    # judges how a material creeps, too. Each press is on another piece of the material.
    options = ["--fps", "20", "--speed", "20", "--baud", "230400", "--material", name, "--seed", str(seed)]
    with running("hardnessd", "simulate", "--link", "forearm", *options) as process:
        while not os.path.exists("forearm") and process.poll() is None:
            time.sleep(0.02)
        yield


def final_verdicts(process):
    """The final verdicts of a running daemon: one for each press, when it ends."""
    for event in hardnessd.Client("events.sock", types=["hardness"]):
        if event["type"] == "hardness" and event["phase"] == "final":
            print(".", end="", flush=True)
            yield event
        elif process.poll() is not None:
            raise RuntimeError(f"hardnessd ended with exit code {process.returncode}")


# %% 2. Record presses
# `hardnessd record` is a daemon that writes everything that it reads and publishes into a file, with the labels that
# you give. With `--sockets` we can follow its events, and stop it after the last press.
def record(name, level, number):
    path = f"{name}-{number}.mcap"
    labels = ["--label", f"level={level}", "--label", f"object={number}"]
    print(f"{path} ", end="", flush=True)
    with pressed(name, number), running(
        "hardnessd", "record", "--config", "own.toml", "--sockets", "--out", path, *labels
    ) as daemon:
        for _ in itertools.islice(final_verdicts(daemon), PRESSES):
            pass
    print()
    return path


train_recordings = [record(*one) for one in TRAIN]
test_recordings = [record(*one) for one in TEST]


# %% 3. Look at the recordings
# A recording has the events as the daemon published them, and every frame in newtons. Events name frames by their
# number since the recorder started. We look at one press of each level: the one whose force is nearest to 15 N.
CONTACT_N = 0.07  # press.contact_threshold_n of the daemon


def area_of(frames):
    """[..., row, column] in newtons -> [...]: how many taxels are in contact."""
    return (frames >= CONTACT_N).sum(axis=(-2, -1))


def presses_of(path):
    """For each press of a recording: its level, its final verdict, and its frames [frame, row, column] in newtons."""
    with recording.open(path) as take:
        level = int(take.labels["level"])
        events = list(take.events())
        newtons = np.array([frame.newtons for frame in take.frames()]).reshape(-1, 28, 28)
    at = {(event["press"], event["state"]): event["frame"] for event in events if event["type"] == "press"}
    for event in events:
        if event["type"] == "hardness" and event["phase"] == "final":
            yield level, event, newtons[at[event["press"], "begin"] : at[event["press"], "end"] + 1]


presses = [press for path in train_recordings for press in presses_of(path)]
shown = [
    min((press for press in presses if press[0] == level), key=lambda press: abs(press[1]["force_n"] - 15))
    for level in (1, 2, 3, 4)
]
widest = [frames[area_of(frames).argmax()] for _, _, frames in shown]
for (level, _, frames), frame in zip(shown, widest):
    print(f"level {level}: {len(frames)} frames, {frame.sum():.1f} N on {area_of(frame)} taxels at the largest area")
print("the last of them, each taxel in tenths of the greatest force:")
rows, columns = np.nonzero(widest[3] >= CONTACT_N)
for row in widest[3][rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]:
    print(" ", "".join(f"{tenth or '.'}" for tenth in (9.99 * row / widest[3].max()).astype(int)))

# %% 4. The same as a picture
# At the same force, a hard object touches fewer taxels than a soft one. A model learns from this.
if importlib.util.find_spec("matplotlib"):
    import matplotlib.pyplot as plt
    from matplotlib.colors import PowerNorm

    places = [[1, 2, 3, 4], ["course", "course", "all", "all"]]
    figure, axes = plt.subplot_mosaic(places, figsize=(10, 6), layout="constrained")
    # A power of the force for the colour, because the forces of a soft object are small.
    norm = PowerNorm(0.5, 0, max(frame.max() for frame in widest))
    for (level, _, frames), frame in zip(shown, widest):
        image = axes[level].imshow(frame, norm=norm)
        axes[level].set(title=f"level {level}\n{frame.sum():.0f} N, {area_of(frame)} taxels", xticks=[], yticks=[])
        axes["course"].plot(frames.sum(axis=(1, 2)), area_of(frames), label=f"level {level}")
        of_level = [verdict for at, verdict, _ in presses if at == level]
        force_n = [verdict["force_n"] for verdict in of_level]
        axes["all"].scatter(force_n, [verdict["contact_area_taxels"] for verdict in of_level], s=12)
    figure.colorbar(image, ax=[axes[level] for level in (1, 2, 3, 4)], label="N on a taxel", shrink=0.8)
    axes["course"].set(title="these four presses, from touch to release", xlabel="force, N", ylabel="area, taxels")
    axes["course"].legend()
    axes["all"].set(title=f"{len(presses)} presses at their largest area", xlabel="force, N", ylabel="area, taxels")
    figure.savefig("presses.png", dpi=120)
    print("wrote presses.png")

# %% 5. Make a data set of the recordings
# `collect` finds the presses as the daemon does, and takes level and object from the labels.
run("hrn-train", "collect", "--out", "own.npz", *train_recordings)
run("hrn-train", "collect", "--out", "own.npz", "--append", "--split", "test", *test_recordings)
data = dataset.load("own.npz")
train, test = data.part("train").labelled(), data.part("test").labelled()
for part, name in [(train, "learn from"), (test, "test on")]:
    print(f"{len(part)} presses of {len(set(part.object))} objects to {name}")


# %% 6. scikit-learn: logistic regression on four sizes of a frame
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler


def sizes(frames):
    """[press, row, column] in newtons -> [press, 4]: logarithms of area, force, greatest force and sum of squares."""
    each = (1, 2)
    found = [area_of(frames), frames.sum(axis=each), frames.max(axis=each), (frames**2).sum(axis=each)]
    return np.log(np.stack(found, axis=1) + 0.001)


classifier = make_pipeline(StandardScaler(), LogisticRegression(C=10, max_iter=1000))
classifier.fit(sizes(train.frames), train.level)
scores = {"scikit-learn": classifier.score(sizes(test.frames), test.level)}
print(f"scikit-learn: {scores['scikit-learn']:.1%} of {len(test)} test presses")

# %% 7. The same as ONNX
# The daemon runs only the operators that docs/formats.md lists. They suffice for the sizes of a frame, too. The scaler
# becomes a part of the weights.
import onnx
from onnx import TensorProto, helper, numpy_helper

scaler, regression = classifier[0], classifier[1]
weights = regression.coef_ / scaler.scale_  # [level, size]
bias = regression.intercept_ - weights @ scaler.mean_
numbers = {"threshold": CONTACT_N, "least": 0.001, "weights": weights, "bias": bias}
nodes = [
    helper.make_node("GreaterOrEqual", ["frame", "threshold"], ["is_touched"]),
    helper.make_node("Cast", ["is_touched"], ["touched"], to=TensorProto.FLOAT),
    helper.make_node("ReduceSum", ["touched", "row_and_column"], ["area"], keepdims=0),
    helper.make_node("ReduceSum", ["frame", "row_and_column"], ["force"], keepdims=0),
    helper.make_node("ReduceMax", ["frame", "row_and_column"], ["greatest"], keepdims=0),
    helper.make_node("ReduceSumSquare", ["frame", "row_and_column"], ["squares"], keepdims=0),
    helper.make_node("Concat", ["area", "force", "greatest", "squares"], ["found"], axis=1),
    helper.make_node("Add", ["found", "least"], ["positive"]),
    helper.make_node("Log", ["positive"], ["sizes"]),
    helper.make_node("Gemm", ["sizes", "weights", "bias"], ["logits"], transB=1),
    helper.make_node("Softmax", ["logits"], ["probabilities"], axis=1),
]
graph = helper.make_graph(
    nodes,
    "sizes",
    [helper.make_tensor_value_info("frame", TensorProto.FLOAT, [1, 1, 28, 28])],
    [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 4]) for name in ("logits", "probabilities")],
    [numpy_helper.from_array(np.array(value, np.float32), name) for name, value in numbers.items()]
    + [numpy_helper.from_array(np.array([2, 3]), "row_and_column")],
)
onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8), "scikit-learn.onnx")

# %% 8. PyTorch: a small network on the whole frame
# The input of a model is in newtons, so the network does any scaling itself. With so few presses it is no better
# than part 6, and its score changes with the seed.
if importlib.util.find_spec("torch"):
    import torch
    from torch import nn

    torch.manual_seed(1)
    torch.set_num_threads(1)

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
            # Noise around a contact is below 0 at times, where a logarithm is no number.
            logits = self.classify(self.features(torch.log1p(20 * frame.clamp(min=0))))
            return logits, torch.softmax(logits, dim=1)

    def tensors(presses):
        return torch.from_numpy(presses.frames)[:, None], torch.from_numpy(presses.level.astype(np.int64)) - 1

    frames, levels = tensors(train)
    net = Net()
    optimizer = torch.optim.AdamW(net.parameters(), lr=1e-3, weight_decay=1e-2)
    for epoch in range(60):
        losses = []
        for batch in torch.randperm(len(frames)).split(16):
            # A press is the same when it is mirrored or turned by a quarter.
            turned = torch.rot90(frames[batch], int(torch.randint(4, ())), (2, 3))
            if torch.rand(()) < 0.5:
                turned = turned.flip(3)
            loss = nn.functional.cross_entropy(net(turned)[0], levels[batch])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
        if epoch % 10 == 9:
            print(f"epoch {epoch + 1}: loss {np.mean(losses):.3f}", flush=True)
    net.eval()
    frames, levels = tensors(test)
    with torch.no_grad():
        scores["PyTorch"] = (net(frames)[1].argmax(1) == levels).double().mean().item()
    print(f"PyTorch {torch.__version__}: {scores['PyTorch']:.1%} of {len(test)} test presses")

    # One frame in, logits and probabilities out, and all weights in the one file.
    torch.onnx.export(
        net,
        (torch.zeros(1, 1, 28, 28),),
        "PyTorch.onnx",
        input_names=["frame"],
        output_names=["logits", "probabilities"],
        external_data=False,
        verbose=False,
    )
else:
    print("PyTorch is not installed: this part is left out")

# %% 9. Add what the daemon needs to know, and check
# `adopt` adds levels, pitch, range and check frames from the data set. The daemon's inference library must recognise
# as many of the test presses as Python did.
for name, score in scores.items():
    out = ["--out", f"own-{name}.onnx", "--method", name]
    run(sys.executable, "-m", "hardnessd.adopt", f"{name}.onnx", "--data", "own.npz", *out)
    run("hrn-train", "check-model", f"own-{name}.onnx")
    evaluated = json.loads(run("hrn-train", "evaluate", "--model", f"own-{name}.onnx", "--data", "own.npz", "--json"))
    assert abs(evaluated["accuracy"] - score) < 0.002, (evaluated["accuracy"], score)

# %% 10. Let the daemon judge with each model
# The objects of the test press the sensor again.
for name in scores:
    pathlib.Path("own.toml").write_text(f'{CONFIGURATION}[model]\npath = "own-{name}.onnx"\n')
    verdicts = []
    with running("hardnessd", "run", "--config", "own.toml") as daemon:
        for object_name, level, number in TEST:
            print(f"{object_name} ", end="", flush=True)
            with pressed(object_name, 100 + number):
                found = list(itertools.islice(final_verdicts(daemon), PRESSES))
            print("", *(verdict["level"] or "-" for verdict in found), flush=True)
            verdicts += [(level, verdict) for verdict in found]
    right = sum(verdict["level"] == level for level, verdict in verdicts)
    print(f"{name}: {right} of {len(verdicts)} presses right, judged by model {verdicts[0][1]['model']}\n")

# To use a model on the robot, name it in the daemon's configuration ([model] path) and reload the daemon with
# `systemctl reload hardnessd`. It misses no frame.
