# SPDX-License-Identifier: Apache-2.0
"""What the node asks of rclpy besides its own class: message classes by name, descriptors, QoS."""

from __future__ import annotations

import array
import functools
import importlib
from collections.abc import Callable

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions

from paul_ros.stream.parameters import Parameter


def _checked(qos: QoSProfile) -> SetParametersResult:
    """rclpy itself checks all but this, which would end in a TypeError of its bindings."""
    return SetParametersResult(successful=qos.depth >= 0, reason=f"depth is {qos.depth}; it must not be negative")


OVERRIDES = QoSOverridingOptions(
    (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY),
    callback=_checked,
)
"""What may be set as a parameter qos_overrides./TOPIC.subscription.POLICY, or .publisher.POLICY."""


@functools.cache
def message_class(type_name: str) -> type:
    """The class of 'package/msg/Name'; raises ImportError where its package is not installed."""
    package, _, name = type_name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except AttributeError:
        raise ImportError(f"{package} has no message {name}") from None


NOT_POSSIBLE = (ParameterException, InvalidQosOverridesError, ValueError, RuntimeError)
"""What rclpy raises of parameters, QoS overrides among them, that it cannot use. It has no common class for these."""


class RosMake:
    """The factory of msg_adapters.outputs for rclpy's message classes."""

    def __call__(self, type_name: str, **fields):
        return message_class(type_name)(**fields)

    def header(self, header):
        """std_msgs/Header, whatever reader the fields are from."""
        stamp = self("builtin_interfaces/msg/Time", sec=header.stamp.sec, nanosec=header.stamp.nanosec)
        return self("std_msgs/msg/Header", stamp=stamp, frame_id=header.frame_id)

    @staticmethod
    def octets(data: bytes) -> array.array:
        return array.array("B", data)


# Profiles are made anew each time: overriding changes the object that it is given.


def input_qos() -> QoSProfile:
    """Matches every publisher; a few frames deep, so that a hiccup of the scheduler loses none."""
    return QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


def output_qos() -> QoSProfile:
    """Matches every subscriber but those who ask for what was published before they came."""
    return QoSProfile(depth=10)


def latched_qos() -> QoSProfile:
    """The last message for those who come later."""
    return QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def unheard(topic: str, say: Callable[[str, str], None]) -> SubscriptionEventCallbacks:
    """say(topic, text) of every publisher whose QoS does not match what this node asks for."""

    def on_event(event) -> None:
        policy = _policy(event)
        say(
            topic,
            f"a publisher of {topic} offers a QoS that this node's subscription does not match, {policy} at least: "
            f"nothing comes from it; change its, or qos_overrides.{topic}.subscription.{policy.lower()}",
        )

    return SubscriptionEventCallbacks(incompatible_qos=on_event, use_default_callbacks=False)


def unhearing(topic: str, say: Callable[[str, str], None]) -> PublisherEventCallbacks:
    """say(topic, text) of every subscriber whose QoS does not match what this node offers."""

    def on_event(event) -> None:
        policy = _policy(event)
        say(
            topic,
            f"a subscriber of {topic} asks for a QoS that this node's publisher does not match, {policy} at least: "
            f"it gets nothing; change its, or qos_overrides.{topic}.publisher.{policy.lower()}",
        )

    return PublisherEventCallbacks(incompatible_qos=on_event, use_default_callbacks=False)


def _policy(event) -> str:
    return qos_policy_name_from_kind(event.last_policy_kind)


def descriptor(parameter: Parameter) -> ParameterDescriptor:
    """The row of the table, as ROS wants it."""
    described = ParameterDescriptor(description=parameter.description, read_only=not parameter.live)
    if parameter.limits is None:
        return described
    low, high = parameter.limits
    if isinstance(parameter.default, float):
        described.floating_point_range = [FloatingPointRange(from_value=low, to_value=high, step=0.0)]
    else:
        described.integer_range = [IntegerRange(from_value=low, to_value=high, step=1)]
    return described
