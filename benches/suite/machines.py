"""One edge between two machines, beside bare Zenoh on the same network, without TLS and with it.

The robot sends one of a recording's tactile frames over and over (steady_source), and brain's contacts reads it. Bare
Zenoh (network/benches/programs/zenoh_latency.rs) is a put and a callback, with the size of this frame in bincode, at the same times and
with the same keys. The latency of the graph is the time from the source's send to its receipt by contacts, with two hops
of iceoryx2 and the link's correction of clocks, to within 6.25 %. CPU time is that of all processes on both sides, their
start included. It needs root: the machines are network namespaces.

Goals: the graph's p50 is at most 2 times that of bare Zenoh, and with TLS at most 1.3 times its own without TLS; nothing
is lost; a frame has at most 1.1 times the bytes of its sample.
"""

import json
import os
import tempfile
from pathlib import Path

from . import figures, graphs, programs
from .network import GRACE_SECS, PORT, Network, fail, finish, on_machines, steady_source
from .options import Option

OPTIONS = {
    "secs": Option(60.0, "how long each run sends", quick=1.0, least=1),
    "rounds": Option(3, "how often each side runs", quick=1, least=1),
    "rates": Option((1000.0, 10000.0), "frames per second", quick=(1000.0,), least=1),
    "recording": Option(programs.HELD_OUT, "its frames are sent"),
}
EXAMPLES = ("steady_source", "zenoh_latency", "wire_bytes")
FIGURES = graphs.LATENCIES | {
    "cpu_secs": ("CPU time", "s", 2),
    "wire_bytes_per_sample": ("bytes on the wire, a sample", "", 0),
    "sent": ("sent", "", 0),
    "received": ("received", "", 0),
    "missing": ("missing", "", 0),
    "lost": ("samples lost", "", 0),
    "resent": ("sent again", "", 0),
    "rejected": ("frames dropped unread", "", 0),
    "blocked_millis": ("source kept waiting", "ms", 1),
    "frame_bytes_per_sample": ("all frames' bytes, a sample", "", 1),
    "clock_error_micros": ("error of the clock offset", "µs", 1),
}


def measure(options):
    sample_bytes, frame_bytes, _ = map(int, programs.output(programs.EXAMPLES / "wire_bytes", options.recording).split())
    with tempfile.TemporaryDirectory() as folder, Network(2) as hosts:
        edge = SplitEdge(Path(folder), hosts, sample_bytes, options)
        rates = [at_rate(edge, rate, options) for rate in options.rates]
    return {"sample_bytes": sample_bytes, "frame_bytes": frame_bytes, "rates": rates}


def at_rate(edge, rate, options):
    n_samples = round(rate * options.secs)
    sides = {
        "bare Zenoh": lambda: edge.bare(rate, n_samples, is_tls=False),
        "graph": lambda: edge.graph(rate, n_samples, is_tls=False),
        "bare, TLS": lambda: edge.bare(rate, n_samples, is_tls=True),
        "graph, TLS": lambda: edge.graph(rate, n_samples, is_tls=True),
    }
    runs = figures.in_turn(options.rounds, sides)
    medians = figures.medians(runs)
    p50 = {side: found["latency_p50_micros"] for side, found in medians.items()}
    ratios = {
        "graph to bare Zenoh": p50["graph"] / p50["bare Zenoh"],
        "graph to bare Zenoh, both with TLS": p50["graph, TLS"] / p50["bare, TLS"],
        "graph with TLS to without": p50["graph, TLS"] / p50["graph"],
    }
    lost = sum(one["lost"] + one["missing"] for side in ("graph", "graph, TLS") for one in runs[side])
    return {"rate": rate, "medians": medians, "p50_ratios": ratios, "lost": lost, "rounds": runs}


