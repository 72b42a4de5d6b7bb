"""Reads a recording with readers that are not ours, and compares each field of each sample with the lines of `blindgrasp
export`: floating-point numbers bit by bit.

    read_recording.py RECORDING.mcap EXPORTED.jsonl

Prints what was compared as a line of JSON; the first difference ends it with exit code 1.
"""

import json
import math
import re
import struct
import sys
from collections import Counter
from pathlib import Path

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

OURS = "blindgrasp_msgs/msg/"


def words_of(definition):
    """The words of codes, by the comment above the field: `# 0 open, 1 closing` above `uint32 phase`."""
    found, comment = {}, ""
    for line in definition.splitlines():
        if line.startswith("#"):
            comment += " " + line[1:]
            continue
        words = {int(code): word for code, word in re.findall(r"\b(\d+) ([a-z_]+)", comment)}
        if words and len(line.split()) == 2 and line.startswith("uint32 "):
            found[line.split()[1]] = words
        comment = ""
    return found


def fields_of(message):
    """The names and values of a decoded message's fields, whichever reader decoded it."""
    names = getattr(message, "__slots__", None) or vars(message)
    return {name: getattr(message, name) for name in names if not name.startswith("_")}


class Comparison:
    """Counts what it compares."""

    def __init__(self, words):
        self.words = words
        self.n_values = 0

    def compare(self, found, expected, place, name=None):
        differs = AssertionError(f"{place}: found {found!r}, export says {expected!r}")
        if isinstance(expected, dict):
            found = found if isinstance(found, dict) else fields_of(found)
            if set(found) - {"header"} != set(expected):
                raise differs
            for key, value in expected.items():
                self.compare(found[key], value, f"{place}.{key}", key)
        elif isinstance(expected, list):
            if len(found) != len(expected):
                raise differs
            for idx, value in enumerate(expected):
                self.compare(found[idx], value, f"{place}[{idx}]")
        else:
            self.n_values += 1
            if not self.is_same(found, expected, name):
                raise differs

    def is_same(self, found, expected, name):
        if isinstance(expected, bool):
            return bool(found) is expected and found in (True, False)
        if isinstance(expected, str):
            if isinstance(found, str):
                return found == expected
            if name in self.words:
                return self.words[name].get(int(found)) == expected
            return format(int(found), "016x") == expected
        if expected is None:
            return not math.isfinite(found)
        if isinstance(expected, float):
            return struct.pack("<d", found) == struct.pack("<d", expected)
        return int(found) == expected and float(found).is_integer()


class Expected:
    """The exported lines by topic and number."""

    def __init__(self, path):
        self.by_topic = {}
        with open(path, encoding="utf-8") as lines:
            for line in map(json.loads, lines):
                topic = self.by_topic.setdefault(line["topic"], {})
                assert line["seq"] not in topic, f"{line['topic']}: seq {line['seq']} twice"
                topic[line["seq"]] = line

    def line(self, topic, header):
        line = self.by_topic[topic][header.seq]
        assert line["stamp_nanos"] == header.stamp_nanos, f"{topic}, seq {header.seq}: stamp {header.stamp_nanos}"
        return line["data"]

    def check_counts(self, reader, n_samples):
        expected = {topic: len(lines) for topic, lines in self.by_topic.items()}
        found = {topic: n for topic, n in n_samples.items() if topic in expected}
        assert found == expected, f"{reader}: read {found}, exported {expected}"


def check_joint_states(message, expected):
    """sensor_msgs/JointState against the frame of its stamp."""
    data = expected["/tactile"][stamp_nanos(message)]
    assert [float(angle) for angle in message.position] == data["joints"], f"{message} against {data}"
    assert len(message.name) == len(message.position)


def check_contact_points(message, expected):
    """sensor_msgs/PointCloud2 against the contacts of its stamp: as float32, which is what it holds."""
    contacts = expected["/contacts"][stamp_nanos(message)]["contacts"]
    offsets = {field.name: field.offset for field in message.fields if field.datatype == 7}
    raw = bytes(message.data)
    points = [
        b"".join(raw[idx * message.point_step + offsets[name] :][:4] for name in ("x", "y", "z", "force"))
        for idx in range(message.width * message.height)
    ]
    as_floats = [struct.pack("<4f", *contact["position_m"], contact["force_newtons"]) for contact in contacts]
    assert points == as_floats, f"{points} against {contacts}"


