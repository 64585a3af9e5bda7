#!/usr/bin/env python3
"""Verdicts of many sensors and to many subscribers, as a table and as a plot.

    pip install matplotlib
    cargo build --release && cargo build --release --example latency
    python3 benches/scale.py --out results/scale.png

Every sensor sends 100 frames/s. Run it as root, or where you may use real-time scheduling: the simulated sensors
then run at a higher priority than the daemon. `--lines FILE` plots the lines that `latency` printed before.
"""

import argparse
import re
import subprocess
import sys

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

SENSORS = [1, 8, 64, 500]
SUBSCRIBERS = [1, 10, 100, 1000]
LINE = re.compile(
    r"sensors (\d+) side 28 rate 100 clients (\d+) Verdict scheduling (\w+) .*?: (\d+) events, (\d+) lost; "
    r"us p50 (\d+) p99 (\d+) .*?processor [\d.]+ us a frame, ([\d.]+) % of a core; anonymous memory (\d+) kB"
)


def measured(latency, program):
    """What `latency` prints, one line after the other."""
    command = [latency, "--program", program, "--event", "verdict"]
    for count in SENSORS:
        own = [*command, "--scheduling", "rr", "--sensors", str(count), "--seconds", "20"]
        yield subprocess.run(["chrt", "--rr", "20", *own], capture_output=True, text=True, check=True).stdout
    for count in SUBSCRIBERS:
        own = [*command, "--sensors", "8", "--clients", str(count), "--seconds", "15"]
        yield subprocess.run(own, capture_output=True, text=True, check=True).stdout


def panel(axes, rows, place, label):
    """Processor time, median and p99 of the rows against the number in column `place`."""
    numbers = [row[place] for row in rows]
    axes.plot(numbers, [row["p50"] for row in rows], "o-", color="#1f77b4", label="median, ms")
    axes.plot(numbers, [row["p99"] for row in rows], "s-", color="#d62728", label="p99, ms")
    axes.plot(numbers, [row["core"] for row in rows], "^--", color="#555555", label="daemon, % of a core")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xticks(numbers, [f"{number:,}" for number in numbers])
    axes.set_yticks([0.5, 1, 5, 10, 50, 100], ["0.5", "1", "5", "10", "50", "100"])
    axes.minorticks_off()
    axes.set_ylim(0.3, 500)
    axes.set_xlabel(label)
    axes.grid(alpha=0.3)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--latency", default="target/release/examples/latency")
    parser.add_argument("--program", default="target/release/hardnessd")
    parser.add_argument("--lines")
    parser.add_argument("--out", default="scale.png")
    args = parser.parse_args()
    lines = open(args.lines) if args.lines else measured(args.latency, args.program)
    rows = []
    for match in filter(None, map(LINE.search, lines)):
        sensors, clients, scheduling, events, lost, p50, p99, core, memory = match.groups()
        row = {"sensors": int(sensors), "clients": int(clients), "scheduling": scheduling}
        row |= {"events": int(events), "lost": int(lost), "core": float(core), "memory": int(memory)}
        rows.append(row | {"p50": int(p50) / 1e3, "p99": int(p99) / 1e3})
        print(*(f"{name} {value}" for name, value in rows[-1].items()), sep=", ")
    if not rows:
        sys.exit("no line of latency --event verdict")
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.8), sharey=True, layout="constrained")
    panel(left, [row for row in rows if row["scheduling"] == "Rr"], "sensors", "sensors, one subscriber")
    panel(right, [row for row in rows if row["scheduling"] == "Other"], "clients", "subscribers, eight sensors")
    lost = sum(row["lost"] for row in rows)
    verdicts = sum(row["events"] for row in rows)
    figure.suptitle(f"From the last byte of a press to its verdict: {verdicts:,} received, {lost:,} lost", fontsize=11)
    left.legend(fontsize=9)
    figure.savefig(args.out, dpi=110)


main()
