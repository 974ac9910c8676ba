# SPDX-License-Identifier: Apache-2.0
"""Raw requests to every service of the node over DDS: each is answered, and the node lifts on."""

from __future__ import annotations

import itertools
import math
import os
import time

import pytest
from node_bench import MAKE, Bench, good

#: State -> ids of the transitions that lead to it from `unconfigured`, and back.
WAYS = {"unconfigured": (), "inactive": (1,), "active": (1, 3), "finalized": (5,)}
BACK = {"unconfigured": (), "inactive": (2,), "active": (4, 2)}
#: State -> id of each transition that it allows -> the state after it.
ALLOWED = {
    "unconfigured": {1: "inactive", 5: "finalized"},
    "inactive": {2: "unconfigured", 3: "active", 6: "finalized"},
    "active": {4: "inactive", 7: "finalized"},
    "finalized": {},
}
IDS = (*range(10), 10, 11, 12, 20, 30, 40, 50, 60, 61, 62, 77, 97, 98, 99, 255)


class Asker(Bench):
    """A bench with a client for each service, which sends frames at 30 Hz while it waits if `busy`."""

    def __init__(self, *arguments) -> None:
        super().__init__(*arguments)
        self.busy, self.next_frame = False, 0.0
        self.clients = {}

    def ask(self, name: str, **fields):
        """Send a request with these fields; return the answer."""
        future = self.client(name).call_async(self.client(name).srv_type.Request(**fields))
        self.until(lambda: self.frame() or future.done(), f"the answer of {name}")
        return future.result()

    def frame(self) -> None:
        if self.busy and time.monotonic() >= self.next_frame:
            self.next_frame = time.monotonic() + 1 / 30
            self.send(good())

    def client(self, name: str):
        if name not in self.clients:
            self.clients[name] = self.node.create_client(SERVICES()[name], f"lifter/{name}")
            self.until(self.clients[name].service_is_ready, name)
        return self.clients[name]

    def change(self, number: int = 0, label: str = "") -> bool:
        return self.ask(
            "change_state", transition=MAKE("lifecycle_msgs/msg/Transition", id=number, label=label)
        ).success

    def state(self) -> str:
        return self.ask("get_state").current_state.label

    def set(self, *parameters) -> list[str]:
        """Set parameters; return the reason of each refusal, '' if it was accepted."""
        results = self.ask("set_parameters", parameters=list(parameters)).results
        return ["" if result.successful else result.reason for result in results]

    def set_all(self, *parameters) -> str:
        """Set parameters atomically; return the reason of the refusal, '' if they were accepted."""
        result = self.ask("set_parameters_atomically", parameters=list(parameters)).result
        return "" if result.successful else result.reason

    def value(self, name: str):
        (value,) = self.ask("get_parameters", names=[name]).values
        return value

    def healthy(self) -> None:
        """Assert that the node lifts."""
        self.until(self.keypoints.get_subscription_count, "the subscription")
        self.lifts()

    def faultless(self) -> None:
        """Assert that the node has counted and logged no fault of its own."""
        assert "noted_callback_failed" not in self.diagnosed()
        assert "Traceback" not in self.lifter.log()


def SERVICES() -> dict[str, type]:
    """Name -> type of every service that a managed node of rclpy has."""
    from lifecycle_msgs import srv as lifecycle
    from rcl_interfaces import srv as parameters
    from type_description_interfaces.srv import GetTypeDescription

    return {
        "change_state": lifecycle.ChangeState,
        "get_state": lifecycle.GetState,
        "get_available_states": lifecycle.GetAvailableStates,
        "get_available_transitions": lifecycle.GetAvailableTransitions,
        "get_transition_graph": lifecycle.GetAvailableTransitions,
        "set_parameters": parameters.SetParameters,
        "set_parameters_atomically": parameters.SetParametersAtomically,
        "get_parameters": parameters.GetParameters,
        "get_parameter_types": parameters.GetParameterTypes,
        "describe_parameters": parameters.DescribeParameters,
        "list_parameters": parameters.ListParameters,
        "get_type_description": GetTypeDescription,
    }


def given(name: str, kind: int, **value):
    """Return a raw rcl_interfaces/Parameter."""
    return MAKE(
        "rcl_interfaces/msg/Parameter", name=name, value=MAKE("rcl_interfaces/msg/ParameterValue", type=kind, **value)
    )


