# SPDX-License-Identifier: Apache-2.0
"""Inputs and outputs of optional message packages, which the test compiles, over real DDS.

Bodies of ROS4HRI followed by their ids, body_ID on /tf, and the skeletons in the image for Foxglove.
"""

from __future__ import annotations

import time

import numpy as np
import pytest
from compiled_messages import lacking
from conftest import FOCAL, camera_info, header_of, persons_at, seen
from foreign_messages import HRI, hri
from node_bench import GOOD, MAKE, Bench, class_of, cloud, good
from test_compiled_messages import compiled  # noqa: F401, a fixture

from paul_ros.layout import load_layout

pytestmark = pytest.mark.skipif(bool(lacking()), reason=f"message packages need {lacking()} to be compiled")

COCO = load_layout("coco17").names
PLACES = {"anna": (0.3, 0, 4), "b2": (-1, 0, 5), "c": (1, 0, 6)}
LIST = "hri_msgs/msg/IdsList"

# The first two tests need the packages missing, so they run before any is compiled.


def test_tf_without_its_package_is_refused(start_lifter, model_file):
    lifter = start_lifter("-p", f"model:={model_file}", "-p", "publish_tf:=true")
    assert lifter.process.wait(20) == 1
    (line,) = lifter.log().splitlines()
    assert "publish_tf needs tf2_msgs" in line and "install" in line


def test_missing_annotations_are_logged_in_one_line(start_lifter, model_file):
    lifter = start_lifter("-p", f"model:={model_file}")
    end = time.monotonic() + 20
    while "Ready" not in lifter.log():
        assert time.monotonic() < end
        time.sleep(0.05)
    assert lifter.log().count("foxglove_msgs is not installed") == 1


class Bodies(Bench):
    """Publishes each body on a topic of its own, and the list of their ids as `keypoints`."""

    def __init__(self, ros, lifter, *names: str) -> None:
        super().__init__(ros, lifter, LIST)
        beside = "/humans/bodies/{}/skeleton2d".format
        self.bodies = {name: self.node.create_publisher(class_of(HRI), beside(name), 10) for name in names}

    def show(self, *names: str) -> int:
        """Send the list of these ids and their bodies, all with one stamp; return its seconds."""
        self.send(lambda header: MAKE(LIST, header=header, ids=list(names)))
        for name in self.bodies.keys() & set(names):
            pose = dict(zip(COCO, seen(persons_at(PLACES[name]))[0]))
            pose["neck"] = (pose["left_shoulder"] + pose["right_shoulder"]) / 2
            self.bodies[name].publish(hri(MAKE, header_of(MAKE, seconds=self.stamp), pose))
        return self.stamp

    def readers(self) -> set:
        return {name for name, publisher in self.bodies.items() if publisher.get_subscription_count()}


def test_bodies_are_read_as_their_ids_come_and_go(ros, start_lifter, model_file, compiled):  # noqa: F811
    compiled("hri_msgs")
    lifter = start_lifter("-p", f"model:={model_file}", "-r", "keypoints:=/humans/bodies/tracked")
    bench = Bodies(ros, lifter, *PLACES)
    bench.keypoints = bench.node.create_publisher(class_of(LIST), "/humans/bodies/tracked", 10)

    def metres():
        bench.camera.publish(camera_info(MAKE))
        return bench.got["layout"] and bench.units() == "m"

    bench.until(metres, "metres")

    def read(*names):
        def settled():
            bench.show(*names)
            return bench.readers() == set(names)

        return settled

    for names in (("anna",), ("anna", "b2"), ("b2", "c"), ()):
        bench.until(read(*names), f"subscriptions of {names}")
        if names:
            bench.until(lambda names=names: persons(bench, bench.show(*names)) == len(names), f"{names} in 3D")

    def well():
        bench.show()
        bench.ros.spin_once(bench.node, timeout_sec=0.03)
        statuses = [status for _, status in bench.got["diagnostics"][-1:]]
        return any(status.level == b"\x00" and status.message.startswith("0 frames") for status in statuses)

    bench.until(well, "level OK while there is nobody")
    assert f"Reading {LIST}" in lifter.log() and "Traceback" not in lifter.log()
    bench.show("c", "1st")
    bench.until(lambda: "Bodies that are not read, by their ids: '1st'" in lifter.log(), "the warning")
    bench.close()


