# SPDX-License-Identifier: Apache-2.0
"""QoS, clocks and their diagnostics, over DDS."""

from __future__ import annotations

import re
import time

import numpy as np
import pytest
from conftest import camera_info, seen
from node_bench import GOOD, MAKE, Bench, class_of, cloud, good, set_parameters


@pytest.fixture
def started(ros, start_lifter, model_file):
    """started(*arguments) -> a bench that is not matched with its node yet."""
    benches = []

    def start(*arguments: str) -> Bench:
        benches.append(Bench(ros, start_lifter("-p", f"model:={model_file}", *arguments)))
        return benches[-1]

    yield start
    for bench in benches:
        bench.close()
        if bench.lifter.process.poll() is None:
            bench.lifter.stop()


def test_levels_from_the_first_to_the_last_frame(started):
    from diagnostic_msgs.msg import DiagnosticStatus

    bench = started()
    bench.until(lambda: bench.got["diagnostics"], "the first diagnostics")
    bench.matched()
    bench.lifts()
    status = bench.next_diagnostics()
    assert status.level == DiagnosticStatus.WARN
    bench.camera.publish(camera_info(MAKE))
    bench.until(lambda: bench.units() == "m", "metres")

    def well():
        time.sleep(0.02)  # faster would lose some, and that is a warning
        bench.send(good())
        return bench.got["diagnostics"][-1][1].level == DiagnosticStatus.OK

    bench.until(well, "level OK")
    values = {pair.key: pair.value for pair in bench.got["diagnostics"][-1][1].values}
    assert float(values["rate_in_hz"]) > 0 and float(values["rate_out_hz"]) > 0
    assert (values["certified_share"], values["ambiguous_share"]) == ("1.000", "0.000")
    assert values["latency_ms_median"] == "unknown"  # the stamps of these tests follow no clock
    bench.until(lambda: bench.got["diagnostics"][-1][1].level == DiagnosticStatus.STALE, "level STALE")
    assert re.search(r"No keypoints for \d+ s on /", bench.lifter.log())


def test_a_person_at_the_edge_of_the_image_is_counted_and_no_warning(started):
    """It walks in for half a second, stays for two, and walks out for half a second, twice."""
    bench = started()
    bench.matched()
    bench.camera.publish(camera_info(MAKE))
    bench.until(lambda: bench.units() == "m", "metres")
    bench.until(lambda: bench.next_diagnostics().level == b"\x00", "level OK")
    edge = seen(GOOD)
    edge[:, 3:] = np.nan
    begin = len(bench.got["diagnostics"])
    for pixels in 2 * (5 * [edge] + 20 * [seen(GOOD)] + 5 * [edge]):
        bench.send(cloud(pixels))
        end = time.monotonic() + 0.1
        bench.until(lambda end=end: time.monotonic() >= end, "a tenth of a second")
    levels = {status.level for _, status in bench.got["diagnostics"][begin:]}
    assert levels == {b"\x00"} and int(bench.diagnosed()["dropped_person_too_few_points"]) == 20
    assert "person_too_few_points" not in bench.lifter.log()


def test_latency_is_from_stamp_to_publish(started):
    bench = started()
    bench.matched()

    def stamped(header):
        now = time.time_ns()
        header.stamp.sec, header.stamp.nanosec = divmod(now, 10**9)
        return good()(header)

    def known():
        bench.send(stamped)
        return bench.diagnosed()["latency_ms_median"] != "unknown"

    bench.until(known, "a latency")
    values = bench.diagnosed()
    assert 0 < float(values["latency_ms_median"]) <= float(values["latency_ms_p99"]) < 1000


def test_a_publisher_whose_qos_does_not_match_is_named(ros, started):
    """The node asks for reliable messages, and this publisher is best effort."""
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    bench = started("-r", "keypoints:=/loud", "-p", "qos_overrides./loud.subscription.reliability:=reliable")
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = bench.node.create_publisher(class_of("sensor_msgs/msg/PointCloud2"), "/loud", best_effort)
    bench.until(lambda: "publisher of /loud" in bench.lifter.log(), "the warning")
    assert "RELIABILITY" in bench.lifter.log() and "qos_overrides./loud.subscription.reliability" in bench.lifter.log()
    bench.until(lambda: "QoS" in bench.next_diagnostics().message, "the diagnostics")
    for _ in range(3):
        status = bench.next_diagnostics()
        assert status.level == b"\x01" and "publisher of /loud" in status.message and "RELIABILITY" in status.message
    bench.node.destroy_publisher(publisher)
    bench.until(lambda: "QoS" not in bench.next_diagnostics().message, "the end of the mismatch")
    assert bench.lifter.log().count("publisher of /loud") == 1


