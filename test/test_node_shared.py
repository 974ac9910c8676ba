# SPDX-License-Identifier: Apache-2.0
"""Launch files, layouts of RViz and Foxglove, and the security policy: all names in them are the node's."""

from __future__ import annotations

import json
import re
import time
import xml.etree.ElementTree as ElementTree

import pytest
import yaml
from conftest import ROOT
from node_bench import MAKE, class_of

from msg_adapters import outputs
from paul_ros.stream.messages import OUTPUTS

PACKAGE = "paul_ros"
POLICY = ElementTree.parse(ROOT / "sros2/lifter.policy.xml").getroot()
#: Element -> (allowed children, required attributes, attributes of which one is required), by sros2's policy.xsd
#: of version 0.2.0.
SCHEMA = {
    "policy": ({"enclaves"}, {"version"}, set()),
    "enclaves": ({"enclave"}, set(), set()),
    "enclave": ({"profiles"}, {"path"}, set()),
    "profiles": ({"profile"}, set(), set()),
    "profile": ({"topics", "services", "actions"}, {"ns", "node"}, set()),
    "topics": ({"topic"}, set(), {"publish", "subscribe"}),
    "services": ({"service"}, set(), {"reply", "request"}),
}


def every_topic() -> set[str]:
    """Topics that a node without remappings may publish."""
    topics = {output.topic.replace("~", "/lifter") for output in OUTPUTS.values()}
    return topics | {"/lifter/layout", "/diagnostics"}


def test_the_policy_keeps_to_the_schema():
    assert POLICY.tag == "policy" and POLICY.get("version") == "0.2.0"
    for element in POLICY.iter():
        if element.tag in ("topic", "service"):
            assert re.fullmatch(r"(~/|/)?[a-z][a-z0-9_]*", element.text) and not element.attrib
            continue
        children, needed, one = SCHEMA[element.tag]
        found = {child.tag for child in element}
        assert found and found <= children
        assert needed <= set(element.attrib) <= needed | one and bool(one & set(element.attrib)) == bool(one)
        assert all(element.get(name) == "ALLOW" for name in one & set(element.attrib))
    assert [enclave.get("path") for enclave in POLICY.iter("enclave")] == ["/lifter"]


def allowed(group: str, way: str, namespace: str) -> set[str]:
    """Full names that the policy would allow a node in this namespace."""
    (profile,) = POLICY.iter("profile")
    found = [element.text for part in profile.findall(group) if part.get(way) == "ALLOW" for element in part]
    assert len(set(found)) == len(found)
    assert profile.get("ns") == "/"
    name = f"{namespace}/{profile.get('node')}"
    return {re.sub(r"^(?!/)", f"{namespace}/", text.replace("~", name)) for text in found}


@pytest.fixture
def graph(ros, start_lifter, model_file):
    """Publishers, subscriptions, services and namespace of a node in simulated time."""
    from rclpy.qos import QoSProfile

    lifter = start_lifter("-p", f"model:={model_file}", "-p", "use_sim_time:=true")
    namespace = f"/{lifter.namespace}"
    spy = ros.create_node("spy", namespace=namespace)
    spy.create_publisher(class_of("sensor_msgs/msg/PointCloud2"), "keypoints", QoSProfile(depth=1))

    def names(ask) -> set[str]:
        return {name for name, _ in ask("lifter", namespace)}

    def asked():
        from rclpy._rclpy_pybind11 import NodeNameNonExistentError

        try:
            return tuple(
                names(ask)
                for ask in (
                    spy.get_publisher_names_and_types_by_node,
                    spy.get_subscriber_names_and_types_by_node,
                    spy.get_service_names_and_types_by_node,
                )
            )
        except NodeNameNonExistentError:
            return set(), set(), set()

    end = time.monotonic() + 30
    while f"{namespace}/keypoints" not in asked()[1] or len(asked()[2]) < 12:
        assert time.monotonic() < end, (asked(), lifter.log())
        time.sleep(0.1)
    yield *asked(), namespace
    spy.destroy_node()
    lifter.stop()


