"""Tests of the gates of examples/blindgrasp_ros, with stand-ins for rclpy, control_msgs and the gripper's controller."""

import importlib
import math
import sys
import threading
import time
import types
import unittest
from pathlib import Path
from types import SimpleNamespace as Message
from unittest import mock

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "examples/blindgrasp_ros"))
from blindgrasp_ros import gripper_gate as example  # noqa: E402

# By their codes in Decision.msg.
ACTIONS = ("hold", "lift", None, "squeeze", "test_lift", "tighten", "set_down", "go_on")


def time_in(seconds):
    sec, nanosec = divmod(time.time_ns() + int(seconds * 1e9), 10**9)
    return Message(sec=sec, nanosec=nanosec)


class Said:
    """The topic of decisions, as the test says them."""

    def __init__(self, decisions):
        self.decisions, self.grasp_id = decisions, 0

    def say(self, action, valid_for_s=10, reason="told", grasp_id=None, ahead_s=0):
        code = ACTIONS.index(action)
        if code not in example.UNDECIDED:
            self.grasp_id += 1
        stamp, valid_until = time_in(ahead_s), time_in(valid_for_s)
        grasp_id = self.grasp_id if grasp_id is None else grasp_id
        self.decisions.take(Message(action=code, reason=reason, grasp_id=grasp_id, stamp=stamp, valid_until=valid_until))


class Gate(unittest.TestCase):
    def setUp(self):
        self.decisions = example.Decisions()
        self.lines = Said(self.decisions)
        self.gate = example.Gate(self.decisions, lambda position: position < 0.03, wait_s=20)

    def close(self, *actions, **how):
        """Closes the hand; the graph decides then."""

        def move():
            # The graph decides when the hand has closed.
            threading.Timer(0.05, lambda: [self.lines.say(action, **how) for action in actions]).start()
            return False, True

        return self.gate.run(0.0, move)

    def test_only_a_fresh_lift_succeeds(self):
        self.assertEqual(self.close("lift", reason="stable"), (True, "stable"))
        self.assertEqual(self.close("hold", reason="unstable"), (False, "unstable"))
        succeeds, why = self.close("lift", valid_for_s=-1)
        self.assertEqual((succeeds, why[:22]), (False, "LIFT was valid until 1"))
        self.assertNotIn("stall_timeout", why)
        self.assertEqual(self.close("test_lift", "hold"), (False, "told"))
        succeeds, why = self.close("lift", ahead_s=1)
        self.assertFalse(succeeds)
        self.assertRegex(why, "stamp lies .* ms in the future: a clock was set back")
        # A hand that closed again: the hold of the later grasp counts.
        self.assertEqual(self.close("lift", "hold"), (False, "told"))

    def test_a_late_hold_of_the_grasp_before_does_not_end_this_one(self):
        def move():
            self.lines.say("hold")
            threading.Timer(0.05, lambda: self.lines.say("lift", reason="stable")).start()
            return True, False

        self.assertEqual(self.gate.run(0.0, move), (True, "stable"))

    def test_a_lift_that_ended_before_the_controller_did_says_why(self):
        def move():
            self.lines.say("lift", valid_for_s=0.02)
            time.sleep(0.1)
            # The node of decisions takes it back.
            self.lines.say("hold", reason="stale", grasp_id=self.lines.grasp_id)
            return False, True

        succeeds, why = self.gate.run(0.0, move)
        self.assertFalse(succeeds)
        self.assertIn("needs a shorter stall_timeout", why)

    def test_a_decision_of_an_earlier_grasp_does_not_count(self):
        self.lines.say("lift")
        self.gate.wait_s = 0.05
        self.assertEqual(self.close(), (False, "no decision within 0.05 s"))
        self.gate.wait_s = 0.3
        self.assertEqual(self.close("lift", grasp_id=1), (False, "no decision within 0.3 s"))

    def test_opening_needs_no_decision_and_a_failed_close_is_none(self):
        self.assertEqual(self.gate.run(0.08, lambda: (True, False)), (True, "no grasp"))
        # A hand that is stuck as it opens still holds the object.
        self.assertEqual(self.gate.run(0.08, lambda: (False, True)), (False, "the controller did not succeed"))
        self.assertEqual(self.gate.run(0.0, lambda: (False, False)), (False, "the controller did not succeed"))
        opposite = example.grasps(Message(grasps_below=None, grasps_above=0.5))
        self.assertEqual([opposite(0.7), opposite(0.1)], [True, False])

    def test_a_graph_that_ends_aborts_and_the_next_one_counts_anew(self):
        self.lines.say("lift", grasp_id=7)
        self.assertEqual(self.close("lift", "hold", reason="no_graph"), (False, "the graph has ended"))
        self.lines.grasp_id = -1
        self.assertEqual(self.close("lift", reason="stable"), (True, "stable"))

    def test_a_cancel_ends_the_wait_for_a_decision(self):
        self.gate.wait_s = 3600
        cancelled = iter([False, True])
        found = self.gate.run(0.0, lambda: (True, False), lambda: next(cancelled))
        self.assertEqual(found, (False, "cancelled"))

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

            def server_is_ready(self):
                return True

            def send_goal_async(self, goal):
                answer = Message(status=example.SUCCEEDED, result=Message(stalled=True))
                return Future(Message(accepted=True, get_result_async=lambda: Future(answer)))

        def server(node, kind, name, execute, goal_callback, cancel_callback):
            served["name"], served["execute"], served["take"] = name, execute, goal_callback
            self.assertEqual(cancel_callback(None), "accept")

        def take(position):
            return served["take"](Message(command=Message(position=position)))

        def spin(node, executor):
            self.assertEqual([take(0.0), take(math.nan), take(math.inf)], ["accept", "reject", "reject"])
            arguments.parallel = True
            self.assertEqual([take([0.0]), take([]), take([0.0, math.nan])], ["accept", "reject", "reject"])
            arguments.parallel = False
            # Nobody decides, or two graphs do: the hand may open only.
            for served["publishers"] in (0, 2):
                self.assertEqual([take(0.0), take(0.08)], ["reject", "accept"])
            self.assertIn("2 nodes publish /blindgrasp/decision, expected one: stop all but one", told[-1])
            for action, position, n in [("lift", 0.0, 1), ("hold", 0.0, 1), (None, 0.08, 2), ("lift", 0.0, 2)]:
                served["publishers"] = n
                ends = []
                command = Message(position=position)
                handle = Message(
                    request=Message(command=command),
                    is_cancel_requested=False,
                    succeed=lambda: ends.append(True),
                    abort=lambda: ends.append(False),
                )
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
            raise KeyboardInterrupt

        def subscribe(kind, topic, take, qos):
            self.assertEqual(topic, "/blindgrasp/decision")
            lines.decisions = take.__self__

        lines, served["publishers"] = self.lines, 1
        rclpy = types.ModuleType("rclpy")
        told = []
        logger = Message(info=told.append, warning=told.append)
        rclpy.init, rclpy.try_shutdown, rclpy.ok = lambda: None, lambda: None, lambda: True
        node = mock.Mock(get_logger=lambda: logger, create_subscription=subscribe, count_publishers=lambda topic: served["publishers"])
        rclpy.create_node, rclpy.spin = lambda name: node, spin
        action, executors = types.ModuleType("rclpy.action"), types.ModuleType("rclpy.executors")
        action.ActionClient, action.ActionServer = Client, server
        executors.MultiThreadedExecutor = Message
        action.GoalResponse = Message(ACCEPT="accept", REJECT="reject")
        action.CancelResponse = Message(ACCEPT="accept")
        control, actions = types.ModuleType("control_msgs"), types.ModuleType("control_msgs.action")
        actions.GripperCommand, control.action = Message(Result=Message), actions
        modules = {"rclpy": rclpy, "rclpy.action": action, "rclpy.executors": executors, "rclpy.qos": mock.MagicMock()}
        modules.update({"control_msgs": control, "control_msgs.action": actions})
        modules.update({name: mock.MagicMock() for name in ("rclpy.clock", "blindgrasp_msgs", "blindgrasp_msgs.msg")})
        arguments = Message(
            parallel=False, controller="/gripper/cmd", grasps_below=0.03, grasps_above=None, wait=0.3, name="grasp_gate",
            decisions="/blindgrasp/decision")
        with mock.patch.dict(sys.modules, modules):
            example.serve(arguments)
        self.assertEqual(served["ends"], [True, False, True, False])
        self.assertEqual((served["name"], served["controller"]), ("~/gripper_cmd", "/gripper/cmd"))

    def test_a_goal_of_the_parallel_gripper_may_have_no_position(self):
        self.assertEqual(example.positions_of(Message(position=[]), True), [])
        self.assertEqual(example.positions_of(Message(position=[0.1, 0.2]), True), [0.1, 0.2])
        self.assertEqual(example.positions_of(Message(position=0.1), False), [0.1])


