"""The parts that the bridges of this folder share: the connection to a running tactile_source, and the phase of a grasp."""

import argparse
import glob
import json
import os
import signal
import socket
import stat
import sys
import threading
import time

# The folders of tactile_source's socket, in the program's order (crates/operator/src/control_socket.rs).
SOCKET_FOLDERS = ("/run/bgrasp", f"/tmp/blindgrasp-{os.getuid()}", f"/dev/shm/blindgrasp-{os.getuid()}.*")


def options(description):
    """The options that all bridges have."""
    found = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    found.add_argument("--address", help="of tactile_source, unix:PATH or HOST:PORT; without it, that of the only graph")
    found.add_argument("-g", "--graph", dest="address", metavar="NAME", help="of this machine, whose tactile_source gets the frames")
    found.add_argument("--hand", help="name or identity (hand_id) of the hand whose frames these are; a graph for another one gets none")
    return found


def now_nanos():
    """The clock of the frames' stamps."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


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


class Source:
    """A connection to tactile_source. `hand` is its first line: the hand that it expects. If the source goes, a thread connects
    again, and frames are lost meanwhile: readings that waited for the next source would look fresh to it."""

    def __init__(self, address, n_joints=None, n_cells=None, hand=None):
        self.address = address
        # A left and a right hand have as many joints and cells.
        self.own_hand = hand
        self.connection, self.hand = self.open()
        # Why the bridge must end.
        self.fault = None
        found = self.hand["n_joints"], self.hand["n_cells"]
        if n_cells is not None and found != (n_joints, n_cells):
            sys.exit(
                f"the graph is for the hand {self.hand['hand']} with {found[0]} joints and {found[1]} cells, this bridge for one with "
                f"{n_joints} and {n_cells}: give the graph --set hand=HAND.yaml"
            )

    def open(self):
        """Connects, as often as it takes; returns the connection and the source's first line."""
        while True:
            connection = connect(self.address)
            answers = connection.makefile()
            try:
                hand = json.loads(answers.readline() or "null")
            except (OSError, ValueError):
                hand = None
            if hand is not None:
                break
            print("the source has closed before its first line; trying again", file=sys.stderr)
            time.sleep(1)
        if "refused" in hand:
            sys.exit(hand["why"])
        # If the source goes, the bridge waits for this one: another may be that of another hand.
        if connection.family == socket.AF_UNIX:
            self.address = f"unix:{connection.getpeername()}"
        if self.own_hand not in (None, hand["hand"], hand.get("hand_id")):
            sys.exit(f"the graph is for the hand {hand['hand']}, this bridge for {self.own_hand}: name its graph with --graph NAME")
        print(f"connected: {hand['hand']}, {hand['n_joints']} joints, {hand['n_cells']} cells", file=sys.stderr)
        # Every further line names the fault of a frame.
        threading.Thread(target=self.tell, args=(answers,), daemon=True).start()
        return connection, hand

    def open_again(self):
        try:
            connection, hand = self.open()
            if any(hand.get(key) != self.hand.get(key) for key in ("hand", "joints", "n_cells")):
                sys.exit(f"the graph is now for the hand {hand['hand']}; start the bridge again")
            self.connection = connection
        except SystemExit as error:
            self.fault = error.code

    @staticmethod
    def tell(answers):
        try:
            for line in answers:
                print(line, end="", file=sys.stderr)
        except OSError:
            pass  # The connection has gone.

    def send(self, frame):
        """Sends a frame; returns whether there was a connection. A frame is lost if the source has gone."""
        if self.own_hand is not None:
            frame = {"hand": self.own_hand, **frame}
        if self.fault is not None:
            sys.exit(self.fault)
        if self.connection is None:
            return False
        try:
            self.connection.sendall(json.dumps(frame).encode() + b"\n")
            return True
        except OSError:
            print("the source has gone; connecting again", file=sys.stderr)
            self.connection.close()
            self.connection = None
            threading.Thread(target=self.open_again, daemon=True).start()
            return False

    def send_all(self, frames):
        """Sends frames. A sentence in place of a frame is printed, once in a row."""
        told = None
        for frame in frames:
            if isinstance(frame, dict):
                self.send(frame)
                told = None
            elif frame != told:
                told = frame
                print(frame, file=sys.stderr)


class MotionPhase:
    """The phase by the fingers' motion, for hands that do not tell it. The hand must open first."""

    WINDOW_NANOS = 50_000_000
    # After such a silence nobody knows what the hand did.
    LOST_NANOS = 1_000_000_000

    def __init__(self, moving_rad_per_s=0.05, still_ms=200.0):
        self.moving, self.still_nanos = moving_rad_per_s, still_ms * 1e6
        # None until the fingers have opened: a hand that holds something when the bridge starts is not open.
        self.phase, self.anchor, self.still_since = None, None, None

    def of(self, stamp_nanos, fingers_rad):
        since, before = self.anchor or (stamp_nanos, fingers_rad)
        nanos = stamp_nanos - since
        if self.anchor is None or not 0 <= nanos <= self.LOST_NANOS:
            self.anchor, self.still_since, self.phase = (stamp_nanos, fingers_rad), None, None
        elif nanos >= self.WINDOW_NANOS:
            speeds = [(now - then) / nanos * 1e9 for now, then in zip(fingers_rad, before)]
            if any(abs(speed) > self.moving for speed in speeds):
                self.still_since = None
                if sum(speeds) <= 0:
                    self.phase = "open"
                elif self.phase == "open":
                    self.phase = "closing"
            else:
                self.still_since = since if self.still_since is None else self.still_since
                if self.phase == "closing" and stamp_nanos - self.still_since >= self.still_nanos:
                    self.phase = "settled"
            self.anchor = (stamp_nanos, fingers_rad)
        return self.phase


class StatusPhase:
    """The phase by what the hand says of itself: it opens, it closes, or it is at rest; `None` until it has been open, and after a
    fault. Otherwise a hand that holds something then would have its load taken for that of the open hand."""

    # The hand must rest for so long to be settled.
    REST_NANOS = 200_000_000

    def __init__(self):
        self.phase, self.rests_since = None, None

    def of(self, stamp_nanos, motion, is_open):
        """`motion` is opens, closes, rests, or None for a fault; `is_open` says that the fingers are at their open end."""
        if motion != "rests":
            self.rests_since = None
        if motion is None:
            self.phase = None
        elif motion == "opens" or (motion == "rests" and is_open):
            self.phase = "open"
        elif motion == "closes" and self.phase is not None:
            # A hand that closes on is not settled: the phase goes back, which begins another grasp.
            self.phase = "closing"
        elif motion == "rests" and self.phase == "closing":
            self.rests_since = stamp_nanos if self.rests_since is None else self.rests_since
            if stamp_nanos - self.rests_since >= self.REST_NANOS:
                self.phase = "settled"
        return self.phase


def run(work):
    """Runs a bridge's `work` until somebody ends it, by SIGINT or SIGTERM."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        work()
    except KeyboardInterrupt:
        pass
