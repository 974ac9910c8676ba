# SPDX-License-Identifier: Apache-2.0
"""Adapters of other packages: the documented example is installed and run; broken ones lose only their messages."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from compiled_messages import lacking
from conftest import ROOT, RosMake, camera_info, header_of, persons_at, seen
from node_bench import Bench

import msg_adapters
from msg_adapters import Adapter, Keypoints2D, MessageError, WrongPointCount, plugins, record
from paul_ros.lifter import Lifter
from paul_ros.model_file import load_model
from paul_ros.offline.bag_records import BagMessages
from paul_ros.offline.bag_writer import BagWriter
from paul_ros.stream.stream import LiftStream

PEOPLE = "acme_msgs/msg/People"
TRUE = persons_at((0.3, 0, 4), (-1, 0.1, 5))
#: The page with the example, wherever it stands.
[TEXT] = [text for page in (ROOT / "docs").rglob("*.md") if "acme_keypoints/__init__.py" in (text := page.read_text())]


def block(name: str) -> str:
    """Return the code block below a file's name in the document."""
    return re.search(rf"`{re.escape(name)}`\n\n```\w*\n(.*?)```", TEXT, re.DOTALL)[1]


DEFINITIONS = {f"acme_msgs/msg/{name}": block(f"acme_msgs/msg/{name}.msg") for name in ("Person", "People")}


def people(make, header, xy: np.ndarray):
    floats = getattr(make, "floats", lambda values: np.array(values, np.float32))
    persons = [
        make(
            "acme_msgs/msg/Person", name=name, u=floats(row[:, 0]), v=floats(row[:, 1]), score=floats([0.9] * len(row))
        )
        for name, row in zip(("anna", "ben"), xy)
    ]
    return make(PEOPLE, header=header, people=persons)


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder for PYTHONPATH in which pip has installed the example."""
    source, target = tmp_path_factory.mktemp("acme"), tmp_path_factory.mktemp("site")
    for name in ("pyproject.toml", "acme_keypoints/__init__.py"):
        (source / name).parent.mkdir(exist_ok=True)
        (source / name).write_text(block(name))
    run(sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-build-isolation",
        "--disable-pip-version-check", "--target", target, source)  # fmt: skip
    return target


def run(*command, path=()) -> str:
    env = {key: value for key, value in os.environ.items() if key != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
    env["PYTHONPATH"] = os.pathsep.join(map(str, (ROOT, *path)))
    answer = subprocess.run(list(map(str, command)), cwd=ROOT, env=env, capture_output=True, text=True, timeout=120)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    return answer.stdout


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("bag") / "people.mcap"
    make = BagMessages(DEFINITIONS)
    with BagWriter(path, make) as writer:
        writer.write("/camera_info", camera_info(make), 0)
        for number in range(5):
            writer.write("/people", people(make, header_of(make, number + 1), seen(TRUE)), number + 1)
    return path


def test_the_example_is_replayed(installed, bag, model_file, tmp_path):
    report = tmp_path / "report.json"
    arguments = ["replay", bag, "--topic", "/people", "--model", model_file, "--json", report]
    run(sys.executable, "-m", "paul_ros.cli", *arguments, path=[installed])
    found = json.loads(report.read_text())
    assert (found["frames"], found["persons"], found["lifted"], found["dropped"]) == (5, 10, 10, {})
    assert (found["input_layout"], found["units"]) == ("coco17", "m")


def test_the_example_is_read_for_training(installed, bag):
    code = """
import sys
from training.loading import load_training_data
print(load_training_data(sys.argv[1]).W.shape)
"""
    assert run(sys.executable, "-c", code, bag, path=[installed]).strip() == "(10, 2, 17)"


def test_without_it_the_type_is_unknown(bag):
    assert PEOPLE not in msg_adapters.SUPPORTED
    with pytest.raises(MessageError, match="PointCloud2") as caught:
        msg_adapters.read(PEOPLE, None, 17)
    assert caught.value.reason == "unknown_type"


@pytest.mark.skipif(bool(lacking()), reason=f"message packages need {lacking()} to be compiled")
def test_the_example_in_the_node(ros, start_lifter, model_file, installed, tmp_path_factory, monkeypatch):
    compiled = tmp_path_factory.mktemp("compiled")
    code = """
