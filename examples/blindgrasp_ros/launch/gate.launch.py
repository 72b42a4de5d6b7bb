"""Starts a graph, the nodes that connect it to the robot, and a gate: ros2 launch blindgrasp_ros gate.launch.py --show-args"""

import os
import shutil

from blindgrasp_ros.hand import read_table
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction, Shutdown
from launch_ros.actions import Node

ARGUMENTS = {
    "run": ("", "the dataflow file of the graph; without one, the graph is run elsewhere"),
    "graph": ("live_gate", "the name of the graph"),
    "namespace": ("/blindgrasp", "of the topics of decisions: each hand has one of its own, such as /blindgrasp/left"),
    "table": ("", "the topics of the hand (YAML); without one, another bridge sends the frames"),
    "address": ("", "of tactile_source, if it is not its usual socket"),
    "gate": ("none", "lift: an example of an arm that lifts on LIFT alone; gripper: the controller of MoveIt's gripper"),
    "name": ("grasp_gate", "gripper: the name of the gate: each hand has one of its own"),
    "controller": ("", "gripper: the action of the real controller"),
    "grasps_below": ("", "gripper: positions below this close on an object"),
    "grasps_above": ("", "gripper: positions above this do, for a value that grows as the gripper closes"),
    "parallel": ("false", "gripper: ParallelGripperCommand"),
    "wait": ("3.0", "gripper: seconds for a decision after the hand has closed"),
}


# If launch is killed, the kernel ends the processes that it has started.
DIES_WITH_LAUNCH = ["setpriv", "--pdeathsig", "TERM"]


def check(given):
    """Refuses arguments with which nodes would fail again and again."""
    for program in ("blindgrasp", "setpriv"):
        if shutil.which(program) is None:
            raise ValueError(f"the program {program} is not in PATH: install it")
    if given["run"] and not os.path.isfile(given["run"]):
        raise ValueError(f"run:={given['run']}: there is no such file in {os.getcwd()}")
    if not given["table"]:
        return
    try:
        joints = read_table(given["table"]).get("joints", {}).get("topic", "/joint_states")
    except ValueError as error:
        raise ValueError(f"table:={given['table']}: {error}") from None
    if joints.lstrip("/") == f"{given['namespace']}/joint_states".lstrip("/"):
        raise ValueError(f"namespace:={given['namespace']}: the table reads {joints} there, which decisions publishes as well: choose another")


def graph_has_ended(event, _):
    # 3: it has ended as it should, but samples were lost.
    if event.returncode not in (0, 3):
        raise RuntimeError("the graph has failed, see its messages above")
    return Shutdown(reason="the graph has ended")


def actions(context):
    given = {name: context.launch_configurations[name] for name in ARGUMENTS}
    given["namespace"] = given["namespace"].rstrip("/") or "/blindgrasp"
    check(given)

    def node(executable, *arguments):
        return Node(
            package="blindgrasp_ros",
            executable=executable,
            arguments=list(arguments),
            prefix=" ".join(DIES_WITH_LAUNCH),
            exec_name=executable,
            output="screen",
            # A node of decisions that starts again says first that none is valid.
            respawn=True,
            respawn_delay=1.0,
        )

    def option(name):
        return [f"--{name.replace('_', '-')}", given[name]] if given[name] else []

    started = [node("decisions", given["graph"], *option("namespace"))]
    topic = f"{given['namespace']}/decision"
    if given["run"]:
        command = [*DIES_WITH_LAUNCH, "blindgrasp", "run", given["run"], "--name", given["graph"]]
        # Nothing lifts without the graph.
        started.append(ExecuteProcess(cmd=command, name="graph", output="screen", on_exit=graph_has_ended))
    if given["table"]:
        started.append(node("hand", given["table"], *(option("address") or option("graph"))))
    if given["gate"] == "lift":
        started.append(node("lift_gate", "--ros-args", "--remap", f"/blindgrasp/decision:={topic}"))
    elif given["gate"] == "gripper":
        closing = option("grasps_below") + option("grasps_above")
        if not given["controller"] or len(closing) != 2:
            raise ValueError("gate:=gripper needs controller:=ACTION and one of grasps_below:=POSITION and grasps_above:=POSITION")
        parallel = ["--parallel"] if given["parallel"].lower() == "true" else []
        options = option("controller") + closing + option("wait") + option("name") + parallel
        started.append(node("gripper_gate", *options, "--decisions", topic))
    elif given["gate"] != "none":
        raise ValueError(f"gate:={given['gate']}, expected none, lift or gripper")
    return started


def generate_launch_description():
    declared = [DeclareLaunchArgument(name, default_value=usual, description=words) for name, (usual, words) in ARGUMENTS.items()]
    return LaunchDescription([*declared, OpaqueFunction(function=actions)])
