"""Gates every pick of MoveIt 2 by configuration: a node that is the gripper's controller for MoveIt.

    ros2 run blindgrasp_ros gripper_gate --controller /gripper_controller/gripper_cmd --grasps-below 0.03

It serves the action `/grasp_gate/gripper_cmd` (control_msgs GripperCommand, or ParallelGripperCommand with --parallel;
`--name left_gate` serves `/left_gate/gripper_cmd`), and
passes each goal on to the real controller. A goal whose position is below --grasps-below (or above --grasps-above, for a
gripper whose value grows as it closes) closes on an object: it succeeds only if the controller has closed the hand and a
fresh LIFT follows on the topic of decisions; everything else aborts it. MoveIt
executes no step after a controller that does not succeed, so the arm stays. Name the gate in moveit_controllers.yaml:

    grasp_gate: {type: GripperCommand, action_ns: gripper_cmd, joints: [finger_joint], default: true}

Unless one node publishes decisions, goals that close on an object are rejected. It needs rclpy, control_msgs and blindgrasp_msgs, in
any RMW. The gate makes no test lift: use a model and an arbiter that decide when the hand is
settled, and read what they promise (`blindgrasp model show`). MoveIt gives a gripper 1.1 times the planned duration and
0.5 s: set `allowed_goal_duration_margin` of the controller to the seconds that --wait allows.

A LIFT is valid for `max_age_ms` of the arbiter (200), and follows some 0.3 s after the fingers stand. The controllers of
ros2_controllers say so only after `stall_timeout`, which is 1 s: set it to 0.2.
"""

import argparse
import collections
import math
import threading
import time

from blindgrasp_ros.node import arguments, clock_fault, ended_by_signals, nanos_of, spin, topic_fault

# Seconds between two looks whether a goal was cancelled, or a signal came.
LOOK_S = 0.05
# action_msgs/msg/GoalStatus
SUCCEEDED = 4
# blindgrasp_msgs/msg/Decision: of these, another decision follows squeeze, test_lift, tighten, set_down and go_on.
LIFT, UNDECIDED = 1, (3, 4, 5, 6, 7)
# The reason with which the node of decisions says that a graph has ended: the next one may count grasps anew.
NO_GRAPH = "no_graph"
# The reason with which it takes back a LIFT whose time is over.
STALE = "stale"


class Decisions:
    """The decisions of a graph, as they come."""

    def __init__(self):
        self.condition = threading.Condition()
        self.waiting = collections.deque()
        # The number of the newest grasp that was decided, or is being decided.
        self.newest = -1
        self.has_ended = False

    def take(self, decision):
        with self.condition:
            if decision.reason == NO_GRAPH:
                self.waiting.clear()
                self.newest, self.has_ended = -1, True
            # The LIFT itself tells until when it was valid.
            elif decision.reason != STALE or (LIFT, decision.grasp_id) not in [(it.action, it.grasp_id) for _, it in self.waiting]:
                self.waiting.append((time.monotonic(), decision))
            self.condition.notify_all()

    def begin(self):
        """Forgets the decisions so far: those of the next grasp have a greater number."""
        with self.condition:
            self.newest = max([self.newest, *(decision.grasp_id for _, decision in self.waiting)])
            self.waiting.clear()
            self.has_ended = False

    def may_lift(self, wait_s, is_cancelled):
        """Whether the final decision of the newest grasp is a LIFT that is still valid, and the reason.

        A hold that came while the hand still closed may be of the grasp before: it counts if nothing follows it.
        """
        closed = time.monotonic()
        deadline = closed + wait_s
        why = f"no decision within {wait_s:g} s"
        with self.condition:
            while True:
                final = [
                    (decision.grasp_id, came, decision)
                    for came, decision in self.waiting
                    if decision.action not in UNDECIDED and decision.grasp_id > self.newest
                ]
                if final:
                    _, came, decision = max(final, key=lambda found: found[:2])
                    if decision.action == LIFT:
                        # The clocks of two machines must agree (NTP).
                        fault = clock_fault(decision)
                        if fault:
                            return False, fault
                        over_ms = (time.time_ns() - nanos_of(decision.valid_until)) / 1e6
                        if over_ms < 0:
                            return True, decision.reason
                        hint = "; a controller that says late that the hand stands needs a shorter stall_timeout" if came < closed else ""
                        return False, f"LIFT was valid until {over_ms:.0f} ms ago{hint}"
                    why = decision.reason
                    if came >= closed:
                        return False, why
                left = deadline - time.monotonic()
                if is_cancelled():
                    return False, "cancelled"
                if self.has_ended or left <= 0:
                    return False, "the graph has ended" if self.has_ended else why
                self.condition.wait(min(left, LOOK_S))


