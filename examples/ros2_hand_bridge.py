#!/usr/bin/env python3
"""Feeds a running graph's tactile_source with frames from topics of ROS 2, in any RMW and any distribution since Humble.

    blindgrasp run dataflow-live.yaml
    python3 examples/ros2_hand_bridge.py my_hand_topics.yaml

It runs where ROS 2 is sourced and needs only rclpy. A table says which topics the hand has:

    joints: {topic: /joint_states, map: {jaw: {from: finger_joint, scale: -0.5, offset: 0.04}}}
    cells:                     # pad after pad, in the order of `blindgrasp info HAND.yaml`
      - {topic: /touch/left, type: my_msgs/msg/Touch, field: taxels.force.z, scale: 0.01}
      - {topic: /touch/right, type: my_msgs/msg/Touch, field: taxels.force.z, order: [3, 2, 1, 0]}
    phase: {topic: /hand/status, type: my_msgs/msg/Status, field: state, words: {0: open, 1: closing, 2: settled}}

A joint's value is `scale` times the topic's, plus `offset`; without an entry it is the value of the same name. Cells are
`scale` times the field's numbers; `order` picks them. A phase is one word for one value; of several values (a list of
states, one a finger) the hand is settled if all are. It counts for `max_age_ms` (1000; 0 for a topic that speaks on change
alone). Without `phase` it is inferred from the fingers' motion: `closes` in the map is then the change of a joint's value
while the hand closes by a radian: 1 if it is not given, -1 where the value falls, 0.1 or -0.1 for a slide in metres, 0 for
a joint that does not close.

A frame is made for each message of the first topic of cells, with the others that are within `tolerance_ms` of it (20) and
angles of the last 150 ms. Frames that lack something are not sent, and counted; the source sees the gap.
"""

import argparse
import json
import os
import socket
import sys
import threading
import time

WORDS = ("open", "closing", "settled", "ended")
# Angles older than this are missed: joint_states often comes at 10 to 30 Hz.
JOINTS_NANOS = 150_000_000


def at(value, path):
    """The values at a path such as `taxels.force.z`: a list where a part of the path is a list."""
    for part in path.split("."):
        value = [getattr(item, part) for item in value] if isinstance(value, (list, tuple)) else getattr(value, part)
    return value


def numbers(value):
    """All numbers in lists of lists, in order."""
    if hasattr(value, "__len__") and not isinstance(value, str):
        return [number for item in value for number in numbers(item)]
    return [float(value)]


def stamp_of(message, now_nanos):
    """The time in the header, if the message has one that is set."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    nanos = stamp.sec * 1_000_000_000 + stamp.nanosec if stamp is not None else 0
    return nanos or now_nanos


class MotionPhase:
    """The phase by the fingers' motion, as the driver `ros2` of blindgrasp finds it (crates/tactile/src/phases.rs)."""

    WINDOW_NANOS = 50_000_000

    def __init__(self, moving_rad_per_s=0.05, still_ms=200.0):
        self.moving, self.still_nanos = moving_rad_per_s, still_ms * 1e6
        self.phase, self.anchor, self.still_since = "open", None, None

    def of(self, stamp_nanos, fingers_rad):
        since, before = self.anchor or (stamp_nanos, fingers_rad)
        nanos = stamp_nanos - since
        if self.anchor is None or nanos < 0:
            self.anchor, self.still_since = (stamp_nanos, fingers_rad), None
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


