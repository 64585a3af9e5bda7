#!/usr/bin/env python3
"""The dashboard and the alert rules of clients/grafana, and docs/metrics.md, against a live daemon.

    python tests/peers/grafana.py target/debug/hardnessd

Claims: /metrics has every metric, every label and every value of a label that a query names, and the metrics and labels
that the page lists, and no other.
"""

import json
import os
import pathlib
import re
import sys
import urllib.request

from bench import Bench, wait_for

ROOT = pathlib.Path(__file__).parents[2]
GRAFANA = ROOT / "clients/grafana"
# Prometheus makes these itself.
OWN_METRICS = {"up"}
OWN_LABELS = {"job", "instance"}
SENSORS = ("forearm", "wrist")


def queries():
    """{title: query}, without the variables of Grafana; and the alerts' queries."""
    dashboard = json.loads((GRAFANA / "hardnessd.json").read_text())
    found = {}
    for panel in dashboard["panels"]:
        for target in panel["targets"]:
            found[f"{panel['title']} {target['refId']}"] = target["expr"], target["legendFormat"]
    places = [panel["gridPos"] for panel in dashboard["panels"]]
    cells = [
        (place["x"] + dx, place["y"] + dy)
        for place in places for dx in range(place["w"]) for dy in range(place["h"])
    ]
    assert len(cells) == len(set(cells)) and max(x for x, _ in cells) < 24, "panels overlap"
    variables = {variable["name"] for variable in dashboard["templating"]["list"]}
    asked = re.findall(r"\$\{?(\w+)", json.dumps(dashboard["panels"]))
    assert set(asked) <= variables | {"__rate_interval", "__all"}, asked
    for variable in dashboard["templating"]["list"]:
        if variable["type"] == "query":
            query, label = re.fullmatch(r"label_values\((.*), (\w+)\)", variable["definition"]).groups()
            found[f"variable {variable['name']}"] = query, f"{{{{{label}}}}}"
    rules = (GRAFANA / "alerts.yml").read_text()
    alerts = {}
    for rule in rules.split("- alert: ")[1:]:
        name, rest = rule.split("\n", 1)
        expression, _, after = re.search(r"expr: (>-)?(.*?)\n +(for|labels):(?s:.*)", rest, re.S).group(2, 3, 0)
        legend = "".join(f"{{{{{label}}}}}" for label in re.findall(r"\$labels\.(\w+)", after))
        alerts[name] = " ".join(expression.split()), legend
    page = (GRAFANA / "README.md").read_text()
    assert set(alerts) == set(re.findall(r"^\| `(\w+)` \|", page, re.M)), alerts
    plain = {
        title: (re.sub(r"\$(robot|sensor)", ".*", query).replace("$__rate_interval", "5s"), legend)
        for title, (query, legend) in found.items()
    }
    return plain, alerts


def scrape(address):
    """{metric: {label: {value}}} of /metrics."""
    text = urllib.request.urlopen(f"http://{address}/metrics", timeout=10).read().decode()
    found = {}
    for line in text.splitlines():
        if line.startswith("#"):
            continue
        name, labels = re.fullmatch(r"(\w+)\{(.*)\} \S+", line).groups()
        of = found.setdefault(name, {})
        for label, value in re.findall(r'(\w+)="((?:[^"\\]|\\.)*)"', labels):
            of.setdefault(label, set()).add(value)
    return found


def check_names(title, query, legend, there):
    """Every metric and label of the query is there."""
    metrics = set(re.findall(r"\bhardnessd_\w+|\bup\b", re.sub(r'"[^"]*"', '""', query)))
    assert metrics, (title, query)
    assert metrics <= set(there) | OWN_METRICS, (title, metrics - set(there))
    labels = OWN_LABELS.copy()
    for metric in metrics - OWN_METRICS:
        labels |= set(there[metric])
    grouped = re.findall(r"\b(?:by|on|ignoring|without) ?\(([^)]*)\)", query)
    named = {label.strip() for group in grouped for label in group.split(",")}
    named |= set(re.findall(r"\{\{(\w+)\}\}", legend))
    assert named <= labels, (title, named - labels)
    for metric, matchers in re.findall(r"\b(hardnessd_\w+)\{([^}]*)\}", query):
        for label, how, value in re.findall(r'(\w+)(=~|!=|!~|=)"([^"]*)"', matchers):
            assert label in there[metric], (title, metric, label)
            for one in value.split("|") if "~" in how else [value]:
                assert any(re.fullmatch(one, known) for known in there[metric][label]), (title, label, one)


def documented(there):
    """docs/metrics.md has every metric with its labels, and no other."""
    rows = re.findall(r"^\| `(hardnessd_\w+)` \| \w+ \|(.*?)\|", (ROOT / "docs/metrics.md").read_text(), re.M)
    page = {name: {"robot", *re.findall(r"`(\w+)`", labels)} for name, labels in rows}
    found = {name.replace("_build_info_info", "_build_info"): set(labels) for name, labels in there.items()}
    assert page == found, (page, found)


def main(binary):
    dashboard, alerts = queries()
    with Bench(binary, sensors=SENSORS, more='[http]\nlisten = "127.0.0.1:0"\n') as bench:
        bench.sensor("forearm")
        bench.sensor("wrist", "--seed", "2")
        bench.daemon()
        address = bench.address("http")
        wait_for("the frame rate", lambda: "hardnessd_frame_rate_hertz" in scrape(address))
        there = scrape(address)
    documented(there)
    for title, (query, legend) in {**dashboard, **alerts}.items():
        check_names(title, query, legend, there)
    print(f"/metrics has all that {len(dashboard)} queries of the dashboard and {len(alerts)} alerts name")


if __name__ == "__main__":
    main(os.path.abspath(sys.argv[1]))