class Gate:
    """Decides how a goal of the gripper ends."""

    def __init__(self, decisions, is_grasp, wait_s):
        self.decisions, self.is_grasp, self.wait_s = decisions, is_grasp, wait_s

    def run(self, position, move, is_cancelled=lambda: False):
        """Moves the hand by `move`, which tells whether the controller succeeded, or stalled. Whether the goal succeeds, and why."""
        self.decisions.begin()
        has_succeeded, has_stalled = move()
        if not self.is_grasp(position):
            return has_succeeded, "no grasp" if has_succeeded else "the controller did not succeed"
        # A hand that an object stops has closed on it, though it has not reached its goal.
        if not (has_succeeded or has_stalled):
            return False, "the controller did not succeed"
        return self.decisions.may_lift(self.wait_s, is_cancelled)


def grasps(arguments):
    """Whether a position closes on an object."""
    if arguments.grasps_below is not None:
        return lambda position: position < arguments.grasps_below
    return lambda position: position > arguments.grasps_above


def positions_of(command, is_parallel):
    """The positions of a goal: ParallelGripperCommand has a list, which may be empty."""
    return list(command.position) if is_parallel else [command.position]


@ended_by_signals
def serve(arguments):
    """Serves goals until a signal comes."""
    import control_msgs.action
    import rclpy
    from blindgrasp_msgs.msg import Decision
    from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
    from rclpy.executors import MultiThreadedExecutor
    from rclpy.qos import DurabilityPolicy, QoSProfile

    # Humble has no ParallelGripperCommand.
    kind = getattr(control_msgs.action, "ParallelGripperCommand" if arguments.parallel else "GripperCommand")
    node = rclpy.create_node(arguments.name)
    controller = ActionClient(node, kind, arguments.controller)
    decisions, is_grasp = Decisions(), grasps(arguments)
    qos = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(Decision, arguments.decisions, decisions.take, qos)
    gate = Gate(decisions, is_grasp, arguments.wait)
    busy = threading.Lock()

    def wait_for(future, meanwhile=lambda: None):
        """What the controller answers; `None` if it has gone, or a signal ends the gate."""
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        while not done.wait(LOOK_S):
            if not rclpy.ok() or not controller.server_is_ready():
                return None
            meanwhile()
        return future.result()

    def take(goal):
        positions = positions_of(goal.command, arguments.parallel)
        if busy.locked():
            why = "another goal is executed"
        elif not positions or not all(map(math.isfinite, positions)):
            why = f"the positions {positions}, expected finite ones"
        else:
            why = topic_fault(node, arguments.decisions) if is_grasp(positions[0]) else None
        if why is None:
            return GoalResponse.ACCEPT
        node.get_logger().warning(f"goal rejected: {why}")
        return GoalResponse.REJECT

    def execute(handle):
        with busy:
            return execute_alone(handle)

    def execute_alone(handle):
        position = positions_of(handle.request.command, arguments.parallel)[0]
        answers = []

        def move():
            if not controller.wait_for_server(timeout_sec=arguments.wait):
                return False, False
            accepted = wait_for(controller.send_goal_async(handle.request))
            if accepted is None or not accepted.accepted:
                return False, False
            has_cancelled = []

            def pass_cancel_on():
                if handle.is_cancel_requested and not has_cancelled:
                    has_cancelled.append(True)
                    accepted.cancel_goal_async()

            answer = wait_for(accepted.get_result_async(), pass_cancel_on)
            if answer is None:
                return False, False
            answers.append(answer.result)
            return answer.status == SUCCEEDED, answer.result.stalled

        succeeds, why = gate.run(position, move, lambda: handle.is_cancel_requested or not rclpy.ok())
        # Another graph may have begun to decide meanwhile.
        fault = topic_fault(node, arguments.decisions) if succeeds and is_grasp(position) else None
        if fault:
            succeeds, why = False, fault
        if handle.is_cancel_requested:
            succeeds, why, end = False, "cancelled", handle.canceled
        else:
            end = handle.succeed if succeeds else handle.abort
        if rclpy.ok():
            node.get_logger().info(f"goal {position:g}: {'succeeded' if succeeds else 'not succeeded'}, {why}")
            end()
        return answers[0] if answers else kind.Result()

    ActionServer(
        node,
        kind,
        "~/gripper_cmd",
        execute,
        goal_callback=take,
        cancel_callback=lambda _: CancelResponse.ACCEPT,
    )
    # The answers of the controller come while a goal is executed.
    spin(node, MultiThreadedExecutor(num_threads=4))


def main():
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--controller", required=True, help="the action of the real gripper controller")
    closing = options.add_mutually_exclusive_group(required=True)
    closing.add_argument("--grasps-below", type=float, help="positions below this close on an object")
    closing.add_argument("--grasps-above", type=float, help="positions above this close on an object")
    options.add_argument("--wait", type=float, default=3.0, help="seconds for a decision after the hand has closed")
    options.add_argument("--parallel", action="store_true", help="ParallelGripperCommand instead of GripperCommand")
    options.add_argument("--name", default="grasp_gate", help="of the node: each gripper has a gate of its own")
    options.add_argument("--decisions", default="/blindgrasp/decision", help="the topic of decisions")
    serve(options.parse_args(arguments()))


if __name__ == "__main__":
    main()
