"""The driver of a hand in an installation of ROS 2: it publishes frames, one at a time.

The first line of stdin has the names of the joints, each further one a frame. A line of stdout answers each: "matched" once other
nodes read its topics, then "sent". The cells are in the field `effort` of a message with a header, so that a frame has one time.
"""

import json
import sys
import time

import rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import String


def main():
    names = json.loads(sys.stdin.readline())
    rclpy.init()
    node = rclpy.create_node("hand_driver")
    joints, cells, phase = (
        node.create_publisher(kind, topic, qos_profile_sensor_data)
        for kind, topic in [(JointState, "/joint_states"), (JointState, "/hand/tactile"), (String, "/hand/phase")]
    )
    while not all(publisher.get_subscription_count() for publisher in (joints, cells, phase)):
        time.sleep(0.05)
    print("matched", flush=True)
    for line in sys.stdin:
        frame = json.loads(line)
        readings = JointState(effort=frame["cells_newtons"])
        readings.header.stamp = node.get_clock().now().to_msg()
        angles = JointState(name=names, position=frame["joints"])
        angles.header.stamp = readings.header.stamp
        joints.publish(angles)
        phase.publish(String(data=frame["phase"]))
        # The cells complete the frame.
        time.sleep(0.02)
        cells.publish(readings)
        print("sent", flush=True)
    rclpy.shutdown()


if __name__ == "__main__":
    main()
