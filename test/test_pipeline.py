# SPDX-License-Identifier: Apache-2.0
"""The node's pipeline in this process: what it builds, when it publishes, what it warns of."""

from __future__ import annotations

import re
import threading
import time
from dataclasses import replace

import pytest
from conftest import camera_info, header_of, persons_at, seen
from foreign_messages import CLOUD, HRI, OPENDR, LiveMake, hri, opendr
from node_bench import MAKE, PATIENCE, class_of, good

from paul_ros.layout import load_layout
from paul_ros.stream.messages import OUTPUTS, STANDARD


@pytest.fixture
def lifter_node(ros):
    """The node's object in this process, with the shipped model."""
    from paul_ros.ros.node import LifterNode

    node = LifterNode()
    node.start()
    yield node
    node.destroy_node()


@pytest.fixture
def warnings(lifter_node, monkeypatch):
    """The node's warnings, without throttling."""
    from paul_ros.ros import advisor

    texts = []
    for limit in ("SILENT_SECONDS", "WARNING_SECONDS", "NOTE_SECONDS"):
        monkeypatch.setattr(advisor, limit, 0.0)
    monkeypatch.setattr(lifter_node._log, "_write", texts.append)
    return texts


def test_silence_is_logged_from_the_start(ros, lifter_node, warnings):
    detector = ros.create_node("detector")
    publisher = detector.create_publisher(class_of("sensor_msgs/msg/PointCloud2"), "keypoints", 10)
    end = time.monotonic() + PATIENCE
    pipeline = lifter_node.pipeline
    while not pipeline._input.type_name:
        assert time.monotonic() < end
        pipeline._search_input()
    warnings.clear()
    pipeline._report()
    assert len(warnings) == 1 and re.fullmatch(r"No keypoints for \d+ s on /keypoints\. .*", warnings[0])
    detector.destroy_publisher(publisher)
    while not warnings[-1].endswith("Nobody publishes it: remap `keypoints` to your detector."):
        assert time.monotonic() < end, warnings
        pipeline._report()
    detector.destroy_node()


def test_notes_are_logged_with_what_to_do(lifter_node, warnings):
    plain, unknown = camera_info(MAKE), camera_info(MAKE)
    unknown.d, unknown.distortion_model = [0.1], "fov"
    for count in (1, 2):
        for message in (plain, unknown):
            lifter_node.pipeline._on_camera_info(message)
        lifter_node.pipeline._advisor.report_notes(lifter_node.stream.ledger)
        assert warnings.pop().startswith(f"noted: distortion_ignored, {count} so far. CameraInfo's distortion is not")
    lifter_node.pipeline._advisor.report_notes(lifter_node.stream.ledger)
    assert not warnings


@pytest.fixture
def built(lifter_node, monkeypatch):
    """Names of the outputs that the node has built for a frame, in order."""
    names = []
    for name, output in OUTPUTS.items():

        def build(make, frame, attitudes, name=name, original=output.build):
            names.append(name)
            return original(make, frame, attitudes)

        monkeypatch.setitem(OUTPUTS, name, replace(output, build=build))
    writers = lifter_node.pipeline._topics._builder._writers
    for name, (writer, values) in writers.items():

        def write(header, array, name=name, writer=writer):
            names.append(name)
            return writer(header, array)

        monkeypatch.setitem(writers, name, (write, values))
    return names


def lifted_frame(node):
    from rclpy.serialization import serialize_message

    return node.stream.keypoints(CLOUD, serialize_message(good()(header_of(MAKE)))).frame


def test_outputs_nobody_listens_to_are_not_built(ros, lifter_node, built):
    frame = lifted_frame(lifter_node)

    def built_now():
        built.clear()
        lifter_node.pipeline._topics.publish_frame(frame)
        return built

    assert built_now() == []
    listener = ros.create_node("listener")
    listener.create_subscription(class_of(OUTPUTS["poses"].message_type), "/lifter/poses", lambda msg: None, 10)
    end = time.monotonic() + PATIENCE
    while not built_now() and time.monotonic() < end:
        time.sleep(0.02)
    assert built_now() == ["poses"]
    listener.destroy_node()


