# SPDX-License-Identifier: Apache-2.0
"""Sessions of requests to the services of a real node, in this process. They need ROS."""

from __future__ import annotations

import gc
import math
import random
import string
import time
import warnings
from typing import Any

import foreign_messages as foreign

from benchmarks.fuzz.bench import Bench
from benchmarks.fuzz.messages import cloud, header, random_pose
from benchmarks.fuzz.tally import Tally, WrongOutput

#: State -> id of a transition -> the state after it.
ALLOWED = {
    "unconfigured": {1: "inactive", 5: "finalized"},
    "inactive": {2: "unconfigured", 3: "active", 6: "finalized"},
    "active": {4: "inactive", 7: "finalized"},
    "finalized": {},
}
LABELS = {1: "configure", 2: "cleanup", 3: "activate", 4: "deactivate", 5: "shutdown", 6: "shutdown", 7: "shutdown"}
#: Live parameter -> type, and lowest and highest number or texts that are taken in any order.
LIVE = {
    "smoothing": (3, 0.0, 100.0),
    "min_confidence": (3, 0.0, 1.0),
    "max_persons": (2, 1, 10000),
    "layout": (4, "", "coco17"),
    "output_layout": (4, "", "coco17"),
    "model": (4, "human", "human"),
}
_LOGGERS = ("lifter", "rcl")
FIXED = ("autostart", "publish_tf", "input_type", "start_type_description_service")
ODD_NAMES = ("", "smothing", "a/b", ".", "smoothing.x", "/lifter/smoothing", "x" * 5000, "é 猫\n", "%s{}", "a\tb")
ODD_NUMBERS = (math.nan, math.inf, -math.inf, -1e-9, -0.5, 1e308, 5e-324)
FIELDS = ("bool", "integer", "double", "string", "byte_array", "bool_array", "integer_array", "double_array")


def service_session(bench: Bench, rng: random.Random, tally: Tally, cases: int, where: str) -> None:
    """Send requests to one node, with frames between them; each must be answered as its state and values demand."""
    # rclpy's own imports.
    warnings.simplefilter("ignore", DeprecationWarning)
    import rclpy

    if not rclpy.ok():
        rclpy.init()
    node = _Node(bench, rng)
    try:
        for _ in range(cases):
            tally.cases += 1
            start = time.process_time()
            try:
                accepted = node.case()
                tally.accepted += accepted
                tally.refused += not accepted
            except Exception:
                tally.crash(where)
            tally.time(time.process_time() - start)
    finally:
        node.close()


