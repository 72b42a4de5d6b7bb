"""Publishes what a running graph decides and feels, in any RMW: ros2 run blindgrasp_ros decisions GRAPH

The topics, in the namespace /blindgrasp: `decision` (blindgrasp_msgs Decision, reliable, transient local); the outputs named by
--outputs, as blindgrasp_msgs has them; `joint_states`, `cell_points`, `contact_points` and `hand_markers`, for RViz. The service
`decide` waits for a decision. The state of the graph is on /diagnostics. The node waits for a graph that does not run. It needs
rclpy, blindgrasp_msgs, and the program blindgrasp on the graph's machine.

A LIFT whose time is over when it is published is a HOLD (`stale`), and within a second after its time is over it is taken back by
one. When the node begins and when the graph ends, however that happens, it publishes a HOLD (`no_graph`). A HOLD takes the place of
the last decision for nodes that come later.
"""

import argparse
import collections
import importlib
import json
import os
import shutil
import subprocess
import sys
import threading
import time
import traceback

from blindgrasp_ros.node import arguments, ended_by_signals, spin

# Calls of `decide` that wait at the same time; each has a thread. The eldest makes room for a new one, without a decision.
MAX_WAITING = 16
MAX_TIMEOUT_S = 60.0
# A graph that does not run is looked for so often.
RETRY_S = 1.0
NO_GRAPH = {"grasp_id": 0, "action": "hold", "reason": "no_graph", "probability_stable": 0.0}
# Counts of nodes that tell of samples from outside that were not used, or not sent.
REFUSALS = ("malformed", "oversized", "cut_off", "late", "out_of_order", "disbelieved", "refused_clients", "unzeroed", "unpublished")
OK, WARN, ERROR = b"\0", b"\1", b"\2"