def test_a_fault_in_building_leaves_no_half_frame(ros, lifter_node, built, monkeypatch):
    got = []
    listener = ros.create_node("listener")
    for name in STANDARD:
        listener.create_subscription(class_of(OUTPUTS[name].message_type), f"/lifter/{name}", got.append, 10)
    end = time.monotonic() + PATIENCE
    topics, frame = lifter_node.pipeline._topics, lifted_frame(lifter_node)
    while not all(topics.frame_publishers[name].get_subscription_count() for name in STANDARD):
        assert time.monotonic() < end
        time.sleep(0.02)
    with monkeypatch.context() as fault:
        fault.setitem(OUTPUTS, "markers", replace(OUTPUTS["markers"], build=lambda *_: 1 / 0))
        with pytest.raises(ZeroDivisionError):
            topics.publish_frame(frame)
    assert set(built) == set(STANDARD) - {"markers"}
    topics.publish_frame(frame)
    while len(got) < len(STANDARD) and time.monotonic() < end:
        ros.spin_once(listener, timeout_sec=0.02)
    # Each topic keeps its order: if the faulty frame had gone out in part, one more message would come.
    for _ in range(10):
        ros.spin_once(listener, timeout_sec=0.02)
    assert len(got) == len(STANDARD)
    listener.destroy_node()


#: No index has the packages of one-person messages, so the tests hand these to the node; all else is real.
POSES = [dict(zip(load_layout("coco17").names, xy.tolist())) for xy in seen(persons_at((0.3, 0, 4), (-1, 0, 5)))]

OPENDR_POINTS = len(load_layout("openpose18").names)


def one_person(node, build, seconds: int, **person) -> None:
    msg = build(LiveMake(), header_of(MAKE, seconds), **person)
    node.pipeline.on_keypoints(OPENDR if build is opendr else HRI, msg, "/humans/bodies/anna/skeleton2d", 0, 0)


@pytest.fixture
def poses_of_node(ros, lifter_node):
    """Spin the node and a listener: poses_of_node(condition, what) -> the poses that came until the condition held."""
    from rclpy.executors import SingleThreadedExecutor

    got, listener = [], ros.create_node("listener")
    listener.create_subscription(class_of(OUTPUTS["poses"].message_type), "/lifter/poses", got.append, 10)
    executor = SingleThreadedExecutor()
    executor.add_node(lifter_node)

    def until(condition, what: str) -> list:
        end = time.monotonic() + PATIENCE
        while not condition(got):
            assert time.monotonic() < end, f"never came: {what}"
            executor.spin_once(timeout_sec=0.02)
            ros.spin_once(listener, timeout_sec=0)
        return got

    poses = lifter_node.pipeline._topics.frame_publishers["poses"]
    until(lambda _: poses.get_subscription_count(), "the listener")
    yield until
    executor.shutdown()
    listener.destroy_node()


def test_persons_in_a_message_each_are_published_when_no_more_come(lifter_node, poses_of_node):
    for ident, pose in enumerate(POSES, 1):
        one_person(lifter_node, opendr, 1, pose=pose, ident=ident)
    assert lifter_node.stream.counts["frames"] == 0
    (image,) = poses_of_node(bool, "the image without a next one")
    assert (image.header.stamp.sec, len(image.poses)) == (1, 2 * OPENDR_POINTS)
    one_person(lifter_node, opendr, 2, pose=POSES[0], ident=1)
    _, image = poses_of_node(lambda got: len(got) == 2, "one more image")
    assert (image.header.stamp.sec, len(image.poses)) == (2, OPENDR_POINTS)
    assert lifter_node.pipeline._group_timer.is_canceled()
    assert lifter_node.stream.counts == dict(frames=2, persons=3, lifted=3) and not lifter_node.stream.ledger.drops


def test_a_node_kept_from_running_between_two_persons_tears_no_image(lifter_node, poses_of_node):
    """The executor serves timers before messages: at the first late tick the second person still waits."""
    one_person(lifter_node, opendr, 1, pose=POSES[0], ident=1)
    time.sleep(0.05)
    lifter_node.pipeline._on_group_tick()
    one_person(lifter_node, opendr, 1, pose=POSES[1], ident=2)
    (image,) = poses_of_node(bool, "the image")
    assert len(image.poses) == 2 * OPENDR_POINTS and lifter_node.stream.counts["frames"] == 1


