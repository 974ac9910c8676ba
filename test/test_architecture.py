# SPDX-License-Identifier: Apache-2.0
"""Who may know whom: the rooms of the house import in one direction, and the robot's need nothing heavy."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("msg_adapters", "paul_ros", "training")
#: What each room may import of the others.
ALLOWED = {"msg_adapters": set(), "paul_ros": {"msg_adapters"}, "training": {"msg_adapters", "paul_ros"}}
ROS = {
    "rclpy",
    "rcl_interfaces",
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
#: On every robot; all else is imported where it is needed, by those who asked for a bag or a picture.
ROBOT = {"numpy", "yaml"}


@dataclass(frozen=True)
class Import:
    file: Path
    package: str
    lazy: bool


def imports_of(room: str) -> Iterator[Import]:
    files = sorted((ROOT / room).rglob("*.py"))
    assert files
    for file in files:
        yield from _imports(ast.parse(file.read_text(encoding="utf-8")), file.relative_to(ROOT), lazy=False)


def _imports(node: ast.AST, file: Path, lazy: bool) -> Iterator[Import]:
    if isinstance(node, ast.Import):
        yield from (Import(file, alias.name.split(".")[0], lazy) for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        package = file.parts[0] if node.level else node.module.split(".")[0]
        yield Import(file, package, lazy)
    inside = lazy or isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
    for child in ast.iter_child_nodes(node):
        yield from _imports(child, file, inside)


def run(code: str, *arguments: str, python: str | Path = sys.executable) -> str:
    answer = subprocess.run([python, "-c", code, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert answer.returncode == 0, answer.stderr
    return answer.stdout


@pytest.mark.parametrize("room", ROOMS)
def test_rooms_import_in_one_direction(room: str) -> None:
    forbidden = set(ROOMS) - ALLOWED[room] - {room}
    wrong = [use for use in imports_of(room) if use.package in forbidden]
    assert [use for use in wrong if not (use.file.parent == Path("paul_ros/cli") and use.lazy)] == []


@pytest.mark.parametrize("room", ["msg_adapters", "paul_ros"])
def test_the_robots_rooms_never_import_torch(room: str) -> None:
    assert [use for use in imports_of(room) if use.package in {"torch", "torchvision"}] == []


def test_ros_is_imported_by_the_node_and_else_only_where_it_is_needed() -> None:
    eager = [use for room in ROOMS for use in imports_of(room) if use.package in ROS and not use.lazy]
    assert {use.file for use in eager} == {
        Path(f"paul_ros/ros/{name}.py")
        for name in (
            "keypoint_input",
            "lifter_process",
            "messages",
            "node",
            "node_parameters",
            "output_topics",
            "pipeline",
            "qos",
            "rclpy_internals",
        )
    }


@pytest.mark.parametrize("room", ["msg_adapters", "paul_ros"])
def test_what_the_robots_rooms_import_at_once_is_on_the_robot(room: str) -> None:
    known = set(sys.stdlib_module_names) | ROBOT | ROS | set(ROOMS)
    assert [use for use in imports_of(room) if not use.lazy and use.package not in known] == []


def test_importing_every_module_of_the_robot_loads_nothing_heavy() -> None:
    modules = [
        ".".join(file.relative_to(ROOT).with_suffix("").parts)
        for room in ("msg_adapters", "paul_ros")
        for file in sorted((ROOT / room).rglob("*.py"))
        if file.stem not in ("__init__", "__main__") and file.parts[-2] != "benchmarks"
    ]
    assert "paul_ros.ros.lifter_process" in modules and "msg_adapters.point_cloud2" in modules
    code = "import importlib, sys\nlist(map(importlib.import_module, sys.argv[1:]))\nprint(*sys.modules)"
    loaded = {name.split(".")[0] for name in run(code, *modules).split()}
    assert not loaded & {"torch", "tqdm", "matplotlib", "scipy", "rosbags", "mcap", "training"}


def test_the_adapters_import_no_message_package() -> None:
    code = "import msg_adapters, sys\nprint(*sys.modules)"
    assert not {name.split(".")[0] for name in run(code).split()} & (ROS | {"rosbags"})


@pytest.mark.skipif(sys.version_info >= (3, 13), reason="NumPy 1.26 has no wheels for Python 3.13")
def test_a_model_lifts_the_same_on_the_robots_numpy(model_file) -> None:
    """`make` sets up .venv/robot with what apt has, NumPy 1.26 and PyYAML, and nothing else."""
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
