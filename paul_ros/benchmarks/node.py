# SPDX-License-Identifier: Apache-2.0
"""`paul benchmark node`: what the lifter costs on a robot, beside a node that does not lift.

Publisher, node and listener are processes of their own and speak over DDS on this machine. The lifter and the echo
node are sent the same messages in turns, a second or two each, so that whatever disturbs the machine disturbs both.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import select
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from msg_adapters import outputs, read
from paul_ros.benchmarks.traffic import ARRIVAL, NODES
from paul_ros.errors import NodeBenchmarkError
from paul_ros.offline.bag import BagMessages, read_records
from paul_ros.offline.demo import find_bag
from paul_ros.offline.processes import need_ros, process, ros_environment, rss_mb, tail
from paul_ros.offline.replay import versions

STARTS = 3
"""Of each node, for the time from its start to its first output."""
SLICE_SECONDS = 2.0
"""One node is measured for about so long before it is the other's turn."""
SOAK_SECONDS = 10.0
"""Memory is read so often in a long run."""

_MODULES = {"lifter": "paul_ros.ros.lifter_process", "echo": "paul_ros.benchmarks.echo"}
_POINTS = 17
_IMAGE = 1280, 720  # pixels; that of the recording
_FILLED = 0.8  # of its cell, by a person
_MESSAGES = 60  # different ones, two seconds of the recording at 30 Hz
_WARM_UP = 20  # messages before anything is measured at a rate and a number of persons
_PROBE_HZ = 100.0
_PATIENCE = 30.0  # seconds for a process to answer
_SILENCE = 1.0  # seconds without an answer after which no more is expected
_US = 1e6
_FRAME = "camera_color_optical_frame"


def run(persons: list[int], rates: list[int], seconds: float) -> dict:
    """The whole benchmark as one object for JSON; a progress bar on stderr where someone is watching.

    seconds: of measuring each node at each number of persons and each rate. The caller sees to it that tqdm is there.
    Raises ImportError without ROS, BagError without the shipped recording, NodeBenchmarkError.
    """
    from tqdm import tqdm

    cells = [(count, rate) for count in persons for rate in rates]
    total = len(NODES) * len(cells) * seconds
    load, starts = os.getloadavg()[0], first_outputs()
    with (
        tqdm(total=total, unit="s", disable=None, dynamic_ncols=True, bar_format=_BAR) as bar,
        _bench(persons) as bench,
    ):
        bench.start_all(*NODES)
        rows = []
        for count, rate in cells:
            bar.set_description(f"{count} persons, {rate:g} Hz")
            rows += _cell(bench, count, rate, seconds, bar.update)
    return {**_head(load, seconds), "start_to_first_output_s": starts, "ratios": ratios(rows), "rows": rows}


_BAR = "{desc}: {percentage:3.0f}%|{bar}| {n:.0f}/{total:.0f} s"


def soak(persons: int, rate: float, minutes: float) -> dict:
    """The lifter alone for so long, its memory read every SOAK_SECONDS; else as `run`."""
    from tqdm import tqdm

    seconds, load, starts = 60 * minutes, os.getloadavg()[0], first_outputs()
    with (
        tqdm(total=seconds, unit="s", disable=None, dynamic_ncols=True, bar_format=_BAR) as bar,
        _bench([persons]) as bench,
    ):
        bench.start_all("lifter")
        bar.set_description(f"soak, {persons} persons, {rate:g} Hz")
        bench.measure("lifter", persons, rate, _WARM_UP)
        turns, memory = [], [(0.0, bench.rss_mb("lifter"))]
        began = time.monotonic()
        while (passed := time.monotonic() - began) < seconds:
            part = min(SOAK_SECONDS, max(seconds - passed, 1 / rate))
            turns.append(bench.measure("lifter", persons, rate, _messages_in(part, rate)))
            memory.append((time.monotonic() - began, bench.rss_mb("lifter")))
            bar.update(part)
    found = {"minutes": minutes, "memory": [{"s": s, "rss_mb": mb} for s, mb in memory], **memory_growth(memory)}
    rows = [row("lifter", persons, rate, turns, memory[-1][1])]
    return {**_head(load, seconds), "start_to_first_output_s": starts, "soak": found, "ratios": [], "rows": rows}


