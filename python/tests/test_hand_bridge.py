"""Tests of the node `hand` of examples/blindgrasp_ros and of line_protocol.py with stand-ins for rclpy and for the source that they feed."""

import contextlib
import importlib.util
import io
import json
import math
import os
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import types
import unittest
from pathlib import Path
from types import SimpleNamespace as Message
from unittest import mock

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
BRIDGES = EXAMPLES / "bridges"
sys.path.insert(0, str(EXAMPLES / "blindgrasp_ros"))
from blindgrasp_ros import hand as bridge  # noqa: E402

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
        self.assertEqual(dict(self.frames.dropped), {"no angle of jaw, wrist within 150 ms": 1})
        self.frames.take_joints(joints(self.t), self.t)
        frame = self.send(self.t)
        self.assertAlmostEqual(frame.pop("joints")[0], 0.03)
        # The frame that was not sent has used up a number.
        expected = {"cells_newtons": [1.0, 2.5, 4.0, 3.0], "phase": "settled", "seq": 1, "stamp_nanos": self.t}
        self.assertEqual(frame, expected)

    def test_a_name_twice_in_a_message_is_refused(self):
        twice = Message(header=header(self.t), name=["wrist", "wrist"], position=[0.1, 0.2])
        with self.assertRaisesRegex(ValueError, "the name wrist stands in a message twice"):
            self.frames.take_joints(twice, self.t)

    def test_old_topics_make_no_frame(self):
        self.frames.take_joints(joints(self.t), self.t)
        self.assertIsNotNone(self.send(self.t + 100 * MILLI))
        self.assertIsNone(self.send(self.t + 100 * MILLI, right_at=self.t + 79 * MILLI))
        self.assertIsNone(self.send(self.t + 151 * MILLI))
        # Each cause has a count.
        expected = {"cells on /right more than 20 ms apart (tolerance_ms)": 1, "no angle of jaw, wrist within 150 ms": 1}
        self.assertEqual(dict(self.frames.dropped), expected)

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
        self.assertEqual((frame["seq"], self.frames.dropped.total()), (4, 1))

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
        self.assertIn("a phase on /status older than 1000 ms (max_age_ms)", self.frames.dropped)

    def test_a_hand_is_settled_if_all_its_fingers_are(self):
        self.frames.take_joints(joints(self.t), self.t)
        for states, phase in [((0, 0), "open"), ((2, 1), "closing"), ((2, 0), "closing"), ((2, 2), "settled")]:
            self.assertEqual(self.send(self.t, states=states)["phase"], phase)
        with self.assertRaisesRegex(ValueError, "stands for none of open, closing"):
            self.send(self.t, states=(7, 7))
        phase = {"topic": "/phase"}
        frames = bridge.Frames({**TABLE, "phase": phase}, HAND)
        frames.take_joints(joints(self.t), self.t)
        frames.take_cells(0, left(self.t, 1, 2), self.t)
        self.assertIn("no phase: no message on /phase", frames.dropped)
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
        self.assertEqual(dict(frames.dropped), {"no message on /left with cell 1": 2})
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
        with self.assertRaisesRegex(ValueError, "names: 2 names, but `field` has 3 values"):
            frames.take_joints(Message(motors=[Message(q=0.5)] * 3), self.t)

    def test_a_joint_that_two_nodes_send_makes_no_frame(self):
        self.frames.take_joints(joints(self.t), self.t, sender="driver")
        self.frames.take_joints(Message(name=["elbow"], position=[1.0]), self.t, sender="arm")
        self.assertIsNotNone(self.send(self.t))
        self.frames.take_joints(joints(self.t), self.t, sender="simulation")
        self.assertIsNone(self.send(self.t))
        self.assertEqual(dict(self.frames.dropped), {"two nodes send the joint wrist: stop one": 1})
        # One of them has ended.
        later = self.t + 2000 * MILLI
        self.frames.take_joints(joints(later), later, sender="simulation")
        self.assertIsNotNone(self.send(later))

    def test_a_frame_has_the_senses_that_the_table_names(self):
        table = {**TABLE, "wrench": {"topic": "/wrench"}, "imu": {"topic": "/imu"}}
        self.frames = bridge.Frames(table, HAND)
        self.frames.take_joints(joints(self.t), self.t)
        vector = lambda *values: Message(**dict(zip("xyz", values)))
        wrench = Message(header=header(self.t), wrench=Message(force=vector(1.0, 2.0, 3.0), torque=vector(4.0, 5.0, 6.0)))
        self.assertIsNone(self.send(self.t))
        self.frames.take_wrench(wrench, self.t)
        self.frames.take_imu(Message(header=header(self.t), linear_acceleration=vector(0.0, 0.0, 9.8)), self.t)
        frame = self.send(self.t)
        self.assertEqual((frame["wrist_wrench"], frame["gravity_m_per_s2"]), ([1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [-0.0, -0.0, -9.8]))
        self.assertIsNone(self.send(self.t + 30 * MILLI))
        self.assertEqual(self.frames.dropped["no message on /wrench within 20 ms (tolerance_ms)"], 2)

    def test_transforms_tell_gravity_while_they_are_new(self):
        self.frames = bridge.Frames({**TABLE, "gravity": {"frame": "world", "palm": "palm"}}, HAND)
        turned = 0.5**0.5

        def transform(parent, child, nanos, x=0.0, z=0.0):
            rotation = Message(x=x, y=0.0, z=z, w=turned)
            kept = Message(header=Message(stamp=header(nanos).stamp, frame_id=parent), child_frame_id=child)
            kept.transform = Message(rotation=rotation)
            return Message(transforms=[kept])

        def gravity(at):
            self.frames.take_joints(joints(at), at)
            frame = self.send(at)
            return frame and [round(value, 6) + 0.0 for value in frame["gravity_m_per_s2"]]

        # The arm is turned by 90 degrees about x; the palm is fixed to it, turned by 90 degrees about z.
        self.frames.take_transforms(transform("arm", "palm", 0, z=turned), self.t, "b", True)
        self.assertIsNone(gravity(self.t))
        self.frames.take_transforms(transform("world", "arm", self.t, x=turned), self.t, "a", False)
        self.assertEqual(gravity(self.t + 100 * MILLI), [-9.81, 0.0, 0.0])
        self.assertIsNone(gravity(self.t + 1000 * MILLI))
        self.assertEqual(self.frames.dropped["no transforms from palm up to world, each from one node and within 100 ms"], 2)
        later = self.t + 1000 * MILLI
        self.frames.take_transforms(transform("world", "arm", later, x=turned), later, "c", False)
        self.assertIsNone(gravity(later))
        self.assertEqual(self.frames.dropped["two nodes send the transform of arm: stop one"], 1)
        later += 2000 * MILLI
        self.frames.take_transforms(transform("world", "arm", later, x=turned), later, "c", False)
        self.assertEqual(gravity(later), [-9.81, 0.0, 0.0])

    def test_cells_come_as_pixels_and_points(self):
        image = Message(encoding="16UC1", is_bigendian=0, height=2, width=2, step=6, data=[1, 0, 2, 1, 9, 9, 3, 0, 4, 0])
        self.assertEqual(bridge.packed(image, "data"), [1.0, 258.0, 3.0, 4.0])
        fields = [Message(name="x", offset=0, datatype=7), Message(name="force", offset=4, datatype=8)]
        data = b"".join(struct.pack(">fd", 9.0, force) for force in (0.5, -1.5))
        cloud = Message(fields=fields, is_bigendian=True, height=1, width=2, point_step=12, row_step=24, data=data)
        self.assertEqual(bridge.packed(cloud, "force"), [0.5, -1.5])
        for field, data in [("other", data), ("force", data[:-1])]:
            with self.assertRaisesRegex(ValueError, "a field of the PointCloud2|23 bytes for 1 x 2"):
                bridge.packed(Message(**{**vars(cloud), "data": data}), field)
        self.frames = bridge.Frames({"cells": [{"topic": "/skin", "type": "sensor_msgs/msg/Image", "scale": 0.5}]}, HAND)
        self.frames.take_cells(0, image, self.t)
        self.assertEqual(self.frames.cells[0][0], [0.5, 129.0, 1.5, 2.0])

    def test_mistakes_in_the_table_are_told(self):
        cells = {"topic": "/left"}
        for table, expected in [
            ([], "the table: [], expected a mapping with joints, cells"),
            ({}, "the table: `cells` is missing"),
            ({"cells": cells}, "the table: cells: {'topic': '/left'}, expected a list of topics"),
            ({"cells": [cells], "tolerence_ms": 1}, "the table: unknown key `tolerence_ms`, expected joints, cells, phase, wrench, imu, gravity, tolerance_ms"),
            ({"cells": [cells, {**cells, "scael": 0.01}]}, "cells[1]: unknown key `scael`, expected topic, type, field"),
            ({"cells": [{"type": "my_msgs/msg/Touch"}]}, "cells[0]: `topic` is missing"),
            ({"cells": [{**cells, "type": "my_msgs/Touch"}]}, "cells[0]: type: 'my_msgs/Touch', expected a type such as"),
            ({"cells": [{**cells, "order": []}]}, "cells[0]: order: [], expected a list of places, from 0 on"),
            ({"cells": [{**cells, "order": [0, -1]}]}, "cells[0]: order: [0, -1], expected a list of places"),
            ({"cells": [{**cells, "scale": "1e-3"}]}, "cells[0]: scale: '1e-3', expected a number"),
            ({"cells": [cells], "joints": {"field": "data"}}, "joints: only one of `field` and `names`"),
            ({"cells": [cells], "joints": {"field": "data", "names": ["jaw"]}}, "joints: names: wrist is missing"),
            ({"cells": [cells], "joints": {"map": {"jaw": {"form": "x"}}}}, "joints: map: jaw: unknown key `form`"),
            ({"cells": [cells], "joints": {"map": {"thumb": {}}}}, "joints: map: the hand has no joint thumb, but jaw, wrist"),
            ({"cells": [cells], "phase": {"topic": "/p", "words": {0: "opened"}}}, "phase: words: {0: 'opened'}, expected a mapping to open"),
        ]:
            with self.subTest(expected), self.assertRaises(ValueError) as raised:
                bridge.Frames(table, HAND)
            self.assertEqual(str(raised.exception)[: len(expected)], expected)

    def test_types_and_fields_that_are_not_there_are_told(self):
        module = types.ModuleType("my_msgs.msg")
        module.Touch = lambda: Message(taxels=[], name="", force=Message(z=0.0))
        with mock.patch.dict(sys.modules, {"my_msgs": types.ModuleType("my_msgs"), "my_msgs.msg": module}):
            self.assertIs(bridge.message_class("cells[0]", "my_msgs/msg/Touch", "taxels.z"), module.Touch)
            with self.assertRaisesRegex(ValueError, r"cells\[0\]: field: force.y: .*no attribute 'y'.*ros2 interface show"):
                bridge.message_class("cells[0]", "my_msgs/msg/Touch", "force.y")
            with self.assertRaisesRegex(ValueError, r"phase: type: no my_msgs/msg/Status .*source the workspace"):
                bridge.message_class("phase", "my_msgs/msg/Status", "data")
        with self.assertRaisesRegex(ValueError, r"cells\[1\]: type: no other_msgs/msg/Touch .*source the workspace"):
            bridge.message_class("cells[1]", "other_msgs/msg/Touch", "data")
        with self.assertRaisesRegex(ValueError, "it is the text '12', expected numbers"):
            bridge.numbers("12")


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
                # While nobody answers, frames are lost, and the bridge does not wait.
                while found.send({"seq": 0}):
                    pass
                self.assertFalse(found.send({"seq": 1}))
                greet(hand)
                while not found.send({"seq": 2}):
                    time.sleep(0.01)

            thread = threading.Thread(target=greet, args=(HAND,))
            thread.start()
            found = bridge.line_protocol.Source(f"unix:{path}")
            thread.join()
            greeted.pop().close()
            sends(HAND)
            with greeted.pop() as connection, connection.makefile() as lines:
                self.assertEqual(json.loads(lines.readline()), {"seq": 2})
            with self.assertRaisesRegex(SystemExit, "is now for the hand other"):
                sends({**HAND, "hand": "other"})
            thread = threading.Thread(target=greet, args=(HAND,))
            thread.start()
            with self.assertRaisesRegex(SystemExit, "the hand gripper, this bridge for left"):
                bridge.line_protocol.Source(f"unix:{path}", hand="left")
            thread.join()
            source.close()

    def test_a_socket_is_sought_in_the_folders_of_this_user(self):
        with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX) as source, mock.patch("sys.stderr"):
            folders = [f"{folder}/{name}" for name in ("absent", "open", "empty", "own")]
            for path in folders[1:]:
                os.mkdir(path, 0o700)
            os.chmod(folders[1], 0o755)
            source.bind(f"{folders[3]}/left.hand")
            source.listen()
            right = socket.socket(socket.AF_UNIX)
            right.bind(f"{folders[3]}/right.hand")
            tactile_bridge = importlib.util.spec_from_file_location("tactile_bridge", BRIDGES.parent / "tactile_bridge.py")
            copied = importlib.util.module_from_spec(tactile_bridge)
            tactile_bridge.loader.exec_module(copied)
            self.assertEqual(copied.SOCKET_FOLDERS, bridge.line_protocol.SOCKET_FOLDERS)
            for module in (bridge.line_protocol, copied):
                with mock.patch.object(module, "SOCKET_FOLDERS", [*folders[:3], f"{folder}/o?n"]):
                    found = [f"unix:{folders[3]}/{name}.hand" for name in ("left", "right")]
                    self.assertEqual(list(module.own_sockets("*")), found)
                    # The right hand's graph has died.
                    with module.connect(None) as connection:
                        self.assertEqual(connection.getpeername(), f"{folders[3]}/left.hand")
            right.listen()
            for module in (bridge.line_protocol, copied):
                with mock.patch.object(module, "SOCKET_FOLDERS", [f"{folder}/o?n"]):
                    with module.connect("right") as connection:
                        self.assertEqual(connection.getpeername(), f"{folders[3]}/right.hand")
                    with self.assertRaisesRegex(SystemExit, "^2 graphs take frames, at .*: name one with --graph NAME$"):
                        module.connect(None)
            right.close()

    def test_a_table_that_cannot_be_used_is_refused(self):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "table.yaml")
            for text, says in ((None, "No such file"), ("cells: [", "expected"), ("cells: [{}]", r"cells\[0\]: `topic` is missing")):
                if text is not None:
                    path.write_text(text)
                with self.assertRaisesRegex(ValueError, says):
                    bridge.read_table(path)

    def test_signals_end_a_bridge_that_waits_for_a_source(self):
        work = "import line_protocol; line_protocol.run(lambda: line_protocol.Source('unix:/nowhere'))"
        for number in (signal.SIGINT, signal.SIGTERM):
            # A shell ignores SIGINT for what it runs in the background, these tests for example.
            heard = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)
            command = [sys.executable, "-c", work]
            waits = subprocess.Popen(command, cwd=BRIDGES, stderr=subprocess.PIPE, text=True, preexec_fn=heard)
            self.assertIn("trying again", waits.stderr.readline())
            waits.send_signal(number)
            self.assertEqual((waits.communicate(timeout=60)[1].count("Traceback"), waits.returncode), (0, 0))


