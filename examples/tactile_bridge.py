#!/usr/bin/env python3
"""Feeds a running graph's tactile_source with frames: a bridge to copy and to put your hand's driver into.

    blindgrasp run dataflow-live.yaml
    blindgrasp export recordings/held-out.mcap --topic /tactile | ./tactile_bridge.py [--rate 1]

This one has no hand: it takes frames from the recording on its stdin, at --rate times the recorded speed. In yours,
`frames` asks the hand. Standard library only.
"""

import argparse
import glob
import json
import os
import socket
import stat
import sys
import threading
import time

# The folders of tactile_source's socket, in the program's order.
SOCKET_FOLDERS = ("/run/bgrasp", f"/tmp/blindgrasp-{os.getuid()}", f"/dev/shm/blindgrasp-{os.getuid()}.*")


def frames(rate):
    """Yields what a hand would: joint angles, forces, phase and grasp, each at its time."""
    begin = first = None
    for line in sys.stdin:
        record = json.loads(line)
        seconds = record["stamp_nanos"] / 1e9 / rate
        begin, first = (time.monotonic(), seconds) if begin is None else (begin, first)
        time.sleep(max(0.0, begin + seconds - first - time.monotonic()))
        yield record["data"]


def own_sockets(graph):
    """The addresses at which the sources of such a graph, or of all (*), may listen without a param: in those of the folders that
    are this user's alone."""
    for folder in (path for pattern in SOCKET_FOLDERS for path in sorted(glob.glob(pattern))):
        try:
            found = os.lstat(folder)
        except OSError:
            continue
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077:
            yield from (f"unix:{path}" for path in sorted(glob.glob(f"{folder}/{graph}.hand")))


def connect_to(address):
    if address.startswith("unix:"):
        connection = socket.socket(socket.AF_UNIX)
        connection.connect(address.removeprefix("unix:"))
        return connection
    host, _, port = address.rpartition(":")
    connection = socket.create_connection((host, int(port)))
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def connect(address):
    """Connects, as often as it takes, to an address or a graph; without one, to the only graph of this user that takes frames."""
    told = None
    while True:
        why = f"no graph {address or ''} takes frames (NAME.hand in {', '.join(SOCKET_FOLDERS)})"
        connections = {}
        for found in [address] if address and ":" in address else own_sockets(address or "*"):
            try:
                connections[found] = connect_to(found)
            except OSError as error:
                why = f"{found}: {error}"
        if len(connections) > 1:
            sys.exit(f"{len(connections)} graphs take frames, at {', '.join(connections)}: name one with --graph NAME")
        for connection in connections.values():
            return connection
        if why != told:
            print(f"{why}; trying again", file=sys.stderr)
        told = why
        time.sleep(1)


def main():
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--address", help="unix:PATH or HOST:PORT; without it, that of the only graph")
    options.add_argument("-g", "--graph", dest="address", metavar="NAME", help="of this machine, which gets the frames")
    options.add_argument("--rate", type=float, default=1.0, help="times the recorded speed")
    arguments = options.parse_args()

    connection = connect(arguments.address)
    answers = connection.makefile()
    # The first line says which hand the source expects, and where the bridge before left off.
    hand = json.loads(answers.readline() or '{"refused": "gone", "why": "the source has gone; start the bridge again"}')
    if "refused" in hand:
        sys.exit(hand["why"])
    print(f"connected: {hand['hand']}, {hand['n_joints']} joints, {hand['n_cells']} cells", file=sys.stderr)
    next_grasp_id = 0 if hand["last_grasp_id"] is None else hand["last_grasp_id"] + 1
    # Every further line says what was wrong with a frame.
    threading.Thread(target=lambda: [print(line, end="", file=sys.stderr) for line in answers], daemon=True).start()

    n_frames = 0
    for data in frames(arguments.rate):
        frame = {
            # Joints, cells, and the senses that the hand has; the others are left out.
            **{name: values for name, values in data.items() if isinstance(values, list) and values},
            "phase": data["phase"],
            "grasp_id": next_grasp_id + data["grasp_id"],
            "seq": n_frames,
            "stamp_nanos": time.clock_gettime_ns(time.CLOCK_BOOTTIME),
        }
        connection.sendall(json.dumps(frame).encode() + b"\n")
        n_frames += 1
    connection.shutdown(socket.SHUT_WR)
    time.sleep(0.2)
    print(f"sent {n_frames} frames", file=sys.stderr)


if __name__ == "__main__":
    try:
        main()
    except (BrokenPipeError, ConnectionResetError):
        sys.exit("the source has gone; start the bridge again")
    except KeyboardInterrupt:
        pass
