# SPDX-License-Identifier: Apache-2.0
"""The node as its users meet it: a real process, real DDS, good and bad input."""

from __future__ import annotations

import array
import json
import os
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
from conftest import LIFTER, ROOT, LifterProcess, camera_info, header_of, persons_at, seen
from foreign_messages import DEFINITIONS as FOREIGN
from node_bench import GOOD, MAKE, PATIENCE, Bench, class_of, cloud, good, header_in, nobody, set_parameters

import msg_adapters
from msg_adapters import outputs
from paul_ros.stream import parameters
from paul_ros.stream.depth import SURFACE
from paul_ros.stream.messages import STANDARD


def half_way(seconds: int):
    """A depth image of a wall 2 m away."""
    header = header_of(MAKE, seconds=seconds)
    values = np.full((480, 640), 2000, "<u2")
    return MAKE(
        "sensor_msgs/msg/Image",
        header=header,
        height=480,
        width=640,
        encoding="16UC1",
        is_bigendian=0,
        step=1280,
        data=MAKE.octets(values.tobytes()),
    )


def crowd(header):
    """10,000 persons in one byte per point, with x = y: best effort may lose a message of megabytes."""
    same = [MAKE("sensor_msgs/msg/PointField", name=name, offset=0, datatype=2, count=1) for name in "xy"]
    return MAKE(
        "sensor_msgs/msg/PointCloud2",
        header=header,
        height=10_000,
        width=17,
        fields=same,
        is_bigendian=False,
        point_step=1,
        row_step=17,
        data=MAKE.octets(bytes(170_000)),
        is_dense=True,
    )


def fields(*names_and_datatypes) -> list:
    return [
        MAKE("sensor_msgs/msg/PointField", name=name, offset=4 * index, datatype=datatype, count=1)
        for index, (name, datatype) in enumerate(names_and_datatypes)
    ]


#: Bad input -> (message, the reason it is counted by, a word of the advice in the log).
BAD = {
    "wrong field names": (cloud(seen(GOOD), fields=fields(("u", 7), ("v", 7))), "wrong_fields", "x and y"),
    # Its advice is not in the log: warnings of one reason are throttled.
    "wrong field type": (cloud(seen(GOOD), fields=fields(("x", 7), ("y", 99))), "wrong_fields", ""),
    "3D cloud": (cloud(seen(GOOD), fields=fields(("x", 7), ("y", 7), ("z", 7))), "not_2d", "3D cloud"),
    "NaN everywhere": (cloud(np.full((1, 17, 2), np.nan)), "person_too_few_points", "left out"),
    "10,000 persons": (crowd, "too_many_persons", "max_persons"),
    "wrong number of points": (cloud(np.ones((1, 25, 2))), "wrong_point_count", "body25"),
    "absurd size": (cloud(seen(GOOD), height=2**32 - 1), "truncated_data", "bytes"),
    "absurd step": (cloud(seen(GOOD), row_step=1, height=2), "wrong_steps", "row_step"),
}


@pytest.fixture(scope="module")
def bench(ros, start_lifter, model_file):
    """One lifter with the shipped parameter file and no CameraInfo, shared by tests that send none."""
    lifter = start_lifter("--params-file", str(ROOT / "config" / "lifter.yaml"), "-p", f"model:={model_file}")
    bench = Bench(ros, lifter)
    bench.matched()
    yield bench
    bench.close()


@pytest.fixture(scope="module")
def after_bad_input(bench):
    """Diagnostics after all bad messages. Each is sent until the log warns of it; then a good one is answered."""
    for fill, reason, _ in BAD.values():

        def warned():
            bench.send(fill)
            bench.lifts()
            return f"dropped: {reason}" in bench.lifter.log()

        bench.until(warned, reason)
    return bench.diagnosed()


def test_without_camera_info_units_are_the_models_and_one_warning_is_logged(bench):
    points = bench.lifts()
    assert bench.units() == "model"
    # The root point of a person in model units is the origin.
    np.testing.assert_allclose(points[0, [11, 12]].mean(axis=0), 0, atol=1e-9)
    for _ in range(2):
        bench.diagnosed()
    assert bench.lifter.log().count("model units") == 1