class SplitEdge:
    """An edge from the robot to brain: of a graph, and of bare Zenoh."""

    def __init__(self, folder, hosts, sample_bytes, options):
        self.robot, self.brain = hosts
        self.sample_bytes = sample_bytes
        self.keys = folder / "keys"
        programs.blindgrasp("keys", self.keys, "--machine", "robot", "--machine", "brain")
        contacts = {"on": "brain", "inputs": {"tactile": "steady_source/tactile"}, "params": {"hand": str(programs.HAND)}}
        operators = {"steady_source": steady_source(options.recording), "contacts": contacts}
        self.flows = {}
        for is_tls, link in (False, {"insecure": True}), (True, {"keys": "keys"}):
            path = folder / f"edge-{is_tls}.yaml"
            self.flows[is_tls] = on_machines(path, self.endpoint(is_tls), link, operators)

    def endpoint(self, is_tls):
        return f"{'tls' if is_tls else 'tcp'}/{self.brain.address}:{PORT}"

    def graph(self, rate, n_samples, is_tls):
        command = [programs.BLINDGRASP, "run", self.flows[is_tls], "--name", "edge", "--json", "--machine"]
        before = self.robot.bytes_sent()
        receiver = self.brain.start(*command, "brain")
        settings = [f"--set=steady_source.rate_hz={rate:g}", f"--set=steady_source.n_samples={n_samples}"]
        sender = self.robot.start(*command, "robot", *settings)
        limit_secs = n_samples / rate + GRACE_SECS
        (sent, sender_secs), (received, receiver_secs) = finish(sender, limit_secs), finish(receiver, limit_secs)
        wire_bytes = self.robot.bytes_sent() - before
        figures_of_ends = of_ends(json.loads(sent)["summary"], json.loads(received)["summary"], n_samples)
        cpu_secs = sender_secs + receiver_secs
        return figures_of_ends | {"cpu_secs": cpu_secs, "wire_bytes_per_sample": wire_bytes / n_samples}

    def bare(self, rate, n_samples, is_tls):
        program = programs.EXAMPLES / "zenoh_latency"
        before = self.robot.bytes_sent()
        receiver = self.brain.start(program, "receive", self.zenoh_config("listen", "brain", is_tls), n_samples)
        if receiver.stdout.readline().strip() != "listening":
            receiver.wait()
            fail(receiver, f"ended with exit code {receiver.returncode}")
        config = self.zenoh_config("connect", "robot", is_tls)
        sender = self.robot.start(program, "send", config, n_samples, f"{rate:g}", self.sample_bytes)
        received, receiver_secs = finish(receiver, n_samples / rate + GRACE_SECS)
        _, status, usage = os.wait4(sender.pid, 0)
        sender.returncode = os.waitstatus_to_exitcode(status)
        if sender.returncode:
            fail(sender, f"ended with exit code {sender.returncode}")
        *latencies, n_received = map(int, received.split())
        found = {figure: nanos / 1e3 for figure, nanos in zip(graphs.LATENCIES, latencies)}
        return found | {
            "cpu_secs": usage.ru_utime + usage.ru_stime + receiver_secs,
            "wire_bytes_per_sample": (self.robot.bytes_sent() - before) / n_samples,
            "sent": n_samples,
            "received": n_received,
        }

    def zenoh_config(self, end, machine, is_tls):
        config = {
            "mode": "peer",
            end: {"endpoints": [self.endpoint(is_tls)]},
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
            "timestamping": {"enabled": False},
        }
        if end == "connect":
            config["listen"] = {"endpoints": []}
        if is_tls:
            keys = self.keys
            own = {"certificate": str(keys / f"{machine}.pem"), "private_key": str(keys / f"{machine}.key.pem")}
            tls = {f"{which}_{name}": path for which in ("listen", "connect") for name, path in own.items()}
            tls |= {"root_ca_certificate": str(keys / "ca.pem"), "enable_mtls": True, "verify_name_on_connect": False}
            config["transport"] = {"link": {"tls": tls}}
        return json.dumps(config)


def of_ends(sent, received, n_samples):
    """The figures of the summaries of robot and brain."""
    [out], [into] = sent["edges"], received["edges"]
    [peer], [seen] = sent["link"]["peers"], received["link"]["peers"]
    [channel] = peer["channels"]
    shares = {"p50": 0.5, "p90": 0.9, "p99": 0.99}
    ages = {f"latency_{name}_micros": figures.quantile_of_ages(into["ages"], share) / 1e3 for name, share in shares.items()}
    return ages | {
        "frame_bytes_per_sample": peer["bytes_sent"] / n_samples,
        "sent": out["sent"],
        "received": into["received"],
        "missing": into["missing"] + out["sent"] - into["received"],
        "lost": sent["samples_lost"] + received["samples_lost"],
        "resent": channel["n_repeated"],
        "rejected": sum(sum(end["link"]["rejected"].values()) for end in (sent, received)),
        "blocked_millis": (out["blocked_nanos"] + channel["blocked_nanos"]) / 1e6,
        # There is only one clock, so that the offset is the error of the correction and of the latencies.
        "clock_error_micros": abs(seen["offset_nanos"] or 0) / 1e3,
    }


def show(result):
    ratio = result["frame_bytes"] / result["sample_bytes"]
    print(f"a frame: {result['sample_bytes']} bytes in bincode, {result['frame_bytes']} in the link's frame: {ratio:.3f} ×")
    for at in result["rates"]:
        figures.sides_table(f"{at['rate']:g} Hz", FIGURES, at["medians"])
        for what, ratio in at["p50_ratios"].items():
            print(f"p50, {what}: {ratio:.2f}")
        print(f"lost or missing in all rounds: {at['lost']}")
