# SPDX-License-Identifier: Apache-2.0
"""The node's event loop: errors that escape a callback are logged, counted and survived."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import pytest
from conftest import ROOT

PATIENCE = 20.0


@pytest.fixture
def spun(ros):
    """A node that is spun by a thread, and a node beside it."""
    from paul_ros.ros.lifter_process import spin
    from paul_ros.ros.node import LifterNode

    node, other, stop = LifterNode(), ros.create_node("other"), threading.Event()
    node.start()
    thread = threading.Thread(target=spin, args=(node, stop))
    thread.start()
    yield node, other
    stop.set()
    thread.join(PATIENCE)
    assert not thread.is_alive()
    node.end()
    node.destroy_node()
    other.destroy_node()


def faults(node) -> int:
    return node.stream.ledger.notes["callback_failed"]


def until(condition) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def state_of(ros, other) -> str:
    """Ask the node for its state."""
    from lifecycle_msgs.srv import GetState

    client = other.create_client(GetState, "/lifter/get_state")
    assert client.wait_for_service(PATIENCE)
    future = client.call_async(GetState.Request())
    ros.spin_until_future_complete(other, future, timeout_sec=PATIENCE)
    other.destroy_client(client)
    return future.result().current_state.label


def test_a_callback_that_raises(ros, spun, capfd):
    from std_msgs.msg import String

    node, other = spun
    node.create_timer(0.01, lambda: {}["of the timer"])
    node.create_subscription(String, "raises", lambda msg: int(msg.data), 10)
    node.executor.wake()
    publisher = other.create_publisher(String, "raises", 10)
    until(publisher.get_subscription_count)
    publisher.publish(String(data="of the subscription"))
    until(lambda: faults(node) > 5)
    assert state_of(ros, other) == "active"
    log = capfd.readouterr().err
    assert log.count("KeyError: 'of the timer'") == 1, "once is enough for a minute"
    assert "invalid literal for int" in log and "Fault in the subscription of raises; the node goes on." in log


def test_a_message_that_cannot_be_taken_locks_nothing_and_takes_no_cpu(ros, spun, monkeypatch, capfd):
    """The message stays where it is, so the executor is ready again at once."""
    from std_msgs.msg import String

    from paul_ros.ros.rclpy_internals import OneThreadExecutor

    node, other = spun
    got = []
    node.create_subscription(String, "taken", got.append, 10)
    publisher = other.create_publisher(String, "taken", 10)
    until(publisher.get_subscription_count)
    with monkeypatch.context() as patch:
        patch.setattr(OneThreadExecutor, "_take_subscription", lambda *_: 1 / 0)
        publisher.publish(String(data="waits"))
        until(lambda: faults(node))
        before = faults(node)
        time.sleep(0.5)
        assert 5 < faults(node) - before < 75
        assert state_of(ros, other) == "active"
    until(lambda: got)
    assert "ZeroDivisionError" in capfd.readouterr().err


@pytest.mark.parametrize("name", ["set_parameters", "set_parameters_atomically", "describe_parameters", "change_state"])
def test_a_service_that_raises_refuses(ros, spun, monkeypatch, capfd, name):
    from rclpy.parameter import Parameter
    from test_node_services import SERVICES

    node, other = spun
    kind = SERVICES()[name]
    request = kind.Request()
    if hasattr(request, "parameters"):
        request.parameters = [Parameter("smoothing", value=1.0).to_parameter_msg()] * 3
    elif hasattr(request, "names"):
        request.names = ["smoothing"]
    else:
        request.transition.id = 4

    def fault(*_):
        raise KeyError("unheard of")

    monkeypatch.setattr(node, "set_parameters_atomically", fault)
    monkeypatch.setattr(node, "describe_parameter", fault)
    monkeypatch.setattr(node, "_LifecycleNodeMixin__change_state", fault)
    client = other.create_client(kind, f"/lifter/{name}")
    assert client.wait_for_service(PATIENCE)
    future = client.call_async(request)
    ros.spin_until_future_complete(other, future, timeout_sec=PATIENCE)
    answer = future.result()
    reason = "internal error, see the node's log: 'unheard of'"
    if name == "set_parameters":
        assert [(result.successful, result.reason) for result in answer.results] == [(False, reason)] * 3
    elif name == "set_parameters_atomically":
        assert (answer.result.successful, answer.result.reason) == (False, reason)
    elif name == "describe_parameters":
        assert not answer.descriptors
    else:
        assert not answer.success
    assert faults(node) and f"Fault in the service /lifter/{name}" in capfd.readouterr().err
    monkeypatch.undo()


def test_a_guard_that_raises_refuses_too(ros, spun, monkeypatch):
    monkeypatch.setattr("paul_ros.ros.services.allowed_transitions", lambda _: 1 / 0)
    monkeypatch.setattr("paul_ros.ros.services._too_many", lambda _: 1 / 0)
    node, other = spun
    services = {service.srv_name.rpartition("/")[2]: service for service in node.services}
    for name, count in (("change_state", 0), ("set_parameters", 3), ("set_parameters_atomically", 3)):
        kind = services[name].srv_type
        request = kind.Request()
        if count:
            request.parameters = [node.get_parameter("smoothing").to_parameter_msg()] * count
        answer = services[name].callback(request, kind.Response())
        text = str(answer)
        assert "internal error" in text or not answer.success
        assert len(getattr(answer, "results", range(count))) == count
    assert faults(node) == 3


def test_a_clock_before_the_epoch(ros, spun):
    """rclpy's time source raises ValueError for it."""
    from rclpy.parameter import Parameter
    from rosgraph_msgs.msg import Clock

    node, other = spun
    assert node.set_parameters([Parameter("use_sim_time", value=True)])[0].successful
    clock, early, late = other.create_publisher(Clock, "/clock", 10), Clock(), Clock()
    until(clock.get_subscription_count)
    early.clock.sec, late.clock.sec = -5, 7
    clock.publish(early)
    until(lambda: faults(node))
    clock.publish(late)
    until(lambda: node.get_clock().now().nanoseconds == 7 * 10**9)


#: Every wait of the event loop fails, as with a middleware that is broken.
BROKEN = """
from rclpy.executors import SingleThreadedExecutor

def broken(*_):
    raise OSError("no middleware")

from paul_ros.ros import lifter_process
SingleThreadedExecutor.spin_once = broken
raise SystemExit(lifter_process.main())
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_loop_that_fails_takes_no_cpu_and_ends_by_a_signal(ros, tmp_path, number):
    env = {key: value for key, value in os.environ.items() if key != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
    log = tmp_path / "log"
    with open(log, "wb") as file:
        command = [sys.executable, "-c", BROKEN, "--ros-args", "-r", "__ns:=/broken"]
        process = subprocess.Popen(command, cwd=ROOT, env=env, stdout=file, stderr=file)
    until(lambda: "no middleware" in log.read_text() or process.poll() is not None)
    before = cpu_seconds(process.pid)
    time.sleep(0.5)
    assert cpu_seconds(process.pid) - before < 0.25
    process.send_signal(number)
    assert process.wait(PATIENCE) == 0
    assert log.read_text().count("OSError: no middleware") == 1


def cpu_seconds(pid: int) -> float:
    """Return the CPU time that a process has used."""
    with open(f"/proc/{pid}/stat", encoding="ascii") as file:
        fields = file.read().rpartition(")")[2].split()
    return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")