def double(name: str, value: float):
    return given(name, 3, double_value=value)


@pytest.fixture(scope="module")
def asker(ros, start_lifter, model_file):
    """One node for all tests that leave it active and lifting."""
    asker = Asker(ros, start_lifter("-p", f"model:={model_file}"))
    asker.matched()
    yield asker
    asker.faultless()
    asker.close()


@pytest.fixture
def start_asker(ros, start_lifter, model_file):
    askers = []

    def start(*arguments: str) -> Asker:
        askers.append(Asker(ros, start_lifter("-p", f"model:={model_file}", *arguments)))
        return askers[-1]

    yield start
    for asker in askers:
        asker.close()
        asker.lifter.stop()


def test_no_service_is_forgotten(asker):
    place = ("lifter", f"/{asker.lifter.namespace}")
    asker.until(lambda: place in asker.node.get_node_names_and_namespaces(), "the node's name")
    found = asker.node.get_service_names_and_types_by_node(*place)
    assert {name.rpartition("/")[2] for name, _ in found} == set(SERVICES())


# --- transitions


def test_every_transition_by_id_in_every_state(start_asker):
    """Only those of the state succeed; all others are refused and change nothing."""
    asker = start_asker("-p", "autostart:=false")

    def go(state: str) -> None:
        assert all(map(asker.change, (*BACK[asker.state()], *WAYS[state]))) and asker.state() == state

    for state, allowed in ALLOWED.items():
        go(state)
        for number in set(IDS) - allowed.keys():
            assert not asker.change(number), (state, number)
            assert asker.state() == state, (state, number)
        for number, after in allowed.items():
            if after != "finalized":
                go(state)
                assert asker.change(number) and asker.state() == after
    log = asker.lifter.log()
    assert (
        "Transition 'activate' is refused: the node is unconfigured. It allows configure (id 1), shutdown (id 5)."
        in log
    )
    assert "Transition with id 77 is refused" in log and "the node is finalized. Start it again." in log
    assert "Traceback" not in log and asker.lifter.process.poll() is None


def test_labels_and_ids(asker):
    """A label counts more than an id, as in rclpy."""
    for request in (
        {"label": "deactivate"},
        {"label": "deactivate", "number": 4},
        {"label": "deactivate", "number": 77},
    ):
        assert asker.change(**request) and asker.state() == "inactive"
        assert asker.change(label="activate")
    for request in (
        {},
        {"label": "configure"},
        {"label": "configure", "number": 4},
        {"label": "nonsense", "number": 4},
        {"label": "Deactivate"},
        {"label": "x" * 10**6},
        {"label": "\n\t é 猫 %s {}"},
    ):
        assert not asker.change(**request) and asker.state() == "active"
    asker.healthy()


def test_the_first_configure_of_a_launch_file_is_refused_calmly(start_asker):
    """As from launch_ros's LifecycleNode or nav2's manager, while the node has activated itself."""
    asker = start_asker()
    assert not asker.change(1)
    asker.healthy()
    asker.faultless()
    assert (
        "Transition 'configure' is refused: the node is active. It has configured and activated itself. "
        "Set `autostart` to false to manage it." in asker.lifter.log()
    )
    # A manager that asks again and again does not fill the log.
    for _ in range(50):
        assert not asker.change(1)
    assert asker.lifter.log().count("is refused") == 1


# --- parameters

ODD_TYPES = (10, 11, 77, 128, 255)
VALUES = {
    0: {},
    1: {"bool_value": True},
    2: {"integer_value": 2},
    3: {"double_value": 2.0},
    4: {"string_value": "two"},
    5: {"byte_array_value": [b"\x02"]},
    6: {"bool_array_value": [True]},
    7: {"integer_array_value": [2]},
    8: {"double_array_value": [2.0]},
    9: {"string_array_value": ["two"]},
    **{kind: {} for kind in ODD_TYPES},
}
OWN = {"model": 4, "smoothing": 3, "max_persons": 2, "publish_tf": 1, "use_sim_time": 1}
NAMES = (*OWN, "", "smothing", "a/b", "/lifter/smoothing", "smoothing.x", ".", "x" * 10**5, "é 猫\n")


