"""Feeds a running graph's tactile_source with frames from topics of ROS 2, in any RMW and any distribution since Humble.

    blindgrasp run dataflow-live.yaml
    ros2 run blindgrasp_ros hand my_hand_topics.yaml

It needs only rclpy. A table says which topics the hand has; examples/bridges has those of a Unitree Dex3-1, of uSkin sensors and of
Robotiq's TSF-85:

    joints: {topic: /joint_states, map: {jaw: {from: finger_joint, scale: -0.5, offset: 0.04}}}
    cells:                     # pad after pad, in the order of `blindgrasp info HAND.yaml`
      - {topic: /touch/left, type: my_msgs/msg/Touch, field: taxels.force.z, scale: 0.01}
      - {topic: /touch/right, type: my_msgs/msg/Touch, field: taxels.force.z, order: [3, 2, 1, 0], missing: 30000}
    phase: {topic: /hand/status, type: my_msgs/msg/Status, field: state, words: {0: open, 1: closing, 2: settled}}

    wrench: {topic: /wrist/wrench}                       # WrenchStamped of the wrist, in the palm frame
    gravity: {frame: world, palm: palm_link}             # frames of /tf: z of the first points upwards; or
    imu: {topic: /palm/imu}                              # an Imu in the palm frame

A joint's value is `scale` times the topic's, plus `offset`; without an entry it is the value of the same name. A topic of
another `type` than sensor_msgs/msg/JointState has its values in a `field`, in the order of `names`. Cells are `scale` times the
field's numbers, plus `offset` (of a sensor_msgs Image with one channel, the pixels; of a PointCloud2, its field of that name);
`order` picks them, and a picked number that is `missing`, or none, makes no frame. A phase is
one word for one value, any that docs/hardware.md names: a robot that makes a test lift or reports how lifts end needs this
topic. Of several values (a list of states, one a finger) the hand is settled if all are. It counts for `max_age_ms` (1000; 0 for a
topic that speaks on change alone, with `latched: true` if its publisher is transient local). Without `phase` it is inferred from the
fingers' motion, and is `open`, `closing` or `settled`:
`closes` in the map is then the change of a joint's value while the hand closes by a radian: 1 if it is not given, -1 where the
value falls, 0.1 or -0.1 for a slide in metres, 0 for a joint that does not close.

A frame is made for each message of the first topic of cells, with the others that are within `tolerance_ms` of it (20), before
it or after it, and angles of the last 150 ms. It has each sense that the table names: wrench and Imu within `tolerance_ms`,
transforms within 0.1 s of it. Frames that lack something are not sent, and counted; the source sees the gap.
So are those whose message waited longer than 150 ms for the bridge, or that come while several nodes publish a topic of cells,
of the phase, or of joints in a `field`. Joint states may come from several nodes, but each joint from one: rclpy tells who sent
it from Kilted on; before, two nodes that send the same joint go unnoticed. A message without a header has the time at which it
was received, or where the middleware does not tell that (CycloneDDS), the one at which it was sent.
"""

import collections
import importlib
import math
import re
import struct
import sys
import time

from blindgrasp_ros import line_protocol
from blindgrasp_ros.node import arguments, ended_by_signals, spin

WORDS = ("open", "closing", "settled", "squeezing", "squeezed", "test_lifting", "test_lifted", "lifting", "ended", "kept", "dropped")
# Angles older than this are missed: joint_states often comes at 10 to 30 Hz. Messages that waited for longer make no frame.
OLD_NANOS = 150_000_000
# Two nodes send a joint if one does so within this time after the other: joint states are rarely slower than 1 Hz.
TWO_NODES_NANOS = 2_000_000_000
# Transforms must be this near to the cells in time: robot_state_publisher sends 20 a second.
TRANSFORM_NANOS = 100_000_000
# Gravity at sea level, in metres per second squared.
GRAVITY = 9.81
# The numbers of a sensor_msgs Image with one channel, and of the fields of a PointCloud2 by their datatype, as `struct` has them.
PIXELS = {"mono8": "B", "8UC1": "B", "8SC1": "b", "mono16": "H", "16UC1": "H", "16SC1": "h", "32SC1": "i", "32FC1": "f", "64FC1": "d"}
DATATYPES = " bBhHiIfd"
PACKED = ("sensor_msgs/msg/Image", "sensor_msgs/msg/PointCloud2")


def is_number(value):
    return type(value) in (int, float) and math.isfinite(value)


def is_text(value):
    return isinstance(value, str) and value != ""


