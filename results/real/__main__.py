"""What `hrn-train fit` reaches on public recordings of real presses, beside controls and plain scikit-learn.

    pip install numpy scikit-learn scipy
    cargo build --release --workspace
    python3 results/real gripper --bin target/release

It clones the repository of the set into the current directory, at the commit that the set names. `--data` names a clone,
or an `.npz` file with the same arrays. No data is part of this repository.

A set is a module with `read(path)`, which gives a `Recorded`, and `splits(recorded, share)`; list it in SETS. A method is
a function in methods.py.
"""

import argparse
import pathlib
import subprocess
import tempfile

import forearm
import gripper
import holds
import methods
import numpy as np
import palpation
from product import Product

SETS = {"forearm": forearm, "gripper": gripper, "holds": holds, "palpation": palpation}


def arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set", choices=SETS)
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="directory of hardnessd and hrn-train")
    parser.add_argument("--data", type=pathlib.Path, help="clone of the set's repository [default: cloned here]")
    parser.add_argument("--learn", type=float, default=0.6, help="share of the trials that is learnt from [0.6]")
    return parser.parse_args()


def clone(module):
    """The path of a clone at the set's commit, made if it is not there."""
    path = pathlib.Path(module.URL.rsplit("/", 1)[1])
    if not path.exists():
        subprocess.run(["git", "clone", module.URL, path], check=True)
        subprocess.run(["git", "-C", path, "checkout", "--quiet", module.COMMIT], check=True)
    return path


def main():
    given = arguments()
    module = SETS[given.set]
    recorded = module.read(given.data or clone(module))
    with tempfile.TemporaryDirectory() as directory:
        product = Product(given.bin, pathlib.Path(directory), recorded)
        for title, parts in module.splits(recorded, given.learn):
            judged = np.concatenate([judge for _, judge in parts])
            print(f"\n{title}: {len(judged)} presses judged, {len(parts[0][0])} learnt from")
            for name, method in {"hrn-train fit, replayed": product.judge, **methods.ALL}.items():
                said = np.concatenate([method(recorded, learn, judge) for learn, judge in parts])
                print(f"  {name:42} {methods.shown(recorded.level[judged], said)}", flush=True)
            print(product.account)


if __name__ == "__main__":
    main()
