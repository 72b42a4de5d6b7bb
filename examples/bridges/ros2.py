#!/usr/bin/env python3
"""Feeds a running graph's tactile_source with frames from topics of ROS 2, in any RMW and any distribution since Humble.

    blindgrasp run dataflow-live.yaml
    python3 examples/bridges/ros2.py my_hand_topics.yaml

It runs where ROS 2 is sourced and needs only rclpy. A table says which topics the hand has; this folder has those of a Unitree
Dex3-1, of uSkin sensors and of Robotiq's TSF-85:

    joints: {topic: /joint_states, map: {jaw: {from: finger_joint, scale: -0.5, offset: 0.04}}}
    cells:                     # pad after pad, in the order of `blindgrasp info HAND.yaml`
      - {topic: /touch/left, type: my_msgs/msg/Touch, field: taxels.force.z, scale: 0.01}
      - {topic: /touch/right, type: my_msgs/msg/Touch, field: taxels.force.z, order: [3, 2, 1, 0], missing: 30000}
    phase: {topic: /hand/status, type: my_msgs/msg/Status, field: state, words: {0: open, 1: closing, 2: settled}}

A joint's value is `scale` times the topic's, plus `offset`; without an entry it is the value of the same name. A topic of
another `type` than sensor_msgs/msg/JointState has its values in a `field`, in the order of `names`. Cells are `scale` times the
field's numbers, plus `offset`; `order` picks them, and a picked number that is `missing`, or none, makes no frame. A phase is
one word for one value, any that docs/hardware.md names: a robot that makes a test lift or reports how lifts end needs this
topic. Of several values (a list of states, one a finger) the hand is settled if all are. It counts for `max_age_ms` (1000; 0 for a
topic that speaks on change alone, with `latched: true` if its publisher is transient local). Without `phase` it is inferred from the
fingers' motion, and is `open`, `closing` or `settled`:
`closes` in the map is then the change of a joint's value while the hand closes by a radian: 1 if it is not given, -1 where the
value falls, 0.1 or -0.1 for a slide in metres, 0 for a joint that does not close.

A frame is made for each message of the first topic of cells, with the others that are within `tolerance_ms` of it (20), before
it or after it, and angles of the last 150 ms. Frames that lack something are not sent, and counted; the source sees the gap.
"""

import importlib
import math
import sys
import time

import line_protocol

WORDS = ("open", "closing", "settled", "squeezing", "squeezed", "test_lifting", "test_lifted", "lifting", "ended", "kept", "dropped")
# Angles older than this are missed: joint_states often comes at 10 to 30 Hz.
JOINTS_NANOS = 150_000_000


def part(value, name):
    """A part of a message, or of each message of a list, however deep."""
    return [part(item, name) for item in value] if isinstance(value, (list, tuple)) else getattr(value, name)


def at(value, path):
    """The values at a path such as `taxels.force.z`: a list where a part of the path is a list."""
    for name in path.split("."):
        value = part(value, name)
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


