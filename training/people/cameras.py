# SPDX-License-Identifier: Apache-2.0
"""Random pinhole cameras as robots carry them, and the points that a body hides from them. NumPy only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from training.people.human_points import human_layout
from training.people.mocap import axis_rotations
from training.people.view_settings import ViewSettings

WIDTH = 1280
_ASPECTS = np.array([3 / 4, 9 / 16])
_PRINCIPAL = 0.01  # standard deviation of the principal point about the image's middle, in image widths
_MIN_DEPTH = 0.2  # metres; nearer points, and those behind the camera, are in no image
_MAX_OFF_AXIS = 0.8  # largest offset of the body's middle from the image's middle, in half images

# Capsules: two ends, each the mean of some points, and a radius in metres.
_CAPSULES = (
    (("head",), ("head_top",), 0.09),
    (("left_shoulder", "neck"), ("left_hip",), 0.11),
    (("right_shoulder", "neck"), ("right_hip",), 0.11),
    *(((f"{side}_hip",), (f"{side}_knee",), 0.07) for side in ("left", "right")),
    *(((f"{side}_knee",), (f"{side}_ankle",), 0.05) for side in ("left", "right")),
    *(((f"{side}_shoulder",), (f"{side}_elbow",), 0.045) for side in ("left", "right")),
    *(((f"{side}_elbow",), (f"{side}_wrist",), 0.035) for side in ("left", "right")),
)
_SPINE = ("neck", "thorax", "spine", "pelvis")


@dataclass(frozen=True)
class Cameras:
    """N pinhole cameras, one for each body.

    Attributes:
        focal: (N,) focal lengths, pixels.
        centre: (N,2) principal points, pixels.
        size: (N,2) width and height of the images, pixels.
        R: (N,3,3) rotations from the y-up world to the optical frame.
        anchor: (N,3) a point of the world, metres.
        place: (N,3) the same point in the optical frame, metres.
    """

    focal: np.ndarray
    centre: np.ndarray
    size: np.ndarray
    R: np.ndarray
    anchor: np.ndarray
    place: np.ndarray

    def to_optical(self, points: np.ndarray) -> np.ndarray:
        """Map world points (N,P,3) to the optical frames, metres."""
        return (points - self.anchor[:, None]) @ self.R.transpose(0, 2, 1) + self.place[:, None]

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project points (N,P,3) of the optical frames to pixels (N,P,2); points behind the camera are meaningless."""
        depth = np.maximum(points[..., 2:], _MIN_DEPTH)
        return self.focal[:, None, None] * points[..., :2] / depth + self.centre[:, None]

    def rays(self, xy: np.ndarray) -> np.ndarray:
        """Map pixels (N,P,2) to rays (x/z, y/z)."""
        return (xy - self.centre[:, None]) / self.focal[:, None, None]

    def inside(self, points: np.ndarray, xy: np.ndarray) -> np.ndarray:
        """Return which points (N,P) lie in the image, occluded ones included."""
        return (points[..., 2] > _MIN_DEPTH) & ((xy >= 0) & (xy < self.size[:, None])).all(2)


def random_cameras(points: np.ndarray, views: ViewSettings, rng: np.random.Generator) -> Cameras:
    """Draw a camera for each body: anywhere round it, with the body somewhere in the image.

    Cameras are rolled a little.  Height, distance and the body's place in the image determine the pitch.

    Args:
        points: (N,P,3) bodies in a y-up world, metres.
        views: distributions of the cameras.
        rng: source of randomness.
    """
    N = len(points)
    middle = points.mean(1)
    near, far = np.log(views.distance)
    distance = np.exp(rng.uniform(near, far, N))
    above = rng.uniform(*views.height, N) - (middle[:, 1] - points[..., 1].min(1))
    sine = np.clip(above / distance, -0.9, 0.9)
    aloft = rng.random(N) < views.aloft
    sine = np.where(aloft, np.sin(np.deg2rad(rng.uniform(*views.elevation, N))), sine)
    focal = WIDTH / 2 / np.tan(np.deg2rad(rng.uniform(*views.field, N) / 2))
    size = np.stack([np.full(N, float(WIDTH)), WIDTH * rng.choice(_ASPECTS, N)], axis=1)
    centre = size / 2 + WIDTH * _PRINCIPAL * rng.standard_normal((N, 2))
    off = np.clip(views.off_axis * rng.standard_normal((N, 2)), -_MAX_OFF_AXIS, _MAX_OFF_AXIS) * size / 2
    ray = np.concatenate([off / focal[:, None], np.ones((N, 1))], axis=1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    tilted = rng.random(N) < views.tilted
    roll = np.deg2rad(np.where(tilted, views.tilt, views.roll) * rng.standard_normal(N))
    R = _orientation(ray, roll, sine, rng.uniform(0, 2 * np.pi, N))
    return Cameras(focal, centre, size, R, middle, distance[:, None] * ray)


def _orientation(ray: np.ndarray, roll: np.ndarray, sine: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Return rotations (N,3,3), world to camera, of cameras with a roll (N,) whose rays (N,3) point down by asin(sine).

    Before the roll is undone, the downward part of R ray is A sin(pitch + b), with (y, z) = A (sin b, cos b).
    """
    level = np.einsum("nji,nj->ni", axis_rotations(roll, 2), ray)
    reach = np.hypot(level[:, 1], level[:, 2])
    pitch = np.arcsin(np.clip(sine / reach, -1, 1)) - np.arctan2(level[:, 1], level[:, 2])
    to_optical = np.diag([1.0, -1.0, -1.0])  # y up to y down, and z into the scene
    return axis_rotations(roll, 2) @ axis_rotations(pitch, 0) @ to_optical @ axis_rotations(yaw, 1)


def hidden_by_body(points: np.ndarray) -> np.ndarray:
    """Return which points (N,P) the body itself occludes: those behind the head, the trunk or a limb.

    A limb is a capsule about its bone.  A point is behind the limb if its image lies in the limb's outline and it is
    deeper than the limb's axis by more than half the radius.  Points of a limb lie on its axis, so only other limbs
    occlude them.  Points of the spine lie within the trunk and are never occluded, because people mark them wherever
    they see the trunk.

    Args:
        points: (N,P,3) points of the layout ``human`` in optical frames, metres.
    """
    points = points.astype(np.float32)
    depth = np.maximum(points[..., 2], np.float32(_MIN_DEPTH))
    u, v = points[..., 0] / depth, points[..., 1] / depth
    hidden = np.zeros(depth.shape, bool)
    for start, end, radius in _CAPSULES:
        (ua, va, da), (ub, vb, db) = (_end(names, points) for names in (start, end))
        du, dv = ub - ua, vb - va
        along = np.clip(((u - ua) * du + (v - va) * dv) / (du * du + dv * dv + 1e-12), 0, 1)
        axis = da + along * (db - da)
        off = np.square(u - ua - along * du) + np.square(v - va - along * dv)
        hidden |= (off * np.square(axis) < radius**2) & (depth > axis + radius / 2)
    return hidden & ~np.isin(human_layout().names, _SPINE)


def _end(names: tuple[str, ...], points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return image x, image y and depth of a capsule's end, (N,1) each."""
    place = points[:, [human_layout().names.index(name) for name in names]].mean(1)
    depth = np.maximum(place[:, 2:], np.float32(_MIN_DEPTH))
    return place[:, :1] / depth, place[:, 1:2] / depth, depth
