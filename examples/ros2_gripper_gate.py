#!/usr/bin/env python3
"""Gates every pick of MoveIt 2 by configuration: a node that is the gripper's controller for MoveIt.

    python3 examples/ros2_gripper_gate.py --controller /gripper_controller/gripper_cmd --grasps-below 0.03 \\
        blindgrasp run dataflow-live.yaml --json

It serves the action `/grasp_gate/gripper_cmd` (control_msgs GripperCommand, or ParallelGripperCommand with --parallel), and
passes each goal on to the real controller. A goal whose position is below --grasps-below closes on an object: it succeeds
only if the controller has closed the hand and a fresh LIFT of blindgrasp follows; everything else aborts it. MoveIt
executes no step after a controller that does not succeed, so the arm stays. Name the gate in moveit_controllers.yaml:

    grasp_gate: {type: GripperCommand, action_ns: gripper_cmd, joints: [finger_joint], default: true}

The rest of the command line starts the graph, whose lines of JSON are the decisions; the graph ends with the node. It needs
rclpy and control_msgs, in any RMW. The gate makes no test lift: use a model and an arbiter that decide when the hand is
settled, and read what they promise (`blindgrasp model show`). MoveIt gives a gripper 1.1 times the planned duration and
0.5 s: set `allowed_goal_duration_margin` of the controller to the seconds that --wait allows.
"""

import argparse
import collections
import json
import subprocess
import sys
import threading
import time

LIFT = "lift"
# Decisions that say what to do next, and end nothing.
UNDECIDED = ("squeeze", "test_lift", "tighten", "set_down", "go_on")


def boottime_nanos():
    """The clock of `valid_until_nanos`."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


class Decisions:
    """The decisions of a graph, line by line, as they come."""

    def __init__(self, lines):
        self.condition = threading.Condition()
        self.waiting = collections.deque()
        self.has_ended = False
        threading.Thread(target=self.read, args=(lines,), daemon=True).start()

    def read(self, lines):
        for line in lines:
            try:
                decision = json.loads(line)
            except ValueError:
                continue
            if isinstance(decision, dict) and "action" in decision:
                with self.condition:
                    self.waiting.append(decision)
                    self.condition.notify_all()
        with self.condition:
            self.has_ended = True
            self.condition.notify_all()

    def begin(self):
        """Forgets the decisions so far: those of the next grasp come after them."""
        with self.condition:
            self.waiting.clear()

    def may_lift(self, wait_s, now_nanos=boottime_nanos):
        """Whether the first final decision is a LIFT that is still valid, and the reason."""
        deadline = time.monotonic() + wait_s
        with self.condition:
            while True:
                while self.waiting:
                    decision = self.waiting.popleft()
                    if decision["action"] == LIFT:
                        is_valid = now_nanos() < decision.get("valid_until_nanos", 0)
                        return is_valid, decision.get("reason", "") if is_valid else "no longer valid"
                    if decision["action"] not in UNDECIDED:
                        return False, decision.get("reason", "")
                left = deadline - time.monotonic()
                if self.has_ended or left <= 0:
                    return False, "the graph has ended" if self.has_ended else f"no decision within {wait_s:g} s"
                self.condition.wait(left)


class Gate:
    """Decides how a goal of the gripper ends."""

    def __init__(self, decisions, grasps_below, wait_s):
        self.decisions, self.grasps_below, self.wait_s = decisions, grasps_below, wait_s
        self.one_at_a_time = threading.Lock()

    def run(self, position, close):
        """Closes the hand by `close`, which tells whether the controller succeeded. Whether the goal succeeds, and why."""
        with self.one_at_a_time:
            return self.run_alone(position, close)

    def run_alone(self, position, close):
        self.decisions.begin()
        if not close():
            return False, "the controller did not succeed"
        if position >= self.grasps_below:
            return True, "no grasp"
        return self.decisions.may_lift(self.wait_s)


def serve(arguments, decisions):
    import rclpy
    from control_msgs.action import GripperCommand, ParallelGripperCommand
    from rclpy.action import ActionClient, ActionServer
    from rclpy.executors import MultiThreadedExecutor

    kind = ParallelGripperCommand if arguments.parallel else GripperCommand
    rclpy.init()
    node = rclpy.create_node("grasp_gate")
    controller = ActionClient(node, kind, arguments.controller)
    gate = Gate(decisions, arguments.grasps_below, arguments.wait)

    def wait_for(future):
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        done.wait()
        return future.result()

    def execute(handle):
        command = handle.request.command
        position = command.position[0] if arguments.parallel else command.position
        answers = []

        def close():
            if not controller.wait_for_server(timeout_sec=arguments.wait):
                return False
            accepted = wait_for(controller.send_goal_async(handle.request))
            if not accepted.accepted:
                return False
            answer = wait_for(accepted.get_result_async())
            answers.append(answer.result)
            # A hand that an object stops has closed on it, though it has not reached its goal.
            return answer.result.reached_goal or answer.result.stalled

        succeeds, why = gate.run(position, close)
        node.get_logger().info(f"goal {position:g}: {'succeeded' if succeeds else 'aborted'}, {why}")
        (handle.succeed if succeeds else handle.abort)()
        return answers[0] if answers else kind.Result()

    ActionServer(node, kind, "/grasp_gate/gripper_cmd", execute)
    try:
        # The answers of the controller come while a goal is executed.
        rclpy.spin(node, MultiThreadedExecutor())
    finally:
        rclpy.try_shutdown()


def main():
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--controller", required=True, help="the action of the real gripper controller")
    options.add_argument("--grasps-below", type=float, required=True, help="positions below this close on an object")
    options.add_argument("--wait", type=float, default=3.0, help="seconds for a decision after the hand has closed")
    options.add_argument("--parallel", action="store_true", help="ParallelGripperCommand instead of GripperCommand")
    options.add_argument("graph", nargs=argparse.REMAINDER, help="the command whose lines are the decisions")
    arguments = options.parse_args()
    if not arguments.graph:
        options.error("expected the command of the graph, such as: blindgrasp run dataflow-live.yaml --json")
    graph = subprocess.Popen(arguments.graph, stdout=subprocess.PIPE, text=True)
    try:
        serve(arguments, Decisions(graph.stdout))
    finally:
        graph.terminate()
        graph.wait()


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(130)
