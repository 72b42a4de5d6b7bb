"""Tests of examples/bridges/ros2.py with stand-ins for rclpy and for the source that it feeds."""

import importlib.util
import json
import math
import socket
import sys
import tempfile
import threading
import types
import unittest
from pathlib import Path
from types import SimpleNamespace as Message
from unittest import mock

BRIDGES = Path(__file__).resolve().parents[2] / "examples/bridges"
sys.path.insert(0, str(BRIDGES))
SPEC = importlib.util.spec_from_file_location("ros2_bridge", BRIDGES / "ros2.py")
bridge = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(bridge)

HAND = {"hand": "gripper", "n_joints": 2, "n_cells": 4, "joints": ["jaw", "wrist"]}
TABLE = {
    "joints": {"map": {"jaw": {"from": "finger_joint", "scale": -0.5, "offset": 0.04}}},
    "cells": [
        {"topic": "/left", "type": "my_msgs/msg/Touch", "field": "taxels.force.z", "scale": 0.01},
        {"topic": "/right", "order": [1, 0]},
    ],
    "phase": {"topic": "/status", "type": "my_msgs/msg/Status", "field": "states", "words": {0: "open", 1: "closing", 2: "settled"}},
}
MILLI = 1_000_000


def header(nanos):
    return Message(stamp=Message(sec=nanos // 10**9, nanosec=nanos % 10**9))


def joints(nanos, finger=0.02, wrist=0.1):
    return Message(header=header(nanos), name=["elbow", "finger_joint", "wrist"], position=[9.0, finger, wrist])


def left(nanos, *forces):
    return Message(header=header(nanos), taxels=[Message(force=Message(z=force)) for force in forces])


class Frames(unittest.TestCase):
    def setUp(self):
        self.frames = bridge.Frames(TABLE, HAND)
        self.t = 5 * 10**9

    def send(self, at, right_at=None, states=(2, 2)):
        self.frames.take_phase(Message(states=list(states)), at)
        self.frames.take_cells(1, Message(data=[3.0, 4.0]), right_at or at)
        return self.frames.take_cells(0, left(at, 100, 250), at)

    def test_topics_become_a_frame(self):
        self.assertIsNone(self.send(self.t))
        self.assertEqual(self.frames.lacks(), "no angle of jaw, wrist")
        self.frames.take_joints(joints(self.t), self.t)
        frame = self.send(self.t)
        self.assertAlmostEqual(frame.pop("joints")[0], 0.03)
        # The frame that was not sent has used up a number.
        expected = {"cells_newtons": [1.0, 2.5, 4.0, 3.0], "phase": "settled", "seq": 1, "stamp_nanos": self.t}
        self.assertEqual(frame, expected)

    def test_old_topics_make_no_frame(self):
        self.frames.take_joints(joints(self.t), self.t)
        self.assertIsNotNone(self.send(self.t + 100 * MILLI))
        self.assertIsNone(self.send(self.t + 100 * MILLI, right_at=self.t + 79 * MILLI))
        self.assertIsNone(self.send(self.t + 151 * MILLI))
        self.assertEqual(self.frames.dropped, 2)
        self.assertIn("tolerance_ms", self.frames.lacks())

    def test_the_second_topic_may_come_after_the_first(self):
        self.frames.take_phase(Message(states=[2, 2]), self.t)
        self.frames.take_joints(joints(self.t), self.t)
        for step in range(3):
            # 30 Hz: the right pad of the frame before is more than the tolerance away.
            at = self.t + step * 33 * MILLI
            self.assertIsNone(self.frames.take_cells(0, left(at, 100, 250), at))
            frame = self.frames.take_cells(1, Message(header=header(at), data=[3.0 + step, 4.0]), at + MILLI)
            self.assertEqual((frame["seq"], frame["stamp_nanos"], frame["cells_newtons"][3]), (step, at, 3.0 + step))
        # The right pad is missed: the next frame shows the gap.
        self.assertIsNone(self.frames.take_cells(0, left(at + 33 * MILLI, 1, 2), at + 33 * MILLI))
        at += 66 * MILLI
        self.assertIsNone(self.frames.take_cells(0, left(at, 1, 2), at))
        frame = self.frames.take_cells(1, Message(data=[3.0, 4.0]), at)
        self.assertEqual((frame["seq"], self.frames.dropped), (4, 1))

    def test_a_dead_driver_beside_a_live_arm_is_noticed(self):
        self.frames.take_joints(joints(self.t), self.t)
        later = self.t + 200 * MILLI
        self.frames.take_joints(Message(header=header(later), name=["elbow"], position=[1.0]), later)
        self.assertIsNone(self.send(later))
        self.frames.take_joints(joints(later), later)
        self.assertIsNotNone(self.send(later))
        # The phase is of the last second.
        at = later + 100 * MILLI
        self.frames.take_cells(1, Message(data=[3.0, 4.0]), at)
        self.assertIsNone(self.frames.take_cells(0, left(at, 100, 250), at + 2000 * MILLI))

    def test_a_hand_is_settled_if_all_its_fingers_are(self):
        self.frames.take_joints(joints(self.t), self.t)
        for states, phase in [((0, 0), "open"), ((2, 1), "closing"), ((2, 0), "closing"), ((2, 2), "settled")]:
            self.assertEqual(self.send(self.t, states=states)["phase"], phase)
        with self.assertRaisesRegex(ValueError, "stands for none of open, closing"):
            self.send(self.t, states=(7, 7))
        phase = {"topic": "/phase"}
        frames = bridge.Frames({**TABLE, "phase": phase}, HAND)
        self.assertIn("no phase: no message on /phase", frames.lacks())
        frames.take_phase(Message(data="test_lifted"), self.t)
        self.assertEqual(frames.phase, "test_lifted")

    def test_the_phase_is_inferred_from_the_motion(self):
        # The jaw slides by 10 mm/s, and its value falls: 0.1 rad/s of a hand that closes.
        jaw = {**TABLE["joints"]["map"]["jaw"], "closes": -0.1}
        frames = bridge.Frames({"cells": TABLE["cells"], "joints": {"map": {"jaw": jaw, "wrist": {"closes": 0}}}}, HAND)
        found = []
        for step in range(200):
            # It opens a little first, and its value in the topic falls then.
            finger = max(0, 20 - step) * 0.0002 if step < 50 else min(step - 50, 50) * 0.0002
            frames.take_joints(joints(self.t + step * 10 * MILLI, finger), 0)
            if frames.phase is not None and frames.phase not in found:
                found.append(frames.phase)
        self.assertEqual(found, ["open", "closing", "settled"])

    def test_a_missing_cell_makes_no_frame(self):
        table = {"cells": [{"topic": "/left", "order": [2, 0], "missing": 30000, "scale": 0.5, "offset": -1.0}]}
        frames = bridge.Frames({**table, "joints": {"map": {"jaw": {"from": "finger_joint"}}}}, HAND)
        frames.take_joints(joints(self.t), self.t)
        frames.phase = "settled"
        for number in (30000, math.nan):
            self.assertIsNone(frames.take_cells(0, Message(data=[number, 7.0, 8.0]), self.t))
            self.assertEqual(frames.lacks(), "no message on /left with cell 1")
        # A number that is not picked may be anything.
        frame = frames.take_cells(0, Message(data=[6.0, math.nan, 8.0]), self.t)
        self.assertEqual((frame["cells_newtons"], frame["seq"]), ([3.0, 2.0], 2))

    def test_lists_of_messages_may_have_lists(self):
        sensor = lambda *z: Message(taxels=[Message(z=value) for value in z])
        self.assertEqual(bridge.numbers(bridge.at(Message(sensors=[sensor(1, 2), sensor(3)]), "sensors.taxels.z")), [1, 2, 3])

    def test_joints_come_from_a_field(self):
        table = {"cells": [{"topic": "/left"}], "joints": {"field": "motors.q", "names": ["wrist", "jaw"]}}
        frames = bridge.Frames(table, HAND)
        frames.take_joints(Message(header=header(self.t), motors=[Message(q=0.5), Message(q=0.25)]), self.t)
        self.assertEqual(frames.joints(self.t), [0.25, 0.5])

    def test_an_unknown_joint_is_told(self):
        with self.assertRaisesRegex(ValueError, "the hand has no joint thumb"):
            bridge.Frames({"cells": [], "joints": {"map": {"thumb": {}}}}, HAND)


class Reconnects(unittest.TestCase):
    def test_a_bridge_connects_again_when_the_source_is_another(self):
        with tempfile.TemporaryDirectory() as folder, mock.patch("sys.stderr"):
            path = f"{folder}/tactile.hand"
            source = socket.socket(socket.AF_UNIX)
            source.bind(path)
            source.listen()
            greeted = []

            def greet(hand):
                connection, _ = source.accept()
                connection.sendall(json.dumps(hand).encode() + b"\n")
                greeted.append(connection)

            def sends(hand):
                thread = threading.Thread(target=greet, args=(hand,))
                thread.start()
                # The first frame after the end may still be taken by the kernel.
                for seq in range(3):
                    found.send({"seq": seq})
                thread.join()

            thread = threading.Thread(target=greet, args=(HAND,))
            thread.start()
            found = bridge.line_protocol.Source(f"unix:{path}")
            thread.join()
            greeted.pop().close()
            sends(HAND)
            with greeted.pop() as connection, connection.makefile() as lines:
                self.assertIn("seq", json.loads(lines.readline()))
            with self.assertRaisesRegex(SystemExit, "is now for the hand other"):
                sends({**HAND, "hand": "other"})
            found.connection.close()
            source.close()


class Node:
    """A stand-in for a node of rclpy: it keeps its subscriptions."""

    def __init__(self):
        self.subscriptions = {}

    def create_subscription(self, kind, topic, callback, qos):
        self.subscriptions[topic] = (kind, callback)

    def create_timer(self, period_s, callback, clock):
        pass

    def get_clock(self):
        return Message(now=lambda: Message(nanoseconds=5 * 10**9))


class Bridge(unittest.TestCase):
    def test_it_sends_lines_to_the_source(self):
        node, t = Node(), 5 * 10**9

        def spin(_):
            calls = {topic: callback for topic, (_, callback) in node.subscriptions.items()}
            calls["/joint_states"](joints(t))
            calls["/status"](Message(states=[2]))
            calls["/right"](Message(data=[3.0, 4.0]))
            calls["/left"](left(t, 100, 250))

        rclpy = types.ModuleType("rclpy")
        rclpy.init, rclpy.try_shutdown, rclpy.ok = lambda: None, lambda: None, lambda: True
        rclpy.create_node, rclpy.spin = lambda name: node, spin
        qos = types.ModuleType("rclpy.qos")
        qos.qos_profile_sensor_data = qos.DurabilityPolicy = qos.QoSProfile = None
        clock = types.ModuleType("rclpy.clock")
        clock.Clock = Message
        modules = {"rclpy": rclpy, "rclpy.qos": qos, "rclpy.clock": clock}
        with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX) as source:
            path = f"{folder}/tactile.hand"
            source.bind(path)
            source.listen()
            lines = []

            def serve():
                connection, _ = source.accept()
                connection.sendall(json.dumps(HAND).encode() + b"\n")
                with connection, connection.makefile() as sent:
                    lines.append(json.loads(sent.readline()))

            thread = threading.Thread(target=serve)
            thread.start()
            classes = mock.patch.object(bridge, "message_class", lambda kind: kind)
            with mock.patch.dict(sys.modules, modules), mock.patch("sys.stderr"), classes:
                bridge.bridge(TABLE, f"unix:{path}")
            thread.join()
        self.assertEqual(lines[0]["cells_newtons"], [1.0, 2.5, 4.0, 3.0])
        self.assertEqual((lines[0]["phase"], lines[0]["seq"]), ("settled", 0))
        kinds = {topic: kind for topic, (kind, _) in node.subscriptions.items()}
        self.assertEqual(kinds["/right"], "std_msgs/msg/Float64MultiArray")
        self.assertEqual(kinds["/joint_states"], "sensor_msgs/msg/JointState")


if __name__ == "__main__":
    unittest.main()
