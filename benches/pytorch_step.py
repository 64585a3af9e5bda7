"""The training steps of `train_step.rs` in PyTorch, in turn with it: their ratio.

    cargo bench -p hrn-train --bench train_step --no-run   # prints the executable
    python benches/pytorch_step.py EXECUTABLE [--threads N] [--rounds N]

Needs torch and numpy. Both sides start from the same weights and images; the losses of the first
20 steps must agree before anything is timed. Then blocks of steps of either side follow each
other, and the median ratio of neighbouring blocks is printed: above 1, ours is faster. It is
printed twice: of the processor's seconds, which a busy machine leaves alone, and of the clock's,
which is what a user of several threads waits for.
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
        self.norm2 = nn.BatchNorm2d(32, eps=1e-8)
        self.conv3 = nn.Conv2d(32, 64, 3, 2, padding=1)
        self.norm3 = nn.BatchNorm2d(64, eps=1e-8)

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


class Discriminator(nn.Module):
    def __init__(self):
        super().__init__()
        self.trunk = Trunk()
        self.head = nn.Linear(64, 1)

    def forward(self, images):
        return self.head(self.trunk(images))


class Generator(nn.Module):
    """30 -> 4 -> 7 -> 14 -> 28 as in `generator.rs`, with the mixture of Eq. (2)."""

    def __init__(self):
        super().__init__()
        self.mu = nn.Parameter(torch.empty(50, 30))
        self.sigma = nn.Parameter(torch.empty(50, 30))
        self.linear = nn.Linear(30, 1024)
        self.norm = nn.BatchNorm1d(1024, eps=1e-5)
        self.deconv1 = nn.ConvTranspose2d(64, 32, 3, 2, padding=1)
        self.norm1 = nn.BatchNorm2d(32, eps=1e-5)
        self.deconv2 = nn.ConvTranspose2d(32, 16, 5, 2, padding=1)
        self.norm2 = nn.BatchNorm2d(16, eps=1e-5)
        self.deconv3 = nn.ConvTranspose2d(16, 1, 5, 2, padding=1)

    def forward(self, eta):
        copies = eta.shape[0] // 50
        z = self.mu.repeat(copies, 1) + self.sigma.repeat(copies, 1) * eta
        x = functional.relu(self.norm(self.linear(z))).view(-1, 64, 4, 4)
        x = functional.relu(self.norm1(self.deconv1(x)))
        x = functional.relu(self.norm2(self.deconv2(x)[:, :, :14, :14]))
        return torch.tanh(self.deconv3(x)[:, :, :28, :28])


def places(module, prefix=""):
    """Our names of a module's parameters."""
    for name, child in module.named_children():
        if isinstance(child, Trunk):
            yield from places(child, prefix)
        elif isinstance(child, nn.Linear):
            yield f"{name}.matrix", child.weight
            yield f"{name}.bias", child.bias
        elif isinstance(child, (nn.Conv2d, nn.ConvTranspose2d)):
            yield f"{name}.kernel", child.weight
            yield f"{name}.bias", child.bias
        else:
            owner = {"norm": "linear", "norm1": "deconv1", "norm2": None, "norm3": "conv3"}[name]
            if owner is None:
                owner = "deconv2" if isinstance(module, Generator) else "conv2"
            yield f"{owner}.gamma", child.weight
            yield f"{owner}.beta", child.bias
    if isinstance(module, Generator):
        yield "mixture.mu", module.mu
        yield "mixture.sigma", module.sigma


def load(module, arrays, side):
    with torch.no_grad():
        for name, place in places(module):
            values = torch.from_numpy(arrays[f"{side}/{name}"])
            place.copy_(values.T if name.endswith(".matrix") else values)


