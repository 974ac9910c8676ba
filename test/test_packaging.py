# SPDX-License-Identifier: Apache-2.0
"""One source tree serves pip, colcon and colcon --symlink-install; ROS finds the launchers in each of them."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import venv
import xml.etree.ElementTree as ElementTree
from configparser import ConfigParser
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import pytest
import yaml
from catkin_pkg.package import parse_package
from conftest import IN_VENV

import paul_ros

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = "paul_ros"
ROOMS = ("paul_ros", "msg_adapters", "training")
#: The packages of this run (rclpy, NumPy ...), which the installs under test use too.
LIBRARIES = sysconfig.get_paths()["purelib"]


@dataclass(frozen=True)
class Install:
    """An install prefix and the environment of a shell that has sourced it."""

    prefix: Path
    environment: dict[str, str]

    def launcher(self, name: str) -> Path:
        """Return the file that `ros2 run paul_ros NAME` starts, by the steps of get_executable_path in ros2pkg.api."""
        code = f"from ament_index_python import get_package_prefix; print(get_package_prefix('{PACKAGE}'))"
        prefix = Path(self.run(sys.executable, "-c", code).strip())
        assert prefix == self.prefix
        files = [path for path in (prefix / "lib" / PACKAGE).iterdir() if os.access(path, os.X_OK)]
        return next(path for path in files if path.name == name)

    def run(self, *command: object) -> str:
        answer = subprocess.run(
            [str(part) for part in command],
            env=self.environment,
            cwd=self.prefix,
            capture_output=True,
            text=True,
            timeout=120,
        )
        assert answer.returncode == 0, answer.stdout + answer.stderr
        return answer.stdout


@pytest.fixture(scope="session")
def source(tmp_path_factory) -> Path:
    """A copy of all files that git tracks or would add, without build outputs."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split("\0")
    tree = tmp_path_factory.mktemp("workspace") / "src" / PACKAGE
    for name in filter(None, listed):
        if (ROOT / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tree / name)
    return tree