def are_all(value, holds):
    """Whether it is a list that is not empty, and all that is in it holds."""
    return isinstance(value, list) and value != [] and all(map(holds, value))


def is_type(value):
    return isinstance(value, str) and re.fullmatch(r"\w+/\w+/\w+", value)


# The keys of the table's parts, each with the words for its value and a check of the value.
NUMBER, TEXT = ("a number", is_number), ("a text", is_text)
FLAG = ("true or false", lambda value: isinstance(value, bool))
MAPPING = ("a mapping", lambda value: isinstance(value, dict))
TYPE = ("a type such as std_msgs/msg/Float64MultiArray", is_type)
NAMES = ("a list of names", lambda value: are_all(value, is_text))
PLACES = ("a list of places, from 0 on", lambda value: are_all(value, lambda place: type(place) is int and place >= 0))
ENTRIES = ("a list of topics", lambda value: are_all(value, lambda entry: isinstance(entry, dict)))
WORD_OF = (f"a mapping to {', '.join(WORDS)}", lambda value: isinstance(value, dict) and all(word in WORDS for word in value.values()))
TOPIC = {"topic": TEXT, "type": TYPE, "field": TEXT, "latched": FLAG}
JOINTS = {**TOPIC, "names": NAMES, "map": MAPPING}
JOINT = {"from": TEXT, "scale": NUMBER, "offset": NUMBER, "closes": NUMBER}
CELLS = {**TOPIC, "scale": NUMBER, "offset": NUMBER, "order": PLACES, "missing": NUMBER}
PHASE = {**TOPIC, "words": WORD_OF, "max_age_ms": NUMBER}
TIMES = {"tolerance_ms": NUMBER, "moving_rad_per_s": NUMBER, "still_ms": NUMBER}
SENSE = {"topic": TEXT}
GRAVITY_FRAMES = {"frame": TEXT, "palm": TEXT, "topic": TEXT}
TABLE = {"joints": MAPPING, "cells": ENTRIES, "phase": MAPPING, "wrench": MAPPING, "imu": MAPPING, "gravity": MAPPING, **TIMES}


def check(where, entry, expected, required=()):
    """Refuses a part of the table.

    # Errors
    ValueError: a key or a value that is not expected, or a required key that is missing."""
    if not isinstance(entry, dict):
        raise ValueError(f"{where}: {entry!r}, expected a mapping with {', '.join(expected)}: correct it, see --help")
    for key in required:
        if key not in entry:
            raise ValueError(f"{where}: `{key}` is missing: write it, see --help")
    for key, value in entry.items():
        if key not in expected:
            raise ValueError(f"{where}: unknown key `{key}`, expected {', '.join(expected)}: correct or remove it")
        what, holds = expected[key]
        if not holds(value):
            raise ValueError(f"{where}: {key}: {value!r}, expected {what}: correct it, see --help")


def read_table(path):
    """The table of a file. Raises ValueError if it cannot be used."""
    import yaml

    try:
        with open(path, encoding="utf-8") as file:
            table = yaml.safe_load(file)
    except (OSError, yaml.YAMLError) as error:
        raise ValueError(getattr(error, "strerror", None) or error) from None
    check_table(table)
    return table


def check_table(table):
    """Refuses a table, as `check` does."""
    check("the table", table, TABLE, ["cells"])
    joints = table.get("joints", {})
    check("joints", joints, JOINTS)
    if ("field" in joints) != ("names" in joints):
        raise ValueError("joints: only one of `field` and `names`: write the field of the values, and their names in its order")
    for name, entry in joints.get("map", {}).items():
        check(f"joints: map: {name}", entry, JOINT)
    for idx, entry in enumerate(table["cells"]):
        check(f"cells[{idx}]", entry, CELLS, ["topic"])
    if "phase" in table:
        check("phase", table["phase"], PHASE, ["topic"])
    for name in ("wrench", "imu"):
        if name in table:
            check(name, table[name], SENSE, ["topic"])
    if "gravity" in table:
        check("gravity", table["gravity"], GRAVITY_FRAMES, ["frame", "palm"])
        if "imu" in table:
            raise ValueError("gravity and imu: both tell gravity: leave one of them out")


def part(value, name):
    """A part of a message, or of each message of a list, however deep."""
    return [part(item, name) for item in value] if isinstance(value, (list, tuple)) else getattr(value, name)


