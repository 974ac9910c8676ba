# SPDX-License-Identifier: Apache-2.0
"""Child processes with ROS 2 nodes, for the demo and the benchmark of the node; no other machine can see them."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from paul_ros.errors import MissingPackageError
from paul_ros.extras import needs_ros
from paul_ros.signals import delayed_signals, raise_signals

_END_TIMEOUT = 30.0  # seconds for a process to end by itself
_TERMINATE_TIMEOUT = 5.0  # seconds after SIGTERM until it is killed


def need_ros(what: str) -> None:
    """Check that ROS 2 is installed, and choose the middleware before it loads.

    Args:
        what: subject of the error, as 'the demo'.

    Raises:
        MissingPackageError: there is no rclpy.
    """
    # Only this machine, and the one middleware that PyPI has.
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    try:
        import rclpy  # noqa: F401
    except ImportError as error:
        raise MissingPackageError(needs_ros(what)) from error


def ros_environment() -> dict[str, str]:
    """Return the environment of the children: a ROS domain of this run's own, and the same paul_ros as here."""
    package = str(Path(__file__).resolve().parent.parent.parent)
    paths = [package, *filter(None, [os.environ.get("PYTHONPATH")])]
    return {
        **os.environ,
        # 1 to 100: the ports of higher domains can collide with those that Linux hands out.
        "ROS_DOMAIN_ID": str(1 + (os.getpid() + 50) % 100),
        "PYTHONPATH": os.pathsep.join(paths),
        "PYTHONSAFEPATH": "1",
        "PYTHONUNBUFFERED": "1",
    }


@contextlib.contextmanager
def process(
    arguments: Sequence[str], environment: dict[str, str], log: BinaryIO, stdout: Any = None
) -> Iterator[subprocess.Popen]:
    """Run a Python module as a child process during the block, then end it if it still runs.

    Args:
        arguments: the module and its arguments.
        environment: environment variables of the child.
        log: file for stderr, and for stdout unless that is given.
        stdout: another place for stdout, as for subprocess.Popen.
    """
    with delayed_signals() as received:  # an interrupt in here would lose the child's id
        child = subprocess.Popen(
            [sys.executable, "-m", *arguments],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=log if stdout is None else stdout,
            stderr=log,
        )
    assert child.stdin
    try:
        raise_signals(received)
        yield child
        child.stdin.close()  # tells the player to leave
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(_END_TIMEOUT)
    finally:
        with contextlib.suppress(BrokenPipeError):
            child.stdin.close()
        _end(child)


def _end(child: subprocess.Popen) -> None:
    """Terminate a process, and kill it only if it does not react: a kill leaks the middleware's shared memory."""
    if child.poll() is None:
        child.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(_TERMINATE_TIMEOUT)
    if child.poll() is None:
        child.kill()
        child.wait()


def tail(log: BinaryIO) -> str:
    """Return the last three lines of a log file as one line."""
    log.seek(0)
    lines = log.read().decode(errors="replace").strip().splitlines()
    return " / ".join(lines[-3:]) or "its log is empty"


def rss_mb(pid: int) -> float:
    """Return the resident memory of a process in MB; NaN for a process that has ended."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024
    return float("nan")