def test_the_policy_allows_what_the_node_does_and_no_more(graph):
    publishers, subscriptions, services, namespace = graph
    # These two need packages that are not installed.
    assert publishers == allowed("topics", "publish", namespace) - {"/tf", f"{namespace}/lifter/annotations"}
    assert subscriptions == allowed("topics", "subscribe", namespace)
    assert services == allowed("services", "reply", namespace)
    assert not allowed("services", "request", namespace) and not list(POLICY.iter("actions"))


def test_the_view_of_rviz_shows_the_outputs():
    config = yaml.safe_load((ROOT / "rviz/lifter.rviz").read_text())
    manager = config["Visualization Manager"]
    kinds = {
        "MarkerArray": "visualization_msgs/msg/MarkerArray",
        "PoseArray": "geometry_msgs/msg/PoseArray",
        "PointCloud2": "sensor_msgs/msg/PointCloud2",
    }
    shown = {}
    for display in manager["Displays"]:
        if "Topic" in display:
            assert display["Topic"]["Durability Policy"] == "Volatile"
            shown[display["Topic"]["Value"].removeprefix("/lifter/")] = kinds[display["Class"].rpartition("/")[2]]
    published = {name: output.message_type for name, output in OUTPUTS.items()}
    assert shown.items() <= published.items() and len(shown) == 3
    cloud = next(display for display in manager["Displays"] if "Channel Name" in display)
    assert cloud["Channel Name"] in {field.name for field in points_cloud().fields}


def points_cloud():
    import numpy as np
    from conftest import header_of

    one = np.zeros((1, 1))
    return outputs.points_cloud(MAKE, header_of(MAKE), np.zeros((1, 1, 3)), one, [""], one[0], one[0])


def test_the_layout_of_foxglove_shows_the_outputs():
    layout = json.loads((ROOT / "foxglove/lifter.json").read_text())
    panels = layout["configById"]

    def leaves(part) -> list[str]:
        return [part] if isinstance(part, str) else leaves(part["first"]) + leaves(part["second"])

    assert sorted(leaves(layout["layout"])) == sorted(panels)
    space, image = panels["3D!lifter"], panels["Image!lifter"]["imageMode"]
    named = {*space["topics"], *image["annotations"], panels["DiagnosticStatusPanel!lifter"]["topicToRender"]}
    named.add(panels["RawMessages!lifter"]["topicPath"])
    assert named <= every_topic()
    assert panels["DiagnosticStatusPanel!lifter"]["selectedName"] == "lifter: lifting"
    field = space["topics"]["/lifter/keypoints3d"]["colorField"]
    assert field in {field.name for field in points_cloud().fields}


def test_the_demo_launches_what_there_is():
    """No index has launch, so the file is read as XML."""
    launch = ElementTree.parse(ROOT / "launch/demo.launch.xml").getroot()
    text = ElementTree.tostring(launch, encoding="unicode")
    arguments = {argument.get("name"): argument.get("default") for argument in launch.findall("arg")}
    assert set(re.findall(r"\$\(var (\w+)\)", text)) == set(arguments)
    for path in re.findall(r"\$\(find-pkg-share paul_ros\)/([\w./]+)", text):
        assert (ROOT / path).is_file(), path
    included = ElementTree.parse(ROOT / "launch/lifter.launch.xml").getroot()
    known = {argument.get("name") for argument in included.findall("arg")}
    assert {argument.get("name") for argument in launch.find("include").findall("arg")} <= known
    view = yaml.safe_load((ROOT / "rviz/lifter.rviz").read_text())["Visualization Manager"]
    stand = next(node for node in launch.findall("node") if node.get("pkg") == "tf2_ros")
    assert f"--frame-id {view['Global Options']['Fixed Frame']} " in stand.get("args")