class Frames:
    """Joins the messages of the table's topics to frames."""

    def __init__(self, table, hand):
        self.table, self.hand = table, hand
        self.map = (table.get("joints") or {}).get("map") or {}
        unknown = set(self.map) - set(hand["joints"])
        if unknown:
            raise ValueError(f"joints: map: the hand has no joint {', '.join(sorted(unknown))}")
        if "field" in (table.get("joints") or {}) and "names" not in table["joints"]:
            raise ValueError("joints: the field has no names of joints: give `names`, in its order")
        if any("topic" not in entry for entry in table["cells"]):
            raise ValueError("cells: an entry has no topic")
        self.tolerance_nanos = float(table.get("tolerance_ms", 20.0)) * 1e6
        self.motion = line_protocol.MotionPhase(table.get("moving_rad_per_s", 0.05), table.get("still_ms", 200.0))
        self.closing = [float((self.map.get(name) or {}).get("closes", 1)) for name in hand["joints"]]
        self.sources = {(self.map.get(name) or {}).get("from", name) for name in hand["joints"]}
        # The last value of each joint of the hand, by the topic's name, and its time.
        self.values = {}
        self.cells = [None] * len(table["cells"])
        # The cells of each topic that its last message lacked.
        self.missing = [[]] * len(table["cells"])
        # The time of a frame for which other topics are still to come.
        self.waits_stamp = None
        self.phase, self.phase_nanos = None, 0
        self.phase_age_nanos = float((table.get("phase") or {}).get("max_age_ms", 1000.0)) * 1e6
        self.seq = 0
        self.dropped = 0

    def take_joints(self, message, now_nanos):
        stamp = stamp_of(message, now_nanos)
        entry = self.table.get("joints") or {}
        if "field" in entry:
            names, values = entry["names"], numbers(at(message, entry["field"]))
        else:
            names, values = message.name, message.position
        ours = {name: (value, stamp) for name, value in zip(names, values) if name in self.sources}
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
        """The frame that the message completes."""
        entry = self.table["cells"][idx]
        found = numbers(at(message, entry.get("field", "data")))
        if len(found) <= max(entry.get("order", [-1])):
            raise ValueError(f"cells: {entry['topic']} has {len(found)} numbers, and `order` names the place {max(entry['order'])}")
        found = [found[place] for place in entry["order"]] if "order" in entry else found
        missing = [place for place, number in enumerate(found) if number == entry.get("missing") or not math.isfinite(number)]
        scale, offset = float(entry.get("scale", 1.0)), float(entry.get("offset", 0.0))
        stamp = stamp_of(message, now_nanos)
        self.missing[idx] = missing
        self.cells[idx] = None if missing else ([scale * number + offset for number in found], stamp)
        if idx == 0:
            if self.waits_stamp is not None:
                self.drop()
            self.waits_stamp = stamp
        return None if self.waits_stamp is None else self.frame(now_nanos)

    def drop(self):
        # The number of a frame is used up also if it is not sent: the source sees the gap and holds the grasp.
        self.waits_stamp, self.seq, self.dropped = None, self.seq + 1, self.dropped + 1

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

    def frame(self, now_nanos):
        """The frame of the table's first topic of cells, once the others near it have come."""
        stamp = self.waits_stamp
        joints = self.joints(stamp)
        is_phase_old = "phase" in self.table and 0 < self.phase_age_nanos < now_nanos - self.phase_nanos
        if self.cells[0] is None or joints is None or self.phase is None or is_phase_old:
            self.drop()
            return None
        if not all(cells is not None and abs(cells[1] - stamp) <= self.tolerance_nanos for cells in self.cells):
            return None
        self.waits_stamp, self.seq = None, self.seq + 1
        return {
            "joints": joints,
            "cells_newtons": [number for values, _ in self.cells for number in values],
            "phase": self.phase,
            "seq": self.seq - 1,
            "stamp_nanos": stamp,
        }

    def lacks(self):
        """The parts that a frame lacks, for a person."""
        joints = [name for name in self.hand["joints"] if (self.map.get(name) or {}).get("from", name) not in self.values]
        cells = [
            entry["topic"] + "".join(f" with cell {place}" for place in places[:1])
            for entry, cells, places in zip(self.table["cells"], self.cells, self.missing)
            if cells is None
        ]
        found = [f"no angle of {', '.join(joints)}"] if joints else []
        found += [f"no message on {', '.join(cells)}"] if cells else []
        topic = (self.table.get("phase") or {}).get("topic")
        why = f"no message on {topic}" if topic else "without a topic of its own, the fingers must open once first"
        found += [f"no phase: {why}"] if self.phase is None else []
        return "; ".join(found) or (
            f"cells more than {self.tolerance_nanos / 1e6:g} ms apart (tolerance_ms), angles older than "
            f"{JOINTS_NANOS / 1e6:g} ms, or an old phase (max_age_ms)"
        )


def message_class(name):
    """The class of a message type such as `sensor_msgs/msg/JointState`."""
    package, _, kind = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)


def bridge(table, address):
    import rclpy
    from rclpy.clock import Clock
    from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data

    source = line_protocol.Source(address)
    rclpy.init()
    node = rclpy.create_node("blindgrasp_hand_bridge")
    frames = Frames(table, source.hand)
    told = [time.monotonic(), 0]

    def now_nanos():
        return node.get_clock().now().nanoseconds

    def send(frame):
        if frame is not None:
            source.send(frame)
        elif frames.dropped > told[1] and time.monotonic() - told[0] > 2.0:
            told[:] = time.monotonic(), frames.dropped
            print(f"{frames.dropped} frames not sent: {frames.lacks()}", file=sys.stderr)

    def subscribe(entry, kind, callback):
        qos = qos_profile_sensor_data
        if entry.get("latched"):
            qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(message_class(entry.get("type", kind)), entry["topic"], callback, qos)

    joints = {"topic": "/joint_states", **(table.get("joints") or {})}
    subscribe(joints, "sensor_msgs/msg/JointState", lambda message: frames.take_joints(message, now_nanos()))
    if "phase" in table:
        subscribe(table["phase"], "std_msgs/msg/String", lambda message: frames.take_phase(message, now_nanos()))
    for idx, entry in enumerate(table["cells"]):
        take = lambda message, idx=idx: send(frames.take_cells(idx, message, now_nanos()))
        subscribe(entry, "std_msgs/msg/Float64MultiArray", take)
    # rclpy can fall asleep on a signal that comes just then; it looks again when it wakes.
    node.create_timer(1.0, lambda: None, clock=Clock())
    try:
        rclpy.spin(node)
    except Exception:
        # A signal that ends ROS 2 makes rclpy.spin raise one of several errors.
        if rclpy.ok():
            raise
    finally:
        rclpy.try_shutdown()


def main():
    options = line_protocol.options(__doc__)
    options.add_argument("table", help="the topics (YAML)")
    # rclpy reads what follows --ros-args.
    own = sys.argv[1 : sys.argv.index("--ros-args")] if "--ros-args" in sys.argv else sys.argv[1:]
    arguments = options.parse_args(own)
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
    line_protocol.run(main)