def boottime_nanos():
    """The clock of `valid_until_nanos`."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def fill(message, decision, until_nanos):
    """Fills a Decision with one that is valid until a time of this machine, as it is said now; without a time it is not valid."""
    # This clock is read first: a pause before the other one is read can only shorten the time.
    wall_nanos = time.time_ns()
    left_nanos = max(0, (until_nanos or 0) - boottime_nanos())
    if decision["action"] == "lift" and until_nanos is not None and left_nanos == 0:
        decision = {**decision, "action": "hold", "reason": "stale", "probability_stable": 0.0}
    for stamp, nanos in [(message.stamp, wall_nanos), (message.valid_until, wall_nanos + left_nanos)]:
        stamp.sec, stamp.nanosec = divmod(nanos, 1_000_000_000)
    message.action = getattr(type(message), decision["action"].upper())
    message.grasp_id, message.reason = decision["grasp_id"], decision["reason"]
    message.probability_stable = decision["probability_stable"]
    return message


class Decisions:
    """The last decision, for calls that wait for one."""

    def __init__(self):
        self.condition = threading.Condition()
        self.last, self.until_nanos = NO_GRAPH, None
        self.waiting = collections.deque()

    def is_valid(self):
        return (self.until_nanos or 0) > boottime_nanos()

    def set(self, decision, until_nanos):
        """Keeps a decision. `go_on` does not take the place of `tighten`."""
        with self.condition:
            told = self.last["action"], self.last["grasp_id"]
            if decision["action"] == "go_on" and self.is_valid() and told == ("tighten", decision["grasp_id"]):
                return
            self.last, self.until_nanos = decision, until_nanos
            self.condition.notify_all()

    def wait(self, timeout_s):
        """The last decision if it is valid, otherwise the next one that is, with the end of its time; None if none comes."""
        call = object()
        with self.condition:
            self.waiting.append(call)
            if len(self.waiting) > MAX_WAITING:
                self.waiting.popleft()
                self.condition.notify_all()
            # Without a number above 0, the call does not wait.
            timeout_s = min(timeout_s, MAX_TIMEOUT_S) if timeout_s > 0 else 0
            self.condition.wait_for(lambda: self.is_valid() or call not in self.waiting, timeout_s)
            if call in self.waiting:
                self.waiting.remove(call)
            return (self.last, self.until_nanos) if self.is_valid() else None


def grown(now, before, names):
    """The counts of these names that have grown, in words."""
    growth = {name: now.get(name, 0) - before.get(name, 0) for name in names}
    return [f"{n} {name}" for name, n in growth.items() if n > 0]


def statuses(now, before):
    """The state of the graph, its nodes and its edges, by two lines of `blindgrasp top --json`: level, part, message and values.
    What was refused, lost or late since the line before is a warning; so is a node that was started again."""
    state, decisions = now["state"], now["decisions"]
    level = {"running": OK, "degraded": ERROR}.get(state, WARN)
    away = [peer["machine"] for peer in (now.get("link") or {}).get("peers", []) if peer["state"] != "up"]
    words = [now["message"]] * bool(now["message"]) + [f"cut off: {machine}" for machine in away]
    values = {"uptime_secs": now["uptime_secs"], "n_lift": decisions["n_lift"], "n_hold": decisions["n_hold"]}
    values |= {f"decision_latency_{name}_nanos": nanos for name, nanos in (now["decision_latency_nanos"] or {}).items()}
    found = [(max(level, WARN) if away else level, "graph", "; ".join([state, *words]), values)]
    nodes = {node["node"]: node for node in before["nodes"]}
    for node in now["nodes"]:
        other = nodes.get(node["node"], node)
        words = grown(node["counts"], other["counts"], REFUSALS) + grown(node, other, ["n_restarts"])
        level = ERROR if node["state"] == "failed" else OK if node["state"] in ("running", "done") and not words else WARN
        values = {name: node[name] for name in ("n_restarts", "n_swaps", "pid", "cpu_percent", "resident_bytes")} | node["counts"]
        found.append((level, node["node"], "; ".join([node["state"], *words]), values))
    edges = {(edge["from"], edge["to"]): edge for edge in before["edges"]}
    for edge in now["edges"]:
        names = ["late", "dropped"] if edge["policy"] == "lossless" else ["late"]
        words = grown(edge, edges.get((edge["from"], edge["to"]), edge), names)
        values = {name: edge[name] for name in ("received", "n_queued", "dropped", "missing", "late", "repeated")}
        found.append((WARN if words else OK, f"{edge['from']} -> {edge['to']}", "; ".join([f"{edge['rate_hz']:.1f} Hz", *words]), values))
    return found


def follow(command, take, has_ended):
    """Runs a command again and again. Each of its lines of JSON goes to `take`; its end, with its last words, to `has_ended`."""
    while True:
        said = ""
        # It gets SIGTERM if this process is killed.
        dying = ["setpriv", "--pdeathsig", "TERM", *command]
        with subprocess.Popen(dying, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as child:
            for line in child.stdout:
                try:
                    found = json.loads(line)
                except ValueError:
                    # A warning, an error, or a line that was cut off.
                    said = line.strip()
                    continue
                take(found)
        has_ended(said)
        time.sleep(RETRY_S)


class Publishing:
    """The node's publishers, and the lines that they publish."""

    def __init__(self, node, graph):
        from blindgrasp_msgs.msg import Decision
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        self.node, self.graph = node, graph
        self.decisions = Decisions()
        qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.message, self.decision = Decision, node.create_publisher(Decision, "decision", qos)
        # The publishers of other topics; None where the type of the messages is not there.
        self.others = {}
        self.said = None
        self.top = None
        self.decide(NO_GRAPH, None)

    def begin_anew(self, said):
        """Says that no decision is valid: the graph has ended, or does not run yet."""
        if said != self.said:
            self.node.get_logger().warning(f"{said or 'the graph has ended'}; waiting for it")
            self.said = said
        if self.decisions.last is not NO_GRAPH:
            self.decide(NO_GRAPH, None)

    def decide(self, decision, until_nanos):
        # The threads of the graph's lines and of the timer publish.
        with self.decisions.condition:
            self.decisions.set(decision, until_nanos)
            self.published = fill(self.message(), decision, until_nanos)
            self.decision.publish(self.published)

    def take_back(self):
        """Publishes a HOLD in place of a LIFT whose time is over. A replay has no such time."""
        with self.decisions.condition:
            last, until_nanos = self.decisions.last, self.decisions.until_nanos
            if self.published.action == self.message.LIFT and until_nanos is not None and not self.decisions.is_valid():
                self.decide(last, until_nanos)

    def answer(self, request, response):
        found = self.decisions.wait(request.timeout_secs)
        response.decided = found is not None
        if found is not None:
            fill(response.decision, *found)
        return response

    def take(self, line):
        """A line of `blindgrasp echo --cdr`."""
        if "decision" in line:
            return self.decide(line["decision"], line["valid_until_nanos"])
        publisher = self.publisher(line["topic"], line["type"])
        if publisher is not None and publisher.get_subscription_count():
            publisher.publish(bytes.fromhex(line["cdr"]))

    def publisher(self, topic, kind):
        from rclpy.qos import qos_profile_sensor_data

        if topic not in self.others:
            package, folder, name = kind.split("/")
            try:
                found = getattr(importlib.import_module(f"{package}.{folder}"), name)
                self.others[topic] = self.node.create_publisher(found, topic.removeprefix("/"), qos_profile_sensor_data)
            except (ImportError, AttributeError) as error:
                self.node.get_logger().warning(f"{topic} is not published: no {kind} ({error}): install or build its package")
                self.others[topic] = None
        return self.others[topic]

    def diagnose(self, line):
        """A line of `blindgrasp top --json`."""
        self.show(statuses(line, self.top or line))
        self.top = line

    def has_no_state(self, said):
        self.top = None
        self.show([(ERROR, "graph", said or "the graph does not run", {})])

    def show(self, found):
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

        message = DiagnosticArray()
        message.header.stamp = self.node.get_clock().now().to_msg()
        for level, part, words, values in found:
            pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items() if value is not None]
            name = f"blindgrasp/{self.graph}: {part}"
            message.status.append(DiagnosticStatus(level=level, name=name, message=words, hardware_id="blindgrasp", values=pairs))
        if "/diagnostics" not in self.others:
            self.others["/diagnostics"] = self.node.create_publisher(DiagnosticArray, "/diagnostics", 1)
        self.others["/diagnostics"].publish(message)


