# SPDX-License-Identifier: Apache-2.0
"""The process of the node `lifter`: arguments, signals and the event loop. Run it by `ros2 run paul_ros lifter`."""

from __future__ import annotations

import os
import signal
import sys

if __name__ == "__main__":
    # The imports below take a third of a second; a signal meanwhile is no error.
    for _number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(_number, lambda *_: sys.exit(0))

    # Before numpy is imported: its threads cost up to 100x on matrices as small as these, and take CPU from the robot.
    for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[_variable] = "1"

    try:
        import rclpy
    except ImportError as _error:
        from paul_ros.extras import needs_ros

        sys.exit(f"lifter: {needs_ros('the node')} ({' '.join(str(_error).split())})")

import argparse
import textwrap
import threading
import time

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from paul_ros.ros.node import LifterNode, one_line
from paul_ros.ros.node_parameters import REFUSALS
from paul_ros.ros.rclpy_internals import OneThreadExecutor
from paul_ros.stream.parameters import as_text

_HELP_COLUMNS = 80

_STOP_SECONDS = 0.2
"""Interval in which an idle node checks for a signal to end."""


def main() -> int:
    """Run the node until SIGINT or SIGTERM; return 0 after a clean end, 1 if it cannot start."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        _init_ros(sys.argv)
        node = LifterNode()
        if node.get_parameter("autostart").value:
            node.start()
    except REFUSALS as error:
        print(f"lifter: {one_line(error)}", file=sys.stderr)
        rclpy.try_shutdown()
        return 1
    state = "Ready" if node.active else "Waiting to be configured,"
    node.get_logger().info(f"{state} {_process_seconds():.2f} s after the process started.")
    spin(node, stop)
    node.end()
    print(node.summary(), file=sys.stderr, flush=True)
    node.destroy_node()
    rclpy.try_shutdown()
    return 0


def spin(node: LifterNode, stop: threading.Event) -> None:
    """Run the node's callbacks until `stop` is set."""
    executor = OneThreadExecutor()
    executor.add_node(node)
    # A timer of the node's, not a timeout of spin_once: that would make and destroy a timer each time.
    node.create_timer(_STOP_SECONDS, lambda: None, clock=Clock(clock_type=ClockType.STEADY_TIME))
    while rclpy.ok() and not stop.is_set():
        executor.spin_once()


def _init_ros(argv: list[str]) -> None:
    """Parse the arguments and initialise rclpy; raises ValueError if ROS refuses them."""
    try:
        _parse(argv)
        # rclpy's own handlers would shut the context down during a frame, which could then not be published.
        rclpy.init(args=argv, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        raise ValueError(
            f"ROS does not start: {error}; arguments are --ros-args -p NAME:=VALUE, -r FROM:=TO, "
            "--params-file FILE, see --help"
        ) from error


def _parse(argv: list[str]) -> None:
    """Refuse everything but ROS arguments and --help."""
    parser = argparse.ArgumentParser(
        prog="lifter",
        description=textwrap.fill(
            "Lift 2D keypoints to 3D. Subscribes to keypoints, camera_info and depth; publishes ~/poses, ~/bodies, "
            "~/persons, ~/keypoints3d, ~/markers, ~/layout and /diagnostics.",
            _HELP_COLUMNS,
        ),
        epilog="Set parameters with --ros-args -p NAME:=VALUE,\ntopics with --ros-args -r keypoints:=TOPIC.\n\n"
        f"parameters:\n{as_text(_HELP_COLUMNS)}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.parse_args(remove_ros_args(argv)[1:])


def _process_seconds() -> float:
    """Return the seconds since this process started, by the kernel's clock."""
    with open("/proc/self/stat", encoding="ascii") as file:
        # The second field, the name, may hold spaces; the start time is the 20th field after it.
        ticks = int(file.read().rpartition(")")[2].split()[19])
    return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    sys.exit(main())
