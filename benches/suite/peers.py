"""The default graph and its group beside Copper and dora: other runtimes for robots in Rust, by their own programs.

"copper" is one process of Copper (benches/copper) with five tasks, which call the stages' functions in turn; its log and
a monitor are on. Its time begins when its source has the frame and ends when its arbiter has decided, all in one thread;
those of graph and group are taken from process to process. "dora" is a chain of six nodes (benches/dora) that passes
samples of the same sizes along and computes nothing, with dora's default policy for full queues (of 1,000 samples), and
"dora, reliable" with its policy `backpressure`. dora's nodes look for each other by multicast on the machine's networks. At
rate max, graph and group are recorded, as Copper logs all that its tasks send. The first build of dora takes some ten
minutes, that of Copper three.
"""

import json
import tempfile
from pathlib import Path

from . import figures, graphs, programs, rate_max, runtime
from .options import Option

OPTIONS = {
    "secs": Option(10.0, "how long each run sends", quick=1.0, least=1),
    "rates": Option((1000.0, 10000.0), "frames per second", quick=(1000.0,), least=10),
    "rounds": Option(3, "how often each side runs", quick=1, least=1),
    "repeats": Option(60, "how often a run at rate max plays the recording", quick=2, least=1),
}
EXAMPLES = ("bare_chain",)
FIGURES = graphs.LATENCIES | {"cpu_secs": ("CPU time", "s", 2), "lost": ("samples lost", "", 0)}


def measure(options):
    peers = {name: programs.build_peer(name) for name in ("copper", "dora")}
    n_grasps = graphs.n_grasps_of(programs.HELD_OUT)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        grouped = runtime.grouped_flow(folder)
        rates = [at_rate(rate, n_grasps, grouped, peers, options) for rate in options.rates]
        runs = figures.in_turn(
            options.rounds,
            {
                "copper": lambda: {"frames_per_sec": copper_rate(peers["copper"])},
                "graph, recorded": lambda: recorded_rate(graphs.DEFAULT, folder, options),
                "group, recorded": lambda: recorded_rate(grouped, folder, options),
            },
        )
    return {"rates": rates, "rate_max": figures.medians(runs), "rate_max_rounds": runs}


def at_rate(rate, n_grasps, grouped, peers, options):
    repeat = graphs.repeats(n_grasps, rate, options.secs)
    secs = (n_grasps * repeat - 0.5) * graphs.GRASP_PERIODS / rate
    settings = graphs.played(programs.HELD_OUT, rate, repeat)
    runs = figures.in_turn(
        options.rounds,
        {
            "bare chain": lambda: runtime.bare_chain(rate, secs),
            "graph": lambda: runtime.graph(graphs.DEFAULT, settings, secs),
            "group": lambda: runtime.graph(grouped, settings, secs),
            "copper": lambda: peer(peers["copper"], programs.HELD_OUT, programs.MODEL, rate, secs),
            "dora": lambda: peer(peers["dora"], rate, secs, "drop_oldest"),
            "dora, reliable": lambda: peer(peers["dora"], rate, secs, "backpressure"),
        },
    )
    return {"rate": rate, "medians": figures.medians(runs), "ratios": figures.ratios(runs, "bare chain"), "rounds": runs}


def peer(*command):
    """What another runtime's program has measured."""
    with graphs.Program([str(word) for word in command]) as program:
        if program.reap() != 0:
            program.fail("has failed")
        found = json.loads(program.lines[-1][1])
    if found.get("relayed_outputs") and command[-1] == "drop_oldest":
        program.fail("has relayed samples that it sends directly on a quiet machine: run it again")
    return graphs.latencies(found) | {"cpu_secs": program.cpu_secs, "lost": found.get("lost", 0)}


def copper_rate(program):
    # Its log takes some 100 MB a second.
    return 1e9 / json.loads(programs.output(program, programs.HELD_OUT, programs.MODEL, "inf", "3"))["frame_nanos"]


def recorded_rate(flow, folder, options):
    recording = folder / "recorded.mcap"
    frames_per_sec = rate_max.graph_rate(flow, programs.HELD_OUT, options.repeats, ["--record", recording, "--overwrite"])
    return {"frames_per_sec": frames_per_sec}


def show(result):
    for at in result["rates"]:
        figures.sides_table(f"{at['rate']:g} Hz", FIGURES, at["medians"], at["ratios"])
    figures.sides_table("rate max", {"frames_per_sec": ("frames a second", "", 0)}, result["rate_max"])
