# SPDX-License-Identifier: Apache-2.0
"""`paul view BAG`: a bag lifted through the code of replay and drawn as a short film."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from paul_ros.errors import BagError, PictureError
from paul_ros.offline.bag_topics import Topics
from paul_ros.offline.film_excerpt import Excerpt
from paul_ros.offline.film_files import check_format, write_film
from paul_ros.offline.film_stage import Stage
from paul_ros.offline.replay import Replay, replay
from paul_ros.stream.stream import LiftStream
from paul_ros.wording import quantity

#: Pictures of a film that is a .png.
PNG_PICTURES = 4

#: Iterates over pictures to show progress; the number of pictures is the second argument.
Progress = Callable[[Iterable[np.ndarray], int], Iterable[np.ndarray]]


@dataclass(frozen=True)
class Film:
    """A film that was written.

    Attributes:
        path: the file.
        pictures: number of pictures.
        summary: one line about what is shown and what was left out.
    """

    path: Path
    pictures: int
    summary: str


def view_bag(
    bag: Path,
    stream: LiftStream,
    out: Path,
    topics: Topics = Topics(),
    start: float = 0.0,
    seconds: float | None = None,
    progress: Progress = lambda pictures, total: pictures,
) -> tuple[Film, BagError | None]:
    """Lift an excerpt of a bag and draw it.

    Args:
        bag: an .mcap file or a rosbag2 folder.
        stream: a new stream, from `open_stream`.
        out: the film, whose suffix chooses the format.
        topics: names of the topics to read.
        start: seconds from the bag's first keypoints.
        seconds: length of the part to show; None = to the end.
        progress: shows progress over the pictures.

    Returns:
        The film, and the error of a damaged bag, all of whose whole messages are drawn.

    Raises:
        BagError: no keypoints can be read in that part; says up to when the bag has some.
        PictureError: nobody was lifted, or the film cannot be written.
    """
    check_format(out)
    found = topics.found_in(bag)
    excerpt = Excerpt.choose(bag, found, start, seconds)
    with tempfile.TemporaryDirectory() as folder:
        part = Path(folder) / "part.mcap"
        excerpt.copy(bag, part, found)
        done = replay(part, stream, topics=found)
    if not any(frame.lifted.ok.any() for frame in done.frames):
        why = " ".join(done.drop_advice) or "no message shows a person"
        raise PictureError(f"{bag}: nobody was lifted, so there is nothing to draw: {why}")
    drawn = _in_one_unit(done)
    first = excerpt.first + (drawn.frames[0].stamp - done.frames[0].stamp) / 1e9
    stage = Stage.of(drawn, bag.stem, first)
    shown = _png_frames(drawn) if out.suffix == ".png" else range(len(drawn.frames))
    write_film(out, progress((stage.draw(index) for index in shown), len(shown)))
    summary = excerpt.summary(len(shown))
    if left_out := len(done.frames) - len(drawn.frames):
        summary += f", {quantity(left_out, 'frame')} without metres left out"
    return Film(out, len(shown), summary), excerpt.damage


def _in_one_unit(done: Replay) -> Replay:
    """Return a replay without the frames in model units, if others are in metres: one room cannot show both."""
    metric = [frame for frame in done.frames if frame.lifted.units == "m"]
    return replace(done, frames=metric) if any(frame.lifted.ok.any() for frame in metric) else done


def _png_frames(done: Replay) -> list[int]:
    """Return the indices of a few frames, evenly over time, from those that show most persons at once."""
    lifted = np.array([frame.lifted.ok.sum() for frame in done.frames])
    full = np.flatnonzero(lifted == lifted.max())
    return full[np.unique(np.linspace(0, len(full) - 1, PNG_PICTURES + 2).round().astype(int)[1:-1])].tolist()
