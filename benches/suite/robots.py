"""The CPU time of one brain for many robots: 1, 2, 4 and so on, with a network namespace each.

A robot's part is source, contacts and arbiter; brain has a part with encoder and classifier for each robot. CPU time is
measured while all of them run. It needs root. Goals: nothing is lost, and the CPU time of a robot does not grow with
their number.
"""

import json
import signal
import sys
import tempfile
import time
from pathlib import Path

from . import figures, graphs, programs
from .network import GRACE_SECS, PORT, Network, fail, finish, on_machines, steady_source
from .options import Option

OPTIONS = {
    "secs": Option(60.0, "how long each number of robots is watched", quick=1.0, least=1),
    "robots": Option(8, "maximum number of robots, at most 200", quick=1, least=1),
    "robot_rate": Option(200.0, "frames per second of each robot", least=1),
    "recording": Option(programs.HELD_OUT, "its frames are sent"),
}
EXAMPLES = ("steady_source",)
FIGURES = {
    "samples": ("samples", "", 0),
    "lost": ("lost", "", 0),
    "brain_cpu_percent": ("brain, % of a core", "", 1),
    "brain_links_cpu_percent": ("its links", "", 1),
    "brain_per_robot_cpu_percent": ("brain, a robot", "", 1),
    "all_cpu_percent": ("all", "", 1),
    "all_per_robot_cpu_percent": ("all, a robot", "", 1),
}


def measure(options):
    if options.robots > 200:
        sys.exit("--robots must be at most 200, because each has its own address")
    counts = [1]
    while counts[-1] < options.robots:
        counts.append(min(2 * counts[-1], options.robots))
    with tempfile.TemporaryDirectory() as folder:
        return {"fleets": [fleet(Path(folder), n_robots, options) for n_robots in counts]}


def fleet(folder, n_robots, options):
    figures.progress(f"{n_robots} robots")
    command = [programs.BLINDGRASP, "run", fleet_flow(folder, options.recording), "--json"]
    with Network(n_robots + 1) as (brain, *hosts):
        brain_parts, robot_parts = [], []
        for idx, host in enumerate(hosts):
            own = ["--namespace", f"robot{idx}", "--name", f"robot{idx}"]
            endpoint = f"tcp/{brain.address}:{PORT + idx}"
            brain_parts.append(brain.start(*command, *own, "--machine", "brain", "--listen", endpoint))
            settings = [f"--set=steady_source.rate_hz={options.robot_rate:g}", f"--set=steady_source.n_samples={10**9}"]
            robot_parts.append(host.start(*command, *own, "--machine", "robot", "--connect", endpoint, *settings))
        wait_for_samples(hosts, brain_parts + robot_parts)
        begin, before = time.monotonic(), cpu_nanos(brain_parts, robot_parts)
        time.sleep(options.secs)
        secs, after = time.monotonic() - begin, cpu_nanos(brain_parts, robot_parts)
        for part in robot_parts:
            part.send_signal(signal.SIGINT)
        ended = [json.loads(finish(part, GRACE_SECS)[0])["summary"] for part in robot_parts + brain_parts]
    percent = {name: 100 * (after[name] - before[name]) / 1e9 / secs for name in after}
    everything = percent["brain"] + percent["robots"]
    return of_summaries(ended) | {
        "n_robots": n_robots,
        "brain_cpu_percent": percent["brain"],
        "brain_links_cpu_percent": percent["brain_links"],
        "brain_per_robot_cpu_percent": percent["brain"] / n_robots,
        "all_cpu_percent": everything,
        "all_per_robot_cpu_percent": everything / n_robots,
    }


def of_summaries(ended):
    edges = [edge for end in ended for edge in end["edges"]]
    channels = [channel for end in ended for peer in end["link"]["peers"] for channel in peer["channels"]]
    return {
        "samples": sum(edge["sent"] for edge in edges if edge["to"].startswith("contacts/")),
        "lost": sum(end["samples_lost"] for end in ended),
        "missing": sum(edge["missing"] for edge in edges),
        "answered": sum(edge["received"] for edge in edges if edge["to"].startswith("lift_arbiter/")),
        "resent": sum(channel["n_repeated"] for channel in channels if channel["is_sent"]),
        "blocked_millis": sum(channel["blocked_nanos"] for channel in channels) / 1e6,
    }


def fleet_flow(folder, recording):
    operators = {"steady_source": steady_source(recording), **graphs.judging_nodes("steady_source")}
    for node, machine in {"contacts": "robot", "encoder": "brain", "classifier": "brain", "lift_arbiter": "robot"}.items():
        operators[node]["on"] = machine
    return on_machines(folder / "fleet.yaml", f"tcp/127.0.0.1:{PORT}", {"insecure": True}, operators)


def wait_for_samples(hosts, parts):
    """Waits until all robots get answers."""
    deadline = time.monotonic() + 20 + GRACE_SECS
    waiting = list(hosts)
    while waiting:
        for part in parts:
            if part.poll() is not None:
                fail(part, f"ended with exit code {part.returncode}")
        if time.monotonic() > deadline:
            fail(parts[-1], "has got no answers")
        time.sleep(0.2)
        [graph] = json.loads(waiting[0].output(programs.BLINDGRASP, "ps", "--json"))["graphs"] or [{"edges": []}]
        if any(edge["to"] == "lift_arbiter/prediction" and edge["received"] > 0 for edge in graph["edges"]):
            waiting.pop(0)


def cpu_nanos(brain_parts, robot_parts):
    brain = with_descendants(brain_parts)
    links = [pid for pid in brain if Path(f"/proc/{pid}/comm").read_text().strip() == "link"]
    return {
        "brain": programs.cpu_nanos(brain),
        "brain_links": programs.cpu_nanos(links),
        "robots": programs.cpu_nanos(with_descendants(robot_parts)),
    }


def with_descendants(parts):
    return [pid for part in parts for pid in (part.pid, *programs.descendants(part.pid))]


def show(result):
    titles = ["robots", *(title for title, _, _ in FIGURES.values())]
    rows = []
    for row in result["fleets"]:
        rows.append([row["n_robots"], *(f"{row[name]:.{decimals}f}" for name, (_, _, decimals) in FIGURES.items())])
    figures.table(titles, rows)
