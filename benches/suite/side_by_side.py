"""Many default graphs side by side: what each of them loses, its latency and what it takes."""

from concurrent.futures import ThreadPoolExecutor

from . import figures, graphs, programs, runtime
from .options import Option

OPTIONS = {
    "graphs": Option(16, "how many graphs run at once", quick=2, least=1),
    "secs": Option(60.0, "how long each sends", quick=1.0, least=0.1),
    "rates": Option((100.0,), "frames per second", least=10),
    "recording": Option(programs.HELD_OUT, "what the source plays"),
}


def measure(options):
    n_grasps = graphs.n_grasps_of(options.recording)
    return {"rates": [at_rate(rate, n_grasps, options) for rate in options.rates]}


def at_rate(rate, n_grasps, options):
    repeat = graphs.repeats(n_grasps, rate, options.secs)
    secs = n_grasps * repeat * graphs.GRASP_PERIODS / rate
    settings = graphs.played(options.recording, rate, repeat)
    with ThreadPoolExecutor(options.graphs) as pool:
        started = [pool.submit(runtime.graph, graphs.DEFAULT, settings, secs) for _ in range(options.graphs)]
        runs = [one.result() for one in started]
    return {"rate": rate, "graphs": runs, "lost": sum(run["lost"] for run in runs)}


def show(result):
    for at in result["rates"]:
        sides = {f"graph {nth}": run for nth, run in enumerate(at["graphs"], 1)}
        print(f"\n{at['rate']:g} Hz, {len(sides)} graphs, samples lost in all: {at['lost']}")
        titles = ["", *(title for title, _, _ in runtime.FIGURES.values())]
        rows = [[side, *(f"{run[figure]:.1f}" for figure in runtime.FIGURES)] for side, run in sides.items()]
        figures.table(titles, rows)
