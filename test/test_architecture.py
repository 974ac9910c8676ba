# SPDX-License-Identifier: Apache-2.0
"""The house: which room may import which, no circles, no large modules, and nothing heavy on the robot."""

from __future__ import annotations

import graphlib
import subprocess
import sys
from pathlib import Path

import import_graph
import pytest
from conftest import IN_VENV
from import_graph import PACKAGES, ROOT, Import, imports_in

#: Room -> the other rooms that it may import. A room is a package, or a folder with an entry here; `paul_ros` is the
#: core, the modules at the top of the package.
ALLOWED = {
    "msg_adapters": set(),
    "paul_ros": {"msg_adapters"},
    "paul_ros.stream": {"msg_adapters", "paul_ros"},
    "paul_ros.ros": {"msg_adapters", "paul_ros", "paul_ros.stream"},
    "paul_ros.offline": {"msg_adapters", "paul_ros", "paul_ros.stream"},
    "paul_ros.benchmarks": {"msg_adapters", "paul_ros", "paul_ros.stream", "paul_ros.offline"},
    "paul_ros.cli": {
        "msg_adapters",
        "paul_ros",
        "paul_ros.stream",
        "paul_ros.ros",
        "paul_ros.offline",
        "paul_ros.benchmarks",
        "training",
    },
    "training": {"msg_adapters", "paul_ros", "paul_ros.stream", "paul_ros.offline"},
}
ROS = {
    "rclpy",
    "lifecycle_msgs",
    "rcl_interfaces",
    "type_description_interfaces",
    "builtin_interfaces",
    "diagnostic_msgs",
    "geometry_msgs",
    "sensor_msgs",
    "std_msgs",
    "visualization_msgs",
    "yolo_msgs",
    "hri_msgs",
    "zed_msgs",
    "ai_msgs",
    "opendr_interface",
    "openpose_ros2_msgs",
    "ros_openpose",
    "ament_index_python",
}
TORCH = {"torch", "torchvision"}
#: Installed on every robot. The code for bags and pictures imports anything else late.
ROBOT = {"numpy", "yaml"}

MAX_LINES = 350
#: At most two modules that may be larger, each with the reason.
LARGE: dict[str, str] = {}
MAX_NODE_LINES = 250


def room_of(module: str) -> str:
    folder = ".".join(module.split(".")[:2])
    return folder if folder in ALLOWED else module.partition(".")[0]


def described(uses: list[Import]) -> list[str]:
    return [f"{use.source} imports {use.target}" for use in uses]


