"""The training steps of `train_step.rs` in PyTorch, in turn with it: their ratio.

    cargo bench --features train --bench train_step --no-run   # prints the executable
    python benches/pytorch_step.py EXECUTABLE [--threads N] [--rounds N]

Needs torch and numpy. Both sides start from the same weights and images; the losses of the first
20 steps must agree before anything is timed. Then blocks of steps of either side follow each
other, and the median ratio of neighbouring blocks is printed: above 1, ours is faster. Seconds are
the processor's.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time

import numpy
import torch
from torch import nn
from torch.nn import functional

CHECKED_STEPS = 20
BLOCK_STEPS = 10


class Trunk(nn.Module):
    """28 -> 14 -> 7 -> 4 as in `network.rs`: TF's SAME padding, batch normalisation, max-pool."""

    def __init__(self):
        super().__init__()
        self.conv1 = nn.Conv2d(1, 16, 5, 2)
        self.conv2 = nn.Conv2d(16, 32, 5, 2)
        self.norm2 = nn.BatchNorm2d(32, eps=1e-3)
        self.conv3 = nn.Conv2d(32, 64, 3, 2, padding=1)
        self.norm3 = nn.BatchNorm2d(64, eps=1e-3)

    def forward(self, images):
        x = images + 1
        x = functional.leaky_relu(self.conv1(functional.pad(x, (1, 2, 1, 2))), 0.2)
        x = self.norm2(self.conv2(functional.pad(x, (1, 2, 1, 2))))
        x = self.norm3(self.conv3(functional.leaky_relu(x, 0.2)))
        return functional.leaky_relu(x, 0.2).amax((2, 3))


class Hrn(nn.Module):
    def __init__(self, levels):
        super().__init__()
        self.trunk = Trunk()
        self.head = nn.Linear(64, levels)

    def forward(self, images):
        return self.head(self.trunk(images))


def load(model, arrays):
    trunk = model.trunk
    places = {
        "conv1.kernel": trunk.conv1.weight,
        "conv1.bias": trunk.conv1.bias,
        "conv2.kernel": trunk.conv2.weight,
        "conv2.gamma": trunk.norm2.weight,
        "conv2.beta": trunk.norm2.bias,
        "conv2.bias": trunk.conv2.bias,
        "conv3.kernel": trunk.conv3.weight,
        "conv3.gamma": trunk.norm3.weight,
        "conv3.beta": trunk.norm3.bias,
        "conv3.bias": trunk.conv3.bias,
        "head.bias": model.head.bias,
    }
    with torch.no_grad():
        for name, place in places.items():
            place.copy_(torch.from_numpy(arrays[name]))
        model.head.weight.copy_(torch.from_numpy(arrays["head.matrix"]).T)


class HrnSteps:
    def __init__(self, arrays):
        self.images = torch.from_numpy(arrays["images"])
        self.levels = torch.from_numpy(arrays["targets"]).argmax(1)
        self.model = Hrn(arrays["targets"].shape[1])
        load(self.model, arrays)
        self.optimiser = torch.optim.SGD(self.model.parameters(), lr=1e-3)

    def run(self, steps):
        begun = time.process_time()
        losses = []
        for _ in range(steps):
            self.optimiser.zero_grad()
            loss = functional.cross_entropy(self.model(self.images), self.levels)
            loss.backward()
            self.optimiser.step()
            losses.append(loss.item())
        return time.process_time() - begun, losses


class Peer:
    """The bench executable, which does as it is told line by line."""

    def __init__(self, executable, weights, threads):
        self.process = subprocess.Popen(
            [executable, "--serve", weights],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"RAYON_NUM_THREADS": str(threads)},
        )
        assert self.process.stdout.readline() == "ready\n"

    def run(self, network, steps):
        self.process.stdin.write(f"{network} {steps}\n")
        self.process.stdin.flush()
        seconds, *losses = map(float, self.process.stdout.readline().split())
        return seconds, losses


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("executable")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=20)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)

    with tempfile.TemporaryDirectory() as directory:
        weights = os.path.join(directory, "weights.npz")
        peer = Peer(arguments.executable, weights, arguments.threads)
        theirs = HrnSteps(dict(numpy.load(weights)))
        _, our_losses = peer.run("hrn", CHECKED_STEPS)
        _, their_losses = theirs.run(CHECKED_STEPS)
        apart = max(abs(a - b) / abs(b) for a, b in zip(our_losses, their_losses))
        print(f"hrn: losses of {CHECKED_STEPS} steps agree within {apart:.1e}")
        if apart > 1e-3:
            sys.exit("hrn: not the same computation")

        ratios, ours_ms, theirs_ms = [], [], []
        for _ in range(arguments.rounds):
            their_seconds, _ = theirs.run(BLOCK_STEPS)
            our_seconds, _ = peer.run("hrn", BLOCK_STEPS)
            ratios.append(their_seconds / our_seconds)
            ours_ms.append(our_seconds / BLOCK_STEPS * 1e3)
            theirs_ms.append(their_seconds / BLOCK_STEPS * 1e3)
        print(
            f"hrn: PyTorch {torch.__version__} {statistics.median(theirs_ms):.1f} ms,"
            f" ours {statistics.median(ours_ms):.1f} ms a step on {arguments.threads} thread(s);"
            f" ratio {statistics.median(ratios):.2f}"
            f" ({min(ratios):.2f} to {max(ratios):.2f})"
        )


if __name__ == "__main__":
    main()