def test_the_layout_that_was_found_is_logged_once(bench):
    for _ in range(2):
        bench.lifts()
    assert bench.lifter.log().count("is taken to have the points of coco17") == 1
    assert [json.loads(msg.data)["input_layout"] for msg in bench.got["layout"]][-1] == "coco17"


def test_header_is_the_inputs_in_every_output(bench):
    def fill(header):
        header.stamp.sec, header.stamp.nanosec = 2_000_000_123, 999_999_999
        header.frame_id = "left eye/optical"
        return good()(header)

    bench.send(fill)
    for name in STANDARD:
        header = header_in(bench.answer(name, 2_000_000_123))
        assert (header.stamp.nanosec, header.frame_id) == (999_999_999, "left eye/optical")


def test_outputs_agree_with_each_other(bench):
    seconds = bench.send(good())
    poses, points, markers = (bench.answer(name, seconds) for name in ("poses", "keypoints3d", "markers"))
    xyz = np.array([(p.position.x, p.position.y, p.position.z) for p in poses.poses])
    data = np.frombuffer(points.data, "<f4").reshape(points.height, points.width, 8)
    np.testing.assert_allclose(data[0, :, :3], xyz, atol=1e-5)
    np.testing.assert_array_equal(data[0, :, 3:6], [(1, keypoint, 0) for keypoint in range(17)])
    spheres = np.array([(p.x, p.y, p.z) for p in markers.markers[1].points])
    np.testing.assert_array_equal(spheres, xyz)


def test_zero_persons_are_answered_by_empty_outputs(bench):
    seconds = bench.send(nobody())
    assert len(bench.answer("poses", seconds).poses) == len(bench.answer("bodies", seconds).poses) == 0
    assert bench.answer("keypoints3d", seconds).height == 0
    assert bench.answer("markers", seconds).markers[0].action == 2


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_counted_explained_and_survived(after_bad_input, bench, case):
    _, reason, advice = BAD[case]
    sent = sum(other == reason for _, other, _ in BAD.values())
    assert int(after_bad_input[f"dropped_{reason}"]) >= sent
    assert any(reason in line and advice in line for line in bench.lifter.log().splitlines())
    assert "Traceback" not in bench.lifter.log() and "dropped_internal_error" not in after_bad_input


def test_stamps_going_backwards_are_lifted_and_noted(bench):
    bench.lifts()
    before = int(bench.diagnosed().get("noted_stamp_backwards", 0))
    bench.stamp -= 50_000
    bench.lifts()
    assert int(bench.diagnosed()["noted_stamp_backwards"]) == before + 1


def test_frames_that_come_while_the_node_is_busy_are_counted(bench):
    bench.lifts()
    before = bench.diagnosed()
    bench.lifter.process.send_signal(signal.SIGSTOP)
    try:
        for _ in range(100):
            bench.send(good())
    finally:
        bench.lifter.process.send_signal(signal.SIGCONT)
    bench.lifts()
    after = bench.diagnosed()
    missed = int(after["dropped_missed"]) - int(before.get("dropped_missed", 0))
    lifted = int(after["frames"]) - int(before["frames"])
    assert missed > 0 and missed + lifted == 101


def test_diagnostics_have_counts_times_units_and_model(bench, model_file):
    bench.lifts()
    values = bench.diagnosed()
    assert int(values["frames"]) >= int(values["lifted"]) > 0
    assert 0 < float(values["lift_us_median"]) <= float(values["lift_us_p99"])
    assert (values["units"], values["model"], len(values["model_sha256"])) == ("model", "stand", 64)
    assert values["input_type"] == "sensor_msgs/msg/PointCloud2"
    status = bench.next_diagnostics()
    assert status.level == b"\x01" and "no metres without a usable CameraInfo" in status.message


