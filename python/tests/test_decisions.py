"""Tests of the node `decisions` of examples/blindgrasp_ros and of its launch file, with stand-ins for rclpy and launch."""

import importlib.util
import itertools
import os
import sys
import tempfile
import threading
import time
import types
import unittest
from pathlib import Path
from types import SimpleNamespace as Message
from unittest import mock

PACKAGE = Path(__file__).resolve().parents[2] / "examples/blindgrasp_ros"
sys.path.insert(0, str(PACKAGE))
from blindgrasp_ros import decisions as node  # noqa: E402

MINUTE = 60 * 10**9


class Decision:
    HOLD, LIFT, TIGHTEN, GO_ON = 0, 1, 5, 7

    def __init__(self):
        self.stamp, self.valid_until = Message(), Message()


def decision(action="lift", grasp_id=3):
    return {"grasp_id": grasp_id, "action": action, "reason": "stable", "probability_stable": 0.9}


class Saying(unittest.TestCase):
    def test_a_lift_whose_time_is_over_is_said_as_a_hold(self):
        now = node.boottime_nanos()
        late = node.fill(Decision(), decision(), now - 1)
        self.assertEqual((late.action, late.reason, late.probability_stable), (Decision.HOLD, "stale", 0.0))
        self.assertEqual((late.valid_until.sec, late.valid_until.nanosec), (late.stamp.sec, late.stamp.nanosec))
        fresh = node.fill(Decision(), decision(), now + MINUTE)
        self.assertEqual((fresh.action, fresh.grasp_id, fresh.reason), (Decision.LIFT, 3, "stable"))
        self.assertAlmostEqual(fresh.valid_until.sec - time.time(), 60, delta=5)
        # In a replay nothing is valid.
        replayed = node.fill(Decision(), decision(), None)
        self.assertEqual((replayed.action, replayed.valid_until.sec), (Decision.LIFT, replayed.stamp.sec))
        # What to do while the arm lifts is said however late.
        self.assertEqual(node.fill(Decision(), decision("tighten"), now - 1).action, Decision.TIGHTEN)

    def test_a_pause_between_two_looks_at_clocks_shortens_the_time(self):
        nanos = itertools.count(10**9, 10**9)
        with mock.patch.object(node, "boottime_nanos", lambda: next(nanos)), mock.patch("time.time_ns", lambda: next(nanos)):
            said = node.fill(Decision(), decision(), MINUTE)
        self.assertLess(said.valid_until.sec, 60)


class Waiting(unittest.TestCase):
    def setUp(self):
        self.decisions = node.Decisions()

    def set(self, grasp_id, action="lift", valid_for=MINUTE):
        self.decisions.set(decision(action, grasp_id), node.boottime_nanos() + valid_for)

    def told(self, timeout_s=0.0):
        found = self.decisions.wait(timeout_s)
        return found and (found[0]["grasp_id"], found[0]["action"])

    def test_a_call_gets_the_valid_decision_or_waits_for_the_next_or_gets_none(self):
        self.assertIsNone(self.told())
        self.set(1, valid_for=-1)
        self.assertIsNone(self.told(0.02))
        self.assertIsNone(self.told(float("nan")))
        self.set(2)
        self.assertEqual(self.told(), (2, "lift"))
        # The answer to a robot that asks while it lifts does not hide the advice before it.
        self.set(2, "tighten")
        self.set(2, "go_on")
        self.assertEqual(self.told(), (2, "tighten"))
        self.decisions.set(node.NO_GRAPH, None)
        self.assertIsNone(self.told())
        threading.Timer(0.05, self.set, [4]).start()
        self.assertEqual(self.told(600.0), (4, "lift"))

    def test_a_new_call_always_waits(self):
        found = {}

        def call(name):
            thread = threading.Thread(target=lambda: found.update({name: self.told(60.0)}))
            thread.start()
            while not (len(self.decisions.waiting) > name or found):
                time.sleep(0.001)
            return thread

        threads = [call(name) for name in range(node.MAX_WAITING + 1)]
        threads[0].join()
        self.assertEqual(found, {0: None})
        self.set(9)
        for thread in threads:
            thread.join()
        self.assertEqual([found[name] for name in range(1, node.MAX_WAITING + 1)], [(9, "lift")] * node.MAX_WAITING)


