# SPDX-License-Identifier: Apache-2.0
"""The managed node: transitions by its services over DDS, and swaps of the model while frames come."""

from __future__ import annotations

import json
import shutil
import signal
import time

import numpy as np
import pytest
from node_bench import MAKE, Bench, good, header_of, set_parameters

from paul_ros.model_file import load_model, save_model


class Managed(Bench):
    """A bench that asks for transitions."""

    def change(self, label: str) -> bool:
        """Request a transition; return True if it succeeded."""
        from lifecycle_msgs.srv import ChangeState

        request = ChangeState.Request()
        request.transition.label = label
        return self._call(ChangeState, "lifter/change_state", request).success

    def state(self) -> str:
        from lifecycle_msgs.srv import GetState

        return self._call(GetState, "lifter/get_state", GetState.Request()).current_state.label

    def _call(self, kind, name: str, request):
        client = self.node.create_client(kind, name)
        self.until(client.service_is_ready, name)
        future = client.call_async(request)
        self.until(future.done, f"the answer of {name}")
        self.node.destroy_client(client)
        return future.result()

    def heard(self, seconds: float) -> int:
        """Send good frames for a while; return how many messages came on all topics."""
        before = {name: len(messages) for name, messages in self.got.items()}
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.send(good())
            self.ros.spin_once(self.node, timeout_sec=0.02)
        return sum(len(messages) - before[name] for name, messages in self.got.items())


@pytest.fixture
def managed(ros, start_lifter, model_file):
    benches = []

    def start(*arguments: str) -> Managed:
        benches.append(Managed(ros, start_lifter("-p", f"model:={model_file}", *arguments)))
        return benches[-1]

    yield start
    for bench in benches:
        bench.close()


def test_transitions(managed):
    bench = managed("-p", "autostart:=false")
    assert bench.state() == "unconfigured" and "Waiting to be configured" in bench.lifter.log()
    assert not bench.change("activate")
    assert bench.change("configure") and bench.state() == "inactive"
    assert bench.keypoints.get_subscription_count() == bench.camera.get_subscription_count() == 0
    assert bench.heard(1.3) == 0
    assert bench.change("activate") and bench.state() == "active"
    bench.matched()
    bench.lifts()
    assert bench.change("deactivate") and bench.state() == "inactive"
    bench.heard(0.1)  # messages on their way
    assert bench.heard(1.3) == 0
    frames = len(bench.got["poses"])
    assert bench.change("activate")
    bench.matched()
    bench.lifts()
    # Messages that came while it was inactive are not counted, not even as missed.
    values = bench.diagnosed()
    bench.until(lambda: int(bench.diagnosed()["frames"]) == len(bench.got["poses"]) > frames, "all frames")
    assert not [key for key in values if key.startswith("dropped_")]
    assert bench.change("deactivate") and bench.change("cleanup") and bench.state() == "unconfigured"
    assert bench.change("configure") and bench.change("activate")
    bench.matched()
    assert int(bench.diagnosed()["frames"]) < frames
    assert bench.change("shutdown") and bench.state() == "finalized"
    assert bench.heard(0.2) == 0
    assert bench.lifter.stop(signal.SIGINT) == 0
    log = bench.lifter.log()
    assert "Traceback" not in log and "ERROR" not in log and "persons lifted" in log.splitlines()[-1]


def test_an_active_node_may_be_shut_down_by_a_signal_in_any_state(managed):
    for transitions in ((), ("configure",), ("configure", "activate")):
        bench = managed("-p", "autostart:=false")
        for label in transitions:
            assert bench.change(label)
        bench.until(lambda: "Waiting" in bench.lifter.log(), "its first word")
        assert bench.lifter.stop(signal.SIGTERM) == 0
        assert "Traceback" not in bench.lifter.log()


def test_a_bad_model_fails_to_configure_and_a_good_one_is_taken_then(managed, model_file, tmp_path):
    bench = managed("-p", "autostart:=false")
    assert set_parameters(bench, model=str(tmp_path / "none.npz")) == [""]
    assert not bench.change("configure") and bench.state() == "unconfigured"
    assert "none.npz" in bench.lifter.log() and "Traceback" not in bench.lifter.log()
    assert set_parameters(bench, model=str(model_file)) == [""]
    assert bench.change("configure") and bench.change("activate")
    bench.matched()
    bench.lifts()


@pytest.fixture
def other_model(model_file, tmp_path):
    """A model of the same person at twice the size in metres."""
    model = load_model(model_file)
    header = {**model.header, "metres_per_unit": 2 * model.metres_per_unit}
    path = tmp_path / "twice.npz"
    save_model(path, header, {**model.weights, "mean_shape": model.mean_shape})
    return path