def test_every_type_for_every_kind_of_name(asker):
    """Singly and atomically: only a right type is accepted, and each refusal has a reason."""
    for name, (kind, value) in itertools.product(NAMES, VALUES.items()):
        parameter = given(name, kind, **value)
        for reason in (*asker.set(parameter), asker.set_all(parameter)):
            if (
                name in OWN
                and kind in (OWN[name], 2 if OWN[name] == 3 else None)
                and name in ("smoothing", "max_persons")
            ):
                assert reason == ""
            elif name == "use_sim_time" and kind == 1:
                assert reason == ""
            else:
                assert 5 < len(reason) < 2000, (name, kind, reason)
            if kind in ODD_TYPES:
                assert f"has type {kind}" in reason and "0 to 9" in reason
    assert (
        asker.set(given("use_sim_time", 1), double("smoothing", 0.0), given("max_persons", 2, integer_value=64))
        == [""] * 3
    )
    assert "''" not in asker.ask("list_parameters").result.names and "" not in asker.ask("list_parameters").result.names
    asker.healthy()


def test_one_bad_parameter_of_many(asker):
    good_one, bad = double("smoothing", 1.5), given("smoothing", 77)
    first, second, third = asker.set(good_one, bad, double("min_confidence", 0.25))
    assert (first, third) == ("", "") and "77" in second
    assert (asker.value("smoothing").double_value, asker.value("min_confidence").double_value) == (1.5, 0.25)
    # Atomically none is taken.
    assert "77" in asker.set_all(double("smoothing", 2.5), bad)
    assert "smoothing" in asker.set_all(double("smoothing", 2.5), double("smothing", 1.0))
    assert asker.value("smoothing").double_value == 1.5
    assert asker.set(double("smoothing", 0.0), double("min_confidence", 0.3)) == ["", ""]
    asker.healthy()


def test_numbers_out_of_range(asker):
    for value in (math.nan, math.inf, -math.inf, -1.0, 1e308, 100.1):
        for name in ("smoothing", "min_confidence", "person_height"):
            assert "out of range" in asker.set(double(name, value))[0]
            assert "out of range" in asker.set_all(double(name, value))
    for value in (-(2**63), -1, 10_001, 2**63 - 1):
        for name in ("max_persons", "smoothing"):
            assert "out of range" in asker.set(given(name, 2, integer_value=value))[0]
    asker.healthy()


def test_an_integer_for_a_floating_point_number(asker, start_asker):
    assert asker.set(given("smoothing", 2, integer_value=1)) == [""]
    value = asker.value("smoothing")
    assert (value.type, value.double_value) == (3, 1.0)
    assert asker.set_all(given("smoothing", 2, integer_value=0), given("person_height", 2, integer_value=2)) == ""
    assert asker.value("person_height").double_value == 2.0
    # No other type is converted.
    (text,) = asker.set(given("smoothing", 4, string_value="1"))
    assert "DOUBLE" in text and "STRING" in text
    (text,) = asker.set(double("max_persons", 5.0))
    assert "INTEGER" in text and "DOUBLE" in text
    assert all(asker.set(given("max_persons", 1, bool_value=True), given("smoothing", 1, bool_value=True)))
    assert asker.set(given("person_height", 2, integer_value=0)) == [""]
    started = start_asker(
        "-p", "smoothing:=1", "-p", "person_height:=2", "-p", "min_confidence:=0", "-p", "smothing:=1"
    )
    assert [started.value(name).double_value for name in ("smoothing", "person_height", "min_confidence")] == [1, 2, 0]
    started.healthy()
    assert started.layout()["smoothing_hz"] == 1.0
    assert started.diagnosed()["noted_unknown_parameter"] == "1"


def test_ten_thousand_parameters(asker):
    many = [double("smoothing", 1.0), double("x" * 100, 1.0), given("smoothing", 77), given("", 0)] * 2500
    refusal = "10000 parameters are too many for one request: send at most 1000"
    assert asker.set(*many) == [refusal] * 10_000 and asker.set_all(*many) == refusal
    assert asker.set(*[double("smoothing", 0.0)] * 1000) == [""] * 1000
    assert all(
        "there is no" in text for text in asker.set(*(double(f"smothing{number}", 0.0) for number in range(1000)))
    )
    declared = asker.ask("list_parameters").result.names
    many = (declared * 10_000)[:10_000]
    assert len(asker.ask("get_parameters", names=many).values) == 10_000
    assert len(asker.ask("get_parameter_types", names=many).types) == 10_000
    assert len(asker.ask("describe_parameters", names=many).descriptors) == 10_000
    assert asker.ask("list_parameters", prefixes=many).result.names == declared
    asker.healthy()