def top(state="running", peers=(), message=None, node_state="running", restarts=0, late=0, malformed=0):
    """A line of `blindgrasp top --json`, with the fields that are read."""
    counts = {"frames": 7, "malformed": malformed}
    source = {"node": "source", "state": node_state, "n_restarts": restarts, "n_swaps": 0, "pid": 4, "cpu_percent": None}
    edge = {"from": "source/tactile", "to": "contacts/tactile", "policy": "lossless", "rate_hz": 99.96, "received": 9, "n_queued": 0}
    return {
        "state": state, "message": message, "uptime_secs": 2.5, "decisions": {"n_lift": 1, "n_hold": 2},
        "decision_latency_nanos": {"p50": 90}, "link": {"peers": [{"machine": "arm", "state": state} for state in peers]},
        "nodes": [{**source, "resident_bytes": 1, "counts": counts}],
        "edges": [{**edge, "dropped": 0, "missing": 0, "late": late, "repeated": 0}],
    }  # fmt: skip


class State(unittest.TestCase):
    def test_levels_and_words_are_those_of_the_graph(self):
        def told(now, before=None):
            return [(level, words) for level, _, words, _ in node.statuses(now, before or top())]

        good = [(node.OK, "running"), (node.OK, "running"), (node.OK, "100.0 Hz")]
        self.assertEqual(told(top()), good)
        self.assertEqual([part for _, part, _, _ in node.statuses(top(), top())], ["graph", "source", "source/tactile -> contacts/tactile"])
        self.assertEqual(told(top("degraded", message="source failed"))[0], (node.ERROR, "degraded; source failed"))
        self.assertEqual(told(top("starting"))[0], (node.WARN, "starting"))
        self.assertEqual(told(top(peers=["up", "down"]))[0], (node.WARN, "running; cut off: arm"))
        self.assertEqual(told(top(node_state="failed"))[1], (node.ERROR, "failed"))
        self.assertEqual(told(top(restarts=1, malformed=3))[1], (node.WARN, "running; 3 malformed; 1 n_restarts"))
        self.assertEqual(told(top(late=2))[2], (node.WARN, "100.0 Hz; 2 late"))
        # What was before the line before is past.
        self.assertEqual(told(top(restarts=1, late=2, malformed=3), top(restarts=1, late=2, malformed=3)), good)
        values = node.statuses(top(), top())[0][3]
        self.assertEqual((values["n_hold"], values["decision_latency_p50_nanos"]), (2, 90))


class Following(unittest.TestCase):
    """Lines of a command that ends: it is run again, and its end is told."""

    def test_a_command_that_ends_is_told_and_run_again(self):
        script = "print('{\"grasp\": 1}'); print('{\"cut'); print('no graph runs')"
        lines, ends = [], []

        def has_ended(said):
            ends.append(said)
            if len(ends) == 2:
                raise KeyboardInterrupt

        with mock.patch.object(node, "RETRY_S", 0.01), self.assertRaises(KeyboardInterrupt):
            node.follow([sys.executable, "-c", script], lines.append, has_ended)
        self.assertEqual((lines, ends), ([{"grasp": 1}] * 2, ["no graph runs"] * 2))


