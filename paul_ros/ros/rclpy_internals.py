# SPDX-License-Identifier: Apache-2.0
"""The only place that uses private attributes of rclpy (Jazzy), each with the reason why no public one will do."""

from __future__ import annotations

from typing import cast

from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecyclePublisher


def lifecycle_state(node: LifecycleNode) -> str:
    """Return the label of a managed node's state, such as 'active'.

    rclpy has no public way inside the node's own process: a node would have to call its own service.
    """
    return cast(str, node._state_machine.current_state[1])


def destroy_lifecycle_publishers(node: LifecycleNode) -> None:
    """Destroy all lifecycle publishers of a node, also those of a configuration that failed half-way.

    rclpy lists its managed entities nowhere in public. The node has no others than publishers.
    """
    for publisher in list(node._managed_entities):
        node.destroy_lifecycle_publisher(cast(LifecyclePublisher, publisher))


class OneThreadExecutor(SingleThreadedExecutor):
    """An executor that waits once for a message, not twice.

    rclpy's executor wakes itself by a guard condition after every callback, for other threads that may wait for the
    same callback group. It then gathers all entities and waits a second time for nothing. No other thread waits here.
    """

    def __init__(self) -> None:
        super().__init__()
        # Replacing the method is the only way to keep the guard condition and never trigger it.
        self._guard.trigger = lambda: None  # type: ignore[method-assign]
