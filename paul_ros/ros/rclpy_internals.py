# SPDX-License-Identifier: Apache-2.0
"""The only place that uses private attributes of rclpy (Jazzy), each with the reason why no public one will do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecyclePublisher
from rclpy.node import Node
from rclpy.parameter import Parameter

FaultReport = Callable[[str, Exception], None]
"""Takes the name of the callback that failed, such as 'the service /lifter/get_state', and its error."""


def lifecycle_state(node: LifecycleNode) -> str:
    """Return the label of a managed node's state, such as 'active'.

    rclpy has no public way inside the node's own process: a node would have to call its own service.
    """
    return cast(str, node._state_machine.current_state[1])


def allowed_transitions(node: LifecycleNode) -> dict[int, str]:
    """Return id -> label of the transitions that a managed node's state allows; public only as a service too."""
    return {transition[0]: transition[1] for transition in node._state_machine.available_transitions}


def parameter_overrides(node: Node) -> dict[str, Parameter]:
    """Return name -> value of all parameters that arguments and files give the node; a change affects declarations.

    rclpy publishes them only by declaring them all, with whatever name and type they have.
    """
    return cast("dict[str, Parameter]", node._parameter_overrides)


def destroy_lifecycle_publishers(node: LifecycleNode) -> None:
    """Destroy all lifecycle publishers of a node, also those of a configuration that failed half-way.

    rclpy lists its managed entities nowhere in public. The node has no others than publishers.
    """
    for publisher in list(node._managed_entities):
        node.destroy_lifecycle_publisher(cast(LifecyclePublisher, publisher))


class OneThreadExecutor(SingleThreadedExecutor):
    """An executor that reports the error of a callback and goes on. It waits once for a message, not twice.

    In rclpy's executor the error of any callback leaves `spin`. An error while a message is taken also keeps the
    callback group locked, so that no callback of the node would ever run again.

    rclpy's executor wakes itself by a guard condition after every callback, for other threads that may wait for the
    same callback group. It then gathers all entities and waits a second time for nothing. No other thread waits here.
    """

    def __init__(self, on_fault: FaultReport) -> None:
        super().__init__()
        self._on_fault = on_fault
        # Replacing the method is the only way to keep the guard condition and never trigger it.
        self._guard.trigger = lambda: None  # type: ignore[method-assign]

    def _make_handler(self, entity: Any, node: Any, take_from_wait_list: Callable[[Any], Any]) -> Any:
        """Make rclpy's handler of an entity, in which neither taking the message nor the callback can raise."""

        def take(taken: Any) -> Any:
            try:
                execute = take_from_wait_list(taken)
            except Exception as error:
                self._on_fault(_name_of(entity), error)
                return None

            async def guarded() -> None:
                try:
                    await execute()
                except Exception as error:
                    self._on_fault(_name_of(entity), error)

            return execute and guarded

        return super()._make_handler(entity, node, take)


def _name_of(entity: Any) -> str:
    """Return a name of what an executor waits for, such as 'the subscription of camera_info'."""
    # Not `service_name` and `topic_name`, which raise for what was destroyed meanwhile.
    for attribute, text in (("srv_name", "the service"), ("topic", "the subscription of")):
        if name := getattr(entity, attribute, None):
            return f"{text} {name}"
    # Timers have no names; their callbacks do.
    callback = getattr(entity, "callback", None)
    return f"the callback {getattr(callback, '__qualname__', type(entity).__name__)}"
