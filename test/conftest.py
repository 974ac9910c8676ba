# SPDX-License-Identifier: Apache-2.0
"""Shared by all tests: markers, an isolated ROS domain with field checks on, and both families of message classes."""

from __future__ import annotations

import fcntl
import os
import tempfile
from pathlib import Path
from typing import IO

_LOCKS: list[IO] = []


def _free_domain() -> int:
    """Return a ROS domain that no other test process on this machine uses, locked as long as this process lives."""
    for domain in range(1, 101):
        try:
            file = open(Path(tempfile.gettempdir()) / f"paul_ros_test_domain_{domain}.lock", "w")
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:  # locked, or the file of another user
            continue
        _LOCKS.append(file)
        return domain
    raise RuntimeError("other tests use all ROS domains from 1 to 100; end them")


# Set before any test imports rclpy; processes that tests start inherit it.
os.environ.update(
    ROS_PYTHON_CHECK_FIELDS="1",
    ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST",
    RMW_IMPLEMENTATION="rmw_fastrtps_cpp",
    ROS_DOMAIN_ID=str(_free_domain()),
)

import array
import functools
import importlib
import importlib.util
import signal
import subprocess
import sys
from collections.abc import Iterator

import import_graph
import numpy as np
import pytest
from foreign_messages import DEFINITIONS

ROOT = Path(__file__).resolve().parent.parent
#: The command of the node's process.
LIFTER = [sys.executable, "-m", "paul_ros.ros.lifter_process"]
_VENV = ROOT / ".venv"
#: Whether this Python is the one that the Makefile sets up.
IN_VENV = _VENV.exists() and os.path.samefile(sys.prefix, _VENV)

# --- which tests run where

#: Marker -> the fixtures, modules and tests that get it. `make test-fast` runs the tests without any marker.
MARKERS = {
    "dds": {"ros", "start_lifter", "test_demo", "test_benchmark_node"},
    "install": {"install", "installed", "compiled"},
    "slow": {"test_no_search_finds_a_better_pose", "test_onp_docs"},
}
#: Packages that a robot may lack. Test modules that import a missing one are not collected.
OPTIONAL = ("torch", "rosbags", "mcap", "matplotlib", "rich", "tqdm", "scipy", "hypothesis", "catkin_pkg")
#: Packages that these modules import late.
LATE = {"paul_ros.offline.bag_records": {"rosbags", "mcap"}, "paul_ros.offline.tables": {"rich"}}
MISSING = {package for package in OPTIONAL if importlib.util.find_spec(package) is None}


@functools.cache
def packages_of(module: str) -> set[str]:
    """Return the foreign packages that a test module needs, itself or through others."""
    reached = import_graph.reached([module])
    late = (LATE[name] for name in reached & LATE.keys())
    return {name.partition(".")[0] for name in reached}.union(*late)


def needs(*packages: str) -> pytest.MarkDecorator:
    """Skip a test that starts processes which need packages that a robot may lack."""
    missing = sorted(MISSING.intersection(packages))
    return pytest.mark.skipif(bool(missing), reason=f"{', '.join(missing)} not installed")


_FILES = sorted(Path(__file__).parent.glob("test_*.py"))
collect_ignore = [file.name for file in _FILES if MISSING and packages_of(file.stem) & MISSING]


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark each test by its fixtures, its module and its name, and by whether the module loads torch.

    With pytest-xdist, all tests that start nodes or install run in one worker: the demo chooses a domain of its own,
    which may be that of another worker. The tests of any other module stay together too, with the module's fixtures.
    """
    for item in items:
        module = item.path.stem
        traits = {*getattr(item, "fixturenames", ()), module, getattr(item, "originalname", None)}
        for marker, wanted in MARKERS.items():
            if traits & wanted:
                item.add_marker(marker)
        if "torch" in packages_of(module):
            item.add_marker("training")
        if config.pluginmanager.hasplugin("xdist"):
            alone = any(item.get_closest_marker(marker) for marker in ("dds", "install"))
            item.add_marker(pytest.mark.xdist_group("nodes" if alone else module))


def _missing(error: BaseException | None) -> bool:
    """Tell if an error is due to an optional package that is not installed."""
    while error is not None:
        if isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] in MISSING:
            return True
        error = error.__cause__
    return False


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo) -> Iterator[None]:
    """Skip a test that finds an optional package missing only when it runs."""
    outcome = yield
    if MISSING and call.excinfo and _missing(call.excinfo.value):
        report = outcome.get_result()
        report.outcome, report.longrepr = "skipped", (str(item.path), 0, f"Skipped: {call.excinfo.value}")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say which test modules were not collected, and why."""
    if collect_ignore:
        text = f"{', '.join(sorted(MISSING))} not installed; not collected: {' '.join(collect_ignore)}"
        terminalreporter.write_line(text)


