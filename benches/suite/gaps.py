"""How long nobody answers when an operator of the running default graph is swapped, and from a kill -9 of it until its
successor is ready; what is lost then."""

import json
import os
import re
import signal
import statistics
import time

from . import figures, graphs, programs
from .options import Option

OPTIONS = {
    "rounds": Option(3, "how often each operator is swapped and killed", quick=1, least=1),
    "rates": Option((1000.0, 10000.0), "frames per second", quick=(1000.0,), least=10),
    "recording": Option(programs.HELD_OUT, "what the source plays"),
}


def measure(options):
    return {"rates": [at_rate(rate, options) for rate in options.rates]}


def at_rate(rate, options):
    swap_millis, restart_millis = {}, {}
    with graphs.Graph(graphs.DEFAULT, graphs.played(options.recording, rate, "forever")) as running:
        running.wait_until_decided()
        for node in graphs.default_nodes():
            swaps = [swap(running, node) for _ in range(options.rounds)]
            swap_millis[node] = [one["handover_pause_nanos"] / 1e6 for one in swaps]
            for _ in range(options.rounds):
                os.kill(running.node(node)["pid"], signal.SIGKILL)
                time.sleep(1)
        summary = running.stop()
    for node, millis in re.findall(r"node '(.*)' is back after ([0-9.]+) ms", running.said()):
        restart_millis.setdefault(node, []).append(float(millis))
    ids = [decision["grasp_id"] for _, decision in running.decisions()]
    return {
        "rate": rate,
        "swap_gap_millis": swap_millis,
        "restart_millis": restart_millis,
        "lost": summary["samples_lost"],
        "swaps": summary["swaps"],
        "restarts": summary["restarts"],
        "decided_once_and_in_order": ids == list(range(len(ids))),
    }


def swap(running, node):
    said = programs.blindgrasp("swap", node, "--graph", running.name, "--probation", "0.3", "--json")
    return json.loads(said)["nodes"][0]


def verdict(result):
    if all(at["decided_once_and_in_order"] for at in result["rates"]):
        return None
    return "decisions are missing, twice or out of order"


def show(result):
    for at in result["rates"]:
        print(f"\n{at['rate']:g} Hz: {at['swaps']} swaps, {at['restarts']} restarts, {at['lost']} samples lost")
        rows = []
        for node, millis in at["swap_gap_millis"].items():
            rows.append([node, middle_and_range(millis), middle_and_range(at["restart_millis"].get(node, []))])
        figures.table(["ms", "swap: nobody active", "kill -9: ready again"], rows)


def middle_and_range(values):
    if not values:
        return "-"
    return f"{statistics.median(values):.1f} ({min(values):.1f}-{max(values):.1f})"