class Publishing(unittest.TestCase):
    def setUp(self):
        self.published, self.logger = {}, mock.Mock()

        def publisher(kind, topic, qos):
            sent = self.published.setdefault(topic, [])
            return Message(publish=sent.append, get_subscription_count=lambda: topic != "unread")

        ros = Message(create_publisher=publisher, get_logger=lambda: self.logger)
        modules = {name: mock.MagicMock() for name in ("rclpy", "rclpy.qos", "blindgrasp_msgs", "blindgrasp_msgs.msg", "std_msgs")}
        modules["blindgrasp_msgs.msg"].Decision = Decision
        modules["std_msgs.msg"] = types.ModuleType("std_msgs.msg")
        modules["std_msgs.msg"].String = str
        patch = mock.patch.dict(sys.modules, modules)
        patch.start()
        self.addCleanup(patch.stop)
        self.publishing = node.Publishing(ros, "gate")

    def test_a_lift_whose_time_is_over_is_taken_back_once(self):
        publishing = self.publishing
        # In a replay no LIFT is valid.
        for until_nanos in (None, node.boottime_nanos() + MINUTE):
            publishing.decide(decision(), until_nanos)
            publishing.take_back()
        with mock.patch.object(node, "boottime_nanos", lambda: until_nanos):
            publishing.take_back()
            publishing.take_back()
        found = [(said.action, said.reason) for said in self.published["decision"]]
        self.assertEqual(found, [(Decision.HOLD, "no_graph"), *[(Decision.LIFT, "stable")] * 2, (Decision.HOLD, "stale")])

    def test_a_decision_is_published_before_the_next_one_is_kept(self):
        publishing = self.publishing
        until_nanos = node.boottime_nanos() + MINUTE
        other = threading.Thread(target=publishing.decide, args=(decision("hold", 4), until_nanos))
        sent = []

        def publish(said):
            if said.grasp_id == 3:
                other.start()
                other.join(0.05)
            sent.append(said.grasp_id)

        publishing.decision.publish = publish
        publishing.decide(decision(), until_nanos)
        other.join()
        self.assertEqual(sent, [3, 4])

    def test_what_is_published_without_a_graph_is_a_hold(self):
        publishing, published, logger = self.publishing, self.published, self.logger
        publishing.take({"decision": decision(), "valid_until_nanos": node.boottime_nanos() + MINUTE})
        for topic in ("/words", "/unread"):
            publishing.take({"topic": topic, "type": "std_msgs/msg/String", "cdr": "00010000"})
        for _ in range(2):
            publishing.take({"topic": "/others", "type": "std_msgs/msg/Other", "cdr": "00"})
        logger.warning.assert_called_once()
        for _ in range(2):
            publishing.begin_anew("")
            publishing.begin_anew("no graph of this name runs")
        # The first and the last decision of all are holds, said once.
        found = [(said.action, said.reason) for said in published["decision"]]
        self.assertEqual(found, [(Decision.HOLD, "no_graph"), (Decision.LIFT, "stable"), (Decision.HOLD, "no_graph")])
        self.assertEqual((published["words"], published["unread"]), ([b"\0\1\0\0"], []))


