#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Make the two recordings beside this file, bit for bit, from the motion-capture clips in source/.

    python bags/make_bags.py [FOLDER]

World frame: metres, y up. The camera is above the origin and looks along +z and a little down; its right is -x.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Iterator

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))  # run from a checkout that nobody installed

from msg_adapters.outputs import keypoints_cloud, pose_array  # noqa: E402
from paul_ros.layout import load_layout  # noqa: E402
from paul_ros.offline.bag_records import BagMessages
from paul_ros.offline.bag_writer import BagWriter
from training.people.human_points import layout_points

RATE = 30  # Hz
START = 1_750_000_000 * 1_000_000_000  # ns, arbitrary
FRAME_ID = "camera_color_optical_frame"
LEFT_ARM, RIGHT_ARM, LEFT_LEG, RIGHT_LEG = (5, 7, 9), (6, 8, 10), (11, 13, 15), (12, 14, 16)
MIN_POINTS_SEEN = 4  # a detector finds no person with fewer


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Attributes:
        width: pixels.
        height_px: pixels.
        focal: focal length in pixels.
        height: height above the ground in metres.
        pitch_deg: angle in degrees by which the camera looks down.
    """

    width: int = 1280
    height_px: int = 720
    focal: float = 900.0
    height: float = 1.2
    pitch_deg: float = 4.0

    def see(self, world: np.ndarray) -> np.ndarray:
        """Map world points (...,3) to the optical frame, to the micrometre, so that all platforms round alike."""
        sin, cos = math.sin(math.radians(self.pitch_deg)), math.cos(math.radians(self.pitch_deg))
        x, down, ahead = -world[..., 0], self.height - world[..., 1], world[..., 2]
        return np.round(np.stack([x, cos * down - sin * ahead, sin * down + cos * ahead], axis=-1), 6)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Map points (...,3) of the optical frame to pixels (...,2)."""
        centre = np.array([self.width / 2, self.height_px / 2])
        return self.focal * points[..., :2] / points[..., 2:] + centre

    def inside(self, xy: np.ndarray) -> np.ndarray:
        """Return which pixels (...,2) lie in the image, (...) bool."""
        return np.all((xy >= 0) & (xy < [self.width, self.height_px]), axis=-1)


@dataclass(frozen=True)
class Person:
    """A clip placed in the world.

    Attributes:
        ident: id of the person.
        clip: name of the clip in source/.
        yaw_deg: rotation in degrees about the vertical through `pivot`.
        pivot: (x, z) of the clip in metres.
        place: (x, z) of the world in metres, where `pivot` comes to stand.
        first_frame: frame of the bag at which the clip begins.
        floor: metres by which the clip is lowered.
    """

    ident: int
    clip: str
    yaw_deg: float
    pivot: tuple[float, float]
    place: tuple[float, float]
    first_frame: int = 0
    floor: float = 0.0

    def points(self) -> np.ndarray:
        """Return COCO-17 points in the world, (F,17,3) metres."""
        with np.load(HERE / "source" / f"{self.clip}.npz", allow_pickle=False) as file:
            points = layout_points(file["joints"], load_layout("coco17"))
        sin, cos = math.sin(math.radians(self.yaw_deg)), math.cos(math.radians(self.yaw_deg))
        x, z = points[..., 0] - self.pivot[0], points[..., 2] - self.pivot[1]
        return np.stack(
            [cos * x + sin * z + self.place[0], points[..., 1] - self.floor, cos * z - sin * x + self.place[1]], axis=-1
        )


@dataclass(frozen=True)
class Seen:
    """One detected person in one frame.

    Attributes:
        ident: id of the person.
        truth: (17,3) metres, optical frame.
        xy: (17,2) detected pixels, NaN = hidden.
        confidence: (17,), 0 = hidden.
    """

    ident: int
    truth: np.ndarray
    xy: np.ndarray
    confidence: np.ndarray


def one_person() -> tuple[Camera, list[list[Seen]]]:
    """Return a person about 4.6 m away who climbs, swings, jumps, sits and walks; all points visible, no noise."""
    camera = Camera()
    person = Person(1, "01_14", yaw_deg=60.0, pivot=(0.4, 0.85), place=(0.0, 4.6))
    frames = camera.see(person.points())
    return camera, [[Seen(person.ident, truth, camera.project(truth), np.ones(17))] for truth in frames]


def two_persons() -> tuple[Camera, list[list[Seen]]]:
    """Return two walkers who cross; occlusion, image border and dropouts hide points, detector noise moves them."""
    camera = Camera()
    persons = [
        Person(3, "03_04", yaw_deg=90.0, pivot=(0.3, 1.8), place=(2.8, 3.6), first_frame=10, floor=0.2),
        Person(7, "29_01", yaw_deg=147.0, pivot=(0.97, -0.79), place=(-2.4, 2.9), first_frame=10),
    ]
    frames = _on_one_clock(camera, persons, seconds=13.0)
    rng = np.random.default_rng(20260101)
    return camera, [_detect(camera, truths, rng) for truths in frames]


