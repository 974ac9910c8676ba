# SPDX-License-Identifier: Apache-2.0
"""CameraInfo over DDS: latched before the node starts, volatile, late, and with the image stated while it runs."""

from __future__ import annotations

import time

import numpy as np
from conftest import camera_info, persons_at, seen
from node_bench import GOOD, MAKE, PATIENCE, Bench, class_of, cloud, set_parameters
from test_camera_info import BARREL, hips, info, raw_pixels

from paul_ros.ros.camera_input import CameraInput


def latched():
    from rclpy.qos import DurabilityPolicy, QoSProfile

    return QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def test_a_camera_that_was_latched_before_the_start_arrives(ros, start_lifter, model_file):
    """It is published once, as by a driver that started long ago. Nobody warns of its QoS or of the volatile one's."""
    early = ros.create_node("driver", namespace="early")
    publisher = early.create_publisher(class_of("sensor_msgs/msg/CameraInfo"), "camera_info", latched())
    publisher.publish(camera_info(MAKE))
    lifter = start_lifter("-p", f"model:={model_file}", "-r", "camera_info:=/early/camera_info")
    bench = Bench(ros, lifter)
    bench.until(lambda: bench.got["layout"] and bench.units() == "m", "metres from the latched CameraInfo")
    # Later messages reach both subscriptions, and count once.
    for _ in range(3):
        publisher.publish(camera_info(MAKE, fx=0.0))
    bench.until(lambda: bench.diagnosed().get("dropped_bad_intrinsics"), "the drops")
    bench.until(lambda: bench.diagnosed()["dropped_bad_intrinsics"] == "3", "all drops")
    assert bench.diagnosed()["dropped_bad_intrinsics"] == "3" and "QoS" not in lifter.log()
    bench.until(lambda: bench.keypoints.get_subscription_count(), "the subscription of keypoints")
    assert np.linalg.norm(bench.lifts() - GOOD, axis=-1).max() < 0.15
    bench.close()
    early.destroy_node()


def test_a_volatile_camera_comes_late_and_its_image_is_stated(ros, start_lifter, model_file):
    bench = Bench(ros, start_lifter("-p", f"model:={model_file}"))
    bench.matched()
    bench.lifts()
    assert bench.units() == "model"
    bench.camera.publish(info(p=(580, 580, 320, 240), d=BARREL))
    bench.until(lambda: bench.units() == "m", "metres")
    assert bench.layout()["image"] == "rectified" and bench.diagnosed()["noted_image_assumed"] == "1"
    assert set_parameters(bench, image="crooked")[0].startswith("`image` is 'crooked'; it must be auto or")
    assert set_parameters(bench, image="raw") == [""]
    bench.until(lambda: bench.layout()["image"] == "raw", "the other image")
    assert bench.layout()["distortion"] == "plumb_bob, corrected"
    truth = persons_at((1.4, 0.0, 3.0))
    body = bench.answer("bodies", bench.send(cloud(raw_pixels(truth, BARREL)))).poses[0].position
    np.testing.assert_allclose((body.x, body.y, body.z), hips(truth)[0], atol=0.03)
    assert "QoS" not in bench.lifter.log()
    bench.close()


def test_a_resized_image_is_a_warning_that_names_both_sizes(ros, start_lifter, model_file):
    from diagnostic_msgs.msg import DiagnosticStatus

    bench = Bench(ros, start_lifter("-p", f"model:={model_file}"))
    bench.matched()
    bench.camera.publish(camera_info(MAKE))
    bench.until(lambda: bench.units() == "m", "metres")

    def warned():
        bench.send(cloud(3 * seen(GOOD)))
        status = bench.next_diagnostics()
        return status.level == DiagnosticStatus.WARN and "CameraInfo states an image of 640x480" in status.message

    bench.until(warned, "the warning")
    bench.close()


def test_latched_publishers_have_their_own_subscription_as_long_as_they_live(ros):
    """A second copy of a message is ignored. Volatile publishers are not asked for what they do not offer."""
    from rclpy.event_handler import PublisherEventCallbacks

    node, taken, refused = ros.create_node("cameras"), [], []
    kind = class_of("sensor_msgs/msg/CameraInfo")
    events = PublisherEventCallbacks(incompatible_qos=refused.append, use_default_callbacks=False)
    volatile = node.create_publisher(kind, "a_camera", 10, event_callbacks=events)
    camera = CameraInput(node, "a_camera", taken.append, lambda *text: refused.append(text))

    def until(condition):
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end
            camera.check_publishers()
            ros.spin_once(node, timeout_sec=0.02)

    until(lambda: volatile.get_subscription_count() == 1)
    driver = node.create_publisher(kind, "a_camera", latched(), event_callbacks=events)
    driver.publish(camera_info(MAKE))
    until(lambda: driver.get_subscription_count() == 2 and taken)
    for count in (2, 3, 4):
        driver.publish(camera_info(MAKE))
        until(lambda: len(taken) >= count)
    for _ in range(20):
        ros.spin_once(node, timeout_sec=0.02)
    assert len(taken) == 4
    node.destroy_publisher(driver)
    until(lambda: node.count_subscribers("a_camera") == 1)
    again: list = []
    events = PublisherEventCallbacks(incompatible_qos=again.append, use_default_callbacks=False)
    other = node.create_publisher(kind, "a_camera", 10, event_callbacks=events)
    until(lambda: other.get_subscription_count() == 1)
    assert not again
    camera.close()
    node.destroy_node()


def test_every_message_is_taken_if_the_middleware_has_no_stamps(ros):
    node, taken = ros.create_node("cameras"), []
    camera = CameraInput(node, "a_camera", taken.append, lambda *_: None)
    for stamp in (0, 0, 7, 7, 0):
        camera._taker()(stamp, {"source_timestamp": stamp})
    assert taken == [0, 0, 7, 0]
    camera.close()
    node.destroy_node()


def test_a_volatile_camera_is_not_asked_for_latched_messages(ros):
    from rclpy.event_handler import PublisherEventCallbacks

    node, refused = ros.create_node("cameras"), []
    events = PublisherEventCallbacks(incompatible_qos=refused.append, use_default_callbacks=False)
    publisher = node.create_publisher(
        class_of("sensor_msgs/msg/CameraInfo"), "another_camera", 10, event_callbacks=events
    )
    camera = CameraInput(node, "another_camera", lambda _: None, lambda *text: refused.append(text))
    end = time.monotonic() + PATIENCE
    while not publisher.get_subscription_count():
        assert time.monotonic() < end
        camera.check_publishers()
        ros.spin_once(node, timeout_sec=0.02)
    for _ in range(10):
        camera.check_publishers()
        ros.spin_once(node, timeout_sec=0.02)
    assert not refused and node.count_subscribers("another_camera") == 1
    camera.close()
    node.destroy_node()
