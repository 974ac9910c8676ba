# SPDX-License-Identifier: Apache-2.0
"""The topics of a bag and their roles: which one holds the keypoints, and which CameraInfo is that of their camera.

A wrong camera gives wrong metres without a word. So a choice between several is left to the user.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from msg_adapters import SUPPORTED
from paul_ros.errors import BagError, WrongTopicError
from paul_ros.offline.bag_reader import matches, topics_of
from paul_ros.wording import nearest

CAMERA_INFO_TYPE = "sensor_msgs/msg/CameraInfo"

_MOST_LISTED = 10
"""Most topics that an error names: a robot's bag can hold hundreds."""

_AMBIGUOUS = ("sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/PoseArray")
"""Types that hold many things beside 2D keypoints."""


_NAMED_TYPES = 3  # types that an error names


@dataclass(frozen=True)
class Role:
    """The use of a topic.

    Attributes:
        name: for messages to users.
        option: of the commands, which chooses the topic.
        types: message types that can be read in this role.
        default: name that is looked for if none is given; "" = none.
    """

    name: str
    option: str
    types: Collection[str]
    default: str = ""

    def check(self, topic: str, type_name: str) -> None:
        """Raise WrongTopicError if a topic's type cannot be read in this role."""
        if type_name not in self.types:
            raise WrongTopicError(
                f"{topic} has the type {type_name}, which is not readable as {self.name}: choose another topic with "
                f"{self.option}, of type {_some(self.types)}"
            )


KEYPOINTS = Role("keypoints", "--topic", SUPPORTED, "/keypoints")
CAMERA_INFO = Role("camera info", "--camera-info-topic", (CAMERA_INFO_TYPE,))
TRUTH = Role("ground truth", "--ground-truth-topic", ("geometry_msgs/msg/PoseArray",), "/ground_truth/poses")
DEPTH = Role("depth", "--depth-topic", ("sensor_msgs/msg/Image",), "/depth")


@dataclass(frozen=True)
class Topics:
    """Names of the topics to read. A given one must have messages; None leaves the choice to `found_in`.

    Attributes:
        keypoints: 2D keypoints. * stands for one part of the name, for message families with a topic per person:
            /humans/bodies/*/skeleton2d. None: /keypoints, else the only topic of a type made for keypoints.
        camera_info: CameraInfo. None: the only one of the bag, whatever its name.
        truth: ground truth, PoseArray in metres in the camera frame, person by person in the input's layout. None:
            /ground_truth/poses if the bag has it.
        depth: depth images aligned to the image of the keypoints. None: /depth if the bag has it.
    """

    keypoints: str | None = None
    camera_info: str | None = None
    truth: str | None = None
    depth: str | None = None

    def found_in(self, bag: Path) -> BagTopics:
        """Choose the topics of a bag.

        Raises:
            BagError: the bag cannot be read, a given topic has no messages, there are no keypoints, or there are
                several CameraInfo topics and none is given.
            WrongTopicError: a topic has a type that cannot be read in its role.
        """
        held = topics_in(bag)
        keypoints = _keypoints(bag, held, self.keypoints)
        return BagTopics(
            keypoints,
            choose_camera(bag, held, self.camera_info, keypoints),
            _named(bag, held, TRUTH, self.truth),
            _named(bag, held, DEPTH, self.depth),
        )


@dataclass(frozen=True)
class BagTopics(Topics):
    """Topics that a bag has, as `Topics.found_in` returns them; None = the bag has none."""

    keypoints: str

    def found_in(self, bag: Path) -> BagTopics:
        """Return these topics: they are those of the bag, or of the bag that this one is an excerpt of."""
        return self

    @property
    def all(self) -> tuple[str, ...]:
        """All names."""
        return tuple(name for name in (self.keypoints, self.camera_info, self.truth, self.depth) if name)


def choose_camera(bag: Path, held: dict[str, str], given: str | None, keypoints: str | None = None) -> str | None:
    """Return the CameraInfo topic to use: the given one, or the only one; None if the bag has none.

    Args:
        bag: for messages to users.
        held: topic -> type name, from `topics_in`.
        given: by the user, or None.
        keypoints: topic of the keypoints, for the advice which camera may be theirs.

    Raises:
        BagError: the given one has no messages, or the bag has several.
    """
    if given:
        return _named(bag, held, CAMERA_INFO, given)
    cameras = [topic for topic, kind in held.items() if kind == CAMERA_INFO_TYPE]
    if len(cameras) < 2:
        return cameras[0] if cameras else None
    beside = [topic for topic in cameras if keypoints and _namespace(topic) == _namespace(keypoints)]
    hint = f"; {beside[0]} has the namespace of {keypoints}" if len(beside) == 1 else ""
    raise BagError(
        f"{bag}: CameraInfo of {len(cameras)} cameras, on {_listed(cameras)}: choose the camera of the keypoints with "
        f"{CAMERA_INFO.option}{hint}"
    )


def topics_in(bag: Path) -> dict[str, str]:
    """Return topic -> type name of all topics with messages; raises BagError if nothing can be read."""
    return {topic: kind for topic, (kind, count) in topics_of(bag).items() if count}


def _keypoints(bag: Path, held: dict[str, str], given: str | None) -> str:
    name = given or KEYPOINTS.default
    named = [topic for topic in held if matches(topic, name)]
    for topic in named:
        KEYPOINTS.check(topic, held[topic])
    if named:
        return name
    made_for_it = [topic for topic, kind in held.items() if kind in SUPPORTED and kind not in _AMBIGUOUS]
    if given or len(made_for_it) != 1:
        raise BagError(_no_messages(bag, held, KEYPOINTS, name))
    return made_for_it[0]


def _named(bag: Path, held: dict[str, str], role: Role, given: str | None) -> str | None:
    """Return the given topic, or the role's default if the bag has it."""
    name = given or role.default
    if name in held:
        role.check(name, held[name])
        return name
    if given:
        raise BagError(_no_messages(bag, held, role, given))
    return None


def _no_messages(bag: Path, held: dict[str, str], role: Role, name: str) -> str:
    """Return the error for a topic without messages: the nearest name, what could be meant, and what to do."""
    fitting = {topic: kind for topic, kind in held.items() if kind in role.types}
    near = nearest(name, fitting) or nearest(name, held)
    start = f"{bag}: no messages on {name}"
    start += f", did you mean '{near}'? The" if near else "; the"
    named = _listed([f"{topic} ({kind})" for topic, kind in (fitting or held).items()])
    if fitting:
        return f"{start} topics with a type for {role.name} are {named}: choose one with {role.option}"
    return f"{start} bag holds {named or 'none at all'}, and {role.name} must be a {' or '.join(role.types)}"


def _listed(topics: Sequence[str]) -> str:
    more = len(topics) - _MOST_LISTED
    return ", ".join(topics[:_MOST_LISTED]) + (f" and {more} more" if more > 0 else "")


def _namespace(topic: str) -> str:
    return topic.rpartition("/")[0]


def _some(types: Collection[str]) -> str:
    """Return the first types as text, and how many more there are."""
    named = " or ".join(list(types)[:_NAMED_TYPES])
    return f"{named} or {len(types) - _NAMED_TYPES} more" if len(types) > _NAMED_TYPES else named