def test_an_unknown_name_is_refused_with_the_nearest(asker):
    (text,) = asker.set(double("smothing", 1.0))
    assert text == "there is no parameter 'smothing', did you mean 'smoothing'?"
    assert asker.set_all(given("modle", 4, string_value="x")) == "there is no parameter 'modle', did you mean 'model'?"
    assert asker.set(given("zzzz", 4)) == ["there is no parameter 'zzzz'"]
    (text,) = asker.set(given("qos_overrides./new.subscription.depth", 2, integer_value=5))
    assert text.endswith("'; the QoS of a topic can be set only at start")


def test_texts_that_name_no_file(asker, tmp_path):
    """To read a device or a pipe would never end."""
    os.mkfifo(tmp_path / "pipe.yaml")
    for text in (
        str(tmp_path / "pipe.yaml"),
        "m" * 10**6,
        "\n",
        " ",
        "猫.npz",
        "/dev/zero",
        "/dev/stdin",
        "/",
        ".",
        "/proc/self/mem",
        "%s%n{}",
        "points999999",
    ):
        for name in ("model", "layout", "output_layout"):
            (reason,) = asker.set(given(name, 4, string_value=text))
            assert 5 < len(reason) < 2000, (name, text)
    asker.healthy()


def test_parameters_that_are_fixed(asker):
    declared = asker.ask("list_parameters").result.names
    overrides = [name for name in declared if name.startswith("qos_overrides.")]
    assert overrides
    for name in ("autostart", "publish_tf", "input_type", "start_type_description_service", *overrides):
        value = asker.value(name)
        assert "read-only" in asker.set(MAKE("rcl_interfaces/msg/Parameter", name=name, value=value))[0]
    asker.healthy()


def test_the_other_services_with_odd_requests(asker):
    for names in ([], [""], ["nothing"], ["smoothing", "nothing"], ["x" * 10**6], ["é\n", "a/b"], ["smoothing"] * 3):
        known = set(names) <= {"smoothing"}
        for service, field in (
            ("get_parameters", "values"),
            ("get_parameter_types", "types"),
            ("describe_parameters", "descriptors"),
        ):
            # ROS answers a request with an unknown name by nothing.
            assert len(getattr(asker.ask(service, names=names), field)) == (len(names) if known else 0)
    for prefixes, depth in itertools.product(([], [""], ["qos_overrides"], ["x" * 10**5], ["."]), (0, 1, 2**64 - 1)):
        assert asker.ask("list_parameters", prefixes=prefixes, depth=depth).result is not None
    for type_name in ("", "std_msgs/msg/String", "std_msgs", "a/b/c/d", "x" * 10**5, "é"):
        for digest in ("", "RIHS01_" + "0" * 64, "RIHS99_zz", "x" * 10**5):
            answer = asker.ask("get_type_description", type_name=type_name, type_hash=digest, include_type_sources=True)
            assert answer.successful or answer.failure_reason
    for name in ("get_state", "get_available_states", "get_available_transitions", "get_transition_graph"):
        assert asker.ask(name) is not None
    asker.healthy()


def test_requests_while_frames_come(asker):
    """At 30 Hz no frame is lost by requests that are refused."""
    asker.healthy()
    before, asker.busy, first = asker.diagnosed(), True, asker.stamp + 1
    end = time.monotonic() + 2
    while time.monotonic() < end:
        for number in (0, 1, 3, 5, 77):
            assert not asker.change(number)
        assert all(
            asker.set(given("smoothing", 77), given("smothing", 255), given("", 0), double("smoothing", math.nan))
        )
        assert asker.set_all(given("model", 255))
    asker.busy = False
    asker.answer("poses", asker.stamp)
    after, sent = asker.diagnosed(), asker.stamp + 1 - first
    lifted, missed = (int(after.get(key, 0)) - int(before.get(key, 0)) for key in ("frames", "dropped_missed"))
    # A machine that stalls for a third of a second loses frames, which are counted.
    assert lifted + missed == sent and lifted > 0.8 * sent > 20
