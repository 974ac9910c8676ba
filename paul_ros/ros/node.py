# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 node `lifter`: its life cycle and its parameters. `pipeline` has the data path.

It subscribes to `keypoints` (2D), `camera_info` and `depth` (both optional). It publishes ~/poses, ~/bodies,
~/persons, ~/keypoints3d, ~/markers, ~/layout and /diagnostics. Headers are the input's own.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterable
from typing import Any, cast

from rcl_interfaces.msg import SetParametersResult
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter

from paul_ros.ros.advisor import ThrottledLog
from paul_ros.ros.diagnostics import summary
from paul_ros.ros.node_parameters import REFUSALS, declare
from paul_ros.ros.pipeline import Pipeline
from paul_ros.ros.rclpy_internals import destroy_lifecycle_publishers, lifecycle_state
from paul_ros.stream.parameters import LIVE
from paul_ros.stream.person_ids import PersonIds
from paul_ros.stream.stream import LiftStream, open_stream

_SWITCHING = ("model", "layout", "output_layout", "image")
"""Parameters that need another stream."""


def _logged(callback: Callable[[Any, LifecycleState], TransitionCallbackReturn]) -> Callable:
    """Log an exception in a transition; rclpy swallows it."""

    @functools.wraps(callback)
    def guarded(self: LifterNode, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return callback(self, state)
        except Exception as error:
            self.get_logger().error(f"{callback.__name__.removeprefix('on_')}: {type(error).__name__}: {error}")
            return TransitionCallbackReturn.ERROR

    return guarded


class LifterNode(LifecycleNode):
    """A managed node (design.ros2.org, Managed nodes). It has a pipeline while it is configured."""

    def __init__(self) -> None:
        """Declare the parameters; raises one of REFUSALS for a value of the wrong type or out of range."""
        super().__init__("lifter")
        self._log = ThrottledLog(self.get_logger().warning)
        self._values = declare(self)
        self._pipeline: Pipeline | None = None
        # Numbers of persons outlive a cleanup: listeners may still hold them.
        self._person_ids = PersonIds()
        self._refusal: Exception | None = None
        self._starting = False
        self._final_summary = "nothing was lifted"
        self.add_on_set_parameters_callback(self._set_parameters)

    @property
    def pipeline(self) -> Pipeline:
        """The data path of a configured node; raises RuntimeError if the node is not configured."""
        if self._pipeline is None:
            raise RuntimeError("the node is not configured")
        return self._pipeline

    @property
    def stream(self) -> LiftStream:
        """The stream of a configured node; raises RuntimeError if the node is not configured."""
        return self.pipeline.stream

    @property
    def active(self) -> bool:
        """True while the node lifts."""
        return self._pipeline is not None and self._pipeline.active

    def start(self) -> None:
        """Configure and activate; raises the error that refused it."""
        self._starting = True
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() != TransitionCallbackReturn.SUCCESS:
                raise self._refusal or RuntimeError("the node could not be started; see its log")
        self._starting = False

    def end(self) -> None:
        """Publish what is kept, and finalize."""
        if lifecycle_state(self) != "finalized":
            self.trigger_shutdown()

    def summary(self) -> str:
        """Return in one line what was done."""
        return f"lifter: {summary(self.stream) if self._pipeline else self._final_summary}"

    # --- transitions

    @_logged
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the model and make the publishers; fails, and may be repeated, if a parameter cannot be used."""
        try:
            self._pipeline = Pipeline(self, self._values, self._log, self._person_ids)
        except REFUSALS as error:
            self._clean_up()
            return self._refuse(error)
        return TransitionCallbackReturn.SUCCESS

    @_logged
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe and publish from now on."""
        super().on_activate(state)
        try:
            self.pipeline.activate()
        except REFUSALS as error:
            self.pipeline.deactivate()
            super().on_deactivate(state)
            return self._refuse(error)
        return TransitionCallbackReturn.SUCCESS

    @_logged
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Publish what is kept, then neither subscribe nor publish."""
        self.pipeline.deactivate()
        return super().on_deactivate(state)

    @_logged
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget the model and all counts."""
        self._clean_up()
        return TransitionCallbackReturn.SUCCESS

    @_logged
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Deactivate and clean up, from any state."""
        if self._pipeline:
            self._pipeline.deactivate()
        self._clean_up()
        return TransitionCallbackReturn.SUCCESS

    @_logged
    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Return to unconfigured, whatever went wrong."""
        return cast(TransitionCallbackReturn, self.on_shutdown(state))

    def _clean_up(self) -> None:
        destroy_lifecycle_publishers(self)
        if self._pipeline:
            self._final_summary = summary(self.stream)
        self._pipeline = None

    def _refuse(self, error: Exception) -> TransitionCallbackReturn:
        self._refusal = error
        if not self._starting:
            self.get_logger().error(one_line(error))
        return TransitionCallbackReturn.FAILURE

    # --- parameters

    def _set_parameters(self, parameters: Iterable[Parameter]) -> SetParametersResult:
        """Take all parameters or none; a refusal states the reason and changes nothing."""
        given = {parameter.name: parameter.value for parameter in parameters if parameter.name in LIVE}
        values = {**self._values, **given}
        try:
            # Before the node is configured, only configuring can tell whether a model can be used.
            if self._pipeline and given:
                self._apply(self._pipeline, given, values)
        except REFUSALS as error:
            return SetParametersResult(successful=False, reason=one_line(error))
        self._values = values
        return SetParametersResult(successful=True)

    @staticmethod
    def _apply(pipeline: Pipeline, given: dict[str, Any], values: dict[str, Any]) -> None:
        if any(name in given for name in _SWITCHING):
            pipeline.switch(open_stream(**values, session=pipeline.stream.session))
        # In the order of the table: only person_height may be refused by the model, and it comes first.
        for name in LIVE:
            if name in given and name not in _SWITCHING:
                setattr(pipeline.stream, name, given[name])
        if pipeline.active:
            pipeline.publish_layout()


def one_line(error: BaseException) -> str:
    """Return an error's text without line breaks and without the places in rcl's own source that it names."""
    return re.sub(r",? at \S+\.c(pp)?:\d+", "", " ".join(str(error).split()))
