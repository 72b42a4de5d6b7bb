"""The way of a robot in ROS 2 through blindgrasp and back, and the cost of publishing to ROS 2.

The robot is a node of hiroz (benches/hiroz): it sends joint angles, phase and cells of recorded grasps, and receives
decisions, through a router of Zenoh on this machine. "loop" is the time from sending a grasp's first settled frame to
receiving its decision, which the arbiter makes at that frame (votes: 1); in "loop, group" the four stages share a
process. "bare" is the same with a node of hiroz in place of blindgrasp, which answers without a look at the frame.
"cost" is the latency of the graph from the recorded source to the launcher: alone, with a node ros2 that publishes
decisions, and with one that publishes frames and contacts as well. hiroz takes minutes to build the first time.
"""

import json
import re
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from . import figures, graphs, programs
from .options import Option

OPTIONS = {
    "secs": Option(60.0, "how long each run sends", quick=2.0, least=1),
    "rounds": Option(3, "how often each side runs", quick=1, least=1),
    "rate": Option(1000.0, "frames per second", least=1),
}
FIGURES = {
    "p50_micros": ("p50", "µs", 1),
    "p90_micros": ("p90", "µs", 1),
    "p99_micros": ("p99", "µs", 1),
    "lost": ("decisions lost", "", 0),
    "late_sends": ("frames sent late", "", 0),
    "refused": ("frames refused", "", 0),
}
COSTS = {
    "cost, alone": [],
    "cost, decisions": ["decision"],
    "cost, decisions, frames and contacts": ["decision", "tactile", "contacts"],
}
REFUSALS = ("malformed", "oversized", "cut_off", "late", "out_of_order")


def measure(options):
    peer = programs.build_peer("hiroz")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        robot = [write_frames(folder / "frames.jsonl"), str(options.rate), str(options.secs)]
        sides = {
            "bare": lambda: bare(peer, robot),
            "loop": lambda: loop(peer, robot, folder, is_group=False),
            "loop, group": lambda: loop(peer, robot, folder, is_group=True),
        }
        for side, published in COSTS.items():
            sides[side] = lambda published=published: cost(peer, published, folder, options)
        runs = figures.in_turn(options.rounds, sides)
    loops = {side: runs[side] for side in ("bare", "loop", "loop, group")}
    costs = {side: runs[side] for side in COSTS}
    ratios = figures.ratios(loops, "bare") | figures.ratios(costs, "cost, alone")
    return {"medians": figures.medians(runs), "ratios": ratios, "rounds": runs}


def write_frames(path):
    """The names of the joints, and the recorded frames."""
    lines = programs.blindgrasp("export", programs.HELD_OUT, "--format", "jsonl").splitlines()
    frames = [json.loads(line) for line in lines]
    names = re.search(r"^joints: \[(.*)\]", programs.HAND.read_text(), re.MULTILINE)[1].split(", ")
    kept = [names, *(frame["data"] for frame in frames if frame["topic"] == "/tactile")]
    path.write_text("".join(json.dumps(line) + "\n" for line in kept))
    return path


class Peer:
    """A program of hiroz that says a line when it is ready, and ends with the block."""

    def __init__(self, *command):
        self.child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        if not self.child.stdout.readline():
            sys.exit(f"{command[0]} {command[1]} has not started")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.child.terminate()
        self.child.stdout.close()
        self.child.wait()


class Router(Peer):
    def __init__(self, peer):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
        super().__init__(peer, "router", self.endpoint)


def run_robot(peer, endpoint, robot):
    found = json.loads(programs.output(peer, "robot", endpoint, *robot).splitlines()[-1])
    lost = found["grasps"] - found["decisions"]
    if lost:
        # The decisions behind it would count for other grasps.
        sys.exit(f"{lost} of {found['grasps']} decisions did not come: run it again on a quiet machine")
    return quantiles(found["micros"]) | {"lost": lost, "late_sends": found["late_sends"]}


def quantiles(micros):
    return {f"p{number}_micros": figures.quantile(micros, number / 100) for number in (50, 90, 99)}


def bare(peer, robot):
    with Router(peer) as router, Peer(peer, "echo", router.endpoint):
        return run_robot(peer, router.endpoint, robot)


def loop(peer, robot, folder, is_group):
    with Router(peer) as router:
        topics = {"cells_topic": "/cells", "phase_topic": "/phase"}
        params = {"driver": "ros2", "hand": str(programs.HAND), "connect": router.endpoint, **topics}
        more = {"sandbox": "on"} | ({"group": "gate"} if is_group else {})
        operators = {"tactile_source": {"params": params}, **graphs.judging_nodes("tactile_source", **more)}
        operators["ros2"] = publisher(router, {"decision": "lift_arbiter/decision"})
        with graphs.Graph(graphs.write_flow(folder / "loop.yaml", operators), ["lift_arbiter.votes=1"]) as running:
            wait_for_router(running)
            found = run_robot(peer, router.endpoint, robot)
            counts = running.node("tactile_source")["counts"]
    return found | {"refused": sum(counts.get(word, 0) for word in REFUSALS)}


def cost(peer, published, folder, options):
    with Router(peer) as router:
        edges = {"decision": "lift_arbiter/decision", "tactile": "recorded_source/tactile", "contacts": "contacts/contacts"}
        params = {"recording": str(programs.HELD_OUT)}
        operators = {"recorded_source": {"params": params}, **graphs.judging_nodes("recorded_source", sandbox="on")}
        if published:
            operators["ros2"] = publisher(router, {port: edges[port] for port in published})
        flow = graphs.write_flow(folder / "cost.yaml", operators)
        settings = [*graphs.played(programs.HELD_OUT, options.rate, "forever"), "lift_arbiter.votes=3"]
        with graphs.Graph(flow, settings) as running:
            wait_for_router(running)
            time.sleep(options.secs)
            running.stop()
    nanos = [decision["latency_nanos"] for _, decision in running.decisions() if "latency_nanos" in decision]
    # The first second is the start.
    return quantiles([one / 1e3 for one in nanos[50:]])


def publisher(router, edges):
    inputs = {port: {"from": edge, "policy": "latest", "capacity": 256} for port, edge in edges.items()}
    return {"inputs": inputs, "params": {"connect": router.endpoint, "namespace": "/", "hand": str(programs.HAND)}}


def wait_for_router(running):
    running.wait_until_running()
    # Its nodes of ROS 2 look for the router.
    time.sleep(2)


def show(result):
    rows = []
    for side, found in result["medians"].items():
        ratio = result["ratios"].get(side, {}).get("p50_micros")
        cells = [f"{found[name]:.{decimals}f}" if name in found else "" for name, (_, _, decimals) in FIGURES.items()]
        rows.append([side, *cells, *figures.ratio_cells(ratio)])
    titles = ["", *(f"{title} {unit}".strip() for title, unit, _ in FIGURES.values()), "p50 ratio", "least..most"]
    figures.table(titles, rows)
