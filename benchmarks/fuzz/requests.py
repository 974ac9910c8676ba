# SPDX-License-Identifier: Apache-2.0
"""Requests to every service of a running node, over DDS, with odd ids, types, names and lengths, while frames come.

The oracle is the state machine of managed nodes (design.ros2.org, Managed nodes) and the parameters as the node itself
returned them: every request is answered, a refusal changes nothing, and every frame that was sent is lifted.
"""

from __future__ import annotations

import os
import random
import string
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fuzz.bench import Bench
from benchmarks.fuzz.messages import COCO, random_pose
from benchmarks.fuzz.tally import Tally, WrongOutput
from msg_adapters import outputs

_PATIENCE = 20.0
"""Seconds until a request counts as unanswered."""

_UNCONFIGURED, _INACTIVE, _ACTIVE, _FINALIZED = 1, 2, 3, 4

_TRANSITIONS = {
    (_UNCONFIGURED, 1): _INACTIVE,
    (_INACTIVE, 2): _UNCONFIGURED,
    (_INACTIVE, 3): _ACTIVE,
    (_ACTIVE, 4): _INACTIVE,
}
"""State and transition -> next state. Shutdown, which ends the node for good, is left to the tests."""

_LABELS = {"configure": 1, "cleanup": 2, "activate": 3, "deactivate": 4}
_TYPES = (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 77, 128, 255)
_NUMBERS = (0.0, 1.0, -1.0, 0.5, 1e308, float("nan"), float("inf"), -0.0)
_INTEGERS = (0, 1, -1, 17, 2**31, 2**63 - 1, -(2**63))
_TEXTS = ("", "x", "coco17", "human", "/", "a/b", "~", "ä" * 40, "\n", "%s", "7" * 2000)


