#!/usr/bin/env python3
"""Prints a line when a robot comes or goes, when the state of a sensor changes, and for each final verdict.

    pip install eclipse-zenoh
    python3 examples/fleet.py --connect tcp/ROUTER:7447 'tactile/hall-3/**'

The robots put their events at the keys of docs/protocol.md; docs/fleet.md says how they and you meet at a router.
"""

import argparse
import json
import threading

import zenoh


def show(*columns):
    # Names come from the network: no character of them may speak to the terminal.
    printable = ["".join(c if c.isprintable() else "?" for c in str(column)) for column in columns]
    print(f"{printable[0]:<30} {printable[1]:<12}", *printable[2:], flush=True)


class Fleet:
    def __init__(self):
        self.states = {}

    def on_token(self, sample):
        is_there = sample.kind == zenoh.SampleKind.PUT
        show(str(sample.key_expr).removeprefix("tactile/"), "", "there" if is_there else "gone")

    def on_event(self, sample):
        try:
            event = json.loads(sample.payload.to_string())
            site, sensor, kind = str(sample.key_expr).removeprefix("tactile/").rsplit("/", 2)
            if kind == "status" and self.states.get((site, sensor)) != event["state"]:
                self.states[site, sensor] = event["state"]
                show(site, sensor, event["state"], event["reason"] or "")
            elif kind == "hardness" and event["phase"] == "final":
                what = event["label"] or event["rejected"]
                show(site, sensor, f"press {event['press']}: {what}, {100 * event['confidence']:.0f} %")
        # Whatever is put at such a key: what is no event is left out.
        except (ValueError, KeyError, TypeError, RecursionError):
            pass


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--connect", required=True, metavar="ENDPOINT", help="a router, tcp/HOST:PORT")
    parser.add_argument("keys", nargs="?", default="tactile/**", help="the robots to show [default: all]")
    parser.add_argument("--seconds", type=float, metavar="S", help="end after S seconds [default: no limit]")
    given = parser.parse_args()
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([given.connect]))
    config.insert_json5("scouting/multicast/enabled", "false")
    fleet = Fleet()
    with zenoh.open(config) as session:
        tokens = session.liveliness().declare_subscriber(given.keys, fleet.on_token, history=True)
        events = session.declare_subscriber(given.keys, fleet.on_event)
        # What was true before.
        for reply in session.get(given.keys):
            if reply.ok:
                fleet.on_event(reply.ok)
        try:
            threading.Event().wait(given.seconds)
        except KeyboardInterrupt:
            pass
        tokens.undeclare()
        events.undeclare()


if __name__ == "__main__":
    main()
