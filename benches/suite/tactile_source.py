"""Frames that a bridge sends to a tactile_source over TCP at a fixed rate: how many are lost and how long they take.

This process is the bridge: it stamps each frame with CLOCK_MONOTONIC right before its write to a loopback socket. A
reader of /tactile (benches/programs/tactile_latency.rs) takes the same clock when it has the frame. What is measured is all
between: the write, the kernel, the source's reading, parsing, checking and publishing, the reader's wake-up. "From the
source" counts from the source's publishing only.
"""

import json
import re
import socket
import tempfile
import time
from pathlib import Path

from . import graphs, programs
from .options import Option

OPTIONS = {
    "rate": Option(1000.0, "frames per second", least=1),
    "secs": Option(60.0, "how long it sends", quick=2.0, least=0.1),
}
EXAMPLES = ("tactile_latency",)


def measure(options):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = free.getsockname()
    operators = {
        "tactile_source": {"params": {"hand": str(programs.HAND), "address": f"127.0.0.1:{address[1]}"}},
        "reader": {"run": str(programs.EXAMPLES / "tactile_latency"), "inputs": {"tactile": "tactile_source/tactile"}},
    }
    with tempfile.TemporaryDirectory() as folder:
        flow = graphs.write_flow(Path(folder) / "bench.yaml", operators)
        with graphs.Graph(flow) as running:
            running.wait_until_running()
            connection = connect(address, running)
            expected = json.loads(connection.makefile().readline())
            n_frames, behind_secs = send(connection, expected, options)
            time.sleep(1)
            counts = running.node("tactile_source")["counts"]
            running.stop()
        said = running.said()
    found = re.search(r"latency (\{.*\})", said)
    if not found:
        running.fail("has a reader that said nothing")
    report = json.loads(found[1])
    sent = {"sent": n_frames, "lost": n_frames - report["frames"], "sent_late_millis_max": behind_secs * 1e3}
    return sent | {"counts": counts} | report


def connect(address, running):
    for _ in range(200):
        try:
            return socket.create_connection(address)
        except OSError:
            if running.has_ended():
                running.fail("ended")
            time.sleep(0.1)
    running.fail("does not listen")


def send(connection, expected, options):
    """Sends at the rate; returns how many frames, and how far behind its time the worst was."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    forces = [round(0.01 * cell, 3) for cell in range(expected["n_cells"])]
    body = {"joints": [0.5] * expected["n_joints"], "cells_newtons": forces, "phase": "open"}
    rest = json.dumps(body)[1:]
    n_frames, behind_secs = int(options.rate * options.secs), 0.0
    begin = time.monotonic()
    for seq in range(n_frames):
        left = begin + seq / options.rate - time.monotonic()
        if left > 0:
            time.sleep(left)
        else:
            behind_secs = max(behind_secs, -left)
        connection.sendall(f'{{"seq":{seq},"stamp_nanos":{time.monotonic_ns()},{rest}\n'.encode())
    return n_frames, behind_secs


def show(result):
    print(f"sent {result['sent']} frames, lost {result['lost']}, the latest {result['sent_late_millis_max']:.1f} ms late")
    for title, key in (("from write to arrival", "from_bridge_nanos"), ("from the source", "from_source_nanos")):
        print(f"{title}: " + ", ".join(f"{name} {nanos / 1e3:.0f} µs" for name, nanos in result[key].items()))
    print("the source's counts: " + ", ".join(f"{name} {count}" for name, count in result["counts"].items()))