def run(code: str, *arguments: str, python: str | Path = sys.executable) -> str:
    answer = subprocess.run([python, "-c", code, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert answer.returncode == 0, answer.stderr
    return answer.stdout


@pytest.mark.parametrize("room", ALLOWED)
def test_rooms_import_in_one_direction(room: str) -> None:
    """Late imports count too."""
    own = [use for use in imports_in(*PACKAGES) if room_of(use.source) == room and use.package in PACKAGES]
    wrong = [use for use in own if room_of(use.target) not in ALLOWED[room] | {room}]
    assert described(wrong) == []


def test_every_room_is_listed() -> None:
    folders = {f"paul_ros.{file.parent.name}" for file in (ROOT / "paul_ros").glob("*/*.py")}
    assert folders - {"paul_ros.native"} == {room for room in ALLOWED if room.startswith("paul_ros.")}


def test_only_the_commands_reach_training_and_late() -> None:
    reaching = [use for use in imports_in("paul_ros") if use.package == "training"]
    assert reaching and described([use for use in reaching if not use.late]) == []
    assert {room_of(use.source) for use in reaching} == {"paul_ros.cli"}


def test_no_module_imports_itself_through_others() -> None:
    """Late imports count too."""
    graph = {
        module: {use.target for use in import_graph.imports_of(module) if use.target != module}
        for module in import_graph.modules()
    }
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        pytest.fail(f"a circle of imports: {' <- '.join(error.args[1])}")


def test_modules_are_short() -> None:
    lines = {module: len(import_graph.modules()[module].read_text().splitlines()) for module in _of_packages()}
    assert len(LARGE) <= 2 and set(LARGE) <= set(lines)
    assert {module: count for module, count in lines.items() if count > MAX_LINES and module not in LARGE} == {}
    assert [module for module in LARGE if lines[module] <= MAX_LINES] == []
    assert lines["paul_ros.ros.node"] <= MAX_NODE_LINES


def _of_packages() -> list[str]:
    return [module for module in import_graph.modules() if module.partition(".")[0] in PACKAGES]


def test_the_robots_packages_never_import_torch() -> None:
    assert described([use for use in imports_in("msg_adapters", "paul_ros") if use.package in TORCH]) == []


def test_motion_capture_needs_no_torch() -> None:
    people = [module for module in _of_packages() if module.startswith("training.people.")]
    assert len(people) > 5
    assert [module for module in people if import_graph.reached([module]) & TORCH] == []


def test_ros_is_imported_in_its_room_and_elsewhere_late() -> None:
    eager = {use.source for use in imports_in(*PACKAGES) if use.package in ROS and not use.late}
    assert "paul_ros.ros.node" in eager
    assert {room_of(module) for module in eager} == {"paul_ros.ros"}


def test_eager_imports_of_the_robots_packages_are_on_the_robot() -> None:
    known = set(sys.stdlib_module_names) | ROBOT | ROS | set(PACKAGES)
    eager = [use for use in imports_in("msg_adapters", "paul_ros") if not use.late]
    assert described([use for use in eager if use.package not in known]) == []


def test_importing_every_module_of_the_robot_loads_nothing_heavy() -> None:
    modules = [
        module
        for module in _of_packages()
        if not module.startswith(("training", "paul_ros.benchmarks")) and not module.endswith("__main__")
    ]
    assert "paul_ros.ros.node" in modules and "msg_adapters.point_cloud2" in modules
    code = "import importlib, sys\nlist(map(importlib.import_module, sys.argv[1:]))\nprint(*sys.modules)"
    loaded = {name.split(".")[0] for name in run(code, *modules).split()}
    assert not loaded & {"torch", "tqdm", "rich", "matplotlib", "scipy", "rosbags", "mcap", "training"}


def test_the_adapters_import_no_message_package() -> None:
    code = "import msg_adapters, sys\nprint(*sys.modules)"
    assert not {name.split(".")[0] for name in run(code).split()} & (ROS | {"rosbags"})


@pytest.mark.install
@pytest.mark.skipif(sys.version_info >= (3, 13), reason="NumPy 1.26 has no wheels for Python 3.13")
@pytest.mark.skipif(not IN_VENV, reason="`make test` sets up the robot's environment")
def test_a_model_lifts_the_same_on_the_robots_numpy(model_file) -> None:
    """`make test` sets up .venv/robot with apt's versions, NumPy 1.26 and PyYAML, and nothing else."""
    code = """
import sys
sys.path.insert(0, sys.argv[2])
import numpy as np
from paul_ros.lifter import Lifter
from paul_ros.model_file import load_model
xy = np.random.default_rng(5).normal(320, 80, (3, 17, 2))
visible = np.ones((3, 17), dtype=bool)
visible[1, 4:9] = False
lifted = Lifter(load_model(sys.argv[1])).lift(xy, visible)
assert lifted.ok.all()
print(np.__version__, *lifted.points.ravel().tolist())
"""
    robot = ROOT / ".venv/robot/bin/python"
    assert robot.exists(), "run `make test`, which sets it up"
    version, *points = run(code, str(model_file), str(ROOT), python=robot).split()
    _, *expected = run(code, str(model_file), str(ROOT)).split()
    assert version.startswith("1.26.")
    assert [float(x) for x in points] == pytest.approx([float(x) for x in expected], rel=1e-6, abs=1e-6)
