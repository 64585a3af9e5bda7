#!/usr/bin/env python3
"""The dashboard and the alert rules of clients/grafana against a live daemon.

    python tests/peers/grafana.py target/debug/hardnessd [--promtool PROGRAM]

Claims: /metrics has every metric, every label and every value of a label that a query names. With Prometheus's
promtool: it takes the rules, and every alert fires when it should and only then.
"""

import argparse
import json
import pathlib
import re
import subprocess
import tempfile
import urllib.request

from bench import Bench, wait_for

GRAFANA = pathlib.Path(__file__).parents[2] / "clients/grafana"
# Prometheus makes these itself.
OWN_METRICS = {"up"}
OWN_LABELS = {"job", "instance"}
SENSORS = ("forearm", "wrist")

MODELS = {name: f'hardnessd_build_info{{job="hardnessd",robot="r",model="{name}",run="{name}"}}' for name in "ab"}
BEGIN = """rule_files: [alerts.yml]
evaluation_interval: 15s
tests:
"""
S = 'robot="r",sensor="s"'
# Of each alert: series, one value each 15 s, with which it is silent, and with which it fires.
CASES = {
    "HardnessdDown": (
        {'up{job="hardnessd"}': "1x80"},
        {'up{job="hardnessd"}': "0x80"},
    ),
    "HardnessdSensorNotLive": (
        {f'hardnessd_link_state{{{S},state="live"}}': "1x80", f'hardnessd_link_state{{{S},state="lost"}}': "0x80"},
        {f'hardnessd_link_state{{{S},state="live"}}': "0x80", f'hardnessd_link_state{{{S},state="lost"}}': "1x80"},
    ),
    "HardnessdFramesDamaged": (
        {f"hardnessd_frames_damaged_total{{{S}}}": "0+1x80", f"hardnessd_frames_total{{{S}}}": "0+300x80"},
        {f"hardnessd_frames_damaged_total{{{S}}}": "0+6x80", f"hardnessd_frames_total{{{S}}}": "0+300x80"},
    ),
    "HardnessdNoVerdicts": (
        {
            f'hardnessd_presses_total{{{S},state="end"}}': "0+1x80",
            f'hardnessd_verdicts_total{{{S},phase="final",level="2"}}': "0+1x80",
        },
        {
            f'hardnessd_presses_total{{{S},state="end"}}': "0+1x80",
            f'hardnessd_verdicts_total{{{S},phase="final",level="2"}}': "7x80",
        },
    ),
    "HardnessdModelFails": (
        {f"hardnessd_verdicts_failed_total{{{S}}}": "3x80"},
        {f"hardnessd_verdicts_failed_total{{{S}}}": "3x70 4x10"},
    ),
    "HardnessdModelChanged": (
        {MODELS["a"]: "1x80"},
        {MODELS["a"]: "1x60 stale", MODELS["b"]: "_x60 1x20"},
    ),
    "HardnessdEventsDropped": (
        {'hardnessd_events_dropped_total{robot="r"}': "9x80"},
        {'hardnessd_events_dropped_total{robot="r"}': "0+1x80"},
    ),
}


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
    assert set(alerts) == set(CASES), set(alerts) ^ set(CASES)
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


def check_alerts(promtool):
    """promtool takes the rules, and each alert fires on its second series and not on its first."""
    subprocess.run([promtool, "check", "rules", "alerts.yml"], cwd=GRAFANA, check=True)
    cases = []
    for alert, (calm, wrong) in CASES.items():
        for series, fires in (calm, False), (wrong, True):
            test = {
                "interval": "15s",
                "input_series": [
                    {"series": name, "values": values} for name, values in series.items()
                ],
                # How many series the alert has that fire. No other label is compared.
                "promql_expr_test": [{
                    "expr": f'count by (alertname) (ALERTS{{alertname="{alert}", alertstate="firing"}})',
                    "eval_time": "19m",
                    "exp_samples": [{"labels": f'{{alertname="{alert}"}}', "value": 1}] if fires else [],
                }],
            }
            cases.append(test)
    with tempfile.TemporaryDirectory() as directory:
        path = pathlib.Path(directory)
        (path / "alerts.yml").write_text((GRAFANA / "alerts.yml").read_text())
        # JSON is YAML.
        (path / "tests.yml").write_text(BEGIN + "".join(f"  - {json.dumps(case)}\n" for case in cases))
        subprocess.run([promtool, "test", "rules", "tests.yml"], cwd=path, check=True)
    print(f"{len(CASES)} alerts fire when they should, and only then")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("binary")
    parser.add_argument("--promtool")
    asked = parser.parse_args()
    dashboard, alerts = queries()
    with Bench(asked.binary, sensors=SENSORS, more='[http]\nlisten = "127.0.0.1:0"\n') as bench:
        bench.sensor("forearm")
        bench.sensor("wrist", "--seed", "2")
        bench.daemon()
        address = bench.address("http")
        wait_for("the frame rate", lambda: "hardnessd_frame_rate_hertz" in scrape(address))
        there = scrape(address)
        for title, (query, legend) in {**dashboard, **alerts}.items():
            check_names(title, query, legend, there)
        print(f"/metrics has all that {len(dashboard)} queries of the dashboard and {len(alerts)} alerts name")
    if asked.promtool is None:
        print("skipped: no promtool here; the rules were not tried")
        return
    check_alerts(asked.promtool)


if __name__ == "__main__":
    main()
