# SPDX-License-Identifier: Apache-2.0
"""Foreign message packages are generated, compiled and imported; the node reads their messages over DDS."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from compiled_messages import lacking
from conftest import ROOT, RosMake, camera_info, persons_at, seen
from foreign_messages import HRI, SIZE, YOLO, hri
from node_bench import Bench

from msg_adapters import hri as hri_adapter
from paul_ros.layout import load_layout

pytestmark = pytest.mark.skipif(bool(lacking()), reason=f"message packages need {lacking()} to be compiled")

MAKE = RosMake()
COCO = load_layout("coco17").names
PERSON = seen(persons_at((0.3, 0, 4)))[0]


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """compiled(package) -> its folder; the package can be imported until the module ends.

    Other tests need these packages to be missing, so they are removed from this process.
    """
    folder, done = tmp_path_factory.mktemp("compiled"), []
    patch = pytest.MonkeyPatch()
    patch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)
    patch.syspath_prepend(folder)

    def compile_once(package: str) -> Path:
        if package in done:
            return folder
        command = [sys.executable, ROOT / "test/compiled_messages.py", package, folder]
        answer = subprocess.run(command, capture_output=True, text=True, timeout=300)
        assert answer.returncode == 0, answer.stderr
        done.append(package)
        return folder

    yield compile_once
    patch.undo()
    for name in [name for name in sys.modules if name.split(".")[0] in done]:
        del sys.modules[name]


def detections(header):
    """Return a message as yolo_ros sends it: ids from 1, a sparse list, in another order."""
    keypoints = [
        MAKE(
            "yolo_msgs/msg/KeyPoint2D",
            id=index + 1,
            point=MAKE("yolo_msgs/msg/Point2D", x=float(x), y=float(y)),
            score=0.9,
        )
        for index, (x, y) in reversed(list(enumerate(PERSON)))
        if COCO[index] != "left_wrist"
    ]
    data = MAKE("yolo_msgs/msg/KeyPoint2DArray", data=keypoints)
    person = MAKE("yolo_msgs/msg/Detection", class_id=0, class_name="person", score=0.9, id="7", keypoints=data)
    return MAKE(YOLO, header=header, detections=[person])


def skeleton(header):
    """Return a ROS4HRI body in normalised coordinates."""
    pose = dict(zip(COCO, PERSON))
    pose["neck"] = (np.add(pose["left_shoulder"], pose["right_shoulder"])) / 2
    assert set(hri_adapter.NAMES) <= set(pose) and SIZE == (640, 480)
    return hri(MAKE, header, pose)


def calibrated(bench):
    """Return a condition that sends CameraInfo until the node has it: messages before discovery are lost."""

    def once():
        bench.camera.publish(camera_info(MAKE))
        return bench.got["layout"] and bench.units() == "m"

    return once


def test_the_node_lifts_yolo_ros(ros, start_lifter, model_file, compiled):
    compiled("yolo_msgs")
    lifter = start_lifter("-p", f"model:={model_file}")
    bench = Bench(ros, lifter, YOLO)
    bench.until(bench.keypoints.get_subscription_count, "a subscription")
    bench.until(lambda: f"Reading {YOLO}" in lifter.log(), "the log line")
    bench.until(calibrated(bench), "metres")
    bench.until(bench_hears(bench, detections), "poses")
    found = bench.answer("poses", bench.send(detections)).poses
    np.testing.assert_allclose(positions(found), persons_at((0.3, 0, 4))[0], atol=0.15)
    cloud = bench.answer("keypoints3d", bench.send(detections))
    rows = np.frombuffer(cloud.data, "<f4").reshape(17, -1)
    assert rows[COCO.index("left_wrist"), 3] == 0 and (np.delete(rows[:, 3], COCO.index("left_wrist")) > 0.8).all()
    assert (rows[:, 5] == 7).all()
    bench.close()


def test_the_node_lifts_a_body_of_ros4hri(ros, start_lifter, model_file, compiled):
    """A message holds one person, who is lifted although no other stamp follows."""
    compiled("hri_msgs")
    lifter = start_lifter("-p", f"model:={model_file}")
    bench = Bench(ros, lifter, HRI)
    bench.until(bench.keypoints.get_subscription_count, "a subscription")
    bench.until(calibrated(bench), "metres")
    bench.until(bench_hears(bench, skeleton), "poses")
    found = positions(bench.answer("poses", bench.send(skeleton)).poses)
    names = bench.layout()["keypoints"]
    common = [name for name in COCO if name in names]
    assert len(common) >= 12
    np.testing.assert_allclose(
        found[[names.index(name) for name in common]],
        persons_at((0.3, 0, 4))[0][[COCO.index(name) for name in common]],
        atol=0.2,
    )
    bench.close()


def bench_hears(bench, fill):
    """Return a condition that sends until an answer shows that both directions work."""

    def heard():
        bench.send(fill)
        return bench.got["poses"] and bench.got["keypoints3d"]

    return heard


def positions(poses) -> np.ndarray:
    return np.array([(p.position.x, p.position.y, p.position.z) for p in poses])
