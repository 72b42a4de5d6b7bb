#!/usr/bin/env python3
"""A ROS 2 node that lifts only on a fresh LIFT of blindgrasp. Needs ROS 2 and the package blindgrasp_msgs.

    RMW_IMPLEMENTATION=rmw_zenoh_cpp python3 ros2_lift_gate.py

With DDS, RMW_IMPLEMENTATION stays as it is, and a zenoh-bridge-ros2dds runs.

Put the motion of your arm into `lift`. Nothing else may start it.
"""

import time

import rclpy
from blindgrasp_msgs.msg import Decision
from rclpy.clock import Clock
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time import Time


class LiftGate(Node):
    def __init__(self):
        super().__init__("lift_gate")
        self.lifted_grasp = None
        # The last decision is kept for a node that starts late: it may be an old one.
        qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(Decision, "/blindgrasp/decision", self.on_decision, qos)

    def on_decision(self, decision):
        if decision.action in (Decision.TIGHTEN, Decision.SET_DOWN, Decision.GO_ON):
            # This node sends no frames while the arm lifts, so it is not told what to do then.
            return
        if decision.action != Decision.LIFT:
            self.get_logger().info(f"grasp {decision.grasp_id}: hold, {decision.reason}")
            return
        # valid_until is a time of the wall clock, whatever use_sim_time says; the clocks of two machines must agree (NTP).
        if time.time_ns() >= Time.from_msg(decision.valid_until).nanoseconds:
            self.get_logger().warning(f"grasp {decision.grasp_id}: LIFT is no longer valid, hold")
            return
        # A grasp is lifted once, however often its decision comes.
        if decision.grasp_id != self.lifted_grasp:
            self.lifted_grasp = decision.grasp_id
            self.lift(decision)

    def lift(self, decision):
        self.get_logger().info(f"grasp {decision.grasp_id}: lift, probability {decision.probability_stable:.2f}")


def main():
    rclpy.init()
    try:
        gate = LiftGate()
        # rclpy can fall asleep on a signal that comes just then; it looks again when it wakes.
        gate.create_timer(1.0, lambda: None, clock=Clock())
        rclpy.spin(gate)
    except KeyboardInterrupt:
        pass
    except Exception:
        # A signal that ends ROS 2 makes rclpy.spin raise one of several errors.
        if rclpy.ok():
            raise
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