def test_parameters_may_change_where_the_table_says_so(bench):
    assert set_parameters(bench, max_persons=1) == [""]
    bench.send(cloud(seen(persons_at((0, 0, 4), (1, 0, 4)))))
    bench.lifts()
    assert int(bench.diagnosed()["dropped_too_many_persons"]) >= 1
    assert set_parameters(bench, max_persons=64, min_confidence=0.5) == ["", ""]
    assert set_parameters(bench, person_height=1.2, smoothing=2.0) == ["", ""]
    keys = ("person_height", "size_spread", "smoothing_hz")
    bench.until(lambda: [bench.layout()[key] for key in keys] == [1.2, 0, 2], "the new layout")
    assert set_parameters(bench, person_height=0.0, smoothing=0.0) == ["", ""]
    bench.until(lambda: [bench.layout()[key] for key in keys] == [1.7, 0.06, 0], "the old layout")
    assert "range" in set_parameters(bench, min_confidence=1.5)[0]
    assert "read-only" in set_parameters(bench, input_type="auto")[0]


def test_a_subscriber_with_a_qos_that_cannot_match_is_warned_about(bench):
    from geometry_msgs.msg import PoseArray
    from rclpy.qos import DurabilityPolicy, QoSProfile

    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    subscription = bench.node.create_subscription(PoseArray, "lifter/poses", lambda msg: None, latched)
    bench.until(lambda: "DURABILITY" in bench.lifter.log(), "the warning")
    bench.node.destroy_subscription(subscription)


