"""The node's process: it spins until a signal ends it, in order.

rclpy's own handlers would end the context at once, and with it all that is still to be said. So
here the main thread does nothing but wait for a signal, and the executor has another one.
"""

from __future__ import annotations

import os
import signal
import sys
import textwrap
import threading

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_USAGE = """\
usage: ros2 run holdfast_ros node [--ros-args [-p NAME:=VALUE]... [--params-file FILE]]

Active sensing for a robot as a lifecycle node of ROS 2 (/holdfast): it decides what to sense and
what to do, and goes on when the service that decides dies. A goal of ~/run starts the run; or a
program of yours drives the robot and asks ~/decide.

for example:
  ros2 run holdfast_ros node --ros-args \\
      -p configuration:=examples/peg_in_hole_2d.yaml -p autostart:=true
  ros2 action send_goal /holdfast/run holdfast_interfaces/action/Run '{}'

parameters:
"""

_USAGE_END = """
Every setting of the configuration file is a parameter as well, by its key (such as
particle_filter.num_particles): docs/settings.md. Topics, services and how a robot is connected
(environment.kind ros): docs/ros.md.
"""


def usage() -> str:
    """Return what ``--help`` prints."""
    from holdfast_ros.ros2.parameters import OWN, OWN_DEFAULTS

    lines = []
    for name, text in OWN.items():
        default = OWN_DEFAULTS[name]
        shown = str(default).lower() if isinstance(default, bool) else default
        words = f"{text} (default: {shown})" if shown not in ("", []) else text
        lines += [f"  {name}", textwrap.indent(textwrap.fill(words, 90), " " * 8)]
    return _USAGE + "\n".join(lines) + "\n" + _USAGE_END


def main(arguments: list[str] | None = None) -> int:
    """Run the node, and return the exit code."""
    given = sys.argv[1:] if arguments is None else arguments
    if "--help" in given or "-h" in given:
        sys.stdout.write(usage())
        return 0
    try:
        import rclpy
        from rclpy.executors import MultiThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        from holdfast_ros.ros2.node import NUM_THREADS, HoldfastNode
    except ImportError as error:
        missing = (error.name or "").partition(".")[0]
        what = "source your ROS 2 (. /opt/ros/DISTRIBUTION/setup.bash)"
        if missing == "holdfast_interfaces":
            what = f"build and source the package {missing} (colcon build --base-paths ros)"
        sys.stderr.write(f"holdfast: error: there is no {missing or error}: {what}\n")
        return 2
    asked_to_end = threading.Event()

    def end(number: int, frame: object) -> None:
        del number, frame
        for handled in saved:
            signal.signal(handled, signal.SIG_DFL)  # the second one ends it at once
        asked_to_end.set()

    saved = [number for number in _SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    for number in saved:
        signal.signal(number, end)
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        node = HoldfastNode()
    except RuntimeError as error:  # what ROS cannot read on the command line, or in a file
        sys.stderr.write(f"holdfast: error: {error}\n")
        return 2
    if not node.autostart:
        how = f"go on with {node.how_to_activate()}; or start it with -p autostart:=true"
        node.get_logger().info(f"unconfigured; {how}")
    elif node.trigger_configure() == node.SUCCESS and node.trigger_activate() == node.SUCCESS:
        node.get_logger().info("active")
    executor = MultiThreadedExecutor(num_threads=NUM_THREADS)
    executor.add_node(node)

    def spin() -> None:
        while rclpy.ok() and not asked_to_end.is_set():
            try:
                executor.spin()
            except Exception as error:  # noqa: BLE001 - one callback's must not end all others
                node.get_logger().error(f"{type(error).__name__}: {error}")

    spinning = threading.Thread(target=spin, name="executor", daemon=True)
    spinning.start()
    asked_to_end.wait()
    if not node.end():
        # A disk that does not answer, say: threads wait for it, and the process would for them.
        sys.stderr.write("holdfast: error: the run has not ended; its journal has everything\n")
        sys.stderr.flush()
        os._exit(1)
    executor.shutdown(timeout_sec=2.0)
    node.destroy_node()
    rclpy.try_shutdown()
    spinning.join(2.0)
    return 0