class _Node:
    """A node, the state that it must be in, and the faults that it reports."""

    def __init__(self, bench: Bench, rng: random.Random) -> None:
        self._bench, self._rng = bench, rng
        self._open()

    def _open(self) -> None:
        from rclpy.logging import LoggingSeverity, set_logger_level

        from paul_ros.ros.node import LifterNode

        faults: list[str] = []

        class Watched(LifterNode):
            def report_fault(self, where: str, error: Exception) -> None:
                faults.append(f"{where}: {error!r}")

        for logger in _LOGGERS:
            set_logger_level(logger, LoggingSeverity.FATAL)
        self._node, self._faults, self._state, self._frames = Watched(), faults, "unconfigured", 0
        for number in (1, 3):
            self._change(number, "")

    def close(self) -> None:
        """Finalize and destroy the node."""
        from rclpy.logging import LoggingSeverity, set_logger_level

        self._node.end()
        self._node.destroy_node()
        del self._node
        gc.collect()  # callbacks of a node refer to it
        for logger in _LOGGERS:
            set_logger_level(logger, LoggingSeverity.UNSET)

    def case(self) -> bool:
        """Send one request, then a frame; return whether the request was accepted.

        Raises:
            WrongOutput: the answer is wrong, or the node reported a fault or does not lift.
        """
        rng = self._rng
        if self._state == "finalized" and rng.random() < 0.5:
            self.close()
            self._open()
        accepted = rng.choice(
            (self._transition, self._parameters, self._parameters, self._atomically, self._question)
        )()
        if self._faults:
            raise WrongOutput(f"faults: {self._faults}")
        if self._node.active != (self._state == "active"):
            raise WrongOutput(f"the node should be {self._state}")
        if self._node.active:
            self._lift()
        return accepted

    def _ask(self, name: str, **fields: Any) -> Any:
        """Send a request as its bytes, and return the answer that its bytes make."""
        from rclpy.serialization import deserialize_message, serialize_message

        (service,) = (item for item in self._node.services if item.service_name == f"/lifter/{name}")
        kind = service.srv_type
        request = deserialize_message(serialize_message(kind.Request(**fields)), kind.Request)
        return deserialize_message(serialize_message(service.callback(request, kind.Response())), kind.Response)

    def _lift(self) -> None:
        make = self._bench.bag
        self._frames += 1
        message = cloud(make, header(make, self._rng, self._frames), [random_pose(self._rng)], self._rng)
        before = self._node.stream.counts["frames"]
        self._node.pipeline.on_keypoints(foreign.CLOUD, make.serialise(message), "/keypoints", 0, 0)
        if self._node.stream.counts["frames"] != before + 1:
            raise WrongOutput(f"the node does not lift: {dict(self._node.stream.ledger.drops)}")

    # --- transitions

    def _transition(self) -> bool:
        rng = self._rng
        number = rng.choice((*LABELS, *LABELS, *LABELS, rng.randrange(256)))
        label = rng.choice(("", "", "", *LABELS.values(), *ODD_NAMES))
        # An end takes a new node, so it is rare.
        if ALLOWED[self._state].get(number) == "finalized" and rng.random() < 0.9:
            number, label = 77, ""
        if label == "shutdown":
            label = "Shutdown"
        return self._change(number, label)

    def _change(self, number: int, label: str) -> bool:
        from lifecycle_msgs.msg import Transition

        allowed = ALLOWED[self._state]
        if label:
            number = next((key for key in allowed if LABELS[key] == label), 0)
        done = self._ask("change_state", transition=Transition(id=number, label=label)).success
        if done != (number in allowed):
            raise WrongOutput(f"transition {number} {label!r} in state {self._state}: {done}")
        self._state = allowed.get(number, self._state)
        if (state := self._ask("get_state").current_state.label) != self._state:
            raise WrongOutput(f"the state is {state}, not {self._state}")
        return done

    # --- parameters

    def _parameters(self) -> bool:
        given = [self._parameter() for _ in range(self._rng.choice((1, 1, 2, 5)))]
        answer = self._ask("set_parameters", parameters=[parameter for parameter, _ in given])
        self._check([result for result in answer.results], [good for _, good in given])
        for parameter, good in given[-1:]:
            if good:
                self._check_value(parameter)
        return any(good for _, good in given)

    def _atomically(self) -> bool:
        given = [self._parameter() for _ in range(self._rng.choice((1, 1, 2, 5)))]
        answer = self._ask("set_parameters_atomically", parameters=[parameter for parameter, _ in given])
        good = all(good for _, good in given)
        self._check([answer.result], [good])
        if good:
            self._check_value(given[-1][0])
        return good

    def _check(self, results: list[Any], expected: list[bool]) -> None:
        if [result.successful for result in results] != expected:
            raise WrongOutput(f"{results} is not {expected}")
        for result in results:
            if not result.successful and not 5 < len(result.reason) < 2500:
                raise WrongOutput(f"a refusal without a reason: {result.reason!r}")

    def _check_value(self, parameter: Any) -> None:
        (value,) = self._ask("get_parameters", names=[parameter.name]).values
        given = parameter.value
        wanted = (
            given.integer_value if given.type == 2 else given.double_value if given.type == 3 else given.string_value
        )
        if wanted != (value.integer_value, value.double_value, value.string_value)[value.type - 2]:
            raise WrongOutput(f"{parameter.name} is {value}, not {wanted}")

    def _parameter(self) -> tuple[Any, bool]:
        """Return a parameter of a request, and whether it must be accepted."""
        from rcl_interfaces.msg import Parameter, ParameterValue

        rng = self._rng
        name = rng.choice((*LIVE, *LIVE, *FIXED, *ODD_NAMES, "".join(rng.choices(string.printable, k=8))))
        kind, low, high = LIVE.get(name, (0, 0, 0))
        if kind and rng.random() < 0.5:
            value: Any = rng.choice((low, high))
            if kind == 3:
                value = rng.choice((low, high, rng.uniform(low, high), *ODD_NUMBERS))
            elif kind == 2:
                value = rng.choice((low, high, 0, -1, high + 1, 2**63 - 1, -(2**63)))
            good = kind == 4 or low <= value <= high or value == 5e-324
            return Parameter(name=name, value=ParameterValue(type=kind, **{f"{FIELDS[kind - 1]}_value": value})), good
        other = rng.choice((*range(10), 10, 77, 255))
        value = ParameterValue(type=other, integer_value=1, double_value=1.0, string_value="coco17", bool_value=True)
        number = other == 2 and kind in (2, 3) or other == 3 and kind == 3
        good = number or (kind == other == 4 and name != "model")
        if kind == other == 4 and name == "model" and self._state in ("unconfigured", "finalized"):
            return self._parameter()  # only configuring can tell whether it is a model
        return Parameter(name=name, value=value), good

    # --- questions

    def _question(self) -> bool:
        rng = self._rng
        names = rng.choices((*LIVE, *FIXED, *ODD_NAMES), k=rng.choice((0, 1, 2, 300)))
        name, fields = rng.choice(
            (
                ("get_parameters", {"names": names}),
                ("get_parameter_types", {"names": names}),
                ("describe_parameters", {"names": names}),
                ("list_parameters", {"prefixes": names, "depth": rng.choice((0, 1, 2**64 - 1))}),
                ("get_type_description", {"type_name": rng.choice(("std_msgs/msg/String", *ODD_NAMES))}),
                ("get_available_states", {}),
                ("get_available_transitions", {}),
                ("get_transition_graph", {}),
            )
        )
        answer = self._ask(name, **fields)
        if name in ("get_parameters", "get_parameter_types", "describe_parameters"):
            known = all(item in LIVE or item in FIXED for item in names)
            (values,) = (getattr(answer, field) for field in answer.get_fields_and_field_types())
            if len(values) != (len(names) if known else 0):
                raise WrongOutput(f"{len(values)} answers of {name} for {names}")
            return known
        return True
