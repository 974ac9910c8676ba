# SPDX-License-Identifier: Apache-2.0
"""Parameters that arguments and files give the node at start: unknown names, and integers for other numbers."""

from __future__ import annotations

import time

import pytest
import yaml

IGNORED = "Unknown parameters are ignored: "


@pytest.fixture
def start(start_lifter, model_file, tmp_path):
    """start(parameters, section) -> the log of a node that has read these parameters from a file, and its exit code."""

    def started(parameters: dict, section: str = "/**") -> tuple[str, int | None]:
        path = tmp_path / "parameters.yaml"
        path.write_text(yaml.safe_dump({section: {"ros__parameters": parameters}}))
        lifter = start_lifter("-p", f"model:={model_file}", "--params-file", str(path))
        end = time.monotonic() + 30
        while "the process started" not in lifter.log() and lifter.process.poll() is None:
            assert time.monotonic() < end
            time.sleep(0.02)
        return lifter.log(), lifter.process.poll()

    return started


def test_unknown_names_are_noted_with_the_nearest(start):
    log, code = start(
        {
            "smothing": 1.0,
            "modle": "x.npz",
            "Layout": "coco17",
            "nothing.of.the.kind": True,
            "use_sim_tme": True,
            "qos_overrides": {"/keypoints": {"subscripton": {"reliability": "reliable"}}},
        }
    )
    assert code is None
    (line,) = (line for line in log.splitlines() if IGNORED in line)
    assert "[WARN]" in line
    for name, nearest in (
        ("smothing", "smoothing"),
        ("modle", "model"),
        ("Layout", "layout"),
        ("use_sim_tme", "use_sim_time"),
    ):
        assert f"'{name}', did you mean '{nearest}'?" in line
    assert "'nothing.of.the.kind'" in line
    assert "'qos_overrides./keypoints.subscripton.reliability', did you mean 'qos_overrides./test" in line


def test_all_known_names_and_those_of_other_nodes_are_no_note(start):
    known = {"use_sim_time": False, "start_type_description_service": True, "smoothing": 1, "min_confidence": 0}
    topics = ["/parameter_events"]
    assert IGNORED not in start(known)[0]
    assert IGNORED not in start({"smothing": 1.0}, "/detector")[0]
    log, _ = start({"qos_overrides": {topic: {"publisher": {"depth": 5}} for topic in topics}})
    assert "'qos_overrides./parameter_events.publisher.depth'" in log, "rclpy ignores it"


def test_every_override_of_qos_that_rclpy_declares_is_known(ros):
    from paul_ros.ros.node import LifterNode
    from paul_ros.ros.node_parameters import _qos_overrides

    node = LifterNode()
    node.start()
    declared = {name for name in node.list_parameters([], 0).names if name.startswith("qos_overrides.")}
    known = set(_qos_overrides(node))
    assert len(declared) > 20 and declared <= known
    # Not declared until somebody publishes keypoints, and unless TF is asked for.
    rest = {name.split(".")[1] for name in known - declared}
    assert rest <= {"/keypoints", "/tf", "/lifter/annotations"}
    node.end()
    node.destroy_node()


@pytest.mark.parametrize(
    "name, value, clue",
    [
        ("smoothing", "1", "DOUBLE"),
        ("smoothing", True, "DOUBLE"),
        ("smoothing", [1], "DOUBLE"),
        ("smoothing", 101, "out of range"),
        ("person_height", -1, "out of range"),
        ("max_persons", 5.0, "INTEGER"),
        ("max_persons", True, "INTEGER"),
        ("publish_tf", 1, "BOOL"),
        ("use_sim_time", "yes!", "BOOL"),
        ("model", 7, "STRING"),
    ],
)
def test_no_other_type_is_converted(start, name, value, clue):
    log, code = start({name: value})
    (line,) = log.splitlines()
    assert code == 1 and line.startswith("lifter: ") and clue in line and name in line