def _head(load: float, seconds: float) -> dict:
    return {
        "benchmark": "node",
        "versions": {**versions(), "rclpy": _version("rclpy"), "rmw": os.environ["RMW_IMPLEMENTATION"]},
        "machine": {
            "processor": _processor(),
            "cpus": os.cpu_count(),
            "load_before": load,
            "load_after": os.getloadavg()[0],
        },
        "settings": {"input_type": "sensor_msgs/msg/PointCloud2", "seconds": seconds, "slice_seconds": SLICE_SECONDS},
    }


def _processor() -> str:
    with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
        names = [line.partition(":")[2].strip() for line in file if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _version(package: str) -> str | None:
    with contextlib.suppress(metadata.PackageNotFoundError):
        return metadata.version(package)
    return None


# --- what is sent


def clouds(persons: int) -> np.ndarray:
    """(K,L) uint8: serialised organised clouds, the shipped recording's poses spread over the image, stamps 0."""
    make = BagMessages()
    zero = make("builtin_interfaces/msg/Time", sec=0, nanosec=0)
    header = make("std_msgs/msg/Header", stamp=zero, frame_id=_FRAME)
    sure, ids = np.ones((persons, _POINTS)), np.arange(persons, dtype=np.float32)
    everyone = spread(_poses(), persons)
    made = (make.serialise(outputs.keypoints_cloud(make, header, xy, sure, ids)) for xy in everyone)
    return np.stack([np.frombuffer(data, np.uint8) for data in made])


def spread(poses: np.ndarray, persons: int) -> np.ndarray:
    """(K,N,P,2) pixels: in each of K images N of the poses (F,P,2), each in a cell of its own of a grid."""
    width, height = _IMAGE
    columns = int(np.ceil(np.sqrt(persons * width / height)))
    cell = np.array([width / columns, height / int(np.ceil(persons / columns))])
    size = np.ptp(poses, axis=1)
    fitted = poses * (_FILLED * (cell / size).min(axis=1))[:, None, None]
    fitted -= (fitted.min(axis=1) + fitted.max(axis=1))[:, None] / 2
    person = np.arange(persons)
    centres = (np.stack([person % columns, person // columns], axis=1) + 0.5) * cell
    # Persons are far apart in time, so that no two of an image are alike.
    frames = (np.arange(_MESSAGES)[:, None] + person * len(poses) // persons) % len(poses)
    return fitted[frames] + centres[:, None]


def _poses() -> np.ndarray:
    """(F,P,2) pixels, every point of one person seen."""
    records = read_records(find_bag("one_person"), ["/keypoints"])
    return np.concatenate([read(record.type_name, record.message(), _POINTS).xy for record in records])


def _camera_info() -> np.ndarray:
    """(1,L) uint8: the recording's first CameraInfo, serialised."""
    first = next(read_records(find_bag("one_person"), ["/camera_info"]))
    return np.frombuffer(first.data, np.uint8)[None]


# --- the processes


@dataclass(frozen=True)
class Turn:
    """One node, some messages. latency_us: of those that were answered, from publish to arrival at the listener."""

    sent: int
    latency_us: np.ndarray
    cpu_s: float


class _Bench:
    """Publisher and listener, which run all the time, and the nodes that are measured."""

    def __init__(self, folder: Path, log: Any, environment: dict[str, str], processes: contextlib.ExitStack) -> None:
        self.publisher: subprocess.Popen
        self.listener: subprocess.Popen
        self.nodes: dict[str, subprocess.Popen] = {}
        self._folder, self._log, self._environment, self._processes = folder, log, environment, processes
        self._arrived = np.zeros(0, ARRIVAL)
        self._unread = b""

    def open(self) -> None:
        """Starts both ends."""
        start = partial(process, environment=self._environment, log=self._log, stdout=subprocess.PIPE)
        self.publisher, self.listener = (
            self._processes.enter_context(start(["paul_ros.benchmarks.traffic", end])) for end in ("publish", "listen")
        )
        os.set_blocking(self.listener.stdout.fileno(), False)
        self._answer()
        self._wait(lambda: self._arrived, "sign of the listener")

    def close(self) -> None:
        """Ends the nodes and both ends, so that none leaves the middleware's shared memory behind."""
        for child in (*self.nodes.values(), self.listener):
            child.terminate()

    def start_all(self, *names: str) -> None:
        """Nodes, the lifter among them, which then knows the camera."""
        for name in names:
            self.start(name)
        self._ask({"camera_info": str(self._folder / "camera_info.npy")})

    def start(self, name: str) -> float:
        """Starts a node; seconds from the start of its process to its first output.

        Messages are sent meanwhile, as by a detector that runs already.
        """
        self._tell({"node": name, "messages": self._messages(min(self._counts())), "rate_hz": _PROBE_HZ, "count": None})
        began = time.time_ns()
        arguments = ["--ros-args", "-r", f"keypoints:=/{name}/keypoints", "-r", f"camera_info:=/{name}/camera_info"]
        arguments += ["-p", f"max_persons:={max(self._counts())}"] if name == "lifter" else []
        self.nodes[name] = self._processes.enter_context(
            process([_MODULES[name], *arguments], self._environment, self._log)
        )
        first = self._wait(lambda: self._of_node(name), f"first output of the {name}")
        self._tell(None)
        self._answer()
        return float(first["arrival"][0] - began) / 1e9

    def measure(self, name: str, persons: int, rate: float, count: int) -> Turn:
        """Sends so many messages to a node and waits for its answers."""
        busy = cpu_seconds(self.nodes[name].pid)
        sent = self._ask({"node": name, "messages": self._messages(persons), "rate_hz": rate, "count": count})
        arrived = self._drain(name, sent)
        cpu = cpu_seconds(self.nodes[name].pid) - busy
        return Turn(sent["sent"], (arrived["arrival"] - arrived["stamp"]) / 1000, cpu)

    def rss_mb(self, name: str) -> float:
        """Resident memory of a node now."""
        return rss_mb(self.nodes[name].pid)

    def _counts(self) -> list[int]:
        return [int(file.stem) for file in self._folder.glob("[0-9]*.npy")]

    def _messages(self, persons: int) -> str:
        return str(self._folder / f"{persons}.npy")

    def _drain(self, name: str, sent: dict) -> np.ndarray:
        """Arrivals of what was sent, as soon as all are there or no more come."""
        last, heard = time.monotonic(), 0
        while heard < sent["sent"] and time.monotonic() - last < _SILENCE:
            time.sleep(0.02)
            self._take_arrivals()
            count = len(self._between(name, sent))
            if count > heard:
                last, heard = time.monotonic(), count
        found = self._between(name, sent)
        self._arrived = self._arrived[:0]
        return found

    def _between(self, name: str, sent: dict) -> np.ndarray:
        of_node = self._of_node(name)
        return of_node[(of_node["stamp"] >= sent["first"]) & (of_node["stamp"] <= sent["last"])]

    def _of_node(self, name: str) -> np.ndarray:
        return self._arrived[self._arrived["node"] == NODES.index(name)]

    def _take_arrivals(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while data := os.read(self.listener.stdout.fileno(), 1 << 16):
                self._unread += data
        whole = len(self._unread) // ARRIVAL.itemsize * ARRIVAL.itemsize
        new, self._unread = np.frombuffer(self._unread[:whole], ARRIVAL), self._unread[whole:]
        self._arrived = np.concatenate([self._arrived, new])

    def _ask(self, command: dict) -> dict:
        self._tell(command)
        return self._answer()

    def _tell(self, command: dict | None) -> None:
        """A command for the publisher; None ends one that has no count."""
        self.publisher.stdin.write((json.dumps(command) if command else "").encode() + b"\n")
        self.publisher.stdin.flush()

    def _answer(self) -> dict:
        """What the publisher says when it is done; arrivals are taken meanwhile, for a pipe does not hold many."""
        line = self._wait(lambda: select.select([self.publisher.stdout], [], [], 0)[0], "the publisher's answer", None)
        return json.loads(line[0].readline())

    def _wait(self, condition: Callable[[], Any], what: str, seconds: float | None = _PATIENCE) -> Any:
        """What the condition gives as soon as that holds something. Raises NodeBenchmarkError."""
        began = time.monotonic()
        while True:
            found = condition()
            if len(found):
                return found
            for name, child in {"publisher": self.publisher, "listener": self.listener, **self.nodes}.items():
                if child.poll() is not None:
                    raise NodeBenchmarkError(f"the {name} ended by itself ({child.returncode}): {tail(self._log)}")
            if seconds and time.monotonic() - began > seconds:
                raise NodeBenchmarkError(f"no {what} within {seconds:.0f} s: {tail(self._log)}")
            time.sleep(0.02)
            self._take_arrivals()


@contextlib.contextmanager
def _bench(persons: list[int]) -> Iterator[_Bench]:
    """Both ends, ready; all processes end with the block."""
    need_ros("the benchmark")
    with tempfile.TemporaryDirectory() as name, tempfile.TemporaryFile() as log:
        folder = Path(name)
        np.save(folder / "camera_info.npy", _camera_info())
        for count in persons:
            np.save(folder / f"{count}.npy", clouds(count))
        with contextlib.ExitStack() as processes:
            bench = _Bench(folder, log, ros_environment(), processes)
            bench.open()
            yield bench
            bench.close()


def first_outputs() -> dict[str, float]:
    """Seconds from the start of a node's process to its first output, the median of STARTS, both nodes in turns.

    Each time publisher and listener are new too: to participants that have just lost one, discovery may take 3 s.
    """
    found: dict[str, list[float]] = {name: [] for name in NODES}
    for _ in range(STARTS):
        for name in NODES:
            with _bench([1]) as bench:
                found[name].append(bench.start(name))
    return {name: float(np.median(seconds)) for name, seconds in found.items()}


def cpu_seconds(pid: int) -> float:
    """CPU time that all threads of a process have used, to the nanosecond: /proc/PID/stat counts in 10 ms.

    Linux makes a clock's id of a process' id in this way, see clock_getcpuclockid(3).
    """
    return time.clock_gettime((~pid << 3) | 2)


# --- figures


def _messages_in(seconds: float, rate: float) -> int:
    return max(1, round(seconds * rate))


def _cell(bench: _Bench, persons: int, rate: float, seconds: float, tick: Callable[[float], Any]) -> list[dict]:
    """Both nodes at one number of persons and one rate: their rows."""
    for name in NODES:
        bench.measure(name, persons, rate, _WARM_UP)
    slices = max(1, round(seconds / SLICE_SECONDS))
    turns: dict[str, list[Turn]] = {name: [] for name in NODES}
    for _ in range(slices):
        for name in NODES:
            turns[name].append(bench.measure(name, persons, rate, _messages_in(seconds / slices, rate)))
            tick(seconds / slices)
    return [row(name, persons, rate, turns[name], bench.rss_mb(name)) for name in NODES]


def row(node: str, persons: int, rate: float, turns: list[Turn], rss: float) -> dict:
    """One row of the report; None where nothing was answered."""
    latency = np.concatenate([turn.latency_us for turn in turns])
    received = len(latency)
    median, p99 = np.percentile(latency, (50, 99)).tolist() if received else (None, None)
    return {
        "node": node,
        "persons": persons,
        "rate_hz": rate,
        "sent": sum(turn.sent for turn in turns),
        "received": received,
        "latency_median_us": median,
        "latency_p99_us": p99,
        "cpu_us_per_frame": _US * sum(turn.cpu_s for turn in turns) / received if received else None,
        "rss_mb": rss,
    }


def ratios(rows: list[dict]) -> list[dict]:
    """The lifter over the echo node, and the CPU time that it adds, for each number of persons and each rate."""
    found = []
    for lifter in (row for row in rows if row["node"] == "lifter"):
        echo = next(row for row in rows if row["node"] == "echo" and _same_cell(row, lifter))
        both = lifter["received"] and echo["received"]
        found.append(
            {
                "persons": lifter["persons"],
                "rate_hz": lifter["rate_hz"],
                **{
                    f"latency_{kind}_ratio": lifter[f"latency_{kind}_us"] / echo[f"latency_{kind}_us"] if both else None
                    for kind in ("median", "p99")
                },
                "cpu_added_us_per_frame": lifter["cpu_us_per_frame"] - echo["cpu_us_per_frame"] if both else None,
            }
        )
    return found


def _same_cell(one: dict, other: dict) -> bool:
    return all(one[key] == other[key] for key in ("persons", "rate_hz"))


def memory_growth(memory: list[tuple[float, float]]) -> dict[str, float | None]:
    """Of (seconds, MB): the largest, and how much came in the second half, by a straight line through it, an hour."""
    seconds, megabytes = np.array(memory).T
    later = seconds >= seconds[-1] / 2
    slope = np.polyfit(seconds[later], megabytes[later], 1)[0] if later.sum() > 1 else None
    return {
        "rss_mb_max": float(megabytes.max()),
        "growth_mb_per_hour": None if slope is None else 3600 * float(slope),
    }
