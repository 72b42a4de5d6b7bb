"""What recording costs: the default graph without and with it, beside a bare iceoryx2 chain of five processes.

At rate max, frames per second from the first decision to the last: the bare chain, which loses nothing either (its
writers block), the graph, and the graph with `run --record`. At 1 kHz (frames per second within a grasp), the time from
source to decision and the CPU time of all processes: the graph, with `run --record`, and with `record` beside it.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from . import figures, graphs, programs, rate_max
from .options import Option

OPTIONS = {
    "rounds": Option(3, "how often each side runs", quick=1, least=1),
    "secs": Option(10.0, "how long each run at 1 kHz sends", quick=1.0, least=0.1),
    "repeats": Option(40, "how often each run at rate max plays the recording", quick=2, least=1),
    "recording": Option(programs.HELD_OUT, "what the source plays"),
}
EXAMPLES = ("bare_chain",)


def measure(options):
    n_grasps = graphs.n_grasps_of(options.recording)
    settings = graphs.played(options.recording, 1000, graphs.repeats(n_grasps, 1000, options.secs))
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.mcap"
        record = ["--record", out, "--overwrite"]

        def frames_per_sec(more):
            return {"frames_per_sec": rate_max.graph_rate(graphs.DEFAULT, options.recording, options.repeats, more)}

        at_max = figures.in_turn(
            options.rounds,
            {
                "bare chain": lambda: bare_rate(n_grasps * options.repeats),
                "graph": lambda: frames_per_sec([]),
                "run --record": lambda: frames_per_sec(record),
            },
        )
        at_1_khz = figures.in_turn(
            options.rounds,
            {
                "graph": lambda: latency(settings, [], None),
                "run --record": lambda: latency(settings, record, None),
                "record beside it": lambda: latency(settings, [], out),
            },
        )
    return {"rate max": summary(at_max, "bare chain"), "1 kHz": summary(at_1_khz, "graph")}


def summary(runs, base):
    return {"medians": figures.medians(runs), "ratios": figures.ratios(runs, base), "rounds": runs}


def bare_rate(n_grasps):
    command = [programs.EXAMPLES / "bare_chain", "--rate=max", f"--grasps={n_grasps}", "--json"]
    found = json.loads(programs.output(*command).splitlines()[-1])["summary"]
    if found["samples_lost"]:
        sys.exit(f"the bare chain lost {found['samples_lost']} samples")
    return {"frames_per_sec": found["samples_per_sec"]}


def latency(settings, more, out):
    """A run at 1 kHz; with `out` a recorder runs beside it."""
    with graphs.Graph(graphs.DEFAULT, settings, more) as running:
        running.wait_until_decided()
        recorder_secs = 0.0
        if out:
            recorder_secs = record_beside(running, out)
        found = running.wait()
    if found["samples_lost"]:
        running.fail(f"has lost samples: {found}")
    return graphs.latencies(found) | {"cpu_secs": running.cpu_secs + recorder_secs}


def record_beside(running, out):
    """Records the graph until it ends; the recorder's CPU time."""
    command = [programs.BLINDGRASP, "record", running.name, "--out", out, "--overwrite", "--json"]
    recorder = subprocess.Popen(command, cwd=programs.PROJECT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    found = json.loads(recorder.stdout.read())
    _, status, usage = os.wait4(recorder.pid, 0)
    recorder.returncode = os.waitstatus_to_exitcode(status)
    if recorder.returncode or found["missing"]:
        sys.exit(f"the recorder ended with exit code {recorder.returncode}: {found}")
    return usage.ru_utime + usage.ru_stime


def show(result):
    rows = {"frames_per_sec": ("frames a second", "", 0)}
    figures.sides_table("rate max", rows, result["rate max"]["medians"], result["rate max"]["ratios"])
    rows = graphs.LATENCIES | {"cpu_secs": ("CPU time", "s", 2)}
    figures.sides_table("1 kHz", rows, result["1 kHz"]["medians"], result["1 kHz"]["ratios"])
