#!/usr/bin/env python3
"""The paper's Tables 2 and 3, made again from the committed results.

    python tests/peers/tables.py target/debug

It needs tar and zstd. Claim: `hrn-train compare` without data makes Tables 2 and 3 of results/paper.tar.zst that are those
of results/paper/tables.md to the last digit: accuracies, kappas and confusion matrices of all methods that this file has.
"""

import os
import pathlib
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).parents[2]
# Columns that only the committed file has: its program computed intervals too.
GONE = ("95 %", "minus ours")


def sections(text):
    """Title -> [method, level] -> column -> cell."""
    found = {}
    for part in text.split("\n## ")[1:]:
        title, _, rest = part.partition("\n")
        rows = (line for line in rest.splitlines() if line.startswith("|"))
        lines = [[cell.strip() for cell in line[1:-1].split("|")] for line in rows]
        if not lines:
            continue
        head, method = lines[0], ""
        rows = {}
        for cells in lines[2:]:
            # A confusion matrix names the method in its first row alone.
            method = cells[0] or method
            kept = [(name, cell) for name, cell in zip(head, cells) if not name.startswith(GONE)]
            rows[method, kept[1][1] if title.endswith("confusion") else ""] = kept[1:]
        found[title] = rows
    return found


def main(binaries):
    program = pathlib.Path(binaries, "hrn-train").absolute()
    with tempfile.TemporaryDirectory() as directory:
        packed = subprocess.run(
            ["zstd", "--quiet", "--decompress", "--stdout", ROOT / "results/paper.tar.zst"], check=True, capture_output=True
        ).stdout
        subprocess.run(["tar", "--extract", "paper/results.json"], input=packed, cwd=directory, check=True)
        out = os.path.join(directory, "paper")
        subprocess.run([program, "compare", "--out", out], check=True, stdout=subprocess.DEVNULL)
        made = sections(pathlib.Path(out, "tables.md").read_text())
    known = sections((ROOT / "results/paper/tables.md").read_text())
    for title, rows in made.items():
        count = 0
        for row, cells in known[title].items():
            assert rows[row] == cells, (title, row, rows[row], cells)
            count += 1
        print(f"{title}: {count} rows are the same, {len(rows) - count} are new")
        assert count >= 15, title
    assert len(made) == 3, made.keys()


if __name__ == "__main__":
    main(*sys.argv[1:])
