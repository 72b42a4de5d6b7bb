"""The default graph beside a bare iceoryx2 chain of five processes that passes samples of the same sizes along, and beside
the same graph whose stages share a process (group).

They send the same number of samples in the same rhythm: rates are frames per second within a grasp (14 frames of a
simulated recording), after which ten frames' time passes; a second has 0.61 times as many frames. Latency is from the
source's send to the launcher's receipt of a decision. CPU time is of all processes, the launcher and the start
included; memory is the sum of the five processes' PSS in mid-run, without the launcher's. The stages' own compute time
is measured on the same recording in one process, at the same pace.
"""

import json
import tempfile
import threading
import time
from pathlib import Path

from . import figures, graphs, programs
from .options import Option

OPTIONS = {
    "secs": Option(60.0, "how long each run sends", quick=1.0, least=0.1),
    "rates": Option((1000.0, 10000.0), "frames per second", quick=(1000.0,), least=10),
    "rounds": Option(3, "how often each side runs", quick=1, least=1),
    "recording": Option(programs.HELD_OUT, "what the source plays"),
    "idle_secs": Option(10.0, "how long an idle graph is watched", quick=1.0, least=0.1),
}
EXAMPLES = ("bare_chain", "stage_times")
PAGE = {"secs": 10.0, "rates": (1000.0,)}
FIGURES = graphs.LATENCIES | {
    "cpu_secs": ("CPU time", "s", 2),
    "pss_mib": ("memory (PSS)", "MiB", 1),
    "first_decision_millis": ("launch to first decision", "ms", 0),
    "lost": ("samples lost", "", 0),
    "samples": ("samples sent", "", 0),
}


def measure(options):
    idle_percent = idle_cpu_percent(options)
    n_grasps = graphs.n_grasps_of(options.recording)
    with tempfile.TemporaryDirectory() as folder:
        grouped = grouped_flow(Path(folder))
        rates = [at_rate(rate, n_grasps, grouped, options) for rate in options.rates]
    return {"idle_cpu_percent": idle_percent, "rates": rates}


def grouped_flow(folder):
    return graphs.default_with(folder, {stage: ["group: judge"] for stage in graphs.default_nodes()[1:]})


def at_rate(rate, n_grasps, grouped, options):
    stages = programs.output(programs.EXAMPLES / "stage_times", options.recording, programs.MODEL, rate)
    repeat = graphs.repeats(n_grasps, rate, options.secs)
    # Half a grasp less: the chain rounds up to whole ones.
    secs = (n_grasps * repeat - 0.5) * graphs.GRASP_PERIODS / rate
    settings = graphs.played(options.recording, rate, repeat)
    runs = figures.in_turn(
        options.rounds,
        {
            "bare chain": lambda: bare_chain(rate, secs),
            "graph": lambda: graph(graphs.DEFAULT, settings, secs),
            "group": lambda: graph(grouped, settings, secs),
        },
    )
    compute_micros = json.loads(stages)["sum_nanos"] / 1e3
    return {
        "rate": rate,
        "medians": figures.medians(runs),
        "ratios": figures.ratios(runs, "bare chain"),
        "compute_micros": compute_micros,
        "rounds": runs,
    }


def bare_chain(rate, secs):
    command = [programs.EXAMPLES / "bare_chain", f"--rate={rate}", f"--secs={secs}", "--json"]
    with graphs.Program(command) as chain:
        summary = chain.wait()
    return graphs.latencies(summary) | {
        "cpu_secs": chain.cpu_secs,
        "pss_mib": summary["pss_mib"],
        "first_decision_millis": (chain.lines[0][0] - chain.begin) * 1e3,
        "lost": summary["samples_lost"],
        "samples": graphs.n_sent(summary),
    }


def graph(flow, settings, secs):
    with graphs.Graph(flow, settings) as running:
        running.wait_until_decided()
        pss_mib = []
        timer = threading.Timer(secs / 2, lambda: pss_mib.append(programs.pss_mib(programs.descendants(running.child.pid))))
        timer.start()
        summary = running.wait()
        timer.cancel()
        timer.join()
    return graphs.latencies(summary) | {
        "cpu_secs": running.cpu_secs,
        "pss_mib": pss_mib[0],
        "first_decision_millis": (running.lines[0][0] - running.begin) * 1e3,
        "lost": summary["samples_lost"],
        "samples": graphs.n_sent(summary),
    }


def idle_cpu_percent(options):
    """What all processes of a graph take whose source sends a frame every ten seconds."""
    settings = graphs.played(options.recording, graphs.RECORDED_HZ / 1000, 1)
    with graphs.Graph(graphs.DEFAULT, settings) as running:
        running.wait_until_running()
        # Until models and recording are read.
        time.sleep(2)
        pids = [running.child.pid, *programs.descendants(running.child.pid)]
        begin, before = time.monotonic(), programs.cpu_nanos(pids)
        time.sleep(options.idle_secs)
        return 100 * (programs.cpu_nanos(pids) - before) / 1e9 / (time.monotonic() - begin)


def show(result):
    print(f"idle graph: {result['idle_cpu_percent']:.2f} % of a core, all processes")
    for at in result["rates"]:
        figures.sides_table(f"{at['rate']:g} Hz", FIGURES, at["medians"], at["ratios"])
        print(f"the stages' own time in one process at this pace: {at['compute_micros']:.1f} µs")


def page(result):
    ratios = result["rates"][0]["ratios"]["graph"]
    peer = "five bare iceoryx2 processes"
    yield "source to decision at 1 kHz, p50", peer, ratios["latency_p50_micros"][0]
    yield "source to decision at 1 kHz, p99", peer, ratios["latency_p99_micros"][0]
    yield "processor time at 1 kHz", peer, ratios["cpu_secs"][0]