def at(value, path):
    """The values at a path such as `taxels.force.z`: a list where a part of the path is a list."""
    try:
        for name in path.split("."):
            value = part(value, name)
    except AttributeError as error:
        raise ValueError(f"field: {path}: {error}: write it as `ros2 interface show` has it") from None
    return value


def numbers(value):
    """All numbers in lists of lists, in order."""
    if isinstance(value, str):
        raise ValueError(f"field: it is the text {value!r}, expected numbers: name another one")
    if hasattr(value, "__len__"):
        return [number for item in value for number in numbers(item)]
    return [float(value)]


def packed(message, field):
    """The numbers that an Image or a PointCloud2 has as bytes.

    # Errors
    ValueError: it has no such numbers."""
    form, offset, step = PIXELS.get(getattr(message, "encoding", None)), 0, 0
    for part in getattr(message, "fields", []):
        if part.name == field:
            form, offset, step = DATATYPES[part.datatype], part.offset, message.point_step
    if form is None:
        raise ValueError(f"field: {field}: expected an Image with one of {', '.join(PIXELS)}, or a field of the PointCloud2")
    form = (">" if message.is_bigendian else "<") + form
    step, row = step or struct.calcsize(form), getattr(message, "row_step", None) or message.step
    places = [line * row + column * step + offset for line in range(message.height) for column in range(message.width)]
    data = bytes(message.data)
    if not places or places[-1] + struct.calcsize(form) > len(data):
        raise ValueError(f"{len(data)} bytes for {message.height} x {message.width} numbers")
    return [float(struct.unpack_from(form, data, place)[0]) for place in places]