import json, pathlib, sys
from compiled_messages import build
build("acme_msgs", pathlib.Path(sys.argv[1]), json.loads(sys.argv[2]))
"""
    run(sys.executable, "-c", code, compiled, json.dumps(DEFINITIONS), path=[ROOT / "test"])
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(map(str, (installed, compiled))), prepend=os.pathsep)
    monkeypatch.syspath_prepend(compiled)
    lifter = start_lifter("-p", f"model:={model_file}")
    bench = Bench(ros, lifter, PEOPLE)
    try:
        bench.until(lambda: bench.keypoints.get_subscription_count(), "a subscription")
        bench.until(lambda: bench.camera.get_subscription_count(), "a subscription")
        bench.camera.publish(camera_info(RosMake()))
        bench.until(lambda: bench.got["layout"] and bench.units() == "m", "metres")

        def fill(header):
            return people(RosMake(), header, seen(TRUE))

        bench.until(lambda: bench.send(fill) and bench.got["poses"], "poses")
        poses = bench.answer("poses", bench.send(fill)).poses
        found = np.array([(p.position.x, p.position.y, p.position.z) for p in poses]).reshape(2, 17, 3)
        np.testing.assert_allclose(found, TRUE, atol=0.15)
        assert f"Reading {PEOPLE}" in lifter.log() and "coco17" in lifter.log()
    finally:
        bench.close()
        for name in [name for name in sys.modules if name.split(".")[0] == "acme_msgs"]:
            del sys.modules[name]


def test_a_broken_plugin_does_not_stop_the_node(ros, start_lifter, model_file, tmp_path, monkeypatch):
    """The type is an installed one, so that messages do arrive."""
    info = tmp_path / "broken_keypoints-2.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: broken-keypoints\nVersion: 2.1\n")
    (info / "entry_points.txt").write_text("[paul_ros.msg_adapters]\nstd_msgs/msg/Header = no_such_module:ADAPTER\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    lifter = start_lifter("-p", f"model:={model_file}")
    bench = Bench(ros, lifter, "std_msgs/msg/Header")
    bench.until(lambda: bench.keypoints.get_subscription_count(), "a subscription")
    for _ in range(3):
        bench.send(lambda header: header)
    bench.until(lambda: "no_such_module" in lifter.log(), "the warning")
    [line] = [line for line in lifter.log().splitlines() if "broken_adapter" in line]
    assert "the Python package broken-keypoints 2.1" in line and "uninstall" in line
    bench.until(lambda: bench.diagnosed().get("dropped_broken_adapter") == "3", "the count")
    assert "Traceback" not in lifter.log()
    assert lifter.stop() == 0
    bench.close()


# --- in this process


class Point:
    """A stand-in for an entry point of importlib.metadata."""

    def __init__(self, target, name: str = PEOPLE, package: str = "acme"):
        self.name, self.value, self._target = name, "acme:X", target
        self.dist = SimpleNamespace(name=package, version="1.0")

    def load(self):
        return self._target() if callable(self._target) else self._target


@pytest.fixture
def plug(monkeypatch):
    """plug(*entry points) simulates their installation."""
    shipped = {name: msg_adapters.SUPPORTED[name] for name in msg_adapters.SUPPORTED}

    def install(*points):
        monkeypatch.setattr(plugins, "_entry_points", lambda: list(points))
        monkeypatch.setattr(msg_adapters, "SUPPORTED", plugins.Adapters(shipped))
        monkeypatch.setattr(msg_adapters, "ONE_PERSON", plugins.OnePerson(msg_adapters.SUPPORTED))

    return install


MESSAGE = SimpleNamespace(header=SimpleNamespace(stamp=SimpleNamespace(sec=7, nanosec=5), frame_id="camera"))


def sound(**changes) -> Keypoints2D:
    result = record(seen(TRUE), None, ("a", "b"), MESSAGE.header)
    return Keypoints2D(**{**vars(result), **changes})


def dies():
    raise SystemExit(3)


def fails(error: BaseException):
    def read(*_):
        raise error

    return Adapter(read)


class Odd(WrongPointCount):
    def __init__(self):
        super().__init__("17 are not 5", lambda points: 1 / 0)


BROKEN = {
    "no module": (lambda: __import__("no_such_module"), "broken_adapter", "no_such_module"),
    "ends the program": (dies, "broken_adapter", "SystemExit"),
    "no adapter": (42, "broken_adapter", "is a int"),
    "raises": (fails(KeyError("odd")), "adapter_failed", "KeyError: 'odd'"),
    "exits": (fails(SystemExit(2)), "adapter_failed", "SystemExit"),
    "a reason that is none": (fails(MessageError(["a", "list"], "odd\nadvice")), "['a', 'list']", "odd"),
    "a count that nobody can ask": (fails(Odd()), "wrong_point_count", "17 are not 5"),
    "gives nothing": (Adapter(lambda *_: None), "adapter_failed", "NoneType"),
    "too many points": (Adapter(lambda *_: sound(xy=np.zeros((2, 18, 2)))), "adapter_failed", "float64 (2, 18, 2)"),
    "one id": (Adapter(lambda *_: sound(ids=("a",))), "adapter_failed", "with 1 ids"),
    "whole numbers": (Adapter(lambda *_: sound(visible=np.ones((2, 17), int))), "adapter_failed", "visible is int64"),
    "NaN seen": (Adapter(lambda *_: sound(xy=np.full((2, 17, 2), np.nan))), "adapter_failed", "no pixels"),
    "ids that are none": (Adapter(lambda *_: sound(ids=(1, []))), "adapter_failed", "ids and frame_id text"),
    "a stamp that is none": (Adapter(lambda *_: sound(stamp=None)), "adapter_failed", "stamp must be an int"),
    "a layout that is none": (Adapter(lambda *_: sound(), lambda _: []), "adapter_failed", "layout returned a list"),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_adapter_costs_its_messages(plug, model_file, case):
    target, reason, word = BROKEN[case]
    plug(Point(target))
    stream = LiftStream(Lifter(load_model(model_file)), None, 0.3, 64)
    assert PEOPLE in msg_adapters.SUPPORTED
    for _ in range(2):
        assert stream.keypoints(PEOPLE, MESSAGE).frame is None
    assert stream.ledger.drops == {reason: 2}
    assert word in stream.ledger.advice[reason]
    if reason in ("broken_adapter", "adapter_failed"):
        assert "the Python package acme 1.0" in stream.ledger.advice[reason]
        assert "\n" not in stream.ledger.advice[reason]


def test_a_sound_one_is_lifted_and_asked_for_its_kind(plug, model_file):
    plug(Point(Adapter(lambda *_: sound(), lambda _: "coco17", one_person=True)))
    stream = LiftStream(Lifter(load_model(model_file)), None, 0.3, 64)
    assert PEOPLE in msg_adapters.ONE_PERSON
    assert stream.keypoints(PEOPLE, MESSAGE).frame is None
    assert stream.flush().lifted.ok.all() and not stream.ledger.drops


def test_a_broken_one_is_of_no_kind(plug):
    plug(Point(dies))
    assert PEOPLE not in msg_adapters.ONE_PERSON and "x/msg/Y" not in msg_adapters.ONE_PERSON


def test_shipped_types_cannot_be_taken_over(plug, caplog):
    cloud = "sensor_msgs/msg/PointCloud2"
    before = msg_adapters.SUPPORTED[cloud]
    plug(Point(fails(ValueError()), cloud, "thief"))
    assert list(msg_adapters.SUPPORTED).count(cloud) == 1 == len(caplog.messages)
    assert msg_adapters.SUPPORTED[cloud] is before
    assert "the Python package thief 1.0" in caplog.text and "ignored" in caplog.text


def test_two_for_one_type_are_none(plug):
    plug(Point(Adapter(lambda *_: sound()), package="one"), Point(Adapter(lambda *_: sound()), package="two"))
    with pytest.raises(MessageError, match="one 1.0 and the Python package two 1.0 .*uninstall all but one"):
        msg_adapters.read(PEOPLE, MESSAGE, 17)


@pytest.mark.parametrize("name", ["People", "acme_msgs/People", "acme_msgs/srv/People", "a/msg/b/c", "/msg/People"])
def test_what_is_no_type_name_is_left_aside(plug, caplog, name):
    plug(Point(Adapter(lambda *_: sound()), name))
    assert name not in msg_adapters.SUPPORTED and "PACKAGE/msg/NAME" in caplog.text


def test_damaged_packages_cost_only_the_adapters_of_others(monkeypatch, caplog):
    from importlib import metadata

    def damaged(**_):
        raise UnicodeDecodeError("utf-8", b"\xff", 0, 1, "odd")

    monkeypatch.setattr(metadata, "entry_points", damaged)
    adapters = plugins.Adapters({"a/msg/B": Adapter(lambda *_: None)})
    assert list(adapters) == ["a/msg/B"] and len(caplog.messages) == 1