def check_transforms(message, expected):
    """tf2_msgs/TFMessage: a tree with the palm, of one stamp, whose rotations are unit quaternions."""
    assert stamp_nanos(message.transforms[0]) in expected["/tactile"], message
    children = {transform.child_frame_id for transform in message.transforms}
    frames = children | {transform.header.frame_id for transform in message.transforms}
    assert "palm" in frames and len(frames) == len(message.transforms) + 1, f"{sorted(frames)} is no tree"
    for transform in message.transforms:
        rotation = transform.transform.rotation
        assert math.isclose(math.hypot(rotation.x, rotation.y, rotation.z, rotation.w), 1.0), transform


def check_description(message, expected):
    """std_msgs/String: the URDF."""
    assert "<robot" in message.data, message.data[:100]


STANDARD = {
    "sensor_msgs/msg/JointState": check_joint_states,
    "sensor_msgs/msg/PointCloud2": check_contact_points,
    "std_msgs/msg/String": check_description,
    "tf2_msgs/msg/TFMessage": check_transforms,
}


def stamp_nanos(message):
    stamp = message.header.stamp
    return stamp.sec * 1_000_000_000 + getattr(stamp, "nanosec", 0)


def by_stamp(expected):
    return {
        topic: {line["stamp_nanos"]: line["data"] for line in lines.values()}
        for topic, lines in expected.by_topic.items()
    }


def with_mcap(path, expected):
    """Reads with mcap and mcap-ros2-support."""
    n_samples, n_standard, n_values = Counter(), Counter(), 0
    stamped = by_stamp(expected)
    with open(path, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, _, message in reader.iter_decoded_messages():
            topic = channel.topic
            if schema.name in STANDARD:
                STANDARD[schema.name](message, stamped)
                n_standard[topic] += 1
                continue
            assert schema.name.startswith(OURS), f"{topic}: {schema.name}"
            comparison = Comparison(words_of(schema.data.decode()))
            seq = message.header.seq
            comparison.compare(message, expected.line(topic, message.header), f"mcap: {topic}, seq {seq}")
            identity = (message.header.epoch, format(message.header.hand_id, "016x"))
            line = expected.by_topic[topic][seq]
            assert identity == (line["epoch"], line["hand_id"]), f"mcap: {topic}, seq {seq}: {identity} against {line}"
            n_values += comparison.n_values
            n_samples[topic] += 1
    expected.check_counts("mcap", n_samples)
    return {"n_samples": n_samples, "n_standard": n_standard, "n_values": n_values}


def with_rosbags(path, expected):
    """Reads with rosbags, which takes the MCAP file itself: no metadata.yaml, no ROS."""
    n_samples, n_standard, n_values = Counter(), Counter(), 0
    stamped = by_stamp(expected)
    with AnyReader([Path(path)]) as reader:
        for connection, _, raw in reader.messages():
            topic, message = connection.topic, reader.deserialize(raw, connection.msgtype)
            if connection.msgtype in STANDARD:
                STANDARD[connection.msgtype](message, stamped)
                n_standard[topic] += 1
                continue
            assert connection.msgtype.startswith(OURS), f"{topic}: {connection.msgtype}"
            comparison = Comparison(words_of(connection.msgdef.data))
            seq = message.header.seq
            comparison.compare(message, expected.line(topic, message.header), f"rosbags: {topic}, seq {seq}")
            n_values += comparison.n_values
            n_samples[topic] += 1
    expected.check_counts("rosbags", n_samples)
    return {"n_samples": n_samples, "n_standard": n_standard, "n_values": n_values}


def main():
    recording, exported = sys.argv[1:]
    expected = Expected(exported)
    print(json.dumps({"mcap": with_mcap(recording, expected), "rosbags": with_rosbags(recording, expected)}))


if __name__ == "__main__":
    main()
