"""What public recordings of real presses say of hardness.

    pip install numpy scipy scikit-learn

    git clone https://github.com/peter-kiechle/tactile-sensors
    python3 examples/real_presses stamp tactile-sensors --hardnessd target/release/hardnessd

    git clone https://github.com/GelSight-lab/EstimateModulus
    git clone https://github.com/GelSight-lab/TactileEstimateModulus
    python3 examples/real_presses squeezes EstimateModulus TactileEstimateModulus

The daemon judges the presses of `stamp`. The other recordings have no frames that it could judge. `results/real` has
four sets that `hrn-train fit` learns from. docs/results.md says what came out, and results/real-presses.md has the commits and more tables.
"""

import argparse
import pathlib

import squeezes
import stamp


def arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = parser.add_subparsers(dest="part", required=True)
    of_stamp, of_squeezes = (parts.add_parser(part) for part in ("stamp", "squeezes"))
    of_stamp.add_argument("clone", type=pathlib.Path, help="of tactile-sensors")
    of_stamp.add_argument("--hardnessd", type=pathlib.Path, required=True, help="the daemon's binary")
    of_stamp.add_argument("--model", type=pathlib.Path, help="an ONNX model in place of the built-in one")
    of_stamp.add_argument("--newtons-per-count", type=float, default=stamp.NEWTONS_PER_COUNT, help="of the array")
    of_squeezes.add_argument("clone", type=pathlib.Path, help="of EstimateModulus")
    of_squeezes.add_argument("table", type=pathlib.Path, help="clone of TactileEstimateModulus")
    return parser.parse_args()


def main():
    given = arguments()
    if given.part == "stamp":
        stamp.report(given.clone, given.hardnessd, given.model, given.newtons_per_count)
    else:
        squeezes.report(given.clone, given.table)


if __name__ == "__main__":
    main()