def pip_install(source: Path, folder: Path) -> Install:
    """Install into a new virtual environment that sees the packages of this one."""
    prefix = folder / "venv"
    venv.create(prefix, symlinks=True, with_pip=True)
    tree = shutil.copytree(source, folder / "source")
    pip = [sys.executable, "-m", "pip"]
    options = ["--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, "wheel", *options, "--wheel-dir", folder, tree], check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    subprocess.run([prefix / "bin" / "pip", "install", *options, wheel], check=True, capture_output=True)
    site = prefix / Path(LIBRARIES).relative_to(sys.prefix)
    (site / "libraries.pth").write_text(LIBRARIES + "\n")
    return Install(prefix, {**os.environ, "AMENT_PREFIX_PATH": str(prefix)})


def colcon_build(source: Path, folder: Path, *options: str) -> Install:
    """Build in a workspace, then source it as a user does."""
    bin_first = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    build = subprocess.run(
        ["colcon", "--log-base", "log", "build", "--base-paths", source.parent, *options],
        cwd=folder,
        env=bin_first,
        capture_output=True,
        text=True,
    )
    assert build.returncode == 0, build.stdout + build.stderr
    sourced = subprocess.run(
        ["bash", "-c", "source install/setup.bash && env -0"],
        cwd=folder,
        env=bin_first,
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    environment = dict(line.split("=", 1) for line in sourced.split("\0") if line)
    return Install(folder / "install" / PACKAGE, environment)


@pytest.fixture(scope="session", params=["pip", "colcon", "colcon --symlink-install"])
def install(request, source, tmp_path_factory) -> Install:
    tool, *options = request.param.split()
    folder = tmp_path_factory.mktemp(tool)
    return pip_install(source, folder) if tool == "pip" else colcon_build(source, folder, *options)


@pytest.mark.parametrize("name, usage", [("lifter", "usage: lifter"), ("paul", "usage: paul")])
def test_ros2_run_finds_the_launcher_and_it_answers(install: Install, name: str, usage: str) -> None:
    assert usage in install.run(install.launcher(name), "--help")


def test_the_launched_node_comes_up_and_ends_on_sigint(install: Install, model_file: Path) -> None:
    node = subprocess.Popen(
        [install.launcher("lifter"), "--ros-args", "-p", f"model:={model_file}"],
        env=install.environment,
        cwd=install.prefix,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        seen = ""
        while "Ready" not in seen:
            line = node.stdout.readline()
            assert line, f"the node ended with {node.wait()}:\n{seen}"
            seen += line
        node.send_signal(signal.SIGINT)
        rest, _ = node.communicate(timeout=30)
        assert node.returncode == 0, seen + rest
    finally:
        node.kill()
        node.wait()


def test_the_installed_package_is_the_one_that_runs_and_has_its_files(install: Install) -> None:
    code = """
import importlib.resources, paul_ros, training, msg_adapters
from paul_ros.layout import layout_names
print(paul_ros.__file__, ' '.join(layout_names()), sep='\\n')
print(*sorted(f.name for f in (importlib.resources.files('paul_ros') / 'models').iterdir()))
assert all((importlib.resources.files(package) / 'py.typed').is_file() for package in ('paul_ros', 'msg_adapters'))
"""
    own_python = install.prefix / "bin" / "python3"
    answer = install.run(own_python if own_python.exists() else "python3", "-c", code)
    module, layouts, models = answer.splitlines()
    assert Path(module) != Path(paul_ros.__file__) and LIBRARIES not in module
    assert layouts.split() == sorted(path.stem for path in (ROOT / "paul_ros/layouts").glob("*.yaml"))
    assert models.split() == sorted(path.name for path in (ROOT / "paul_ros/models").glob("*.npz"))
    share = install.prefix / "share" / PACKAGE
    assert (share / "package.xml").read_bytes() == (ROOT / "package.xml").read_bytes()
    for folder in ("launch", "config", "rviz", "foxglove", "sros2"):
        assert sorted(path.name for path in (share / folder).iterdir()) == sorted(os.listdir(ROOT / folder))
    assert {path.name for path in (share / "bags").iterdir()} >= {"ACKNOWLEDGEMENT.md", "one_person.mcap"}


def test_a_user_can_run_the_command_under_its_own_name(install: Install) -> None:
    assert "usage: paul" in install.run(install.prefix / "bin" / "paul", "--help")


#: A sitecustomize.py that makes the packages of $HIDDEN look as if they were not installed, also in processes of tests.
HIDE = """
import os
from importlib.machinery import PathFinder

find, hidden = PathFinder.find_spec, os.environ["HIDDEN"].split()
PathFinder.find_spec = classmethod(
    lambda _, name, *rest: None if name.partition(".")[0] in hidden else find(name, *rest)
)
"""


@pytest.mark.install
def test_the_nodes_tests_run_without_torch_and_bags(tmp_path: Path) -> None:
    """`colcon test` on a robot, which lacks the packages for training and for bags."""
    (tmp_path / "sitecustomize.py").write_text(HIDE)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "HIDDEN": "torch rosbags mcap rich tqdm"}
    environment.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)

    def pytest_run(*arguments: str) -> str:
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments]
        answer = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
        assert answer.returncode == 0, answer.stdout + answer.stderr
        return answer.stdout

    collected, said, left_out = pytest_run("--collect-only").partition("not installed; not collected: ")
    assert said and "test_trainer.py" in left_out and "test_trainer.py" not in collected
    for module in ("test_node.py", "test_node_lifecycle.py", "test_stream.py", "test_lifter.py"):
        assert module in collected and module not in left_out
    pytest_run("test/test_lost_messages.py", "test/test_model.py", "test/test_node_lifecycle.py::test_transitions")
    pytest_run("-k", "measured_now or replay_are", "test/test_numbers.py", "test/test_docs.py")


def test_versions_agree() -> None:
    package = parse_package(str(ROOT / "package.xml"))
    assert package.version == paul_ros.__version__ == metadata.version(PACKAGE)