def in_child(quaternion, vector):
    """A vector of the parent frame in the child's, by the child's rotation."""
    x, y, z, w = -quaternion.x, -quaternion.y, -quaternion.z, quaternion.w
    cross = lambda a, b: (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    once = cross((x, y, z), vector)
    twice = cross((x, y, z), once)
    return [value + 2 * (w * first + second) for value, first, second in zip(vector, once, twice)]


def stamp_of(message, came_nanos):
    """The time in the header, if the message has one that is set; otherwise the time at which the message came."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    nanos = stamp.sec * 1_000_000_000 + stamp.nanosec if stamp is not None else 0
    return nanos or came_nanos


class Frames:
    """Joins the messages of the table's topics to frames. `came_nanos` is the time at which a message was received."""

    def __init__(self, table, hand):
        check_table(table)
        self.table, self.hand = table, hand
        self.map = table.get("joints", {}).get("map") or {}
        unknown = set(self.map) - set(hand["joints"])
        if unknown:
            raise ValueError(f"joints: map: the hand has no joint {', '.join(sorted(unknown))}, but {', '.join(hand['joints'])}")
        self.sources = {self.map.get(name, {}).get("from", name) for name in hand["joints"]}
        names = table.get("joints", {}).get("names", self.sources)
        if not self.sources <= set(names):
            raise ValueError(f"joints: names: {', '.join(sorted(self.sources - set(names)))} is missing: name it, or write `map`")
        self.tolerance_nanos = float(table.get("tolerance_ms", 20.0)) * 1e6
        self.motion = line_protocol.MotionPhase(table.get("moving_rad_per_s", 0.05), table.get("still_ms", 200.0))
        self.closing = [float(self.map.get(name, {}).get("closes", 1)) for name in hand["joints"]]
        # The last value of each joint of the hand, by the topic's name, and its time.
        self.values = {}
        # Who sent each of them last and when, and the joint or transform that two nodes sent, and when.
        self.senders, self.sent_twice = {}, None
        # The last readings of each sense by its name in the line protocol, and their time; the topic of each that a frame must have.
        self.senses, self.topics = {}, {}
        if "wrench" in table:
            self.topics["wrist_wrench"] = table["wrench"]["topic"]
        if "imu" in table:
            self.topics["gravity_m_per_s2"] = table["imu"]["topic"]
        # The parent, the rotation, the time (of a static one None), the sender of the frames of /tf, and when it came.
        self.transforms = {}
        self.cells = [None] * len(table["cells"])
        # The cells of each topic that its last message lacked.
        self.missing = [[]] * len(table["cells"])
        # The time of a frame for which other topics are still to come.
        self.waits_stamp = None
        self.phase, self.phase_nanos = None, 0
        self.phase_age_nanos = float(table.get("phase", {}).get("max_age_ms", 1000.0)) * 1e6
        self.seq = 0
        # The frames that were not sent, by the cause.
        self.dropped = collections.Counter()

    def take_joints(self, message, came_nanos, sender=None):
        stamp = stamp_of(message, came_nanos)
        entry = self.table.get("joints", {})
        if "field" in entry:
            names, values = entry["names"], numbers(at(message, entry["field"]))
            if len(names) != len(values):
                raise ValueError(f"names: {len(names)} names, but `field` has {len(values)} values: name each of them, in order")
        else:
            names, values = message.name, message.position
        twice = sorted(name for name in self.sources if list(names).count(name) > 1)
        if twice:
            raise ValueError(f"the name {twice[0]} stands in a message twice: one node must send each joint once")
        ours = {name: (value, stamp) for name, value in zip(names, values) if name in self.sources}
        self.values.update(ours)
        for name in ours:
            other, other_nanos = self.senders.get(name, (sender, 0))
            if other != sender and came_nanos - other_nanos < TWO_NODES_NANOS:
                self.sent_twice = (f"the joint {name}", came_nanos)
            self.senders[name] = (sender, came_nanos)
        joints = self.joints(stamp)
        if ours and joints is not None and "phase" not in self.table:
            fingers = [value / rate for value, rate in zip(joints, self.closing) if rate]
            self.phase, self.phase_nanos = self.motion.of(stamp, fingers), came_nanos

    def take_wrench(self, message, came_nanos):
        force, torque = message.wrench.force, message.wrench.torque
        values = [force.x, force.y, force.z, torque.x, torque.y, torque.z]
        self.senses["wrist_wrench"] = (values, stamp_of(message, came_nanos))

    def take_imu(self, message, came_nanos):
        # A sensor at rest measures the force that keeps it from falling.
        up = message.linear_acceleration
        self.senses["gravity_m_per_s2"] = ([-up.x, -up.y, -up.z], stamp_of(message, came_nanos))

    def take_transforms(self, message, came_nanos, sender, is_static):
        for it in message.transforms:
            *_, other, other_nanos = self.transforms.get(it.child_frame_id, (None, None, None, sender, 0))
            if other != sender and came_nanos - other_nanos < TWO_NODES_NANOS:
                self.sent_twice = (f"the transform of {it.child_frame_id}", came_nanos)
            stamp = None if is_static else stamp_of(it, came_nanos)
            self.transforms[it.child_frame_id] = (it.header.frame_id, it.transform.rotation, stamp, sender, came_nanos)

    def gravity(self, stamp):
        """Gravity in the palm frame by the transforms; None if they do not tell it."""
        frame, rotations = self.table["gravity"]["palm"], []
        while frame != self.table["gravity"]["frame"]:
            parent, rotation, at_nanos, *_ = self.transforms.get(frame, (None, None, None))
            # A ring of frames leads nowhere.
            if parent is None or at_nanos is not None and abs(at_nanos - stamp) > TRANSFORM_NANOS or len(rotations) > 100:
                return None
            rotations.append(rotation)
            frame = parent
        found = [0.0, 0.0, -GRAVITY]
        for rotation in reversed(rotations):
            found = in_child(rotation, found)
        return found

    def take_phase(self, message, came_nanos):
        """One word for one value; of a list, the hand is settled if all fingers are, and open if all are."""
        entry = self.table["phase"]
        found = at(message, entry.get("field", "data"))
        words = entry.get("words")
        states = found if isinstance(found, (list, tuple)) or hasattr(found, "tolist") else [found]
        named = [str(state) if words is None else words.get(state, words.get(str(state))) for state in states]
        if not named or any(word not in WORDS for word in named):
            raise ValueError(f"{found!r} stands for none of {', '.join(WORDS)}: name it in `words`")
        self.phase, self.phase_nanos = named[0] if len(set(named)) == 1 else "closing", came_nanos

    def take_cells(self, idx, message, came_nanos):
        """The frame that the message completes."""
        entry = self.table["cells"][idx]
        field = entry.get("field", "data")
        found = packed(message, field) if entry.get("type") in PACKED else numbers(at(message, field))
        if len(found) <= max(entry.get("order", [-1])):
            raise ValueError(f"order: the place {max(entry['order'])}, but `field` has {len(found)} numbers: correct it")
        found = [found[place] for place in entry["order"]] if "order" in entry else found
        missing = [place for place, number in enumerate(found) if number == entry.get("missing") or not math.isfinite(number)]
        scale, offset = float(entry.get("scale", 1.0)), float(entry.get("offset", 0.0))
        stamp = stamp_of(message, came_nanos)
        if idx == 0:
            if self.waits_stamp is not None:
                self.drop(self.lacking_cells(self.waits_stamp))
            self.waits_stamp = stamp
        self.missing[idx] = missing
        self.cells[idx] = None if missing else ([scale * number + offset for number in found], stamp)
        return None if self.waits_stamp is None else self.frame(came_nanos)

    def drop(self, why):
        # The number of a frame is used up also if it is not sent: the source sees the gap and holds the grasp.
        self.waits_stamp, self.seq = None, self.seq + 1
        self.dropped[why] += 1

    def joint(self, name, stamp):
        """The value of a joint of the hand, `None` if it was not heard of lately."""
        entry = self.map.get(name, {})
        value, at_nanos = self.values.get(entry.get("from", name), (None, 0))
        if value is None or abs(at_nanos - stamp) > OLD_NANOS:
            return None
        return float(entry.get("scale", 1.0)) * value + float(entry.get("offset", 0.0))

    def joints(self, stamp):
        """The hand's joints, if each was heard of lately."""
        values = [self.joint(name, stamp) for name in self.hand["joints"]]
        return None if None in values else values

    def frame(self, came_nanos):
        """The frame of the table's first topic of cells, once the others near it have come."""
        stamp = self.waits_stamp
        why = self.lacking(stamp, came_nanos)
        if why:
            self.drop(why)
        if why or self.lacking_cells(stamp):
            return None
        self.waits_stamp, self.seq = None, self.seq + 1
        frame = {
            "joints": self.joints(stamp),
            "cells_newtons": [number for values, _ in self.cells for number in values],
            "phase": self.phase,
            "seq": self.seq - 1,
            "stamp_nanos": stamp,
        }
        for name in self.topics:
            frame[name] = self.senses[name][0]
        if "gravity" in self.table:
            frame["gravity_m_per_s2"] = self.gravity(stamp)
        return frame

    def lacking(self, stamp, came_nanos):
        """Why no frame of this time can be made, for a person; nothing if only cells may be missing that are still to come."""
        joints = [name for name in self.hand["joints"] if self.joint(name, stamp) is None]
        phase = self.table.get("phase")
        if joints:
            return f"no angle of {', '.join(joints)} within {OLD_NANOS / 1e6:g} ms"
        if self.sent_twice and came_nanos - self.sent_twice[1] < TWO_NODES_NANOS:
            return f"two nodes send {self.sent_twice[0]}: stop one"
        if self.cells[0] is None:
            return self.lacking_cells(stamp)
        if self.phase is None:
            return f"no phase: {'no message on ' + phase['topic'] if phase else 'without a topic of its own, the fingers must open once first'}"
        if phase and 0 < self.phase_age_nanos < came_nanos - self.phase_nanos:
            return f"a phase on {phase['topic']} older than {self.phase_age_nanos / 1e6:g} ms (max_age_ms)"
        # A model must not decide without a sense that the table names.
        for name, topic in self.topics.items():
            if abs(self.senses.get(name, (None, 0))[1] - stamp) > self.tolerance_nanos:
                return f"no message on {topic} within {self.tolerance_nanos / 1e6:g} ms (tolerance_ms)"
        frames = self.table.get("gravity")
        if frames and self.gravity(stamp) is None:
            return f"no transforms from {frames['palm']} up to {frames['frame']}, each from one node and within {TRANSFORM_NANOS / 1e6:g} ms"
        return None

    def lacking_cells(self, stamp):
        """The topics of cells that a frame of this time lacks, for a person; nothing if it lacks none."""
        found = []
        for entry, cells, missing in zip(self.table["cells"], self.cells, self.missing):
            if cells is None:
                found.append(f"no message on {entry['topic']}" + "".join(f" with cell {place}" for place in missing[:1]))
            elif abs(cells[1] - stamp) > self.tolerance_nanos:
                found.append(f"cells on {entry['topic']} more than {self.tolerance_nanos / 1e6:g} ms apart (tolerance_ms)")
        return ", ".join(found)


def message_class(where, name, field):
    """The class of a message type such as `sensor_msgs/msg/JointState`.

    # Errors
    ValueError: the type is not there, or has no such field."""
    package, folder, kind = name.split("/")
    try:
        found = getattr(importlib.import_module(f"{package}.{folder}"), kind)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"{where}: type: no {name} ({error}): source the workspace that has the package, or correct the type") from None
    try:
        if name not in PACKED:
            at(found(), field)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
    return found


