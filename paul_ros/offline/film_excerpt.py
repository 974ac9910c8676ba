# SPDX-License-Identifier: Apache-2.0
"""The excerpt of a bag that a film shows: which keypoint messages, chosen without decoding any."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from msg_adapters import ONE_PERSON
from paul_ros.errors import BagError
from paul_ros.offline.bag_reader import matches, read_records
from paul_ros.offline.bag_records import Record
from paul_ros.offline.bag_topics import BagTopics
from paul_ros.offline.bag_writer import BagWriter
from paul_ros.offline.film_files import PICTURES_PER_SECOND
from paul_ros.wording import quantity

#: Most pictures of a film; a longer bag is shown in larger steps.
MAX_PICTURES = 200

#: Nanoseconds within which the messages of one image arrive, if each holds one person.
_IMAGE_NS = 30_000_000


@dataclass(frozen=True)
class Excerpt:
    """Keypoint messages of a bag, evenly over a part of it.

    Attributes:
        times: log times of the chosen messages in nanoseconds.
        messages: number of keypoint messages in the bag.
        first: seconds from the bag's first keypoints to the first chosen ones.
        last: seconds from the bag's first keypoints to the last chosen ones.
        length: seconds from the bag's first keypoints to its last.
        speed: speed of the film; 1 = real time.
        damage: error of a damaged bag; None = the bag is whole.
    """

    times: frozenset[int]
    messages: int
    first: float
    last: float
    length: float
    speed: float
    damage: BagError | None

    @classmethod
    def choose(cls, bag: Path, topics: BagTopics, start: float, seconds: float | None) -> Excerpt:
        """Choose up to MAX_PICTURES images.

        Args:
            bag: an .mcap file or a rosbag2 folder.
            topics: of the bag.
            start: seconds from the bag's first keypoints.
            seconds: length of the part; None = to the end.

        Raises:
            BagError: the bag has no keypoint messages that can be read, or none in that part.
        """
        times, one_person, damage = _keypoint_times(bag, topics)
        since = (times - times[:1]) / 1e9
        wanted = np.flatnonzero((since >= start) & (since <= start + (np.inf if seconds is None else seconds)))
        if not len(times):
            raise BagError(f"{bag}: no message on {topics.keypoints} can be read")
        if not len(wanted):
            raise BagError(_empty_part(bag, since, start, seconds))
        first, last = since[wanted[0]], since[wanted[-1]]
        step = max(1 / PICTURES_PER_SECOND, (last - first) / (MAX_PICTURES - 1))
        # Rounded, so that a camera's jitter makes no step a frame longer.
        slots = np.round((since[wanted] - first) / step, 2).astype(int)
        chosen = times[wanted[np.unique(slots, return_index=True)[1]]]
        if one_person:
            chosen = _with_same_image(times, chosen)
        speed = step * PICTURES_PER_SECOND
        return cls(frozenset(chosen.tolist()), len(times), first, last, since[-1], speed, damage)

    def copy(self, bag: Path, part: Path, topics: BagTopics) -> None:
        """Write the chosen messages to a bag, with the latest message of each other topic before each of them."""
        waiting: dict[str, Record] = {}
        with BagWriter(part) as writer:
            try:
                for record in read_records(bag, topics.all):
                    if not matches(record.topic, topics.keypoints):
                        waiting[record.topic] = record
                    elif record.log_time in self.times:
                        for other in waiting.values():
                            writer.write_record(other)
                        waiting = {}
                        writer.write_record(record)
            except BagError:
                if not self.damage:
                    raise

    def summary(self, pictures: int) -> str:
        """Return one line about what a film of so many pictures shows and leaves out."""
        speed = "in real time" if self.speed < 1.01 else f"{self.speed:.1f} times as fast as real time"
        return (
            f"{quantity(pictures, 'picture')} of {quantity(self.messages, 'message')}, "
            f"{self.first:.1f} to {self.last:.1f} s of {self.length:.1f} s, {speed}"
        )


def _keypoint_times(bag: Path, topics: BagTopics) -> tuple[np.ndarray, bool, BagError | None]:
    """Return the log times of all keypoint messages in ns, whether each holds one person, and a bag's damage."""
    times, one_person = [], False
    try:
        for record in read_records(bag, topics.all):
            if matches(record.topic, topics.keypoints):
                times.append(record.log_time)
                one_person = one_person or record.type_name in ONE_PERSON
    except BagError as error:
        if not times:
            raise
        return np.array(times, int), one_person, error
    return np.array(times, int), one_person, None


def _empty_part(bag: Path, since: np.ndarray, start: float, seconds: float | None) -> str:
    """Return the error for a part without keypoints; `since` is the seconds from the first keypoints to each."""
    when = f"from {start:g} s on" if seconds is None else f"from {start:g} s to {start + seconds:g} s"
    if start > since[-1]:
        cure = f"the bag has keypoints up to {since[-1]:.1f} s: choose an earlier --start"
    else:
        cure = f"the next are at {since[since >= start][0]:.3f} s: choose larger --seconds"
    return f"{bag}: no keypoints {when}; {cure}"


def _with_same_image(times: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return the chosen times and those of other persons in the same images."""
    before = chosen[np.maximum(np.searchsorted(chosen, times, side="right") - 1, 0)]
    return times[(times >= before) & (times < before + _IMAGE_NS)]