# --- messages


class RosMake:
    """Message factory of rclpy's classes."""

    def __call__(self, type_name: str, **fields):
        package, _, name = type_name.split("/")
        return getattr(importlib.import_module(f"{package}.msg"), name)(**fields)

    @staticmethod
    def octets(data: bytes):
        return array.array("B", data)


class BagMake:
    """Message factory of rosbags' dataclasses, with the foreign packages registered."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.store = get_typestore(Stores.ROS2_JAZZY)
        for name, text in DEFINITIONS.items():
            self.store.register(get_types_from_msg(text, name))

    def __call__(self, type_name: str, **fields):
        return self.store.types[type_name](**fields)

    @staticmethod
    def octets(data: bytes):
        return np.frombuffer(data, np.uint8)

    @staticmethod
    def floats(values):
        """Return the value of a float32[] field."""
        return np.array(values, np.float32)

    def through_cdr(self, msg):
        """Return the message as a bag delivers it; this also checks that every field can be written."""
        name = msg.__msgtype__
        return self.store.deserialize_cdr(self.store.serialize_cdr(msg, name), name)


@pytest.fixture(scope="session")
def bag_make() -> BagMake:
    return BagMake()


@pytest.fixture(scope="session", params=["rclpy", "rosbags"])
def every_make(request):
    """Both message factories: every test with this fixture runs twice."""
    return RosMake() if request.param == "rclpy" else request.getfixturevalue("bag_make")


@pytest.fixture
def make(every_make):
    """Both message factories, unless a test module overrides this fixture with one."""
    return every_make


def header_of(make, seconds: int = 7, nanoseconds: int = 5, frame: str = "camera_color_optical_frame"):
    stamp = make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


#: The COCO points of a standing person that faces the camera; metres, x right, y down, z forward.
PERSON = np.array(
    [
        (0, -0.62, -0.12),
        (0.03, -0.66, -0.09),
        (-0.03, -0.66, -0.09),
        (0.07, -0.64, 0),
        (-0.07, -0.64, 0),
        (0.2, -0.4, 0.02),
        (-0.2, -0.4, 0.02),
        (0.3, -0.15, 0.05),
        (-0.25, -0.15, -0.1),
        (0.33, 0.05, -0.1),
        (-0.2, 0, -0.3),
        (0.12, 0.1, 0),
        (-0.12, 0.1, 0),
        (0.14, 0.5, -0.1),
        (-0.13, 0.5, 0.05),
        (0.15, 0.9, 0.05),
        (-0.14, 0.9, 0.1),
    ]
)
FOCAL, CENTRE = 600.0, (320.0, 240.0)


@pytest.fixture(scope="session")
def model_file(tmp_path_factory) -> Path:
    """A model file that gives PERSON for every input: all weights are zero except the last bias."""
    from paul_ros.layout import load_layout
    from paul_ros.model_file import save_model, weight_shapes
    from paul_ros.normalisation import to_unit_size

    layout = load_layout("coco17")
    shape = to_unit_size(PERSON.T[None], layout)[0]
    start, end = np.array(layout.edges).T
    metres = float(np.linalg.norm(PERSON[start] - PERSON[end], axis=1).mean())
    header = {
        "layout": layout.to_dict(),
        "bottleneck": 2,
        "metres_per_unit": metres,
        "stature": 1.7,
        "chirality": {"known": True, "source": "made by hand"},
        "architecture": {
            "encoder": {"kind": "residual", "width": 4, "blocks": 1},
            "decoder": {"kind": "mlp", "hidden": [4]},
        },
    }
    arrays = {name: np.zeros(size) for name, size in weight_shapes(header, 17).items()}
    arrays["mean_shape"], arrays["decoder.1.bias"] = shape, shape.ravel()
    path = tmp_path_factory.mktemp("model") / "stand.npz"
    save_model(path, header, arrays)
    return path


def coco_model():
    """Return the shipped model reduced to COCO-17, without the weights of the other points."""
    from paul_ros.layout import load_layout
    from paul_ros.model import Model
    from paul_ros.model_file import load_model
    from paul_ros.normalisation import to_unit_size

    human, coco = load_model(), load_layout("coco17")
    own = np.array([human.layout.names.index(name) for name in coco.names])
    rows = np.concatenate([part * len(human.layout.names) + own for part in range(3)])
    last = len(human.header["architecture"]["decoder"]["hidden"])
    weights = {**human.weights, "encoder.input.weight": human.weights["encoder.input.weight"][:, rows]}
    for name in (f"decoder.{last}.weight", f"decoder.{last}.bias"):
        weights[name] = human.weights[name][rows]
    mean = to_unit_size(human.mean_shape[None, :, own], coco)[0]
    unit = np.ptp(human.mean_shape[1, own]) / np.ptp(mean[1])  # its edges have another mean length
    header = {**human.header, "layout": coco.to_dict(), "misfit": human.misfit / unit}
    header["metres_per_unit"] = human.metres_per_unit * float(unit)
    return Model("coco", header, coco, weights, mean, human.sha256)


def persons_at(*places) -> np.ndarray:
    """Return PERSON at each (x, y, z), as (N, 17, 3) metres."""
    return PERSON + np.array(places, dtype=float).reshape(-1, 1, 3)


def seen(points: np.ndarray) -> np.ndarray:
    """Return the pixels (N, P, 2) of points (N, P, 3) in the tests' camera."""
    return FOCAL * points[..., :2] / points[..., 2:] + CENTRE


