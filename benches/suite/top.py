"""What `blindgrasp top` costs: processor time of its own and of the launcher, and the graph's latency with it and without.

The default graph runs at about 1,000 frames a second. It is watched by nobody and by a `top` on a terminal of 120x40, in
turn. Latency is from the source's send to the launcher's receipt of a decision, as the graph itself counts it.
"""

import fcntl
import os
import pty
import struct
import sys
import termios
import threading
import time

from . import figures, graphs, programs
from .options import Option

OPTIONS = {
    "secs": Option(20.0, "how long each side runs", quick=1.0, least=0.1),
    "rounds": Option(3, "how often each side runs", quick=1, least=1),
    "interval": Option(1.0, "seconds between two polls of top", least=0.1),
}
ROWS, COLUMNS = 40, 120
RATE_HZ = 1600
FIGURES = {
    "frames_hz": ("frames a second", "", 0),
    "latency_p50_micros": ("latency p50", "µs", 1),
    "latency_p99_micros": ("latency p99", "µs", 1),
    "launcher_cpu_percent": ("launcher", "% of a core", 2),
    "top_cpu_percent": ("top", "% of a core", 2),
}


def measure(options):
    with graphs.Graph(graphs.DEFAULT, graphs.played(programs.HELD_OUT, RATE_HZ, "forever")) as running:
        running.wait_until_decided()
        runs = figures.in_turn(
            options.rounds,
            {"alone": lambda: watch(running, None, options.secs), "watched": lambda: watched(running, options)},
        )
    return {"medians": figures.medians(runs), "ratios": figures.ratios(runs, "alone"), "rounds": runs}


def watched(running, options):
    top = Top(running.name, options.interval)
    try:
        return watch(running, top.pid, options.secs)
    finally:
        top.quit()


def watch(running, top_pid, secs):
    # Past the start of `top`.
    time.sleep(2)
    pids = {"launcher": running.child.pid} | ({"top": top_pid} if top_pid else {})
    before = running.status()
    cpu_before = {name: programs.cpu_nanos([pid]) for name, pid in pids.items()}
    begin = time.monotonic()
    time.sleep(secs)
    cpu_after = {name: programs.cpu_nanos([pid]) for name, pid in pids.items()}
    elapsed_secs = time.monotonic() - begin
    after = running.status()
    ages = ages_since(after, before)
    n_frames = after["edges"][0]["received"] - before["edges"][0]["received"]
    found = {
        "frames_hz": n_frames / (after["uptime_secs"] - before["uptime_secs"]),
        "latency_p50_micros": figures.quantile_of_ages(ages, 0.5) / 1e3,
        "latency_p99_micros": figures.quantile_of_ages(ages, 0.99) / 1e3,
    }
    for name in pids:
        found[f"{name}_cpu_percent"] = 100 * (cpu_after[name] - cpu_before[name]) / 1e9 / elapsed_secs
    return found


class Top:
    """`top` on a terminal that somebody reads."""

    def __init__(self, name, interval):
        self.pid, self.terminal = pty.fork()
        if self.pid == 0:
            fcntl.ioctl(0, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
            os.environ["TERM"] = "xterm-256color"
            os.execv(programs.BLINDGRASP, ["blindgrasp", "top", name, "--interval", str(interval)])
        threading.Thread(target=self.read, daemon=True).start()

    def read(self):
        try:
            while os.read(self.terminal, 1 << 16):
                pass
        except OSError:
            pass

    def quit(self):
        os.write(self.terminal, b"\x03")
        _, status = os.waitpid(self.pid, 0)
        if status != 0:
            sys.exit(f"top ended with exit code {os.waitstatus_to_exitcode(status)}")


def decision_ages(status):
    """The histogram of the ages of the decisions that the launcher has read."""
    edges = status["edges"]
    return next(edge for edge in edges if edge["from"] == "lift_arbiter/decision" and edge["to"] == "run")["ages"]


def ages_since(now, before):
    counts = dict(map(tuple, decision_ages(before)))
    return [(upper, count - counts.get(upper, 0)) for upper, count in decision_ages(now)]


def show(result):
    figures.sides_table("", FIGURES, result["medians"], result["ratios"])