class Node:
    """A lifter in its own process, and the clients of its services."""

    def __init__(self, folder: Path) -> None:
        import rclpy
        from geometry_msgs.msg import PoseArray
        from lifecycle_msgs.srv import ChangeState, GetAvailableStates, GetAvailableTransitions, GetState
        from rcl_interfaces.srv import (
            DescribeParameters,
            GetParameters,
            GetParameterTypes,
            ListParameters,
            SetParameters,
            SetParametersAtomically,
        )
        from sensor_msgs.msg import PointCloud2

        environment = {key: value for key, value in os.environ.items() if key != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
        self.log = folder / "lifter.log"
        with open(self.log, "wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "paul_ros.ros.lifter_process"], env=environment, stdout=log, stderr=log
            )
        self._rclpy = rclpy
        self._owns_context = not rclpy.ok()
        if self._owns_context:
            rclpy.init()
        self.node = rclpy.create_node("fuzz")
        kinds = (
            ("change_state", ChangeState),
            ("get_state", GetState),
            ("get_available_states", GetAvailableStates),
            ("get_available_transitions", GetAvailableTransitions),
            ("get_transition_graph", GetAvailableTransitions),
            ("set_parameters", SetParameters),
            ("set_parameters_atomically", SetParametersAtomically),
            ("get_parameters", GetParameters),
            ("get_parameter_types", GetParameterTypes),
            ("describe_parameters", DescribeParameters),
            ("list_parameters", ListParameters),
        )
        self.kinds = dict(kinds)
        self.clients = {name: self.node.create_client(kind, f"/lifter/{name}") for name, kind in kinds}
        self.lifted: list[int] = []
        self.keypoints = self.node.create_publisher(PointCloud2, "keypoints", 10)
        self.node.create_subscription(
            PoseArray, "lifter/poses", lambda message: self.lifted.append(message.header.stamp.sec), 100
        )
        self.sent = 0
        try:
            for name, client in self.clients.items():
                self._until(client.service_is_ready, "a service")
                self._until(lambda: self._answers(name), f"the first answer of {name}")
        except WrongOutput:
            self.close()
            raise

    def close(self) -> None:
        """End the node and the clients."""
        self.process.terminate()
        self.process.wait(_PATIENCE)
        self.node.destroy_node()
        if self._owns_context:
            self._rclpy.shutdown()

    def _answers(self, name: str) -> bool:
        """Send an empty request, which changes nothing; return whether it is answered soon.

        The middleware may lose answers until it has matched both directions.
        """
        future = self.clients[name].call_async(self.request(name))
        self._rclpy.spin_until_future_complete(self.node, future, timeout_sec=1.0)
        return bool(future.done())

    def call(self, name: str, request: Any) -> Any:
        """Return the response to a request.

        Raises:
            WrongOutput: there is none, or the node has ended.
        """
        future = self.clients[name].call_async(request)
        self._until(future.done, f"an answer of {name} to {request}")
        return future.result()

    def request(self, name: str, **fields: Any) -> Any:
        """Return an empty request of a service with some fields set."""
        return self.kinds[name].Request(**fields)

    def lift(self, rng: random.Random, frames: int) -> None:
        """Send frames and wait until each is lifted.

        Raises:
            WrongOutput: one is not.
        """
        self._until(self.keypoints.get_subscription_count, "the subscription")
        self._until(lambda: self.node.count_publishers("/lifter/poses"), "the publisher")
        first = self.sent + 1
        for _ in range(frames):
            self.sent += 1
            self.keypoints.publish(_cloud(self.sent, rng))
            self._until(lambda: self.sent in self.lifted, f"frame {self.sent}")
        self.lifted = [stamp for stamp in self.lifted if stamp >= first]

    def _until(self, condition: Any, what: str) -> None:
        end = time.monotonic() + _PATIENCE
        while not condition():
            if self.process.poll() is not None:
                raise WrongOutput(f"the node ended while waiting for {what[:200]}: {self.log.read_text()[-600:]}")
            if time.monotonic() > end:
                raise WrongOutput(f"never came: {what[:200]}")
            self._rclpy.spin_once(self.node, timeout_sec=0.05)


def _cloud(seconds: int, rng: random.Random) -> Any:
    """Return a PointCloud2 of one person."""
    from paul_ros.ros.messages import RosMake

    make, pose = RosMake(), random_pose(rng)
    stamp = make("builtin_interfaces/msg/Time", sec=seconds, nanosec=0)
    head = make("std_msgs/msg/Header", stamp=stamp, frame_id="camera")
    xy = np.array([[pose[name] for name in COCO]])
    return outputs.keypoints_cloud(make, head, xy, np.full(xy.shape[:2], 0.9), ["1"])


def request_session(bench: Bench, rng: random.Random, tally: Tally, cases: int, where: str) -> None:
    """Send odd requests to the node, then bring it back and lift."""
    node = bench.node()
    for number in range(cases):
        name = rng.choice(sorted({*node.clients, "change_state", "set_parameters"}))
        tally.cases += 1
        start = time.process_time()
        try:
            accepted = _REQUESTS.get(name, _ask)(node, name, rng)
            tally.accepted += accepted
            tally.refused += not accepted
        except WrongOutput as error:
            tally.misread(f"{where} case {number} {name}", str(error))
            if node.process.poll() is not None:
                raise
        except Exception:
            tally.crash(f"{where} case {number} {name}")
        tally.time(time.process_time() - start)
    _activate(node)
    _restore(node)
    node.lift(rng, 3)


def _state(node: Node) -> int:
    return int(node.call("get_state", node.request("get_state")).current_state.id)


def _activate(node: Node) -> None:
    """Bring the node to the active state by its own services."""
    for transition in {_UNCONFIGURED: (1, 3), _INACTIVE: (3,)}.get(_state(node), ()):
        request = node.request("change_state")
        request.transition.id = transition
        if not node.call("change_state", request).success:
            raise WrongOutput(f"transition {transition} is refused: {node.log.read_text()[-300:]}")


def _restore(node: Node) -> None:
    """Set the parameters that may change to their defaults."""
    from rclpy.parameter import Parameter

    from paul_ros.stream.parameters import DEFAULTS, LIVE

    values = [Parameter(name, value=DEFAULTS[name]).to_parameter_msg() for name in LIVE]
    for result in node.call("set_parameters", node.request("set_parameters", parameters=values)).results:
        if not result.successful:
            raise WrongOutput(f"a default is refused: {result.reason}")


def _change_state(node: Node, name: str, rng: random.Random) -> bool:
    """Request a transition by id, by label, by both or by none."""
    before = _state(node)
    request = node.request(name)
    request.transition.id = rng.choice((0, 1, 1, 2, 2, 3, 3, 4, 4, 8, 10, 50, 60, 61, 77, 97, 255))
    request.transition.label = rng.choice(("", "", "", *_LABELS, "x", "ä" * 300))
    success = node.call(name, request).success
    # As in rclcpp, a label decides if there is one.
    wanted = _LABELS.get(request.transition.label) if request.transition.label else request.transition.id
    after = _TRANSITIONS.get((before, wanted or 0))
    if success != (after is not None):
        raise WrongOutput(f"{request.transition} in state {before} is answered by {success}")
    if _state(node) != (after or before):
        raise WrongOutput(f"{request.transition} in state {before} leads to state {_state(node)}")
    return bool(success)


def _set_parameters(node: Node, name: str, rng: random.Random) -> bool:
    """Set odd parameters; each that is refused must keep its value."""
    from rcl_interfaces.msg import Parameter

    from paul_ros.stream.parameters import DEFAULTS

    names = [*DEFAULTS, "use_sim_time", "smothing", "", "a.b", "/", "x" * 300]
    count = rng.choice((0, 1, 1, 1, 2, 3, 200 if rng.random() < 0.05 else 4))
    # The clock of the node is left alone, or nothing would be lifted.
    parameters = [Parameter(name=rng.choice(names), value=_value(rng)) for _ in range(count)]
    parameters = [each for each in parameters if each.name != "use_sim_time" or each.value.type != 1]
    known = sorted({each.name for each in parameters} & set(DEFAULTS))
    before = _values(node, known)
    answer = node.call(name, node.request(name, parameters=parameters))
    results = answer.results if name == "set_parameters" else [answer.result] * len(parameters)
    if len(results) != len(parameters):
        raise WrongOutput(f"{len(parameters)} parameters, {len(results)} results")
    if any(not each.successful and not each.reason for each in results):
        raise WrongOutput("a refusal without a reason")
    after = _values(node, known)
    changed = {each.name for each, result in zip(parameters, results) if result.successful}
    for parameter in known:
        if parameter not in changed and before[parameter] != after[parameter]:
            raise WrongOutput(f"{parameter} was refused and changed from {before[parameter]} to {after[parameter]}")
    return bool(results) and all(each.successful for each in results)


def _values(node: Node, names: list[str]) -> dict[str, str]:
    found = node.call("get_parameters", node.request("get_parameters", names=names)).values
    return dict(zip(names, map(str, found)))


def _value(rng: random.Random) -> Any:
    """Return a value of any type, whose type may not be that of its content."""
    from rcl_interfaces.msg import ParameterValue

    return ParameterValue(
        type=rng.choice(_TYPES),
        bool_value=rng.random() < 0.5,
        integer_value=rng.choice(_INTEGERS),
        double_value=rng.choice(_NUMBERS),
        string_value=rng.choice(_TEXTS),
        byte_array_value=[b"\0"] * rng.choice((0, 3)),
        bool_array_value=[True] * rng.choice((0, 2)),
        integer_array_value=[rng.choice(_INTEGERS)] * rng.choice((0, 1)),
        double_array_value=[rng.choice(_NUMBERS)] * rng.choice((0, 1)),
        string_array_value=[rng.choice(_TEXTS)] * rng.choice((0, 1)),
    )


def _ask(node: Node, name: str, rng: random.Random) -> bool:
    """Send a request that changes nothing, with odd names."""
    from paul_ros.stream.parameters import DEFAULTS

    request = node.request(name)
    if hasattr(request, "names"):
        odd = (*DEFAULTS, *_TEXTS, "".join(rng.choices(string.printable, k=20)))
        request.names = [rng.choice(odd) for _ in range(rng.choice((0, 1, 3, 10_000 if rng.random() < 0.01 else 10)))]
    if hasattr(request, "prefixes"):
        request.prefixes = [rng.choice((*_TEXTS, "qos_overrides")) for _ in range(rng.choice((0, 1, 3)))]
        request.depth = rng.choice((0, 1, 2**63, 2**64 - 1))
    before = _state(node)
    node.call(name, request)
    if _state(node) != before:
        raise WrongOutput(f"{name} changed the state")
    return True


_REQUESTS = {
    "change_state": _change_state,
    "set_parameters": _set_parameters,
    "set_parameters_atomically": _set_parameters,
}
