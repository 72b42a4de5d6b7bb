"""Tests of examples/ros2_gripper_gate.py, with stand-ins for rclpy, control_msgs and the gripper's controller."""

import importlib.util
import json
import math
import queue
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

EXAMPLE = Path(__file__).resolve().parents[2] / "examples/ros2_gripper_gate.py"
SPEC = importlib.util.spec_from_file_location("ros2_gripper_gate", EXAMPLE)
example = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(example)


class Lines:
    """The lines of a graph, as the test says them."""

    def __init__(self):
        self.queue, self.n_said, self.grasp_id = queue.Queue(), 0, 0

    def say(self, action, valid_for_s=10, reason="told", grasp_id=None):
        if action not in example.UNDECIDED:
            self.grasp_id += 1
        valid_until = example.boottime_nanos() + int(valid_for_s * 1e9)
        grasp_id = self.grasp_id if grasp_id is None else grasp_id
        decision = {"action": action, "reason": reason, "grasp_id": grasp_id, "valid_until_nanos": valid_until}
        self.queue.put(json.dumps(decision))

    def __iter__(self):
        return iter(self.queue.get, None)


class Gate(unittest.TestCase):
    def setUp(self):
        self.lines = Lines()
        self.decisions = example.Decisions(self.lines)
        self.addCleanup(self.lines.queue.put, None)
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
        # A hand that closed again: the hold of the later grasp counts.
        self.assertEqual(self.close("lift", "hold"), (False, "told"))

    def test_a_late_hold_of_the_grasp_before_does_not_end_this_one(self):
        def move():
            self.lines.say("hold")
            while not self.decisions.waiting:
                time.sleep(0.001)
            threading.Timer(0.05, lambda: self.lines.say("lift", reason="stable")).start()
            return True, False

        self.assertEqual(self.gate.run(0.0, move), (True, "stable"))

    def test_a_lift_that_ended_before_the_controller_did_says_why(self):
        def move():
            self.lines.say("lift", valid_for_s=0.02)
            time.sleep(0.1)
            return False, True

        succeeds, why = self.gate.run(0.0, move)
        self.assertFalse(succeeds)
        self.assertIn("needs a shorter stall_timeout", why)

    def test_a_decision_of_an_earlier_grasp_does_not_count(self):
        self.lines.say("lift")
        while not self.decisions.waiting:
            time.sleep(0.001)
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

    def test_a_graph_that_ends_aborts(self):
        self.lines.queue.put("grasp 3 HOLD")
        self.lines.queue.put(None)
        self.assertEqual(self.close(), (False, "the graph has ended"))

    def test_a_cancel_ends_the_wait_for_a_decision(self):
        self.gate.wait_s = 3600
        cancelled = iter([False, True])
        found = self.gate.run(0.0, lambda: (True, False), lambda: next(cancelled))
        self.assertEqual(found, (False, "cancelled"))

    def test_a_graph_ends_with_the_gate_that_started_it(self):
        with tempfile.TemporaryDirectory() as folder:
            gone = f"{folder}/gone"
            graph = f"""import signal, sys
signal.signal(signal.SIGTERM, lambda *_: (open({gone!r}, "w").close(), sys.exit()))
print('{{"action": "hold"}}', flush=True)
signal.pause()"""
            serve = """import time, ros2_gripper_gate as gate
def serve(_, decisions):
    while not decisions.waiting:
        time.sleep(0.01)
    print(flush=True)
    time.sleep(3600)
gate.serve = serve
gate.main()"""
            command = [sys.executable, "-c", serve, "--controller", "/c", "--grasps-below", "0", sys.executable, "-c", graph]
            gate = subprocess.Popen(command, cwd=EXAMPLE.parent, stdout=subprocess.PIPE)
            gate.stdout.readline()
            gate.kill()
            gate.wait()
            while not Path(gone).exists():
                time.sleep(0.01)
            gate.stdout.close()

    def test_the_gate_ends_with_its_graph(self):
        arguments = ["gate", "--controller", "/c", "--grasps-below", "0", sys.executable, "-c", "raise SystemExit(7)"]
        with mock.patch.object(sys, "argv", arguments), mock.patch.object(example, "serve", lambda _, decisions: self.wait_for_end(decisions)):
            with self.assertRaisesRegex(SystemExit, "the graph has ended with the exit code 7: "):
                example.main()

    @staticmethod
    def wait_for_end(decisions):
        while not decisions.has_ended:
            time.sleep(0.001)
        return True

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

        def spin(timeout_sec):
            if served.get("ends") and "is_idle" not in served:
                # Without goals the gate waits for more.
                served["is_idle"] = True
                time.sleep(0.6)
                return
            if served.get("ends"):
                # The graph has ended.
                lines.queue.put(None)
                self.wait_for_end(self.decisions)
                self.assertEqual(take(0.08), "reject")
                return
            self.assertEqual([take(0.0), take(math.nan), take(math.inf)], ["accept", "reject", "reject"])
            arguments.parallel = True
            self.assertEqual([take([0.0]), take([]), take([0.0, math.nan])], ["accept", "reject", "reject"])
            arguments.parallel = False
            for action, position in [("lift", 0.0), ("hold", 0.0), (None, 0.08)]:
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

        lines = self.lines
        rclpy = types.ModuleType("rclpy")
        logger = Message(info=lambda text: None, warning=lambda text: None)
        rclpy.init, rclpy.try_shutdown, rclpy.ok = lambda: None, lambda: None, lambda: True
        rclpy.create_node = lambda name: Message(get_logger=lambda: logger)
        action, executors = types.ModuleType("rclpy.action"), types.ModuleType("rclpy.executors")
        action.ActionClient, action.ActionServer = Client, server
        executors.MultiThreadedExecutor = lambda num_threads: Message(add_node=lambda node: None, spin_once=spin)
        action.GoalResponse = Message(ACCEPT="accept", REJECT="reject")
        action.CancelResponse = Message(ACCEPT="accept")
        control, actions = types.ModuleType("control_msgs"), types.ModuleType("control_msgs.action")
        actions.GripperCommand, control.action = Message(Result=Message), actions
        modules = {"rclpy": rclpy, "rclpy.action": action, "rclpy.executors": executors}
        modules.update({"control_msgs": control, "control_msgs.action": actions})
        arguments = Message(parallel=False, controller="/gripper/cmd", grasps_below=0.03, grasps_above=None, wait=20.0, name="grasp_gate")
        with mock.patch.dict(sys.modules, modules):
            self.assertTrue(example.serve(arguments, self.decisions))
        self.assertEqual(served["ends"], [True, False, True])
        self.assertTrue(self.decisions.has_ended)
        self.assertEqual((served["name"], served["controller"]), ("~/gripper_cmd", "/gripper/cmd"))

    def test_a_goal_of_the_parallel_gripper_may_have_no_position(self):
        self.assertEqual(example.positions_of(Message(position=[]), True), [])
        self.assertEqual(example.positions_of(Message(position=[0.1, 0.2]), True), [0.1, 0.2])
        self.assertEqual(example.positions_of(Message(position=0.1), False), [0.1])


