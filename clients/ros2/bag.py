#!/usr/bin/env python3
"""Makes a ROS 2 bag of recordings of hardnessd: a directory with the files and metadata.yaml.

    pip install mcap
    python3 bag.py --out take press.mcap
    ros2 bag info take && ros2 bag play take

Several files, such as those of the daemon's own rotating recording, become one bag. Files are linked where the disk
allows it, else copied; nothing is changed. `ros2 bag reindex -s mcap take` does the same where ROS is installed.
"""

import argparse
import contextlib
import json
import os
import pathlib
import shutil
import sys

from mcap.reader import make_reader

# As ROS 2 Humble writes it; later versions read it.
VERSION = 5


def summary(path):
    """First and last time, and for each topic its type and how many messages it has."""
    with open(path, "rb") as file:
        found = make_reader(file).get_summary()
    if found is None or found.statistics is None:
        raise ValueError(f"{path}: found a recording that was cut off, expected a whole one: see `hardnessd recover`")
    counts = found.statistics.channel_message_counts
    topics = {
        channel.topic: (found.schemas[channel.schema_id].name, counts.get(number, 0))
        for number, channel in found.channels.items()
    }
    return found.statistics.message_start_time, found.statistics.message_end_time, topics


def metadata(files):
    """The text of metadata.yaml for (name, summary) of each file."""
    files = [(name, start, end, topics) for name, (start, end, topics) in files]
    begin, finish = min(file[1] for file in files), max(file[2] for file in files)
    total = {}
    for _, _, _, topics in files:
        for topic, (kind, count) in topics.items():
            total[topic] = (kind, total.get(topic, (kind, 0))[1] + count)
    # JSON's strings are YAML's too.
    text = json.dumps
    lines = [
        "rosbag2_bagfile_information:",
        f"  version: {VERSION}",
        "  storage_identifier: mcap",
        f"  duration:\n    nanoseconds: {finish - begin}",
        f"  starting_time:\n    nanoseconds_since_epoch: {begin}",
        f"  message_count: {sum(count for _, count in total.values())}",
        "  topics_with_message_count:",
    ]
    for topic, (kind, count) in sorted(total.items()):
        lines += [
            "    - topic_metadata:",
            f"        name: {text(topic)}",
            f"        type: {text(kind)}",
            "        serialization_format: cdr",
            '        offered_qos_profiles: ""',
            f"      message_count: {count}",
        ]
    lines += ['  compression_format: ""', '  compression_mode: ""', "  relative_file_paths:"]
    lines += [f"    - {text(name)}" for name, *_ in files]
    lines += ["  files:"]
    for name, start, end, topics in files:
        lines += [
            f"    - path: {text(name)}",
            f"      starting_time:\n        nanoseconds_since_epoch: {start}",
            f"      duration:\n        nanoseconds: {end - start}",
            f"      message_count: {sum(count for _, count in topics.values())}",
        ]
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", required=True, help="the directory to make")
    parser.add_argument("recordings", nargs="+")
    args = parser.parse_args()
    out = pathlib.Path(args.out)
    try:
        sources = sorted((summary(path), path) for path in args.recordings)
        out.mkdir()
        # Without its last file it is no bag. Then nothing of it stays, and the next try finds the path free.
        with contextlib.ExitStack() as made:
            made.callback(out.rmdir)
            files = []
            for number, (found, path) in enumerate(sources):
                name = f"{out.name}_{number}.mcap"
                made.callback((out / name).unlink, missing_ok=True)
                try:
                    os.link(path, out / name)
                except OSError:
                    shutil.copyfile(path, out / name)
                files.append((name, found))
            made.callback((out / "metadata.yaml").unlink, missing_ok=True)
            (out / "metadata.yaml").write_text(metadata(files))
            made.pop_all()
    except (OSError, ValueError) as error:
        sys.exit(f"bag.py: {error}")
    except Exception as error:  # of the library: what is no MCAP
        sys.exit(f"bag.py: found no recording: {error}")


if __name__ == "__main__":
    main()
