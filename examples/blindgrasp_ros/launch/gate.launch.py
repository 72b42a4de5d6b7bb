"""Starts a graph, the nodes that connect it to the robot, and a gate: ros2 launch blindgrasp_ros gate.launch.py --show-args"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction, Shutdown
from launch_ros.actions import Node

ARGUMENTS = {
    "run": ("", "the dataflow file of the graph; without one, the graph is run elsewhere"),
    "graph": ("live_gate", "the name of the graph"),
    "namespace": ("/blindgrasp", "of the topics of decisions: each hand has one of its own"),
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


def actions(context):
    given = {name: context.launch_configurations[name] for name in ARGUMENTS}
    given["namespace"] = given["namespace"].rstrip("/") or "/blindgrasp"

    def node(executable, *arguments):
        arguments = list(arguments)
        # A node of decisions that starts again says first that none is valid.
        return Node(package="blindgrasp_ros", executable=executable, arguments=arguments, output="screen", respawn=True, respawn_delay=1.0)

    def option(name):
        return [f"--{name.replace('_', '-')}", given[name]] if given[name] else []

    started = [node("decisions", given["graph"], *option("namespace"))]
    topic = f"{given['namespace']}/decision"
    if given["run"]:
        command = ["blindgrasp", "run", given["run"], "--name", given["graph"]]
        # Nothing lifts without the graph.
        started.append(ExecuteProcess(cmd=command, output="screen", on_exit=Shutdown(reason="the graph has ended")))
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