class Node:
    """A stand-in for a node of rclpy: it keeps its subscriptions. A second node publishes the topics of `shared`."""

    def __init__(self):
        self.subscriptions, self.shared = {}, []

    def create_subscription(self, kind, topic, callback, qos):
        self.subscriptions[topic] = (kind, callback)
        return Message(topic_name=topic)

    def count_publishers(self, topic):
        return 2 if topic in self.shared else 1

    def create_timer(self, period_s, callback, clock):
        pass

    def get_clock(self):
        return Message(now=lambda: Message(nanoseconds=5 * 10**9))


class Bridge(unittest.TestCase):
    """The bridge with a source that reads the lines of one connection; `info` is what rclpy says of a message beside it."""

    def run_bridge(self, spin, distribution="kilted"):
        """The lines that the source has got when `spin` is over, and what the bridge said."""
        self.node = Node()
        executor = Message(add_node=None)
        rclpy = types.ModuleType("rclpy")
        rclpy.init, rclpy.try_shutdown, rclpy.ok = lambda: None, lambda: None, lambda: True
        rclpy.create_node, rclpy.spin = lambda name: self.node, lambda node, executor: spin(executor)
        qos, clock = types.ModuleType("rclpy.qos"), mock.MagicMock(__name__="rclpy.clock")
        qos.qos_profile_sensor_data = qos.DurabilityPolicy = qos.QoSProfile = None
        executors, subscription = types.ModuleType("rclpy.executors"), types.ModuleType("rclpy.subscription")
        executors.SingleThreadedExecutor = lambda: executor
        subscription.Subscription = Message() if distribution == "humble" else Message(CallbackType=None)
        modules = {module.__name__: module for module in (rclpy, qos, clock, executors, subscription)}
        lines = []
        with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX) as source:
            source.bind(f"{folder}/tactile.hand")
            source.listen()

            def serve():
                connection, _ = source.accept()
                connection.sendall(json.dumps(HAND).encode() + b"\n")
                with connection, connection.makefile() as sent:
                    lines.extend(json.loads(line) for line in sent)

            thread = threading.Thread(target=serve)
            thread.start()
            with mock.patch("sys.stderr"):
                self.source = bridge.line_protocol.Source(f"unix:{folder}/tactile.hand")
            classes = mock.patch.object(bridge, "message_class", lambda where, kind, field: kind)
            said = io.StringIO()
            with mock.patch.dict(sys.modules, modules), contextlib.redirect_stderr(said), classes:
                bridge.bridge(TABLE, self.source)
            self.source.connection.shutdown(socket.SHUT_RDWR)
            self.source.connection.close()
            thread.join()
        return lines, said.getvalue()

    def send(self, waited_ms=0, has_header=False, came="received_timestamp"):
        """A message on each topic. It waited so long for the bridge."""
        t = self.node.get_clock().now().nanoseconds
        info = {"received_timestamp": 0, "source_timestamp": 1, came: time.time_ns() - waited_ms * MILLI}
        calls = {topic: callback for topic, (_, callback) in self.node.subscriptions.items()}
        cells = left(t, 100, 250)
        if not has_header:
            del cells.header
        calls["/joint_states"](joints(t), info)
        calls["/status"](Message(states=[2]), info)
        calls["/right"](Message(data=[3.0, 4.0]), info)
        calls["/left"](cells, info)

    def test_it_sends_lines_to_the_source(self):
        [line], _ = self.run_bridge(lambda _: self.send(has_header=True))
        self.assertEqual(line["cells_newtons"], [1.0, 2.5, 4.0, 3.0])
        self.assertEqual((line["phase"], line["seq"], line["stamp_nanos"]), ("settled", 0, 5 * 10**9))
        kinds = {topic: kind for topic, (kind, _) in self.node.subscriptions.items()}
        self.assertEqual(kinds["/right"], "std_msgs/msg/Float64MultiArray")
        self.assertEqual(kinds["/joint_states"], "sensor_msgs/msg/JointState")

    def test_a_message_without_a_header_has_the_time_at_which_it_came(self):
        for came in ("received_timestamp", "source_timestamp"):
            [line], _ = self.run_bridge(lambda _, came=came: self.send(waited_ms=100, came=came))
            waited_ms = (5 * 10**9 - line["stamp_nanos"]) / MILLI
            # The node's clock stands still, that of the messages does not.
            self.assertTrue(100 <= waited_ms < 150, waited_ms)

    def test_messages_that_waited_are_not_sent(self):
        def spin(_):
            self.send(waited_ms=8000)
            self.send(waited_ms=8000, has_header=True)
            with mock.patch("time.monotonic", lambda: 1e9):
                self.send()

        [line], said = self.run_bridge(spin)
        self.assertEqual(line["seq"], 2)
        self.assertIn("2 frames not sent: 2: a message on /left waited longer than 150 ms for the bridge", said)

    def test_topics_of_two_nodes_are_not_mixed(self):
        def spin(_):
            for topic in ("/left", "/right", "/status"):
                self.node.shared = [topic]
                self.send()
            # Joint states usually come from several nodes.
            self.node.shared = ["/joint_states"]
            with mock.patch("time.monotonic", lambda: 1e9):
                self.send()

        [line], said = self.run_bridge(spin)
        self.assertEqual(line["seq"], 3)
        self.assertIn("3 frames not sent: 1: several nodes publish /left", said)
        self.assertIn("several nodes publish /status", said)

    def test_in_humble_the_executor_hands_over_the_times(self):
        def spin(executor):
            t, info = 5 * 10**9, {"received_timestamp": time.time_ns(), "source_timestamp": 1}
            sent = {"/joint_states": joints(t), "/status": Message(states=[2]), "/right": Message(data=[3.0, 4.0]), "/left": left(t, 1, 2)}
            for topic, message in sent.items():
                handle = Message(take_message=lambda kind, is_raw, message=message: (message, info))
                taken = executor._take_subscription(Message(handle=handle, msg_type=None))
                # The executor calls back with what it took.
                self.node.subscriptions[topic][1](taken)

        [line], _ = self.run_bridge(spin, "humble")
        self.assertEqual(line["stamp_nanos"], 5 * 10**9)

    def test_frames_without_a_source_are_counted(self):
        def spin(_):
            self.send()
            with mock.patch.object(self.source, "send", lambda _: False), mock.patch("time.monotonic", lambda: 1e9):
                self.send()

        lines, said = self.run_bridge(spin)
        self.assertEqual(len(lines), 1)
        self.assertIn("1 frames not sent: 1: no connection to the source", said)


if __name__ == "__main__":
    unittest.main()
