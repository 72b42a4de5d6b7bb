"""The default graph at 1,000 frames a second: alone, and while its page is served.

"server" is `blindgrasp view` without a browser, "20 readers" are curl processes that read its events, "1000 connections"
are opened and ask for events, and "browser" is headless Chromium that renders in software on the same machine
(tests/browser.py). Of the browser: the time from the request of the page to its first frame, and from a decision's line
on the launcher's stdout to its picture. Without chromedriver the browser is left out.
"""

import contextlib
import json
import resource
import shutil
import socket
import subprocess
import time

from . import figures, graphs, programs
from .options import Option

OPTIONS = {
    "secs": Option(8.0, "how long each run is measured", quick=1.0, least=0.1),
    "rounds": Option(6, "how often each side runs", quick=1, least=1),
}
N_READERS, N_CONNECTIONS = 20, 1000
FIGURES = {
    "p50_micros": ("latency p50", "µs", 1),
    "p99_micros": ("latency p99", "µs", 1),
    "server_cpu_percent": ("server", "% of a core", 1),
    "frames_per_sec": ("frames drawn a second", "", 1),
    "first_frame_millis": ("first frame", "ms", 0),
    "decision_to_screen_millis": ("decision to screen", "ms", 0),
}


def measure(options):
    # A descriptor for each connection.
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, most), most))
    python = programs.test_python()
    watchers = {
        "alone": None,
        "server": no_reader,
        f"{N_READERS} readers": readers,
        f"{N_CONNECTIONS} connections": connections,
    }
    if shutil.which("chromedriver"):
        watchers["browser"] = lambda address: Browser(python, address)
    else:
        figures.progress("no chromedriver: the browser is left out")
    sides = {name: lambda watcher=watcher: measured(watcher, options.secs) for name, watcher in watchers.items()}
    runs = figures.in_turn(options.rounds, sides)
    return {"medians": figures.medians(runs), "ratios": figures.ratios(runs, "alone"), "rounds": runs}


def measured(watcher, secs):
    with contextlib.ExitStack() as ended_in_turn:
        running = ended_in_turn.enter_context(graphs.Graph(graphs.DEFAULT, graphs.played(programs.HELD_OUT, 1000, "forever")))
        running.wait_until_decided()
        server, browser = None, None
        if watcher:
            server = ended_in_turn.enter_context(Server(running.name))
            found = ended_in_turn.enter_context(watcher(server.address))
            browser = found if isinstance(found, Browser) else None
        time.sleep(1)
        n_before = len(running.lines)
        cpu_before = programs.cpu_nanos([server.child.pid]) if server else 0
        frames_before = browser.asked("frames") if browser else 0
        time.sleep(secs)
        result = latency(running, n_before)
        if server:
            result["server_cpu_percent"] = 100 * (programs.cpu_nanos([server.child.pid]) - cpu_before) / 1e9 / secs
        if browser:
            result["frames_per_sec"] = (browser.asked("frames") - frames_before) / secs
            result |= of_browser(running, browser)
    return result


def latency(running, n_before):
    lines = [json.loads(line) for _, line in running.lines[n_before:]]
    micros = [line["latency_nanos"] / 1e3 for line in lines if line.get("latency_nanos")]
    return {"p50_micros": figures.quantile(micros, 0.5), "p99_micros": figures.quantile(micros, 0.99)}


def of_browser(running, browser):
    # The browser counts milliseconds since 1970.
    offset_secs = time.time() - time.monotonic()
    at = {decision["grasp_id"]: 1e3 * (secs + offset_secs) for secs, decision in running.decisions()}
    painted = [(int(grasp), millis) for grasp, millis in browser.asked("painted")]
    millis = [millis - at[grasp] for grasp, millis in painted if grasp in at]
    return {
        "first_frame_millis": browser.asked("firstFrameMs"),
        "decision_to_screen_millis": figures.quantile(millis, 0.5),
    }


class Server:
    """`blindgrasp view` of a graph."""

    def __init__(self, name):
        command = [programs.BLINDGRASP, "view", name]
        self.child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        self.address = self.child.stdout.readline().strip()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.child.terminate()
        self.child.wait()


class Browser:
    """Chromium with the page."""

    def __init__(self, python, address):
        command = [python, programs.PROJECT / "tests" / "browser.py", address]
        self.child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.child.stdout.readline()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.child.stdin.close()
        self.child.wait()

    def asked(self, what):
        """What the page says of itself."""
        self.child.stdin.write(f"blindgrasp.{what}\n")
        self.child.stdin.flush()
        return json.loads(self.child.stdout.readline())


def no_reader(_):
    return contextlib.nullcontext()


@contextlib.contextmanager
def readers(address):
    command = ["curl", "-sN", f"{address}/events"]
    children = [subprocess.Popen(command, stdout=subprocess.DEVNULL) for _ in range(N_READERS)]
    yield
    for child in children:
        child.terminate()
        child.wait()


@contextlib.contextmanager
def connections(address):
    port = int(address.rstrip("/").rsplit(":", 1)[1])
    sockets = []
    for _ in range(N_CONNECTIONS):
        sockets.append(socket.create_connection(("127.0.0.1", port)))
        sockets[-1].sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
    yield
    for connection in sockets:
        connection.close()


def show(result):
    figures.sides_table("", FIGURES, result["medians"], result["ratios"])