class HrnSteps:
    def __init__(self, arrays):
        self.images = torch.from_numpy(arrays["images"])
        self.levels = torch.from_numpy(arrays["targets"]).argmax(1)
        self.model = Hrn(arrays["targets"].shape[1])
        load(self.model, arrays, "hrn")
        self.optimiser = sgd(self.model.parameters())

    def step(self):
        self.optimiser.zero_grad()
        loss = functional.cross_entropy(self.model(self.images), self.levels)
        loss.backward()
        self.optimiser.step()
        return loss.item()


class GanSteps:
    def __init__(self, arrays, optimiser):
        self.images = torch.from_numpy(arrays["images"])
        self.eta = torch.from_numpy(arrays["eta"])
        self.generator, self.discriminator = Generator(), Discriminator()
        load(self.generator, arrays, "generator")
        load(self.discriminator, arrays, "discriminator")
        self.of_generator = optimiser(self.generator.parameters())
        self.of_discriminator = optimiser(self.discriminator.parameters())

    def step(self):
        images = self.generator(self.eta)
        self.of_discriminator.zero_grad()
        loss = (
            functional.softplus(-self.discriminator(self.images)).mean()
            + functional.softplus(self.discriminator(images.detach())).mean()
        )
        loss.backward()
        self.of_discriminator.step()

        self.of_generator.zero_grad()
        self.discriminator.requires_grad_(False)
        fooled = functional.softplus(-self.discriminator(images)).mean()
        of_generator = fooled + 0.1 * (1 - self.generator.sigma).square().mean()
        of_generator.backward()
        self.discriminator.requires_grad_(True)
        self.of_generator.step()
        return loss.item() + of_generator.item()


def run(network, steps):
    begun = time.process_time()
    losses = [network.step() for _ in range(steps)]
    return time.process_time() - begun, losses


def timed(run_block):
    """Seconds of the processor and of the clock."""
    begun = time.monotonic()
    processor_seconds, _ = run_block()
    return processor_seconds, time.monotonic() - begun


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
        arrays = dict(numpy.load(weights))
        hrn, gan = HrnSteps(arrays), GanSteps(arrays, adam)
        check("hrn", peer, hrn)
        # With Adam a gradient that is nothing but rounding becomes a step of the full rate, so
        # two exact computations part after three steps; with SGD they stay together.
        check("gan-sgd", peer, GanSteps(arrays, sgd))
        measure("hrn", peer, hrn, arguments)
        measure("gan", peer, gan, arguments)


def sgd(parameters):
    return torch.optim.SGD(parameters, lr=1e-3)


def adam(parameters):
    return torch.optim.Adam(parameters, lr=1e-3, betas=(0.5, 0.999), eps=1e-8)


def check(name, peer, theirs):
    _, our_losses = peer.run(name, CHECKED_STEPS)
    _, their_losses = run(theirs, CHECKED_STEPS)
    apart = max(abs(a - b) / abs(b) for a, b in zip(our_losses, their_losses))
    print(f"{name}: losses of {CHECKED_STEPS} steps agree within {apart:.1e}")
    if apart > 1e-3:
        sys.exit(f"{name}: not the same computation: {our_losses} {their_losses}")


def measure(name, peer, theirs, arguments):
    blocks = []
    for _ in range(arguments.rounds):
        their_seconds = timed(lambda: run(theirs, BLOCK_STEPS))
        our_seconds = timed(lambda: peer.run(name, BLOCK_STEPS))
        blocks.append((their_seconds, our_seconds))
    for index, clock in enumerate(["processor", "clock"]):
        their_ms, our_ms = (
            statistics.median(block[side][index] for block in blocks) / BLOCK_STEPS * 1e3
            for side in range(2)
        )
        ratios = [theirs[index] / ours[index] for theirs, ours in blocks]
        print(
            f"{name}, {arguments.threads} thread(s), {clock}: PyTorch {torch.__version__}"
            f" {their_ms:.1f} ms, ours {our_ms:.1f} ms a step;"
            f" ratio {statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"
        )


if __name__ == "__main__":
    main()