class LiftGate(unittest.TestCase):
    """ros2_lift_gate.py, with stand-ins for rclpy and the messages."""

    def test_a_grasp_is_lifted_once_in_a_run_of_the_graph(self):
        modules = {name: mock.MagicMock() for name in ("rclpy", "rclpy.clock", "rclpy.qos", "rclpy.node", "rclpy.time")}
        modules.update({name: mock.MagicMock() for name in ("blindgrasp_msgs", "blindgrasp_msgs.msg")})
        modules["rclpy.node"].Node = object
        modules["rclpy.time"].Time.from_msg = lambda nanos: Message(nanoseconds=nanos)
        kind = Message(HOLD=0, LIFT=1, TIGHTEN=5, SET_DOWN=6, GO_ON=7)
        modules["blindgrasp_msgs.msg"].Decision = kind
        spec = importlib.util.spec_from_file_location("ros2_lift_gate", EXAMPLE.with_name("ros2_lift_gate.py"))
        gate = importlib.util.module_from_spec(spec)
        with mock.patch.dict(sys.modules, modules):
            spec.loader.exec_module(gate)
        node, logger, lifted = gate.LiftGate.__new__(gate.LiftGate), mock.Mock(), []
        node.lifted_grasp, node.lifted_until_nanos = None, 0
        node.get_logger, node.lift = lambda: logger, lambda decision: lifted.append(decision.grasp_id)
        until = time.time_ns() + 10**10
        decision = lambda action, after_s=0: Message(grasp_id=0, action=action, valid_until=until + int(after_s * 1e9), reason="stable")
        node.on_decision(decision(kind.LIFT))
        node.on_decision(decision(kind.LIFT))
        self.assertEqual(lifted, [0])
        logger.warning.assert_called_once_with("grasp 0: LIFT came before, ignored")
        # The graph is started again, and counts from 0.
        node.on_decision(decision(kind.LIFT, after_s=3))
        self.assertEqual(lifted, [0, 0])
        node.on_decision(decision(kind.TIGHTEN))
        self.assertIn("ignored", logger.info.call_args[0][0])


if __name__ == "__main__":
    unittest.main()