def camera_info(make, fx: float = FOCAL, fy: float = FOCAL, cx: float = CENTRE[0]):
    region = make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    k = np.array([fx, 0, cx, 0, fy, CENTRE[1], 0, 0, 1])
    return make(
        "sensor_msgs/msg/CameraInfo",
        header=header_of(make),
        height=480,
        width=640,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=k,
        r=np.zeros(9),
        p=np.zeros(12),
        binning_x=0,
        binning_y=0,
        roi=region,
    )


class LifterProcess:
    """The real node in its own process and namespace; `log()` returns its output."""

    def __init__(self, folder: Path, namespace: str, *ros_args: str) -> None:
        self.namespace = namespace
        self._log = folder / f"{namespace}.log"
        # The start-up hook of the ROS wheels sets this mark, and a child that inherits it would skip the hook.
        env = {key: value for key, value in os.environ.items() if key != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
        with open(self._log, "wb") as log:
            self.process = subprocess.Popen(
                [*LIFTER, "--ros-args", "-r", f"__ns:=/{namespace}", *ros_args],
                cwd=ROOT,
                env=env,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def log(self) -> str:
        return self._log.read_text()

    def stop(self, number: int = signal.SIGTERM) -> int:
        """Send a signal and return the exit code."""
        self.process.send_signal(number)
        return self.process.wait(20)


@pytest.fixture(scope="session")
def ros():
    """rclpy, initialised in the tests' process."""
    import rclpy

    rclpy.init()
    yield rclpy
    rclpy.shutdown()


@pytest.fixture(scope="module")
def start_lifter(tmp_path_factory):
    """start_lifter(*ros_args) -> LifterProcess; all stop with the module."""
    folder, started = tmp_path_factory.mktemp("nodes"), []

    def start(*ros_args: str) -> LifterProcess:
        started.append(LifterProcess(folder, f"test{len(started)}", *ros_args))
        return started[-1]

    yield start
    for lifter in started:
        # SIGKILL would leave the middleware's shared memory behind.
        if lifter.process.poll() is None:
            lifter.stop()
