"""The default graph beside the same graph with operators/sklearn_classifier.py in place of the Rust classifier.

Latency is from the source's send to the launcher's receipt of a decision. CPU time is that of the classifier and of the
processes that it has started, between two looks. The model is train_sklearn.py's default one, of `data`;
scripts/python-env makes the environment.
"""

import tempfile
import time
from pathlib import Path

from . import figures, graphs, programs
from .options import Option

OPTIONS = {
    "secs": Option(20.0, "how long each run is watched", quick=1.0, least=0.1),
    "rates": Option((100.0, 1000.0), "frames per second", quick=(1000.0,), least=10),
    "rounds": Option(3, "how often each side runs", quick=1, least=1),
    "data": Option(programs.HELD_OUT, "the recordings that the model learns from"),
}
FIGURES = {
    "latency_p50_micros": ("latency p50", "µs", 0),
    "latency_p99_micros": ("latency p99", "µs", 0),
    "cpu_micros_per_sample": ("classifier's CPU time a sample", "µs", 0),
    "samples_per_sec": ("samples a second", "", 0),
    "lost": ("samples lost", "", 0),
    "accuracy_percent": ("accuracy", "%", 1),
}
OPERATORS = programs.PROJECT / "operators"


def measure(options):
    python = programs.test_python()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        model, table = folder / "bench.joblib", folder / "features.csv"
        programs.blindgrasp("export", options.data, "--features", programs.MODEL, "--out", table)
        trained = programs.output(python, "-B", OPERATORS / "train_sklearn.py", table, "--out", model)
        program = folder / "classifier"
        program.write_text(f'#!/bin/sh\nexec {python} -B {OPERATORS}/sklearn_classifier.py "$@"\n')
        program.chmod(0o755)
        flow = graphs.default_with(folder, {"classifier": [f"run: {program}", f"params: {{model: {model}}}"]})
        # The sandbox does not know the files of Python.
        before, node = flow.read_text().split(f"run: {program}")
        flow.write_text(before + f"run: {program}" + node.replace("    sandbox: on\n", "", 1))
        rates = [at_rate(rate, flow, options) for rate in options.rates]
    return {"trained": trained, "rates": rates}


def at_rate(rate, python_flow, options):
    sides = {
        "Rust": lambda: run(graphs.DEFAULT, rate, options.secs),
        "scikit-learn": lambda: run(python_flow, rate, options.secs),
    }
    runs = figures.in_turn(options.rounds, sides)
    return {"rate": rate, "medians": figures.medians(runs), "ratios": figures.ratios(runs, "Rust"), "rounds": runs}


def run(flow, rate, secs):
    with graphs.Graph(flow, graphs.played(programs.HELD_OUT, rate, "forever")) as running:
        running.wait_until_decided()
        before = look(running)
        time.sleep(secs)
        after = look(running)
        summary = running.stop()
    n_samples = after["n_samples"] - before["n_samples"]
    return graphs.latencies(summary) | {
        "cpu_micros_per_sample": (after["cpu_nanos"] - before["cpu_nanos"]) / 1e3 / n_samples,
        "samples_per_sec": n_samples / (after["at"] - before["at"]),
        "lost": summary["samples_lost"],
        "accuracy_percent": 100 * summary["accuracy"],
    }


def look(running):
    """What the classifier has answered and used."""
    status = running.status()
    pid = next(node["pid"] for node in status["nodes"] if node["node"] == "classifier")
    edge = next(edge for edge in status["edges"] if edge["to"].startswith("classifier/"))
    cpu_nanos = programs.cpu_nanos([pid, *programs.descendants(pid)])
    return {"n_samples": edge["received"], "cpu_nanos": cpu_nanos, "at": time.monotonic()}


def show(result):
    print(result["trained"])
    for at in result["rates"]:
        figures.sides_table(f"{at['rate']:g} Hz", FIGURES, at["medians"], at["ratios"])
