# SPDX-License-Identifier: Apache-2.0
"""Processes of `paul benchmark node`: a publisher, a listener and the measured nodes, which speak over DDS."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sized
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, BinaryIO, TypeVar

import numpy as np

from paul_ros.benchmarks.node_messages import camera_info, clouds
from paul_ros.benchmarks.traffic import ARRIVAL, NODES
from paul_ros.errors import NodeBenchmarkError
from paul_ros.offline.processes import need_ros, process, ros_environment, rss_mb, tail

#: Name of a measured node -> its Python module.
MODULES = {"lifter": "paul_ros.ros.lifter_process", "echo": "paul_ros.benchmarks.echo"}

_PROBE_HZ = 100.0  # rate of the messages that wait for a node's first output
_TIMEOUT = 30.0  # seconds for a process to answer
_SILENCE = 1.0  # seconds without an answer after which no more are expected
_POLL = 0.02  # seconds

_Found = TypeVar("_Found", bound=Sized)


@dataclass(frozen=True)
class Turn:
    """A measured run of one node.

    Attributes:
        sent: number of messages sent.
        latency_us: (N,) microseconds from the publisher's stamp to the arrival of the N answers at the listener.
        cpu_s: CPU time of the node's process in seconds.
    """

    sent: int
    latency_us: np.ndarray
    cpu_s: float


class NodeBench:
    """A publisher and a listener that run all the time, and the nodes between them.

    Attributes:
        nodes: name -> process of each started node.
    """

    def __init__(
        self, folder: Path, log: BinaryIO, environment: dict[str, str], processes: contextlib.ExitStack
    ) -> None:
        """Start the publisher and the listener, and wait until both are ready.

        Args:
            folder: messages to send, as `node_bench` writes them.
            log: file for the output of all processes.
            environment: environment variables of all processes.
            processes: ends all processes when it closes.
        """
        self.nodes: dict[str, subprocess.Popen] = {}
        self._folder, self._log, self._environment, self._processes = folder, log, environment, processes
        self._arrived: np.ndarray = np.zeros(0, ARRIVAL)
        self._unread = b""
        start = partial(process, environment=environment, log=log, stdout=subprocess.PIPE)
        self._publisher, self._listener = (
            processes.enter_context(start(["paul_ros.benchmarks.traffic", end])) for end in ("publish", "listen")
        )
        self._commands, self._answers = _pipe(self._publisher.stdin), _pipe(self._publisher.stdout)
        self._arrivals = _pipe(self._listener.stdout).fileno()
        os.set_blocking(self._arrivals, False)
        self._read_answer()
        self._wait(lambda: self._arrived, "sign of the listener")

    def terminate(self) -> None:
        """Tell the nodes and the listener to end: a process that is killed leaks the middleware's shared memory."""
        for child in (*self.nodes.values(), self._listener):
            child.terminate()

    def start_all(self, *names: str) -> None:
        """Start nodes and send the camera to the lifter, which must be one of them."""
        for name in names:
            self.start(name)
        self._ask({"camera_info": str(self._folder / "camera_info.npy")})

    def start(self, name: str) -> float:
        """Start a node while messages are sent, as by a detector that runs already.

        Returns:
            Seconds from the start of its process to its first output.
        """
        self._send(
            {"node": name, "messages": self._messages(min(self._persons())), "rate_hz": _PROBE_HZ, "count": None}
        )
        began = time.time_ns()
        arguments = ["--ros-args", "-r", f"keypoints:=/{name}/keypoints", "-r", f"camera_info:=/{name}/camera_info"]
        arguments += ["-p", f"max_persons:={max(self._persons())}"] if name == "lifter" else []
        self.nodes[name] = self._processes.enter_context(
            process([MODULES[name], *arguments], self._environment, self._log)
        )
        first = self._wait(lambda: self._of_node(name), f"first output of the {name}")
        self._send(None)
        self._read_answer()
        return float(first["arrival"][0] - began) / 1e9

    def measure(self, name: str, persons: int, rate: float, count: int) -> Turn:
        """Send `count` messages of so many persons to a node at a rate in Hz, and wait for its answers."""
        before = cpu_seconds(self.nodes[name].pid)
        sent = self._ask({"node": name, "messages": self._messages(persons), "rate_hz": rate, "count": count})
        arrived = self._await_arrivals(name, sent)
        cpu = cpu_seconds(self.nodes[name].pid) - before
        return Turn(sent["sent"], (arrived["arrival"] - arrived["stamp"]) / 1000, cpu)

    def rss_mb(self, name: str) -> float:
        """Return the resident memory of a node in MB."""
        return rss_mb(self.nodes[name].pid)

    def _persons(self) -> list[int]:
        """Return the numbers of persons for which there are messages."""
        return [int(file.stem) for file in self._folder.glob("[0-9]*.npy")]

    def _messages(self, persons: int) -> str:
        return str(self._folder / f"{persons}.npy")

    def _await_arrivals(self, name: str, sent: dict) -> np.ndarray:
        """Return the arrivals for what was sent, as soon as all came or no more come."""
        last, count = time.monotonic(), 0
        while count < sent["sent"] and time.monotonic() - last < _SILENCE:
            time.sleep(_POLL)
            self._take_arrivals()
            now = len(self._between(name, sent))
            if now > count:
                last, count = time.monotonic(), now
        found = self._between(name, sent)
        self._arrived = self._arrived[:0]
        return found

    def _between(self, name: str, sent: dict) -> np.ndarray:
        of_node = self._of_node(name)
        return of_node[(of_node["stamp"] >= sent["first"]) & (of_node["stamp"] <= sent["last"])]

    def _of_node(self, name: str) -> np.ndarray:
        return self._arrived[self._arrived["node"] == NODES.index(name)]

    def _take_arrivals(self) -> None:
        """Read what the listener has written so far."""
        with contextlib.suppress(BlockingIOError):
            while data := os.read(self._arrivals, 1 << 16):
                self._unread += data
        whole = len(self._unread) // ARRIVAL.itemsize * ARRIVAL.itemsize
        new, self._unread = np.frombuffer(self._unread[:whole], ARRIVAL), self._unread[whole:]
        self._arrived = np.concatenate([self._arrived, new])

    def _ask(self, command: dict) -> dict:
        self._send(command)
        return self._read_answer()

    def _send(self, command: dict | None) -> None:
        """Send a command to the publisher; None ends a command that has no count."""
        self._commands.write((json.dumps(command) if command else "").encode() + b"\n")
        self._commands.flush()

    def _read_answer(self) -> dict:
        """Wait for the publisher's answer; arrivals are read meanwhile, as the pipe would fill up."""
        ready = self._wait(lambda: select.select([self._answers], [], [], 0)[0], "the publisher's answer", None)
        return json.loads(ready[0].readline())

    def _wait(self, condition: Callable[[], _Found], what: str, timeout: float | None = _TIMEOUT) -> _Found:
        """Return what the condition gives as soon as it is not empty.

        Raises:
            NodeBenchmarkError: a process ended, or `timeout` seconds are over.
        """
        began = time.monotonic()
        while True:
            found = condition()
            if len(found):
                return found
            for name, child in {"publisher": self._publisher, "listener": self._listener, **self.nodes}.items():
                if child.poll() is not None:
                    raise NodeBenchmarkError(f"the {name} ended by itself ({child.returncode}): {tail(self._log)}")
            if timeout and time.monotonic() - began > timeout:
                raise NodeBenchmarkError(f"no {what} within {timeout:.0f} s: {tail(self._log)}")
            time.sleep(_POLL)
            self._take_arrivals()


def _pipe(stream: IO[bytes] | None) -> IO[bytes]:
    assert stream is not None, "the process was started with a pipe here"
    return stream


@contextlib.contextmanager
def node_bench(persons: list[int]) -> Iterator[NodeBench]:
    """Run a NodeBench during the block, with messages for these numbers of persons.

    Raises:
        MissingPackageError: ROS 2 is not installed.
        BagError: the shipped recording is not installed.
        NodeBenchmarkError: a process fails.
    """
    need_ros("the benchmark")
    with tempfile.TemporaryDirectory() as name, tempfile.TemporaryFile() as log:
        folder = Path(name)
        np.save(folder / "camera_info.npy", camera_info())
        for count in persons:
            np.save(folder / f"{count}.npy", clouds(count))
        with contextlib.ExitStack() as processes:
            bench = NodeBench(folder, log, ros_environment(), processes)
            yield bench
            bench.terminate()


def cpu_seconds(pid: int) -> float:
    """Return the CPU time of all threads of a process in seconds, to the nanosecond: /proc/PID/stat counts in 10 ms.

    The clock's id is made from the process id as in clock_getcpuclockid(3) of Linux.
    """
    return time.clock_gettime((~pid << 3) | 2)
