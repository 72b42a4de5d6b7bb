"""The default graph and its group at rate max, beside one process that calls the stage functions in a loop.

As many such processes as there are cores are the bound.
"""

import json
import os
import tempfile
from pathlib import Path

from . import figures, graphs, programs, runtime
from .options import Option

OPTIONS = {
    "rounds": Option(3, "how often each side runs", quick=1, least=1),
    "repeats": Option(60, "how often each run plays the recording", quick=2, least=1),
    "recording": Option(programs.HELD_OUT, "what the source plays"),
}
EXAMPLES = ("stage_times",)
PAGE = {}


def measure(options):
    with tempfile.TemporaryDirectory() as folder:
        grouped = runtime.grouped_flow(Path(folder))
        runs = figures.in_turn(
            options.rounds,
            {
                "loop": lambda: {"frames_per_sec": loop_rate(options.recording)},
                "graph": lambda: {"frames_per_sec": graph_rate(graphs.DEFAULT, options.recording, options.repeats)},
                "group": lambda: {"frames_per_sec": graph_rate(grouped, options.recording, options.repeats)},
            },
        )
    medians = figures.medians(runs)
    bound = os.cpu_count() * medians["loop"]["frames_per_sec"]
    for found in medians.values():
        found["share_of_bound"] = found["frames_per_sec"] / bound
    return {"medians": medians, "rounds": runs}


def loop_rate(recording):
    stages = json.loads(programs.output(programs.EXAMPLES / "stage_times", recording, programs.MODEL, "inf"))
    return 1e9 / stages["frame_nanos"]


def graph_rate(flow, recording, repeat, more=()):
    """Frames per second of a graph, from its first decision to its last."""
    with graphs.Graph(flow, graphs.played(recording, float("inf"), repeat), more) as running:
        summary = running.wait()
    if summary["samples_lost"] or summary.get("samples_not_recorded"):
        running.fail(f"has lost samples: {summary}")
    *decided, _ = running.lines
    secs = decided[-1][0] - decided[0][0]
    return graphs.n_sent(summary) * (len(decided) - 1) / len(decided) / secs


def show(result):
    rows = {"frames_per_sec": ("frames a second", "", 0), "share_of_bound": ("of a loop on each core", "", 2)}
    figures.sides_table("rate max", rows, result["medians"])


def page(result):
    share = result["medians"]["graph"]["share_of_bound"]
    yield "a frame at rate max", "the stages in a loop on all cores", 1 / share
