# SPDX-License-Identifier: Apache-2.0
"""Child processes that speak ROS 2, for the demo and the benchmark of the node; only this machine hears them."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

_PATIENCE = 30.0  # seconds for a process to end
_LAST_PATIENCE = 5.0  # after which it is killed


def need_ros(what: str) -> None:
    """Raises ImportError, with a text for the user, where there is no rclpy; sets what must be set before it loads."""
    # Before the middleware loads: only this machine, and the one middleware that PyPI has.
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    try:
        import rclpy  # noqa: F401
    except ImportError as error:
        raise ImportError(
            f"{what} needs ROS 2: source /opt/ros/jazzy/setup.bash, or pip install 'paul_ros[ros]'"
        ) from error


def ros_environment() -> dict[str, str]:
    """For the children: a ROS domain of this run's own, and the same paul_ros as here."""
    package = str(Path(__file__).resolve().parent.parent.parent)
    paths = [package, *filter(None, [os.environ.get("PYTHONPATH")])]
    # 1..100: higher domains may meet the ports that Linux hands out.
    return {
        **os.environ,
        "ROS_DOMAIN_ID": str(1 + (os.getpid() + 50) % 100),
        "PYTHONPATH": os.pathsep.join(paths),
        "PYTHONSAFEPATH": "1",
        "PYTHONUNBUFFERED": "1",
    }


@contextlib.contextmanager
def process(
    arguments: Sequence[str], environment: dict[str, str], log: Any, stdout: Any = None
) -> Iterator[subprocess.Popen]:
    """A Python module as a child process; ended, if it still runs, with the block.

    log: a file for what it says, on stdout too unless `stdout` is another place for that.
    """
    with _no_interrupt() as interrupted:  # in the midst of this nobody would know the child's id yet
        child = subprocess.Popen(
            [sys.executable, "-m", *arguments],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=log if stdout is None else stdout,
            stderr=log,
        )
    try:
        if interrupted:
            raise KeyboardInterrupt
        yield child
        child.stdin.close()  # the player's sign to leave
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(_PATIENCE)
    finally:
        with contextlib.suppress(BrokenPipeError):
            child.stdin.close()
        _end(child)


@contextlib.contextmanager
def _no_interrupt() -> Iterator[list]:
    """Ctrl-C raises nothing within the block; the list that is given then holds something."""
    interrupted: list = []
    before = signal.signal(signal.SIGINT, lambda *signalled: interrupted.append(signalled))
    try:
        yield interrupted
    finally:
        signal.signal(signal.SIGINT, before)


def _end(child: subprocess.Popen) -> None:
    """Asks first, since a process that is killed leaves the middleware's shared memory behind."""
    if child.poll() is None:
        child.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(_LAST_PATIENCE)
    if child.poll() is None:
        child.kill()
        child.wait()


def tail(log: Any) -> str:
    """The last lines of a log file, as one."""
    log.seek(0)
    lines = log.read().decode(errors="replace").strip().splitlines()
    return " / ".join(lines[-3:]) or "it said nothing"


def rss_mb(pid: int) -> float:
    """Resident memory of a process now."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024
    return float("nan")