class Launch(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.addCleanup(os.chdir, os.getcwd())
        os.chdir(folder.name)
        Path("flow.yaml").touch()
        Path("t.yaml").write_text("joints: {topic: /left/joint_states}\ncells: [{topic: /cells}]\n")
        self.missing = None
        which = mock.patch("shutil.which", lambda program: None if program == self.missing else program)
        which.start()
        self.addCleanup(which.stop)

    def started(self, **given):
        """The nodes and commands that the launch file starts, as words."""
        words = lambda kind: lambda **of: [kind, *of.get("cmd", [of.get("executable"), *of.get("arguments", [])])]
        launch, ros = types.ModuleType("launch"), types.ModuleType("launch_ros.actions")
        actions = types.ModuleType("launch.actions")
        launch.LaunchDescription, ros.Node, actions.ExecuteProcess = list, words("node"), words("run")
        actions.DeclareLaunchArgument = lambda name, default_value, description: (name, default_value)
        actions.OpaqueFunction, actions.Shutdown = (lambda function: function), Message
        modules = {"launch": launch, "launch.actions": actions, "launch_ros": types.ModuleType("launch_ros"), "launch_ros.actions": ros}
        spec = importlib.util.spec_from_file_location("gate_launch", PACKAGE / "launch/gate.launch.py")
        with mock.patch.dict(sys.modules, modules):
            file = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(file)
        self.ended = file.graph_has_ended
        *declared, function = file.generate_launch_description()
        return function(Message(launch_configurations={**dict(declared), **given}))

    def test_the_options_start_their_nodes(self):
        self.assertEqual(self.started(), [["node", "decisions", "live_gate", "--namespace", "/blindgrasp"]])
        started = self.started(run="flow.yaml", graph="g", table="t.yaml", address="unix:/s", gate="lift")
        run = ["run", "setpriv", "--pdeathsig", "TERM", "blindgrasp", "run", "flow.yaml", "--name", "g"]
        hand = ["node", "hand", "t.yaml", "--address", "unix:/s"]
        decisions = ["node", "decisions", "g", "--namespace", "/blindgrasp"]
        lift_gate = ["node", "lift_gate", "--ros-args", "--remap", "/blindgrasp/decision:=/blindgrasp/decision"]
        self.assertEqual(started, [decisions, run, hand, lift_gate])
        with self.assertRaisesRegex(ValueError, "expected none, lift or gripper"):
            self.started(gate="arm")

    def test_each_hand_has_its_graph_and_its_topics(self):
        of_left = {"graph": "left", "table": "t.yaml", "namespace": "/blindgrasp/left"}
        decisions, hand, lift_gate = self.started(gate="lift", **of_left)
        self.assertEqual(decisions[2:], ["left", "--namespace", "/blindgrasp/left"])
        self.assertEqual(hand[2:], ["t.yaml", "--graph", "left"])
        self.assertEqual(lift_gate[-1], "/blindgrasp/decision:=/blindgrasp/left/decision")
        of_gripper = {"gate": "gripper", "controller": "/c", "grasps_below": "0.03", "name": "left_gate"}
        for parallel in ("true", "True"):
            gripper = self.started(parallel=parallel, **of_gripper, **of_left)[-1]
            own = ["--controller", "/c", "--grasps-below", "0.03", "--wait", "3.0", "--name", "left_gate", "--parallel"]
            self.assertEqual(gripper[2:], [*own, "--decisions", "/blindgrasp/left/decision"])

    def test_nothing_starts_that_would_fail_again_and_again(self):
        Path("wrong.yaml").write_text("cells: [{}]")
        for given, says in [
            ({"run": "none.yaml"}, "run:=none.yaml: there is no such file"),
            ({"table": "none.yaml"}, "table:=none.yaml: No such file"),
            ({"table": "wrong.yaml"}, r"table:=wrong.yaml: cells\[0\]: `topic` is missing"),
            ({"table": "t.yaml", "namespace": "/left/"}, "namespace:=/left: the table reads /left/joint_states there"),
        ]:
            with self.assertRaisesRegex(ValueError, says):
                self.started(**given)
        for self.missing in ("blindgrasp", "setpriv"):
            with self.assertRaisesRegex(ValueError, f"the program {self.missing} is not in PATH"):
                self.started()

    def test_a_failed_graph_is_a_failed_launch(self):
        self.started()
        for code in (0, 3):
            self.assertEqual(self.ended(Message(returncode=code), None).reason, "the graph has ended")
        for code in (1, -9):
            with self.assertRaisesRegex(RuntimeError, "the graph has failed"):
                self.ended(Message(returncode=code), None)

    def test_a_gate_of_the_gripper_that_cannot_start_is_refused(self):
        for given in [{"grasps_below": "0.03"}, {"controller": "/c"}, {"controller": "/c", "grasps_below": "0", "grasps_above": "1"}]:
            with self.assertRaisesRegex(ValueError, "gate:=gripper needs controller"):
                self.started(gate="gripper", **given)

    def test_setup_names_nodes_that_there_are(self):
        found = {}
        with mock.patch.dict(sys.modules, {"setuptools": Message(setup=found.update)}):
            exec((PACKAGE / "setup.py").read_text(encoding="utf-8"), {})
        nodes = [script.split(" = ") for script in found["entry_points"]["console_scripts"]]
        started = {"decisions", "hand", "lift_gate", "gripper_gate"}
        self.assertEqual({name for name, _ in nodes}, started)
        for name, target in nodes:
            self.assertEqual(target, f"blindgrasp_ros.{name}:main")
            self.assertIn("\ndef main():", (PACKAGE / f"blindgrasp_ros/{name}.py").read_text(encoding="utf-8"))
        for _, files in found["data_files"]:
            self.assertTrue((PACKAGE / files[0]).is_file())


if __name__ == "__main__":
    unittest.main()