def test_package_xml_is_valid_and_says_what_the_code_needs() -> None:
    package = parse_package(str(ROOT / "package.xml"))
    package.validate()
    assert package.package_format == 3 and package.get_build_type() == "ament_python"
    assert package.licenses == ["Apache-2.0"] and (ROOT / package.licenses[0].file).is_file()
    needed = {dependency.name for dependency in package.exec_depends}
    setup = ConfigParser()
    setup.read(ROOT / "setup.cfg")
    required = re.findall(r"^[\w-]+", setup["options"]["install_requires"], re.MULTILINE)
    assert {f"python3-{name.lower().removeprefix('py')}" for name in required} <= needed
    node = "".join(file.read_text(encoding="utf-8") for file in sorted((ROOT / "paul_ros/ros").glob("*.py")))
    writers = (ROOT / "msg_adapters/outputs.py").read_text(encoding="utf-8")
    imported = set(re.findall(r"^from (\w+)\.(?:msg|srv) import", node, re.MULTILINE))
    made = set(re.findall(r'"(\w+)/msg/', writers))
    assert "rcl_interfaces" in imported and "builtin_interfaces" in made
    # Foxglove's messages are useful only beside Foxglove, which brings them.
    assert (imported | made) - {"foxglove_msgs"} <= needed


def test_package_xml_names_nothing_that_only_pip_has() -> None:
    """Bloom refuses such keys for Debian packages, in test_depend too."""
    package = parse_package(str(ROOT / "package.xml"))
    names = {dependency.name for dependency in package.exec_depends + package.test_depends}
    assert [name for name in names if name.endswith("-pip")] == []
    assert not names & {"mcap-ros2-support", "python3-torch"}


@pytest.mark.skipif(not IN_VENV, reason="`make test` sets up this environment")
def test_the_environment_runs_this_source() -> None:
    """Otherwise tests that start `paul` or the node would test older code."""

    def contents(folder: Path) -> dict[str, bytes]:
        files = (path for room in ROOMS for path in (folder / room).rglob("*"))
        wanted = (path for path in files if path.suffix in (".py", ".yaml", ".npz"))
        return {str(path.relative_to(folder)): path.read_bytes() for path in wanted}

    source, installed = contents(ROOT), contents(Path(LIBRARIES))
    differ = [name for name in source.keys() | installed.keys() if source.get(name) != installed.get(name)]
    assert not differ, f"the virtual environment has another state of {differ}: run `make setup`"


def test_the_launch_file_names_what_there_is() -> None:
    """launch and launch_ros are not on PyPI, so the test reads the file as XML and checks its substitutions."""
    launch = ElementTree.parse(ROOT / "launch/lifter.launch.xml").getroot()
    node = launch.find("node")
    assert node.get("pkg") == PACKAGE
    assert (ROOT / "lib" / PACKAGE / node.get("exec")).is_file()
    arguments = {argument.get("name"): argument.get("default") for argument in launch.findall("arg")}
    used = set(re.findall(r"\$\(var (\w+)\)", ElementTree.tostring(launch, encoding="unicode")))
    assert used == set(arguments)
    parameters = ROOT / arguments["config"].removeprefix(f"$(find-pkg-share {PACKAGE})/")
    assert yaml.safe_load(parameters.read_text())["/**"]["ros__parameters"]
    pipeline_source = (ROOT / "paul_ros/ros/pipeline.py").read_text(encoding="utf-8")
    for remap in node.findall("remap"):
        assert f'"{remap.get("from")}"' in pipeline_source


def test_launchers_are_executable_in_git() -> None:
    listed = subprocess.run(
        ["git", "ls-files", "--stage", "lib", ".ci"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.splitlines()
    modes = {line.split("\t")[1]: line.split()[0] for line in listed}
    assert modes == {name: "100755" for name in (".ci/run", "lib/paul_ros/lifter", "lib/paul_ros/paul")}