@ended_by_signals
def serve(arguments):
    import rclpy
    from blindgrasp_msgs.srv import Decide
    from rclpy.callback_groups import ReentrantCallbackGroup
    from rclpy.clock import Clock, ClockType
    from rclpy.executors import MultiThreadedExecutor

    node = rclpy.create_node("blindgrasp", namespace=arguments.namespace)
    publishing = Publishing(node, arguments.graph)
    node.create_service(Decide, "decide", publishing.answer, callback_group=ReentrantCallbackGroup())

    def work(*of):
        try:
            follow(*of)
        except Exception:
            if rclpy.ok():
                # A node that publishes no more must not seem to work.
                traceback.print_exc()
                os._exit(1)

    echo = [arguments.program, "echo", "--cdr", "--graph", arguments.graph, *arguments.outputs]
    top = [arguments.program, "top", "--json", arguments.graph]
    node.create_timer(1.0, publishing.take_back, clock=Clock(clock_type=ClockType.STEADY_TIME))
    threading.Thread(target=work, args=(echo, publishing.take, publishing.begin_anew), daemon=True).start()
    threading.Thread(target=work, args=(top, publishing.diagnose, publishing.has_no_state), daemon=True).start()
    spin(node, MultiThreadedExecutor(num_threads=MAX_WAITING + 4))


def main():
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("graph", help="its name, as `blindgrasp ps` tells it")
    options.add_argument("--outputs", nargs="+", default=["decision", "tactile", "contacts"], help="of the graph, as NODE/PORT or PORT")
    options.add_argument("--namespace", default="/blindgrasp", help="of topics and service")
    options.add_argument("--program", default="blindgrasp", help="the program of the graph")
    given = options.parse_args(arguments())
    for program in (given.program, "setpriv"):
        if shutil.which(program) is None:
            sys.exit(f"the program {program} is not in PATH: install it" + (", or name it with --program" if program != "setpriv" else ""))
    serve(given)
    # The threads may be in rclpy, which an orderly end of Python would take from them.
    os._exit(0)


if __name__ == "__main__":
    main()