def _on_one_clock(camera: Camera, persons: list[Person], seconds: float) -> list[list[tuple[int, np.ndarray]]]:
    """Return (ident, truth) of the persons whose clip is running, for each frame of the bag."""
    frames: list[list] = [[] for _ in range(round(seconds * RATE))]
    for person in persons:
        for number, truth in enumerate(camera.see(person.points()), person.first_frame):
            if number < len(frames):
                frames[number].append((person.ident, truth))
    return frames


def _detect(camera: Camera, truths: list[tuple[int, np.ndarray]], rng: np.random.Generator) -> list[Seen]:
    """Return the detections of one frame; the tallest in the image comes first, so rows are not persons."""
    found = []
    for ident, truth in truths:
        xy = camera.project(truth)
        hidden = ~camera.inside(xy) | (rng.random(17) < 0.03)
        for other_ident, other in truths:
            if other_ident != ident and other[11:13, 2].mean() < truth[11:13, 2].mean():
                hidden |= _behind(camera, xy, other)
        noise = rng.normal(size=(17, 2)) * rng.uniform(2.0, 3.0, size=(17, 1))
        confidence = np.clip(0.95 - 0.03 * np.hypot(*noise.T) - 0.1 * rng.random(17), 0.3, 1.0)
        if (~hidden).sum() >= MIN_POINTS_SEEN:
            found.append(
                Seen(
                    ident,
                    truth,
                    np.where(hidden[:, None], np.nan, np.round(xy + noise, 3)),
                    np.where(hidden, 0.0, np.round(confidence, 4)),
                )
            )
    return sorted(found, key=lambda seen: -np.ptp(seen.xy[np.isfinite(seen.xy[:, 1]), 1]))


def _behind(camera: Camera, xy: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return which of the points xy (17,2) a body (17,3), made of capsules about its bones, covers."""
    mid = [other[[5, 6]].mean(axis=0), other[[11, 12]].mean(axis=0)]
    capsules = [(mid[0], mid[1], 0.18), (other[3], other[4], 0.12)]
    for limb in (LEFT_ARM, RIGHT_ARM, LEFT_LEG, RIGHT_LEG):
        capsules += [(other[a], other[b], 0.06) for a, b in zip(limb, limb[1:])]
    covered = np.zeros(len(xy), bool)
    for start, end, radius in capsules:
        a, b = camera.project(start), camera.project(end)
        along = np.clip(((xy - a) * (b - a)).sum(-1) / ((b - a) ** 2).sum(), 0.0, 1.0)
        distance = np.hypot(*(xy - a - along[:, None] * (b - a)).T)
        covered |= distance < radius * camera.focal / ((start[2] + end[2]) / 2)
    return covered


def write(path: Path, camera: Camera, frames: list[list[Seen]]) -> None:
    """Write a bag with uncompressed chunks, so that its bytes depend on no compressor's version."""
    make = BagMessages()
    with BagWriter(path, make, compression="none") as bag:
        for number, persons in enumerate(frames):
            stamp = START + number * 1_000_000_000 // RATE
            for topic, message in _messages(make, camera, persons, stamp):
                bag.write(topic, message, stamp)


def _messages(make: BagMessages, camera: Camera, persons: list[Seen], stamp: int) -> Iterator[tuple[str, object]]:
    time = make("builtin_interfaces/msg/Time", sec=stamp // 1_000_000_000, nanosec=stamp % 1_000_000_000)
    header = make("std_msgs/msg/Header", stamp=time, frame_id=FRAME_ID)
    xy = np.array([person.xy for person in persons]).reshape(-1, 17, 2)
    confidence = np.array([person.confidence for person in persons]).reshape(-1, 17)
    truth = np.array([person.truth for person in persons]).reshape(-1, 17, 3)
    yield "/camera_info", _camera_info(make, header, camera)
    yield "/keypoints", keypoints_cloud(make, header, xy, confidence, [str(person.ident) for person in persons])
    yield "/ground_truth/poses", pose_array(make, header, truth)


def _camera_info(make: BagMessages, header: object, camera: Camera) -> object:
    f, cx, cy = camera.focal, camera.width / 2, camera.height_px / 2
    roi = make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return make(
        "sensor_msgs/msg/CameraInfo",
        header=header,
        height=camera.height_px,
        width=camera.width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=np.array([f, 0, cx, 0, f, cy, 0, 0, 1.0]),
        r=np.eye(3).ravel(),
        p=np.array([f, 0, cx, 0, 0, f, cy, 0, 0, 0, 1.0, 0]),
        binning_x=0,
        binning_y=0,
        roi=roi,
    )


BAGS = {"one_person.mcap": one_person, "two_persons_crossing.mcap": two_persons}


def main(folder: Path) -> None:
    """Write both bags to a folder."""
    for name, scene in BAGS.items():
        camera, frames = scene()
        write(folder / name, camera, frames)
        print(f"{folder / name}: {len(frames)} frames, {(folder / name).stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE)