class LiftGate(unittest.TestCase):
    """The gate of the arm, with stand-ins for rclpy and the messages."""

    def test_a_grasp_is_lifted_once_in_a_run_of_the_graph(self):
        modules = {name: mock.MagicMock() for name in ("rclpy", "rclpy.qos", "rclpy.node")}
        modules.update({name: mock.MagicMock() for name in ("blindgrasp_msgs", "blindgrasp_msgs.msg")})
        modules["rclpy.node"].Node = object
        kind = Message(HOLD=0, LIFT=1, TIGHTEN=5, SET_DOWN=6, GO_ON=7)
        modules["blindgrasp_msgs.msg"].Decision = kind
        with mock.patch.dict(sys.modules, modules):
            gate = importlib.import_module("blindgrasp_ros.lift_gate")
        node, logger, lifted = gate.LiftGate.__new__(gate.LiftGate), mock.Mock(), []
        node.lifted_grasp, node.lifted_until_nanos = None, 0
        node.get_logger, node.lift = lambda: logger, lambda decision: lifted.append(decision.grasp_id)
        node.subscription, publishers = Message(topic_name="/left/decision"), ["one"]
        node.count_publishers = lambda topic: len(publishers)
        decision = lambda action, after_s=0, ahead_s=0: Message(
            grasp_id=0, action=action, stamp=time_in(ahead_s), valid_until=time_in(10 + after_s), reason="stable"
        )
        node.on_decision(decision(kind.LIFT))
        node.on_decision(decision(kind.LIFT))
        self.assertEqual(lifted, [0])
        logger.warning.assert_called_once_with("grasp 0: LIFT came before, ignored")
        # The graph is started again, and counts from 0.
        node.on_decision(decision(kind.LIFT, after_s=3))
        self.assertEqual(lifted, [0, 0])
        # A clock was set back, or a second graph decides.
        node.on_decision(decision(kind.LIFT, after_s=6, ahead_s=1))
        self.assertRegex(logger.warning.call_args[0][0], "grasp 0: hold, the decision's stamp lies .* ms in the future")
        publishers.append("another")
        node.on_decision(decision(kind.LIFT, after_s=6))
        self.assertIn("grasp 0: hold, 2 nodes publish /left/decision", logger.warning.call_args[0][0])
        self.assertEqual(lifted, [0, 0])
        node.on_decision(decision(kind.TIGHTEN))
        self.assertIn("ignored", logger.info.call_args[0][0])


if __name__ == "__main__":
    unittest.main()