def test_a_subscriber_whose_qos_does_not_match_is_named_and_the_override_helps(started):
    from geometry_msgs.msg import PoseArray
    from rclpy.qos import DurabilityPolicy, QoSProfile

    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    for override in ((), ("-p", "qos_overrides./renamed.publisher.durability:=transient_local")):
        got = []
        bench = started("-r", "~/poses:=/renamed", *override)
        bench.node.create_subscription(PoseArray, "/renamed", got.append, latched)
        if override:
            bench.until(lambda: bench.send(good()) and got, "poses")
            assert "QoS" not in bench.lifter.log()
        else:
            bench.until(lambda: "subscriber of /renamed" in bench.lifter.log(), "the warning")
            assert "DURABILITY" in bench.lifter.log()
        bench.lifter.stop()


@pytest.mark.parametrize("value", ["sometimes", "-5", "99999999999"])
def test_an_override_that_cannot_be_is_refused(start_lifter, model_file, value):
    policy = "reliability" if value == "sometimes" else "depth"
    lifter = start_lifter(
        "-p",
        f"model:={model_file}",
        "-r",
        "~/poses:=/renamed",
        "-p",
        f"qos_overrides./renamed.publisher.{policy}:={value}",
    )
    assert lifter.process.wait(20) == 1
    (line,) = lifter.log().splitlines()
    assert line.startswith("lifter: ") and (value in line or policy in line)


def test_an_input_whose_override_cannot_be_is_an_error_in_diagnostics(started):
    bench = started("-r", "keypoints:=/wrong", "-p", "qos_overrides./wrong.subscription.reliability:=sometimes")
    bench.node.create_publisher(class_of("sensor_msgs/msg/PointCloud2"), "/wrong", 1)
    bench.until(lambda: "sometimes" in bench.lifter.log(), "the warning")
    assert bench.next_diagnostics().level == b"\x02" and "Traceback" not in bench.lifter.log()


def test_an_input_type_that_is_not_the_published_one_is_an_error(started):
    bench = started("-p", "input_type:=geometry_msgs/msg/PoseArray")
    warning = "has the type sensor_msgs/msg/PointCloud2, but input_type is geometry_msgs/msg/PoseArray"
    bench.until(lambda: warning in bench.lifter.log(), "the warning")
    bench.until(lambda: warning in bench.next_diagnostics().message, "the diagnostics")
    assert bench.next_diagnostics().level == b"\x02"


def test_simulated_time_without_a_clock_is_named(started):
    """Frames are lifted all the same, and the warning ends with the first publisher of /clock."""
    bench = started("-p", "use_sim_time:=true")
    bench.matched()
    bench.lifts()
    warning = "use_sim_time is true, but nobody publishes /clock"

    def last():
        return bench.got["diagnostics"][-1][1]  # all stamps are zero

    bench.until(lambda: bench.got["diagnostics"] and warning in last().message, "the diagnostics")
    assert last().level != b"\x00"
    bench.node.create_publisher(class_of("rosgraph_msgs/msg/Clock"), "/clock", 10)
    bench.until(lambda: warning not in last().message, "a clock")
    assert bench.lifter.log().count(warning) == 1 and "--clock" in bench.lifter.log()


def test_simulated_time_that_is_set_back(started):
    """As with a bag that loops: diagnostics continue while time stands still, and the node warns and continues."""
    bench = started("-p", "use_sim_time:=true")
    clock = bench.node.create_publisher(class_of("rosgraph_msgs/msg/Clock"), "/clock", 10)
    bench.matched()
    warning = "Time was set back by 95.0 s."

    def tick(seconds: int):
        clock.publish(MAKE("rosgraph_msgs/msg/Clock", clock=MAKE("builtin_interfaces/msg/Time", sec=seconds)))

    def stamps() -> list[int]:
        return [stamp for stamp, _ in bench.got["diagnostics"]]

    def at(seconds: int):
        def reached():
            tick(seconds)
            return stamps() and stamps()[-1] == seconds * 10**9

        return reached

    bench.until(at(100), "diagnostics of simulated time")
    bench.lifts()
    bench.until(at(5), "diagnostics after the jump")
    assert bench.lifter.log().count(warning) == 1
    bench.lifts()
    # A change of the clock's source is no jump.
    for simulated in (False, True):
        assert set_parameters(bench, use_sim_time=simulated) == [""]
    tick(5)
    bench.until(at(5), "diagnostics of simulated time again")
    count = len(stamps())
    bench.until(lambda: len(stamps()) >= count + 2, "diagnostics while time stands still")
    assert stamps()[-1] == 5 * 10**9
    values = {pair.key: pair.value for pair in bench.got["diagnostics"][-1][1].values}
    assert values["noted_clock_set_back"] == "1"
