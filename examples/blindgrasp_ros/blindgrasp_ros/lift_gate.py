"""A node that lifts only on a fresh LIFT of blindgrasp: ros2 run blindgrasp_ros lift_gate

Put the motion of your arm into `lift`. Nothing else may start it.
"""

import argparse
import time

from blindgrasp_msgs.msg import Decision
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from blindgrasp_ros.node import arguments, clock_fault, ended_by_signals, nanos_of, spin, topic_fault

# Two LIFTs of one grasp that are valid until times less than this apart are one decision: a graph needs longer to start.
SAME_RUN_NANOS = 1_000_000_000


class LiftGate(Node):
    def __init__(self):
        super().__init__("lift_gate")
        # The grasp that was lifted last, and until when its LIFT was valid.
        self.lifted_grasp, self.lifted_until_nanos = None, 0
        # The last decision is kept for a node that starts late: it may be an old one.
        qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.subscription = self.create_subscription(Decision, "/blindgrasp/decision", self.on_decision, qos)

    def on_decision(self, decision):
        if decision.action in (Decision.TIGHTEN, Decision.SET_DOWN, Decision.GO_ON):
            # This node sends no frames while the arm lifts, so it is not told what to do then.
            self.get_logger().info(f"grasp {decision.grasp_id}: what to do while the arm lifts is ignored")
            return
        if decision.action != Decision.LIFT:
            self.get_logger().info(f"grasp {decision.grasp_id}: hold, {decision.reason}")
            return
        # valid_until is a time of the wall clock, whatever use_sim_time says; the clocks of two machines must agree (NTP).
        until_nanos = nanos_of(decision.valid_until)
        if time.time_ns() >= until_nanos:
            self.get_logger().warning(f"grasp {decision.grasp_id}: LIFT is no longer valid, hold")
            return
        # A decision may come before the node knows its publisher.
        fault = clock_fault(decision) or topic_fault(self, self.subscription.topic_name, n_least=0)
        if fault:
            self.get_logger().warning(f"grasp {decision.grasp_id}: hold, {fault}")
            return
        # A grasp is lifted once, however often its decision comes. A graph that is started again counts from 0 again, and
        # decides at least a second later.
        if decision.grasp_id == self.lifted_grasp and abs(until_nanos - self.lifted_until_nanos) < SAME_RUN_NANOS:
            self.get_logger().warning(f"grasp {decision.grasp_id}: LIFT came before, ignored")
            return
        self.lifted_grasp, self.lifted_until_nanos = decision.grasp_id, until_nanos
        self.lift(decision)

    def lift(self, decision):
        self.get_logger().info(f"grasp {decision.grasp_id}: lift, probability {decision.probability_stable:.2f}")


@ended_by_signals
def serve():
    spin(LiftGate())


def main():
    argparse.ArgumentParser(description=__doc__).parse_args(arguments())
    serve()


if __name__ == "__main__":
    main()
