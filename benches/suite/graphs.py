"""Graphs that subjects run: their files, and the running graph."""

import itertools
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import threading
import time

from .programs import BLINDGRASP, HAND, MODEL, PROJECT, blindgrasp, output

DEFAULT = PROJECT / "dataflow.yaml"
# Of a simulated recording: frames per second within a grasp, and frames' time from a grasp's first frame to the next's.
RECORDED_HZ, GRASP_PERIODS = 100, 23
LATENCIES = {
    "latency_p50_micros": ("latency p50", "µs", 1),
    "latency_p90_micros": ("latency p90", "µs", 1),
    "latency_p99_micros": ("latency p99", "µs", 1),
}
# Seconds within which a graph must have started.
PATIENCE_SECS = 30
numbers = itertools.count()


def default_nodes():
    """The nodes of the default graph, the source first."""
    operators = DEFAULT.read_text().split("\noperators:\n")[1]
    return re.findall(r"^  (\w+):", operators, re.MULTILINE)


def default_with(folder, lines):
    """A file of the default graph in which nodes have more lines: texts by node."""
    text = re.sub(r"(?<= )(recordings|models|hands)/", rf"{PROJECT}/\1/", DEFAULT.read_text())
    for node, more in lines.items():
        head = f"\n  {node}:\n"
        if text.count(head) != 1:
            sys.exit(f"{DEFAULT}: expected one node '{node}'")
        text = text.replace(head, head + "".join(f"    {line}\n" for line in more))
    path = folder / "dataflow.yaml"
    path.write_text(text)
    return path


def judging_nodes(source):
    """The default graph behind this node's frames, as operators of a dataflow file."""
    return {
        "contacts": {"inputs": {"tactile": f"{source}/tactile"}, "params": {"hand": str(HAND)}},
        "encoder": {"inputs": {"contacts": "contacts/contacts"}, "params": {"model": str(MODEL)}},
        "classifier": {"inputs": {"feature": "encoder/feature"}, "params": {"model": str(MODEL)}},
        "lift_arbiter": {"inputs": {"prediction": "classifier/prediction"}, "params": {"max_age_ms": 60000}},
    }


def write_flow(path, operators, **more):
    """A dataflow file: JSON is YAML, too."""
    path.write_text(json.dumps({"version": 1, "name": "bench", **more, "operators": operators}, indent=2))
    return path


def n_grasps_of(recording):
    return json.loads(blindgrasp("info", recording, "--json"))["n_grasps"]


def played(recording, rate_hz, repeat):
    """Settings of the recorded source: frames per second within a grasp, `inf` as fast as the graph takes them."""
    rate = "max" if rate_hz == float("inf") else f"{rate_hz / RECORDED_HZ:g}"
    return [f"recording={recording}", f"rate={rate}", f"repeat={repeat}"]


def repeats(n_grasps, rate_hz, secs):
    """How often a recording fills this time."""
    return max(1, round(secs * rate_hz / (GRASP_PERIODS * n_grasps)))


class Program:
    """A program that runs. Its block ends it, unless it has ended. Its lines are read at once, and kept with their time."""

    def __init__(self, command):
        self.command = command
        self.log = tempfile.TemporaryFile("w+")
        self.lines = []
        self.begin = time.monotonic()
        self.child = subprocess.Popen(command, cwd=PROJECT, stdout=subprocess.PIPE, stderr=self.log, text=True)
        self.reader = threading.Thread(target=self.read)
        self.reader.start()

    def read(self):
        for line in self.child.stdout:
            self.lines.append((time.monotonic(), line))

    def __enter__(self):
        return self

    def __exit__(self, kind, *_):
        if self.child.returncode is None:
            os.kill(self.child.pid, signal.SIGINT)
            self.reap()

    def has_ended(self):
        return not self.reader.is_alive()

    def reap(self):
        """Waits for the end; the exit code. `cpu_secs` is then the time of all its processes."""
        self.reader.join()
        _, status, usage = os.wait4(self.child.pid, 0)
        self.child.returncode = os.waitstatus_to_exitcode(status)
        self.cpu_secs = usage.ru_utime + usage.ru_stime
        return self.child.returncode

    def wait(self):
        """Waits for the end; the summary. Loss is no failure: the figures will say it."""
        code = self.reap()
        if code not in (0, 3):
            self.fail(f"ended with exit code {code}")
        return json.loads(self.lines[-1][1])["summary"]

    def said(self):
        self.log.seek(0)
        return self.log.read()

    def fail(self, what):
        sys.exit(f"{shlex.join(map(str, self.command))} {what}:\n{self.said()}")


class Graph(Program):
    """A graph that runs."""

    def __init__(self, flow, settings=(), more=()):
        self.name = f"bench-{os.getpid()}-{next(numbers)}"
        sets = [f"--set={setting}" for setting in settings]
        super().__init__([BLINDGRASP, "run", flow, "--name", self.name, "--json", *more, *sets])

    def status(self):
        return json.loads(blindgrasp("ps", self.name, "--json"))["graphs"][0]

    def node(self, name):
        return next(node for node in self.status()["nodes"] if node["node"] == name)

    def wait_until_decided(self):
        """Until the first decision."""
        deadline = time.monotonic() + PATIENCE_SECS
        while not self.lines:
            if self.has_ended() or time.monotonic() > deadline:
                self.fail("has made no decision")
            time.sleep(0.01)

    def wait_until_running(self):
        deadline = time.monotonic() + PATIENCE_SECS
        command = [BLINDGRASP, "ps", self.name, "--json"]
        while True:
            said = subprocess.run(command, capture_output=True, text=True)
            if said.returncode == 0 and json.loads(said.stdout)["graphs"][0]["state"] == "running":
                return
            if self.has_ended() or time.monotonic() > deadline:
                self.fail("has not started")
            time.sleep(0.05)

    def stop(self):
        """Ends the graph; its summary."""
        output(BLINDGRASP, "stop", self.name)
        return self.wait()

    def decisions(self):
        """The decisions so far, each with the time of its line."""
        found = [(at, json.loads(line)) for at, line in list(self.lines)]
        return [(at, decision) for at, decision in found if "grasp_id" in decision]


def latencies(summary):
    """From the source's send to the launcher's receipt of a decision."""
    nanos = summary.get("decision_latency_nanos") or summary["latency_nanos"]
    return {f"latency_{name}_micros": nanos[name] / 1e3 for name in ("p50", "p90", "p99")}


def n_sent(summary):
    return summary["samples"] if "samples" in summary else summary["edges"][0]["sent"]
