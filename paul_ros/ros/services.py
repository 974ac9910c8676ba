# SPDX-License-Identifier: Apache-2.0
"""Guards of the node's own services: every request gets an answer, and none ends the process.

rclpy brings these services: `change_state` and its relatives, those of parameters, and `get_type_description`. In
rclpy 7.1 some requests raise an error inside them, which leaves `spin` (https://github.com/ros2/rclpy/issues/1209).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.lifecycle import LifecycleNode
from rclpy.parameter import Parameter
from type_description_interfaces.srv import GetTypeDescription

from paul_ros.ros.advisor import ThrottledLog
from paul_ros.ros.node_parameters import one_line
from paul_ros.ros.rclpy_internals import FaultReport, allowed_transitions, lifecycle_state

MAX_PARAMETERS = 1000
"""Largest number of parameters that one request may set: frames wait for the answer."""

_TYPES = [kind.value for kind in Parameter.Type]
_TRANSITIONS = {
    1: "configure",
    2: "cleanup",
    3: "activate",
    4: "deactivate",
    5: "shutdown",
    6: "shutdown",
    7: "shutdown",
}
_STARTING = ("configure", "activate")

Callback = Callable[[Any, Any], Any]
"""A callback of a service: request, empty response -> response."""


def guard_services(node: LifecycleNode, log: ThrottledLog, on_fault: FaultReport) -> None:
    """Let every service of a node refuse what it cannot do.

    Args:
        node: owner of the services, with the parameter `autostart`.
        log: of refused transitions, whose response has no field for a reason.
        on_fault: called with every error that a service raises.
    """
    for service in node.services:
        answering = functools.partial(_answering, name=service.service_name, on_fault=on_fault)
        callback = service.callback
        if service.srv_type is ChangeState:
            callback = _allowed_only(callback, node, log)
        elif service.srv_type is SetParameters:
            callback = _one_by_one(_readable_only(answering(callback)))
        elif service.srv_type is SetParametersAtomically:
            callback = _readable_only(callback)
        service.callback = answering(callback)


def _answering(callback: Callback, name: str, on_fault: FaultReport) -> Callback:
    """Turn every error into a refusal."""

    def answer(request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except Exception as error:
            on_fault(f"the service {name}", error)
            # A new response: the error may have left the given one half filled.
            return _refused(request, type(response)(), f"internal error, see the node's log: {one_line(error)}")

    return answer


def _refused(request: Any, response: Any, reason: str) -> Any:
    """Fill an empty response with a refusal; types without a field for it stay empty, as in all nodes of rclpy."""
    refusal = SetParametersResult(successful=False, reason=reason)
    if isinstance(response, SetParameters.Response):
        response.results = [refusal] * len(request.parameters)
    elif isinstance(response, SetParametersAtomically.Response):
        response.result = refusal
    elif isinstance(response, GetTypeDescription.Response):
        response.failure_reason = reason
    return response


# --- parameters


def _one_by_one(callback: Callback) -> Callback:
    """Let each parameter of a request be accepted or refused on its own."""

    def answer(request: SetParameters.Request, response: SetParameters.Response) -> SetParameters.Response:
        if reason := _too_many(request.parameters):
            return _refused(request, response, reason)
        singles = (SetParameters.Request(parameters=[parameter]) for parameter in request.parameters)
        response.results = [callback(single, SetParameters.Response()).results[0] for single in singles]
        return response

    return answer


def _readable_only(callback: Callback) -> Callback:
    """Refuse a request of too many parameters, or with a type of value that ROS does not have."""

    def answer(request: Any, response: Any) -> Any:
        reason = _too_many(request.parameters) or _unknown_type(request.parameters)
        return _refused(request, response, reason) if reason else callback(request, response)

    return answer


def _too_many(parameters: list[Any]) -> str:
    """Return why a request has too many parameters; '' if it has not."""
    if len(parameters) <= MAX_PARAMETERS:
        return ""
    return f"{len(parameters)} parameters are too many for one request: send at most {MAX_PARAMETERS}"


def _unknown_type(parameters: list[Any]) -> str:
    """Return why a value cannot be read; '' if all can."""
    for parameter in parameters:
        if parameter.value.type not in _TYPES:
            return (
                f"the value of '{one_line(parameter.name)}' has type {parameter.value.type}; "
                f"rcl_interfaces/ParameterType has {min(_TYPES)} to {max(_TYPES)}"
            )
    return ""


# --- transitions


def _allowed_only(callback: Callback, node: LifecycleNode, log: ThrottledLog) -> Callback:
    """Refuse a transition that the node's state does not allow, and log the reason."""

    def answer(request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response:
        number, label = request.transition.id, request.transition.label
        allowed = allowed_transitions(node)
        # As in rclpy, a label counts more than an id.
        if label in allowed.values() if label else number in allowed:
            return callback(request, response)
        name = label or _TRANSITIONS.get(number, "")
        known = name if name in _TRANSITIONS.values() else ""
        state, autostart = lifecycle_state(node), node.get_parameter("autostart").value
        log(f"{state}: transition {known or number}", _refusal(name, number, state, allowed, autostart))
        response.success = False
        return response

    return answer


def _refusal(name: str, number: int, state: str, allowed: dict[int, str], autostart: bool) -> str:
    """Say why a transition is refused and what to do.

    Args:
        name: label of the transition; '' if its id has none.
        number: id of the transition.
        state: state of the node.
        allowed: id -> label of the transitions that the state allows.
        autostart: whether the node has configured and activated itself.
    """
    wanted = f"'{one_line(name)}'" if name else f"with id {number}"
    text = f"Transition {wanted} is refused: the node is {state}."
    if autostart and state == "active" and name in _STARTING:
        return f"{text} It has configured and activated itself. Set `autostart` to false to manage it."
    if not allowed:
        return f"{text} Start it again."
    return f"{text} It allows {', '.join(f'{label} (id {key})' for key, label in allowed.items())}."