class Frames:
    """Joins the messages of the table's topics to frames."""

    def __init__(self, table, hand):
        self.table, self.hand = table, hand
        self.map = (table.get("joints") or {}).get("map") or {}
        unknown = set(self.map) - set(hand["joints"])
        if unknown:
            raise ValueError(f"joints: map: the hand has no joint {', '.join(sorted(unknown))}")
        self.tolerance_nanos = float(table.get("tolerance_ms", 20.0)) * 1e6
        self.motion = MotionPhase(table.get("moving_rad_per_s", 0.05), table.get("still_ms", 200.0))
        self.closing = [float((self.map.get(name) or {}).get("closes", 1)) for name in hand["joints"]]
        self.sources = {(self.map.get(name) or {}).get("from", name) for name in hand["joints"]}
        # The last value of each joint of the hand, by the topic's name, and its time.
        self.values = {}
        self.cells = [None] * len(table["cells"])
        self.phase, self.phase_nanos = None, 0
        self.phase_age_nanos = float((table.get("phase") or {}).get("max_age_ms", 1000.0)) * 1e6
        self.seq = 0
        self.dropped = 0

    def take_joints(self, message, now_nanos):
        stamp = stamp_of(message, now_nanos)
        ours = {name: (value, stamp) for name, value in zip(message.name, message.position) if name in self.sources}
        self.values.update(ours)
        joints = self.joints(stamp)
        if ours and joints is not None and "phase" not in self.table:
            fingers = [value / rate for value, rate in zip(joints, self.closing) if rate]
            self.phase, self.phase_nanos = self.motion.of(stamp, fingers), now_nanos

    def take_phase(self, message, now_nanos):
        """One word for one value; of a list, the hand is settled if all fingers are, and open if all are."""
        entry = self.table["phase"]
        found = at(message, entry.get("field", "data"))
        words = entry.get("words")
        states = found if isinstance(found, (list, tuple)) or hasattr(found, "tolist") else [found]
        named = [str(state) if words is None else words.get(state, words.get(str(state))) for state in states]
        if any(word not in WORDS for word in named):
            raise ValueError(f"phase: {found!r} stands for none of {', '.join(WORDS)}: name it in `words`")
        self.phase, self.phase_nanos = named[0] if len(set(named)) == 1 else "closing", now_nanos

    def take_cells(self, idx, message, now_nanos):
        """The frame that the message completes: that of the table's first topic of cells, with the others near it."""
        entry = self.table["cells"][idx]
        values = [float(entry.get("scale", 1.0)) * number for number in numbers(at(message, entry.get("field", "data")))]
        if "order" in entry:
            values = [values[place] for place in entry["order"]]
        stamp = stamp_of(message, now_nanos)
        self.cells[idx] = (values, stamp)
        return self.frame(stamp, now_nanos) if idx == 0 else None

    def joints(self, stamp):
        """The hand's joints, if each was heard of lately."""
        values = []
        for name in self.hand["joints"]:
            entry = self.map.get(name) or {}
            value, at_nanos = self.values.get(entry.get("from", name), (None, 0))
            if value is None or abs(at_nanos - stamp) > JOINTS_NANOS:
                return None
            values.append(float(entry.get("scale", 1.0)) * value + float(entry.get("offset", 0.0)))
        return values

    def frame(self, stamp, now_nanos):
        joints = self.joints(stamp)
        is_phase_old = "phase" in self.table and 0 < self.phase_age_nanos < now_nanos - self.phase_nanos
        # Its number is used up also if it is not sent: the source sees the gap and holds the grasp.
        seq, self.seq = self.seq, self.seq + 1
        missing = [entry["topic"] for entry, cells in zip(self.table["cells"], self.cells) if cells is None]
        is_near = all(cells is not None and abs(cells[1] - stamp) <= self.tolerance_nanos for cells in self.cells)
        if missing or not is_near or joints is None or self.phase is None or is_phase_old:
            self.dropped += 1
            return None
        return {
            "joints": joints,
            "cells_newtons": [number for values, _ in self.cells for number in values],
            "phase": self.phase,
            "seq": seq,
            "stamp_nanos": stamp,
        }

    def lacks(self):
        """The parts that a frame lacks, for a person."""
        joints = [name for name in self.hand["joints"] if (self.map.get(name) or {}).get("from", name) not in self.values]
        cells = [entry["topic"] for entry, cells in zip(self.table["cells"], self.cells) if cells is None]
        found = [f"no angle of {', '.join(joints)}"] if joints else []
        found += [f"no message on {', '.join(cells)}"] if cells else []
        found += ["no phase"] if self.phase is None else []
        return "; ".join(found) or (
            f"cells more than {self.tolerance_nanos / 1e6:g} ms apart (tolerance_ms), angles older than "
            f"{JOINTS_NANOS / 1e6:g} ms, or an old phase (max_age_ms)"
        )


def connect(address):
    while True:
        try:
            if address.startswith("unix:"):
                connection = socket.socket(socket.AF_UNIX)
                connection.connect(address.removeprefix("unix:"))
                return connection
            host, _, port = address.rpartition(":")
            connection = socket.create_connection((host, int(port)))
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return connection
        except OSError as error:
            print(f"{address}: {error}; trying again", file=sys.stderr)
            time.sleep(1)


def bridge(table, address):
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from rosidl_runtime_py.utilities import get_message

    connection = connect(address)
    answers = connection.makefile()
    hand = json.loads(answers.readline())
    if "refused" in hand:
        sys.exit(hand["why"])
    print(f"connected: {hand['hand']}, {hand['n_joints']} joints, {hand['n_cells']} cells", file=sys.stderr)
    threading.Thread(target=lambda: [print(line, end="", file=sys.stderr) for line in answers], daemon=True).start()

    rclpy.init()
    node = rclpy.create_node("blindgrasp_hand_bridge")
    frames = Frames(table, hand)
    told = [time.monotonic()]

    def now_nanos():
        return node.get_clock().now().nanoseconds

    def send(frame):
        if frame is not None:
            connection.sendall(json.dumps(frame).encode() + b"\n")
        elif time.monotonic() - told[0] > 2.0:
            told[0] = time.monotonic()
            print(f"{frames.dropped} frames not sent: {frames.lacks()}", file=sys.stderr)

    def subscribe(entry, kind, callback):
        node.create_subscription(get_message(entry.get("type", kind)), entry["topic"], callback, qos_profile_sensor_data)

    joints = {"topic": "/joint_states", **(table.get("joints") or {})}
    subscribe(joints, "sensor_msgs/msg/JointState", lambda message: frames.take_joints(message, now_nanos()))
    if "phase" in table:
        subscribe(table["phase"], "std_msgs/msg/String", lambda message: frames.take_phase(message, now_nanos()))
    for idx, entry in enumerate(table["cells"]):
        take = lambda message, idx=idx: send(frames.take_cells(idx, message, now_nanos()))
        subscribe(entry, "std_msgs/msg/Float64MultiArray", take)
    try:
        rclpy.spin(node)
    finally:
        rclpy.try_shutdown()


def main():
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("table", help="the topics (YAML)")
    options.add_argument("--address", default=f"unix:/tmp/blindgrasp-{os.getuid()}/tactile.hand", help="or HOST:PORT")
    arguments = options.parse_args()
    import yaml

    with open(arguments.table, encoding="utf-8") as file:
        table = yaml.safe_load(file)
    if not isinstance(table, dict) or not table.get("cells"):
        sys.exit(f"{arguments.table}: expected topics under `cells`; see --help")
    try:
        bridge(table, arguments.address)
    except ValueError as error:
        sys.exit(f"{arguments.table}: {error}")


if __name__ == "__main__":
    try:
        main()
    except (BrokenPipeError, ConnectionResetError):
        sys.exit("the source has gone; start the bridge again")
    except KeyboardInterrupt:
        pass
