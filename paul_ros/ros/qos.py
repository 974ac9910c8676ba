# SPDX-License-Identifier: Apache-2.0
"""Quality of service: profiles, what users may override, and warnings about endpoints that do not match."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind
from rclpy.qos_overriding_options import QoSOverridingOptions

WarnOfTopic = Callable[[str, str], None]
"""Takes the name of a topic and a warning about it."""


_MAX_DEPTH = 2**31 - 1


def _validated(qos: QoSProfile) -> SetParametersResult:
    """Reject a depth that is no 32-bit number: rclpy checks all but this, and its bindings would raise TypeError."""
    return SetParametersResult(
        successful=0 <= qos.depth <= _MAX_DEPTH, reason=f"depth is {qos.depth}; it must be 0 to {_MAX_DEPTH}"
    )


OVERRIDES = QoSOverridingOptions(
    (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY),
    callback=_validated,
)
"""Policies that the parameters qos_overrides./TOPIC.subscription.POLICY and .publisher.POLICY may set."""


# Profiles are made anew for each endpoint: an override changes the object that it is given.


def input_qos() -> QoSProfile:
    """Match every publisher. A few frames deep, so that a hiccup of the scheduler loses none."""
    return QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


def output_qos() -> QoSProfile:
    """Match every subscriber except those that ask for latched messages."""
    return QoSProfile(depth=10)


def latched_qos() -> QoSProfile:
    """Keep the last message for subscribers that come later."""
    return QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def subscription_events(topic: str, warn: WarnOfTopic) -> SubscriptionEventCallbacks:
    """Warn of every publisher whose QoS this node's subscription does not match."""

    def on_mismatch(event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        warn(
            topic,
            f"A publisher of {topic} offers a QoS that this node's subscription does not match ({policy} at least): "
            f"nothing comes from it. Change its QoS, or set qos_overrides.{topic}.subscription.{policy.lower()}.",
        )

    return SubscriptionEventCallbacks(incompatible_qos=on_mismatch, use_default_callbacks=False)


def publisher_events(topic: str, warn: WarnOfTopic) -> PublisherEventCallbacks:
    """Warn of every subscriber whose QoS this node's publisher does not match."""

    def on_mismatch(event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        warn(
            topic,
            f"A subscriber of {topic} asks for a QoS that this node's publisher does not match ({policy} at least): "
            f"it gets nothing. Change its QoS, or set qos_overrides.{topic}.publisher.{policy.lower()}.",
        )

    return PublisherEventCallbacks(incompatible_qos=on_mismatch, use_default_callbacks=False)