def test_a_model_is_swapped_between_two_frames_and_none_is_lost(managed, other_model, model_file):
    """Every stamp is answered once at up to 100 Hz. Persons are 4 m away before the swap and 8 m after."""
    from conftest import camera_info

    bench = managed()
    bench.matched()
    bench.camera.publish(camera_info(MAKE))
    bench.until(lambda: bench.units() == "m", "metres")
    bench.lifts()
    missed, first = bench.diagnosed().get("dropped_missed"), bench.stamp + 1
    asked = swapped = None
    due, sent = time.monotonic(), 0
    while sent < 300:
        answered = bench.got["poses"][-1].header.stamp.sec
        # If the machine stalls, wait: the queues hold 10 messages.
        if time.monotonic() >= due and bench.stamp - answered < 8:
            bench.send(good())
            due, sent = time.monotonic() + 0.01, sent + 1
        bench.ros.spin_once(bench.node, timeout_sec=0.001)
        if sent == 100 and asked is None:
            asked = bench.stamp
            client, future = ask(bench, model=str(other_model))
        if asked and swapped is None and future.done():
            swapped = bench.stamp
            assert [result.successful for result in future.result().results] == [True]
    bench.answer("poses", bench.stamp)
    stamps = [msg.header.stamp.sec for msg in bench.got["poses"] if msg.header.stamp.sec >= first]
    assert stamps == list(range(first, bench.stamp + 1))
    depth = {msg.header.stamp.sec: msg.poses[0].position.z for msg in bench.got["poses"] if msg.poses}
    near = [stamp for stamp in stamps if depth[stamp] < 6]
    # Messages that came before the request may wait for its answer, but none is answered twice or out of order.
    assert near and near == stamps[: len(near)] and near[-1] <= swapped
    assert depth[first] == pytest.approx(4, abs=0.2) and depth[bench.stamp] == pytest.approx(8, abs=0.4)
    assert bench.layout()["model"] == "twice" and bench.units() == "m"
    values = bench.diagnosed()
    assert values["model"] == "twice" and int(values["frames"]) >= 300 and values.get("dropped_missed") == missed


def ask(bench, **values):
    """Request parameters without waiting for the answer."""
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter

    client = bench.node.create_client(SetParameters, "lifter/set_parameters")
    assert client.wait_for_service(20)
    wanted = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    return client, client.call_async(SetParameters.Request(parameters=wanted))


def test_a_model_or_layout_that_cannot_be_used_is_refused_with_the_reason(managed, model_file, tmp_path):
    bench = managed()
    bench.matched()
    before = bench.lifts()
    damaged = tmp_path / "damaged.npz"
    damaged.write_bytes(model_file.read_bytes()[:-100])
    assert "damaged" in set_parameters(bench, model=str(damaged))[0]
    assert "none.npz" in set_parameters(bench, model=str(tmp_path / "none.npz"))[0]
    assert "coco17" in set_parameters(bench, layout="coco71")[0]
    assert "mediapipe33" in set_parameters(bench, output_layout="mediapipe33")[0]
    np.testing.assert_array_equal(bench.lifts(), before)
    assert bench.layout()["model"] == "stand"


def test_layouts_may_change_and_the_latched_layout_follows(managed):
    bench = managed()
    bench.matched()
    bench.lifts()
    assert bench.layout()["layout"] == "coco17"
    assert set_parameters(bench, layout="openpose18") == [""]
    bench.until(lambda: bench.layout()["layout"] == bench.layout()["input_layout"] == "openpose18", "the new layout")
    assert set_parameters(bench, output_layout="coco17") == [""]
    bench.until(lambda: bench.layout()["layout"] == "coco17", "the new layout of the output")
    assert set_parameters(bench, layout="") == [""]
    bench.lifts()
    bench.until(lambda: bench.layout()["input_layout"] == "coco17", "the layout that is found")


def test_the_same_path_is_read_anew(managed, model_file, other_model, tmp_path):
    path = tmp_path / "model.npz"
    shutil.copy(model_file, path)
    bench = managed("-p", f"model:={path}")
    bench.until(lambda: bench.got["layout"], "the layout")
    first = json.loads(bench.got["layout"][-1].data)["model_sha256"]
    shutil.copy(other_model, path)
    assert set_parameters(bench, model=str(path)) == [""]
    bench.until(lambda: bench.layout()["model_sha256"] != first, "the new model")


def test_persons_that_wait_are_published_before_another_model_comes(ros, monkeypatch, other_model, model_file):
    from foreign_messages import OPENDR, LiveMake, opendr
    from rclpy.parameter import Parameter
    from test_pipeline import POSES

    from paul_ros.ros.node import LifterNode

    node, models = LifterNode(), []
    node.start()
    monkeypatch.setattr(
        node.pipeline._topics, "publish_frame", lambda frame: models.append(node.stream.lifter.model.name)
    )
    node.pipeline.on_keypoints(OPENDR, opendr(LiveMake(), header_of(MAKE), pose=POSES[0]), "/keypoints", 0, 0)
    before = node.stream.lifter.model.name
    assert not models
    assert node.set_parameters([Parameter("model", value=str(other_model))])[0].successful
    assert models == [before] and node.stream.counts["frames"] == 1
    node.end()
    node.destroy_node()


def test_a_fault_in_a_transition_is_logged_and_leads_to_unconfigured(ros, monkeypatch, capfd):
    from paul_ros.ros.node import LifterNode
    from paul_ros.ros.rclpy_internals import lifecycle_state

    node = LifterNode()
    monkeypatch.setattr("paul_ros.ros.node.Pipeline", lambda *_: 1 / 0)
    node.trigger_configure()
    assert lifecycle_state(node) == "unconfigured"
    assert "ZeroDivisionError" in capfd.readouterr().err
    monkeypatch.undo()
    node.start()
    assert node.active
    node.end()
    node.destroy_node()
