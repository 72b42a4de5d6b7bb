#!/usr/bin/env python3
"""A robot in ROS 2 over Zenoh, for network/tests/e2e/ros2.rs: a router, and nodes of zenoh-ros2-sdk.

Reads frames of a recording, one JSON object a line, from stdin. It publishes each as joint_states, phase and cells, prints
each decision as a line, and ends after the last one. Types and their hashes are those of rosbags, which knows ROS 2 Jazzy.

Usage: ros2_peer.py PORT RATE_HZ N_DECISIONS DECISION.msg
"""

import json
import os
import queue
import sys
import time
import traceback

os.environ["GIT_PYTHON_REFRESH"] = "quiet"

import numpy
import zenoh
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from zenoh_ros2_sdk import ROS2Publisher, ROS2ServiceClient, ROS2Subscriber
from zenoh_ros2_sdk.qos import QosDurability, QosProfile
from zenoh_ros2_sdk.session import ZenohSession
from zenoh_ros2_sdk.utils import compute_service_type_hash

DECISION = "blindgrasp_msgs/msg/Decision"
DECIDE = "blindgrasp_msgs/srv/Decide"


def main() -> None:
    port, rate_hz, n_decisions = int(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])
    router = {"mode": "router", "listen": {"endpoints": [f"tcp/127.0.0.1:{port}"]}, "scouting": {"multicast": {"enabled": False}}}
    router = zenoh.open(zenoh.Config.from_json5(json.dumps(router)))
    manager = ZenohSession.get_instance("127.0.0.1", port)
    manager.store = store = get_typestore(Stores.ROS2_JAZZY)
    with open(sys.argv[4], encoding="utf-8") as file:
        definition = file.read()
    store.register(get_types_from_msg(definition, DECISION))
    manager._registered_types.update({name: name for name in store.types})

    def node(kind, topic, message, **more):
        return kind(topic=topic, msg_type=message, router_port=port, type_hash=store.hash_rihs01(message), **more)

    decisions = queue.Queue()
    late = QosProfile(durability=QosDurability.TRANSIENT_LOCAL)
    node(ROS2Subscriber, "/decision", DECISION, callback=decisions.put)
    markers = []
    node(ROS2Subscriber, "/hand_markers", "visualization_msgs/msg/MarkerArray", callback=lambda said: markers.append(said.markers))
    clouds = []
    node(ROS2Subscriber, "/cell_points", "sensor_msgs/msg/PointCloud2", callback=clouds.append)
    last_frame = router.declare_subscriber("0/tactile/**", zenoh.handlers.RingChannel(1))
    joints = node(ROS2Publisher, "/robot/joint_states", "sensor_msgs/msg/JointState")
    cells = node(ROS2Publisher, "/cells", "std_msgs/msg/Float64MultiArray")
    phases = node(ROS2Publisher, "/phase", "std_msgs/msg/String")
    types = store.types
    layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    names = json.loads(sys.stdin.readline())
    print(json.dumps("ready"), flush=True)
    sys.stdin.readline()
    # After a restart of the router, blindgrasp comes back within some seconds.
    while not all(publisher.pub.matching_status.matching for publisher in (joints, cells)):
        time.sleep(0.05)
    # The phase may be without a reader.
    patience = time.monotonic() + 2
    while not phases.pub.matching_status.matching and time.monotonic() < patience:
        time.sleep(0.05)
    publisher = "@ros2_lv/*/*/*/*/MP/*/*/*/%decision/**"
    while not any(reply.ok for reply in manager.liveliness.get(publisher)):
        time.sleep(0.05)
    due = time.monotonic()
    for line in sys.stdin:
        frame = json.loads(line)
        now = time.time_ns()
        stamp = types["builtin_interfaces/msg/Time"](sec=now // 10**9, nanosec=now % 10**9)
        header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="palm")
        empty = numpy.zeros(0)
        # Other joints of the robot, in another order, are on the topic as well.
        position = numpy.array([9.0, *reversed(frame["joints"])])
        joints.publish(header=header, name=["elbow", *reversed(names)], position=position, velocity=empty, effort=empty)
        phases.publish(data=frame["phase"])
        cells.publish(layout=layout, data=numpy.array(frame["cells_newtons"]))
        due += 1 / rate_hz
        time.sleep(max(0.0, due - time.monotonic()))
    for _ in range(n_decisions):
        said = decisions.get(timeout=60)
        valid_secs = (said.valid_until.sec - said.stamp.sec) + 1e-9 * (said.valid_until.nanosec - said.stamp.nanosec)
        print(json.dumps({"grasp_id": said.grasp_id, "action": said.action, "reason": said.reason,
                          "probability": said.probability_stable, "valid_secs": valid_secs}), flush=True)
    # It is told again to a node that asks.
    with open(sys.argv[4].replace("Decision.msg", "Decide.srv"), encoding="utf-8") as file:
        request, response = file.read().split("---")
    client = ROS2ServiceClient(
        service_name="/decide", srv_type=DECIDE, request_definition=request, response_definition=response, router_port=port,
        type_hash=compute_service_type_hash(DECIDE, request, response, {DECISION: definition}), timeout=30)
    answers = [client.call(timeout_secs=secs) for secs in (5.0, -1.0)]
    print(json.dumps([[answer.decided, answer.decision.grasp_id, answer.decision.action] for answer in answers]), flush=True)
    # A node that comes later gets the last decision. (zenoh-ros2-sdk finds no publisher whose topic has two words.)
    again = queue.Queue()
    node(ROS2Subscriber, "/decision", DECISION, callback=again.put, qos=late)
    print(json.dumps({"late": again.get(timeout=60).grasp_id}), flush=True)
    replies = manager.liveliness.get("@ros2_lv/**")
    tokens = sorted("/".join(str(reply.ok.key_expr).split("/")[5:]) for reply in replies if reply.ok)
    print(json.dumps({"tokens": tokens}), flush=True)
    hand = markers[-1]
    felt = any(colour.r > 0.4 for picture in markers for colour in picture[-1].colors)
    print(json.dumps({"frame": list(bytes(last_frame.recv().payload)),
                      "pictures": len(markers), "shapes": len(hand) - 1, "cells": len(hand[-1].points),
                      "points": [clouds[-1].width, [field.name for field in clouds[-1].fields]],
                      "size": [hand[0].scale.x, hand[0].scale.y, hand[0].scale.z], "felt": felt}), flush=True)


try:
    main()
except Exception:
    traceback.print_exc()
    os._exit(1)
# Threads of Zenoh would keep the process.
os._exit(0)
