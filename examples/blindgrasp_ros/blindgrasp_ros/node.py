"""The parts that the nodes of this package share."""

import functools
import sys
import time

# A decision may come from a machine whose clock is so far ahead.
MAX_AHEAD_NANOS = 50_000_000


def arguments():
    """The arguments of this program; rclpy reads those that follow --ros-args."""
    own = sys.argv[1:]
    return own[: own.index("--ros-args")] if "--ros-args" in own else own


def ended_by_signals(work):
    """Decorates the work of a node: ROS 2 begins, and from then on a signal ends the work without an error."""

    @functools.wraps(work)
    def begin(*of):
        import rclpy

        rclpy.init()
        try:
            work(*of)
        except KeyboardInterrupt:
            pass
        except Exception:
            # A signal that ends ROS 2 makes the next call of rclpy raise one of several errors.
            if rclpy.ok():
                raise
        finally:
            rclpy.try_shutdown()

    return begin


def spin(node, executor=None):
    """Runs a node until a signal comes."""
    import rclpy
    from rclpy.clock import Clock, ClockType

    # rclpy can fall asleep on a signal that comes just then; it looks again when it wakes.
    node.create_timer(1.0, lambda: None, clock=Clock(clock_type=ClockType.STEADY_TIME))
    rclpy.spin(node, executor)


def nanos_of(stamp):
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def clock_fault(decision):
    """Why nobody knows how long a LIFT is valid, in words; None if its stamp is a time that has come."""
    ahead_nanos = nanos_of(decision.stamp) - time.time_ns()
    if ahead_nanos <= MAX_AHEAD_NANOS:
        return None
    return f"the decision's stamp lies {ahead_nanos / 1e6:.0f} ms in the future: a clock was set back, or two machines need NTP"


def topic_fault(node, topic, n_least=1):
    """Why decisions on a topic do not count, in words; None if one node publishes them, or if none may and none does."""
    n = node.count_publishers(topic)
    if n_least <= n <= 1:
        return None
    hint = "stop all but one; DDS forgets a killed one after up to 20 s" if n else "start the node of decisions"
    return f"{n} nodes publish {topic}, expected one: {hint}"
