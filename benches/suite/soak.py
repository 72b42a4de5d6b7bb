"""Kills, stops and swaps of the operators of a running graph, over and over: whether anything is lost.

The default graph runs at about 1,000 frames a second. Each act is on a random operator: kill -9, kill -9 of it and its
reader, SIGSTOP (the launcher finds it by its heartbeat and kills it), a swap, or a swap beside a stopped reader. At the
end the graph is stopped. It must have lost no sample and decided each grasp once, in order; the exit code is 1 if not.
"""

import os
import random
import signal
import subprocess
import tempfile
import time
from pathlib import Path

from . import figures, graphs, programs
from .options import Option

OPTIONS = {
    "secs": Option(3600.0, "how long it lasts", quick=5.0, least=1),
    "pause": Option(0.7, "seconds between two acts", least=0.01),
    "seed": Option(1, "of the acts"),
}
SUPERVISION = ["restart: {policy: on-failure, limit: 1000, within_s: 60, backoff_ms: 1}", "heartbeat_ms: 500"]
ACTS = ("kill", "kill two neighbours", "stop", "swap", "swap beside a stopped reader")
RATE_HZ = 1600


def measure(options):
    nodes = graphs.default_nodes()
    settings = [*graphs.played(programs.HELD_OUT, RATE_HZ, "forever"), "lift_arbiter.max_age_ms=600000"]
    with tempfile.TemporaryDirectory() as folder:
        flow = graphs.default_with(Path(folder), {node: SUPERVISION for node in nodes})
        with graphs.Graph(flow, settings) as running:
            running.wait_until_running()
            acts, sizes = disturb(running, nodes, options)
            time.sleep(3)
            summary = running.stop()
    ids = [decision["grasp_id"] for _, decision in running.decisions()]
    tenth = max(1, len(sizes) // 10)
    first, last = sizes[:tenth], sizes[-tenth:]
    return {
        "acts": acts,
        "restarts": summary["restarts"],
        "samples": graphs.n_sent(summary),
        "samples_lost": summary["samples_lost"],
        "decisions": len(ids),
        "decided_once_in_order": ids == list(range(len(ids))),
        "exit_code": running.child.returncode,
        "launcher_mib": [round(max(mib for mib, _ in part), 1) for part in (first, last)],
        "launcher_descriptors": [max(descriptors for _, descriptors in part) for part in (first, last)],
    }


def disturb(running, nodes, options):
    """Acts until the time is over; how often each act was done, and the launcher's sizes before each."""
    chance = random.Random(options.seed)
    acts, sizes = dict.fromkeys(ACTS, 0), []
    begin = last_report = time.monotonic()
    while time.monotonic() - begin < options.secs:
        time.sleep(options.pause * chance.uniform(0.5, 1.5))
        if running.has_ended():
            break
        sizes.append(size_of(running.child.pid))
        act(running, nodes, chance, acts)
        if time.monotonic() - last_report > 60:
            last_report = time.monotonic()
            figures.progress(f"{last_report - begin:.0f} s: {sum(acts.values())} acts")
    return acts, sizes


def act(running, nodes, chance, acts):
    pids = {node["node"]: node["pid"] for node in running.status()["nodes"] if node["state"] == "running"}
    at, what = chance.randrange(len(nodes)), chance.choice(ACTS)
    node = nodes[at]
    reader = pids.get(nodes[at + 1]) if at + 1 < len(nodes) else None
    needs_reader = what in ("kill two neighbours", "swap beside a stopped reader")
    if node not in pids or (needs_reader and reader is None):
        return
    acts[what] += 1
    try:
        if what == "stop":
            os.kill(pids[node], signal.SIGSTOP)
        elif what.startswith("kill"):
            os.kill(pids[node], signal.SIGKILL)
            if needs_reader:
                os.kill(reader, signal.SIGKILL)
        else:
            swap(running, node, reader if needs_reader else None, chance)
    except ProcessLookupError:
        pass


def swap(running, node, stopped, chance):
    if stopped:
        os.kill(stopped, signal.SIGSTOP)
    command = [programs.BLINDGRASP, "swap", node, "--probation", "0", "--graph", running.name]
    swapping = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    if stopped:
        # Shorter than a heartbeat may take.
        time.sleep(chance.uniform(0.1, 0.4))
        os.kill(stopped, signal.SIGCONT)
    swapping.wait()


def size_of(pid):
    """Resident memory in MiB and the number of open descriptors."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20, len(os.listdir(f"/proc/{pid}/fd"))


def verdict(result):
    if result["samples_lost"] or result["exit_code"] or not result["decided_once_in_order"]:
        return "samples or decisions were lost or out of order"
    return None


def show(result):
    figures.table(["", ""], list(result.items()))
