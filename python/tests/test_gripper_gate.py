"""Tests of examples/ros2_gripper_gate.py, with stand-ins for rclpy, control_msgs and the gripper's controller."""

import importlib.util
import json
import queue
import sys
import time
import types
import unittest
from pathlib import Path
from types import SimpleNamespace as Message
from unittest import mock

EXAMPLE = Path(__file__).resolve().parents[2] / "examples/ros2_gripper_gate.py"
SPEC = importlib.util.spec_from_file_location("ros2_gripper_gate", EXAMPLE)
example = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(example)


class Lines:
    """The lines of a graph, as the test says them."""

    def __init__(self):
        self.queue = queue.Queue()

    def say(self, action, valid_for_s=10, reason="told"):
        valid_until = example.boottime_nanos() + int(valid_for_s * 1e9)
        self.queue.put(json.dumps({"action": action, "reason": reason, "valid_until_nanos": valid_until}))

    def __iter__(self):
        return iter(self.queue.get, None)


class Gate(unittest.TestCase):
    def setUp(self):
        self.lines = Lines()
        self.decisions = example.Decisions(self.lines)
        self.addCleanup(self.lines.queue.put, None)
        self.gate = example.Gate(self.decisions, grasps_below=0.03, wait_s=20)

    def close(self, *actions, **how):
        """Closes the hand; the graph decides then."""

        def close():
            for action in actions:
                self.lines.say(action, **how)
            return True

        return self.gate.run(0.0, close)

    def test_only_a_fresh_lift_succeeds(self):
        self.assertEqual(self.close("lift", reason="stable"), (True, "stable"))
        self.assertEqual(self.close("hold", reason="unstable"), (False, "unstable"))
        self.assertEqual(self.close("lift", valid_for_s=-1), (False, "no longer valid"))
        self.assertEqual(self.close("test_lift", "hold"), (False, "told"))
        # The lift of a later grasp does not count.
        self.assertEqual(self.close("hold", "lift"), (False, "told"))

    def test_a_decision_of_an_earlier_grasp_does_not_count(self):
        self.lines.say("lift")
        while not self.decisions.waiting:
            time.sleep(0.001)
        self.gate.wait_s = 0.05
        self.assertEqual(self.close(), (False, "no decision within 0.05 s"))

    def test_opening_needs_no_decision_and_a_failed_close_is_none(self):
        self.assertEqual(self.gate.run(0.08, lambda: True), (True, "no grasp"))
        self.assertEqual(self.gate.run(0.0, lambda: False), (False, "the controller did not succeed"))

    def test_a_graph_that_ends_aborts(self):
        self.lines.queue.put("grasp 3 HOLD")
        self.lines.queue.put(None)
        self.assertEqual(self.close(), (False, "the graph has ended"))

    def test_the_server_ends_goals_as_the_gate_says(self):
        served = {}

        class Future:
            def __init__(self, result):
                self.found = result

            def add_done_callback(self, callback):
                callback(self)

            def result(self):
                return self.found

        class Client:
            def __init__(self, node, kind, name):
                served["controller"] = name

            def wait_for_server(self, timeout_sec):
                return True

            def send_goal_async(self, goal):
                stalled = Message(result=Message(reached_goal=False, stalled=True))
                return Future(Message(accepted=True, get_result_async=lambda: Future(stalled)))

        def server(node, kind, name, execute):
            served["name"], served["execute"] = name, execute

        def spin(node, executor):
            for action, position in [("lift", 0.0), ("hold", 0.0), (None, 0.08)]:
                ends = []
                command = Message(position=position)
                handle = Message(request=Message(command=command), succeed=lambda: ends.append(True), abort=lambda: ends.append(False))
                # The graph decides while the hand closes.
                sender = Client.send_goal_async

                def send(self, goal, action=action, sender=sender):
                    if action:
                        lines.say(action)
                    return sender(self, goal)

                with mock.patch.object(Client, "send_goal_async", send):
                    result = served["execute"](handle)
                served.setdefault("ends", []).extend(ends)
                self.assertTrue(result.stalled)

        lines = self.lines
        rclpy = types.ModuleType("rclpy")
        logger = Message(info=lambda text: None)
        rclpy.init, rclpy.try_shutdown, rclpy.spin = lambda: None, lambda: None, spin
        rclpy.create_node = lambda name: Message(get_logger=lambda: logger)
        action, executors = types.ModuleType("rclpy.action"), types.ModuleType("rclpy.executors")
        action.ActionClient, action.ActionServer, executors.MultiThreadedExecutor = Client, server, object
        control, actions = types.ModuleType("control_msgs"), types.ModuleType("control_msgs.action")
        actions.GripperCommand = actions.ParallelGripperCommand = Message(Result=Message)
        modules = {"rclpy": rclpy, "rclpy.action": action, "rclpy.executors": executors}
        modules.update({"control_msgs": control, "control_msgs.action": actions})
        arguments = Message(parallel=False, controller="/gripper/cmd", grasps_below=0.03, wait=20.0)
        with mock.patch.dict(sys.modules, modules):
            example.serve(arguments, self.decisions)
        self.assertEqual(served["ends"], [True, False, True])
        self.assertEqual((served["name"], served["controller"]), ("/grasp_gate/gripper_cmd", "/gripper/cmd"))


if __name__ == "__main__":
    unittest.main()