@ended_by_signals
def bridge(table, source):
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
    from rclpy.subscription import Subscription

    frames = Frames(table, source.hand)
    node = rclpy.create_node("blindgrasp_hand")
    executor = SingleThreadedExecutor()
    is_humble = not hasattr(Subscription, "CallbackType")
    if is_humble:
        # The executor of Humble takes a message with its times, and passes on the message alone.
        executor._take_subscription = lambda subscription: subscription.handle.take_message(subscription.msg_type, False)
    # The topics that only one node may publish.
    own_topics = set()
    told = [time.monotonic()]

    def subscribe(where, entry, kind, field, take, is_own):
        def taken(message, info):
            waited_nanos = max(0, time.time_ns() - (info["received_timestamp"] or info["source_timestamp"]))
            try:
                # The node's clock may be that of a simulation.
                take(message, node.get_clock().now().nanoseconds - waited_nanos, waited_nanos, info.get("publisher_gid"))
            except ValueError as error:
                raise ValueError(f"{where}: {error}") from None

        qos = qos_profile_sensor_data
        if entry.get("latched"):
            qos = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        kind = message_class(where, entry.get("type", kind), field)
        subscription = node.create_subscription(kind, entry["topic"], (lambda both: taken(*both)) if is_humble else taken, qos)
        if is_own:
            own_topics.add(subscription.topic_name)

    def take_joints(message, came_nanos, _, sender):
        frames.take_joints(message, came_nanos, sender)

    def take_phase(message, came_nanos, *_):
        frames.take_phase(message, came_nanos)

    def take_cells(idx, message, came_nanos, waited_nanos):
        shared = [topic for topic in sorted(own_topics) if node.count_publishers(topic) > 1]
        why = None
        if shared:
            why = f"several nodes publish {', '.join(shared)}: stop all but one; DDS forgets a killed one after up to 20 s"
            # Nobody knows whose phase it is.
            frames.phase = None
        elif waited_nanos > OLD_NANOS:
            why = f"a message on {table['cells'][idx]['topic']} waited longer than {OLD_NANOS / 1e6:g} ms for the bridge"
        if why is None:
            frame = frames.take_cells(idx, message, came_nanos)
            if frame is not None and not source.send(frame):
                frames.dropped["no connection to the source"] += 1
        elif idx == 0:
            frames.drop(why)
        if frames.dropped and time.monotonic() - told[0] > 2.0:
            told[0] = time.monotonic()
            causes = "; ".join(f"{n}: {why}" for why, n in frames.dropped.most_common())
            print(f"{frames.dropped.total()} frames not sent: {causes}", file=sys.stderr)
            frames.dropped.clear()

    joints = {"topic": "/joint_states", **table.get("joints", {})}
    subscribe("joints", joints, "sensor_msgs/msg/JointState", joints.get("field", "position"), take_joints, "field" in joints)
    if "phase" in table:
        subscribe("phase", table["phase"], "std_msgs/msg/String", table["phase"].get("field", "data"), take_phase, True)
    if "wrench" in table:
        take = lambda message, came_nanos, *_: frames.take_wrench(message, came_nanos)
        subscribe("wrench", table["wrench"], "geometry_msgs/msg/WrenchStamped", "wrench", take, True)
    if "imu" in table:
        take = lambda message, came_nanos, *_: frames.take_imu(message, came_nanos)
        subscribe("imu", table["imu"], "sensor_msgs/msg/Imu", "linear_acceleration", take, True)
    if "gravity" in table:
        topic = table["gravity"].get("topic", "/tf")
        for entry, is_static in [({"topic": topic}, False), ({"topic": f"{topic}_static", "latched": True}, True)]:
            take = lambda message, came_nanos, _, sender, is_static=is_static: frames.take_transforms(message, came_nanos, sender, is_static)
            subscribe("gravity", entry, "tf2_msgs/msg/TFMessage", "transforms", take, False)
    for idx, entry in enumerate(table["cells"]):
        take = lambda message, came_nanos, waited_nanos, _, idx=idx: take_cells(idx, message, came_nanos, waited_nanos)
        subscribe(f"cells[{idx}]", entry, "std_msgs/msg/Float64MultiArray", entry.get("field", "data"), take, True)
    spin(node, executor)


def work():
    options = line_protocol.options(__doc__)
    options.add_argument("table", help="the topics (YAML)")
    given = options.parse_args(arguments())
    try:
        table = read_table(given.table)
        bridge(table, line_protocol.Source(given.address, hand=given.hand))
    except ValueError as error:
        sys.exit(f"{given.table}: {error}")


def main():
    line_protocol.run(work)


if __name__ == "__main__":
    main()