def test_the_last_persons_are_published_at_the_end(lifter_node, poses_of_node):
    from paul_ros.ros.lifter_process import spin

    one_person(lifter_node, opendr, 1, pose=POSES[0])
    stop = threading.Event()
    stop.set()
    spin(lifter_node, stop)
    lifter_node.end()
    assert "1 frames, 1 of 1 persons lifted" in lifter_node.summary()
    (image,) = poses_of_node(bool, "the image")
    assert len(image.poses) == OPENDR_POINTS


def test_the_id_of_a_body_is_in_the_topic(lifter_node, monkeypatch):
    published = []
    monkeypatch.setattr(lifter_node.pipeline._topics, "publish_frame", published.append)
    lifter_node.pipeline._on_camera_info(camera_info(MAKE))
    one_person(lifter_node, hri, 1, pose=POSES[0])
    lifter_node.pipeline.flush()
    assert [frame.keypoints.ids for frame in published] == [("anna",)]


def test_numbers_of_persons_outlive_a_switch_and_a_cleanup(lifter_node):
    """A planner may still hold them."""
    from rclpy.parameter import Parameter

    who = lifter_node.stream.session.person_ids
    (number,) = who.numbers(("anna",))
    lifter_node.set_parameters([Parameter("output_layout", value="model")])
    assert lifter_node.stream.session.person_ids is who
    for trigger in ("deactivate", "cleanup", "configure", "activate"):
        getattr(lifter_node, f"trigger_{trigger}")()
    assert lifter_node.stream.session.person_ids.numbers(("ben", "anna"))[1] == number


def test_without_a_stamp_the_nodes_clock_decides(lifter_node, monkeypatch):
    """The time of arrival is the middleware's, or of the node if the middleware states none."""
    published, before = [], time.time_ns()
    monkeypatch.setattr(lifter_node.pipeline._topics, "publish_frame", published.append)
    for number, received in enumerate((before - 5 * 10**9, 0)):
        for ident, pose in enumerate(POSES, 1):
            msg = opendr(LiveMake(), header_of(MAKE, 0, 0, frame=""), pose=pose, ident=ident)
            lifter_node.pipeline.on_keypoints(OPENDR, msg, "/keypoints", 0, received)
        lifter_node.pipeline.flush()
        assert published[number].keypoints.ids == ("1", "2") and not published[number].stamped
    assert published[0].keypoints.stamp == before - 5 * 10**9
    assert before <= published[1].keypoints.stamp <= time.time_ns()
    assert lifter_node.stream.ledger.notes == {"no_stamp": 4, "no_frame": 4}


def test_the_executor_waits_once_for_a_callback(lifter_node, monkeypatch):
    """rclpy's own executor waits a second time after each."""
    import rclpy.executors

    from paul_ros.ros.rclpy_internals import OneThreadExecutor

    waits, count = [], rclpy.executors.NumberOfEntities
    monkeypatch.setattr(rclpy.executors, "NumberOfEntities", lambda *sizes: waits.append(sizes) or count(*sizes))
    found = []
    for kind in (OneThreadExecutor, rclpy.executors.SingleThreadedExecutor):
        executor, ticks = kind(), []
        executor.add_node(lifter_node)
        timer = lifter_node.create_timer(0.02, lambda ticks=ticks: ticks.append(1))
        waits.clear()
        while len(ticks) < 20:
            executor.spin_once()
        found.append(len(waits))
        lifter_node.destroy_timer(timer)
        executor.shutdown()
    assert found[0] < 0.75 * found[1]


def test_bytes_that_are_no_cloud_are_a_counted_drop(lifter_node):
    """Another ROS distribution, or damage, may cause them."""
    from rclpy.serialization import serialize_message

    data = serialize_message(good()(header_of(MAKE)))
    for part in (data[:40], data[:-1], b"", b"\0\1\0\0" + bytes(8) + b"\xff" * 60):
        lifter_node.pipeline.on_keypoints(CLOUD, part, "/keypoints", 0, 0)
    assert lifter_node.stream.ledger.drops == {"damaged_bytes": 4} and lifter_node.stream.counts["frames"] == 0
    lifter_node.pipeline.on_keypoints(CLOUD, data, "/keypoints", 0, 0)
    assert lifter_node.stream.counts["lifted"] == 1