def test_no_torch_in_the_node(bench):
    bench.lifts()
    with open(f"/proc/{bench.lifter.process.pid}/maps", encoding="utf-8") as maps:
        mapped = maps.read()
    assert "rclpy" in mapped and "torch" not in mapped
    done = subprocess.run(
        [LIFTER[0], "-X", "importtime", *LIFTER[1:], "--help"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    imported = {line.rpartition("|")[2].strip().split(".")[0] for line in done.stderr.splitlines()}
    assert "numpy" in imported and not imported & {"torch", "training", "rosbags", "mcap", "scipy"}
    assert "min_confidence" in done.stdout


def test_numpy_is_not_imported_before_the_process_limits_its_threads():
    """`python -m` imports the packages around a module first."""
    code = "import sys, paul_ros.ros; print('numpy' in sys.modules)"
    done = subprocess.run([LIFTER[0], "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_camera_info_turns_model_units_into_metres(ros, start_lifter, model_file):
    bench = Bench(ros, start_lifter("-p", f"model:={model_file}"))
    bench.matched()
    assert bench.units() == "model"
    bench.camera.publish(camera_info(MAKE, fx=0.0))
    bench.until(lambda: "bad_intrinsics" in bench.lifter.log(), "the warning")
    assert bench.diagnosed()["dropped_bad_intrinsics"] == "1" and bench.units() == "model"
    bench.camera.publish(camera_info(MAKE))
    bench.until(lambda: bench.units() == "m", "the new layout")
    points = bench.lifts()
    assert np.linalg.norm(points - GOOD, axis=-1).max() < 0.15
    assert bench.diagnosed()["units"] == "m"

    def measured():
        # For the frame after the next: by then the image has come, unless it was lost.
        bench.depth.publish(half_way(bench.stamp + 2))
        return bench.lifts()[0, 0, 2] > 3 > bench.lifts()[0, 0, 2]

    bench.until(measured, "the measured depth")
    assert int(bench.diagnosed()["noted_depth_used"]) >= 1
    assert bench.answer("bodies", bench.stamp).poses[0].position.z == pytest.approx(2 + SURFACE, abs=1e-3)
    other = camera_info(MAKE)
    other.d, other.distortion_model = array.array("d", [0.9]), "fov"
    for _ in range(2):
        bench.camera.publish(other)
    bench.until(lambda: int(bench.diagnosed().get("noted_distortion_ignored", 0)) == 1, "the note")
    assert bench.units() == "m" and bench.lifter.log().count("'fov' is not known") == 1
    bench.close()
    assert "Ready" in bench.lifter.log()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_in_the_midst_of_frames_ends_it_cleanly(ros, start_lifter, model_file, number):
    bench = Bench(ros, start_lifter("-p", f"model:={model_file}"))
    bench.matched()
    for _ in range(200):
        bench.send(good())
    assert bench.lifter.stop(number) == 0
    bench.close()
    log = bench.lifter.log()
    assert "Traceback" not in log and "internal_error" not in log
    assert log.splitlines()[-1].startswith("lifter: ")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_the_process_imports_ends_it_cleanly(tmp_path, number):
    (tmp_path / "rclpy.py").write_text(f"import os, time\nos.kill(os.getpid(), {int(number)})\ntime.sleep(10)\n")
    env = {key: value for key, value in os.environ.items() if key != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
    env["PYTHONPATH"] = os.pathsep.join([str(tmp_path), str(ROOT)])
    done = subprocess.run(LIFTER, env=env, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def without_rclpy(folder: Path) -> dict[str, str]:
    """Return an environment in which rclpy cannot be imported."""
    (folder / "rclpy.py").write_text("raise ModuleNotFoundError(\"No module named 'rclpy'\", name='rclpy')")
    env = {key: value for key, value in os.environ.items() if key != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
    return {**env, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])}


@pytest.mark.parametrize("command", [LIFTER, [str(ROOT / "lib/paul_ros/lifter")]])
def test_without_ros_one_line_names_the_cure(tmp_path, command):
    env = without_rclpy(tmp_path)
    env["PATH"] = os.pathsep.join([str(Path(LIFTER[0]).parent), env["PATH"]])
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("lifter: the node needs ROS 2: source /opt/ros/")
    assert "or pip install '.[ros]' in a clone of paul_ros" in line


def test_help_fits_a_terminal_and_has_all_parameters():
    done = subprocess.run([*LIFTER, "--help"], cwd=ROOT, capture_output=True, text=True, check=True)
    lines = done.stdout.splitlines()
    assert max(map(len, lines)) <= 80 and not any(line.startswith("|") for line in lines)
    for parameter in parameters.PARAMETERS:
        assert any(line.startswith(f"  {parameter.name} (default ") for line in lines), parameter.name


def test_pose_array_of_a_best_effort_publisher(ros, start_lifter, model_file):
    lifter = start_lifter("-p", f"model:={model_file}", "-p", "layout:=coco17")
    bench = Bench(ros, lifter, "geometry_msgs/msg/PoseArray", best_effort=True)
    xyz = np.concatenate([seen(persons_at((0, 0, 4), (1, 0, 4))), np.full((2, 17, 1), 0.9)], axis=-1)

    def answered():
        bench.send(lambda header: outputs.pose_array(MAKE, header, xyz))
        return any(len(msg.poses) == 34 for msg in bench.got["poses"])

    bench.until(answered, "two persons")
    bench.send(lambda header: outputs.pose_array(MAKE, header, xyz * 3))
    bench.until(lambda: "not_2d" in lifter.log(), "the drop")
    bench.close()
    assert lifter.stop() == 0
    assert "1 not_2d" in lifter.log().splitlines()[-1]


def test_an_input_that_cannot_be_read_is_named_and_a_good_one_is_found_later(ros, start_lifter, model_file):
    lifter = start_lifter("-p", f"model:={model_file}")
    wrong = Bench(ros, lifter, "std_msgs/msg/String")
    wrong.until(lambda: "std_msgs/msg/String, which cannot be read" in lifter.log(), "the warning")
    wrong.close()
    bench = Bench(ros, lifter)
    bench.matched()
    bench.lifts()
    bench.close()


def test_a_detector_of_another_type_is_found_when_the_first_has_gone(ros, start_lifter, model_file):
    lifter = start_lifter("-p", f"model:={model_file}")
    for kind in ("sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/PoseArray"):
        bench = Bench(ros, lifter, kind)
        bench.until(lambda kind=kind: f"Reading {kind}" in lifter.log(), f"a subscription of {kind}")
        bench.until(bench.keypoints.get_subscription_count, "the subscription")
        bench.close()


def test_a_detector_of_another_type_beside_the_first_is_named(ros, start_lifter, model_file):
    """Its messages are not read: a WARN until one of the two is gone."""
    bench = Bench(ros, start_lifter("-p", f"model:={model_file}"))
    bench.matched()
    context = ros.Context()  # one process cannot have two types on a topic
    ros.init(context=context)
    other = ros.create_node("other", namespace=bench.lifter.namespace, context=context)
    publisher = other.create_publisher(class_of("geometry_msgs/msg/PoseArray"), "keypoints", 10)
    text = f"/{bench.lifter.namespace}/keypoints also has the type geometry_msgs/msg/PoseArray: nothing comes from"
    bench.until(lambda: text in bench.next_diagnostics().message, "the warning")
    assert bench.next_diagnostics().level == b"\x01" and bench.lifter.log().count(text) == 1
    bench.lifts()
    other.destroy_publisher(publisher)
    bench.until(lambda: text not in bench.next_diagnostics().message, "the end of the warning")
    other.destroy_node()
    ros.shutdown(context=context)
    bench.close()


def test_a_message_package_that_is_not_installed_is_named(ros, start_lifter, model_file):
    lifter = start_lifter("-p", f"model:={model_file}", "-p", "input_type:=yolo_msgs/msg/DetectionArray")
    bench = Bench(ros, lifter)
    bench.until(lambda: "yolo_msgs" in lifter.log(), "the warning")
    assert "Install it" in lifter.log()
    bench.close()


@pytest.mark.parametrize("type_name", sorted(set(FOREIGN) & set(msg_adapters.SUPPORTED)))
def test_every_foreign_package_that_is_missing_is_named(type_name):
    """The node's warning has the text of this error."""
    from paul_ros.ros.messages import message_class

    with pytest.raises(ImportError, match=type_name.split("/")[0]):
        message_class(type_name)


def refused(lifter: LifterProcess) -> str:
    """Return the only line of a node that ends by itself with exit code 1."""
    assert lifter.process.wait(PATIENCE) == 1
    assert len(lifter.log().splitlines()) == 1
    return lifter.log()


def test_a_model_file_with_one_byte_changed_is_refused(start_lifter, model_file, tmp_path):
    data = bytearray(model_file.read_bytes())
    data[len(data) // 2] ^= 1
    changed = tmp_path / "changed.npz"
    changed.write_bytes(data)
    line = refused(start_lifter("-p", f"model:={changed}"))
    assert str(changed) in line and "damaged" in line


@pytest.mark.parametrize(
    "argument, word",
    [
        ("model:=no_such_model", "no_such_model"),
        ("layout:=coco71", "coco17"),
        ("min_confidence:=2.0", "range"),
        ("input_type:=std_msgs/msg/String", "PointCloud2"),
    ],
)
def test_parameters_that_cannot_be_used_are_refused(start_lifter, model_file, argument, word):
    assert word in refused(start_lifter("-p", f"model:={model_file}", "-p", argument))


@pytest.mark.parametrize(
    "arguments, word",
    [
        (["-p", "foo"], "NAME:=VALUE"),
        (["-r"], "FROM:=TO"),
        (["--params-file", "/no/such.yaml"], "/no/such.yaml"),
        (["-x"], "-x"),
        (["-p", f"model:={'a' * 300}"], "too long"),
        # Readable by its permissions, but reading it fails.
        (["-p", "model:=/proc/self/mem"], "/proc/self/mem"),
    ],
)
def test_arguments_that_cannot_be_used_are_refused(start_lifter, arguments, word):
    line = refused(start_lifter(*arguments))
    assert line.startswith("lifter: ") and word in line


def test_parameter_file_and_table_come_from_one_place():
    shipped = (ROOT / "config" / "lifter.yaml").read_text()
    assert shipped == parameters.as_yaml(), "python -m paul_ros.stream.parameters > config/lifter.yaml"
    reference = ROOT / "docs/reference/node.md"
    page = reference if reference.exists() else ROOT / "README.md"
    assert parameters.as_markdown() in page.read_text(), "paste paul_ros.stream.parameters.as_markdown()"