def persons(bench, seconds: int) -> int:
    """Return the number of persons in the last answer; an answer comes with the next message."""
    bench.ros.spin_once(bench.node, timeout_sec=0.03)
    points = len(bench.layout()["keypoints"])
    sizes = [len(msg.poses) // points for msg in bench.got["poses"] if msg.header.stamp.sec >= seconds - 3]
    return sizes[-1] if sizes else 0


@pytest.fixture
def published(ros, start_lifter, model_file, compiled):  # noqa: F811
    """A node with all optional outputs, and a bench that listens to them."""
    compiled("tf2_msgs")
    compiled("foxglove_msgs")
    lifter = start_lifter("-p", f"model:={model_file}", "-p", "publish_tf:=true", "-r", "/tf:=tf")
    bench = Bench(ros, lifter)
    bench.got |= {"tf": [], "annotations": []}
    bench.node.create_subscription(class_of("tf2_msgs/msg/TFMessage"), "tf", bench.got["tf"].append, 10)
    kind = class_of("foxglove_msgs/msg/ImageAnnotations")
    bench.node.create_subscription(kind, "lifter/annotations", bench.got["annotations"].append, 10)
    bench.matched()
    yield bench
    bench.close()


def test_transforms_and_annotations(published):
    bench = published
    bench.until(lambda: bench.send(good()) and bench.got["tf"] and bench.got["annotations"], "both")
    # Without metres both are empty.
    assert not bench.got["tf"][-1].transforms and not bench.got["annotations"][-1].points[0].points
    bench.camera.publish(camera_info(MAKE))
    bench.until(lambda: bench.units() == "m", "metres")
    two = seen(persons_at(*list(PLACES.values())[:2]))
    two[1, 3:5] = np.nan
    stamp = bench.send(cloud(two))
    body = bench.answer("bodies", stamp).poses[1]
    bench.until(
        lambda: bench.got["tf"][-1].transforms and bench.got["tf"][-1].transforms[0].header.stamp.sec == stamp, "tf"
    )
    transforms = bench.got["tf"][-1].transforms
    assert [t.child_frame_id for t in transforms] == ["body_0", "body_1"]
    assert {t.header.frame_id for t in transforms} == {"camera_color_optical_frame"}
    move, turn = transforms[1].transform.translation, transforms[1].transform.rotation
    assert (move.x, move.y, move.z) == (body.position.x, body.position.y, body.position.z)
    assert (turn.x, turn.y, turn.z, turn.w) == tuple(getattr(body.orientation, axis) for axis in "xyzw")
    bench.until(lambda: bench.got["annotations"][-1].points[1].timestamp.sec == stamp, "annotations")
    lines, dots = bench.got["annotations"][-1].points
    assert (lines.type, dots.type) == (4, 1) and len(dots.points) == len(dots.outline_colors) == 2 * 17
    assert len(lines.points) == 2 * len(lines.outline_colors) == 2 * 2 * len(load_layout("coco17").edges)
    drawn = np.array([(p.x, p.y) for p in dots.points]).reshape(2, 17, 2) - 0.5
    np.testing.assert_allclose(drawn[0], two[0], atol=0.05 * FOCAL / 4)
    faint = np.array([colour.a < 1 for colour in dots.outline_colors]).reshape(2, 17)
    np.testing.assert_array_equal(np.argwhere(faint), [(1, 3), (1, 4)])


def test_transforms_are_of_persons_with_an_id_of_their_own(published):
    """Two persons with one id, and a detector without stamp and frame."""
    bench = published

    def metres():
        bench.camera.publish(camera_info(MAKE))
        return bench.send(good()) and bench.units() == "m"

    bench.until(metres, "metres")
    three = seen(persons_at(*PLACES.values()))
    stamp = bench.send(cloud(three, ["7", "5", "7"]))
    assert list(bench.answer("persons", stamp).joint_names) == ["", "5", ""]
    sent = time.time()
    bench.keypoints.publish(cloud(three, ["1", "2", "3"])(header_of(MAKE, 0, 0, frame="")))
    bench.until(lambda: any(msg.header.stamp.sec > 10**9 for msg in bench.got["persons"]), "persons without a stamp")
    (persons,) = (msg for msg in bench.got["persons"] if msg.header.stamp.sec > 10**9)
    assert persons.header.frame_id == "camera_color_optical_frame"
    assert -0.1 < persons.header.stamp.sec + persons.header.stamp.nanosec / 1e9 - sent < 10
    bench.until(lambda: "body_3" in {name for _, name in transforms_of(bench)}, "transforms")
    assert [name for found, name in transforms_of(bench) if found == stamp] == ["body_5"]
    named = {"body_1", "body_2", "body_3"}
    assert {name for found, name in transforms_of(bench) if found == persons.header.stamp.sec} == named
    values = bench.diagnosed()
    assert [values[f"noted_{reason}"] for reason in ("duplicate_ids", "no_stamp", "no_frame")] == ["2", "1", "1"]


def transforms_of(bench) -> list[tuple[int, str]]:
    """Return (seconds of the stamp, name of the frame) of all transforms that came."""
    return [(t.header.stamp.sec, t.child_frame_id) for msg in bench.got["tf"] for t in msg.transforms]


def test_persons_without_an_id_have_no_frame_of_their_own():
    """Their order is not the same from frame to frame."""
    from types import SimpleNamespace

    from msg_adapters import outputs

    def make(type_name, **fields):
        return SimpleNamespace(**fields)

    header = SimpleNamespace(frame_id="camera", stamp=None)
    message = outputs.body_transforms(make, header, ("", "7"), GOOD[0, :2], np.eye(4)[:2])
    assert [transform.child_frame_id for transform in message.transforms] == ["body_7"]
