# SPDX-License-Identifier: Apache-2.0
"""Random pinhole cameras as robots carry them: where they stand, what they see, and what the body hides of itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from training.people.mocap import human_layout, turn
from training.people.view_settings import Views

WIDTH = 1280
_ASPECTS = np.array([3 / 4, 9 / 16])
_PRINCIPAL = 0.01  # standard deviation of the principal point about the middle, in widths
_NEAREST = 0.2  # metres before the camera; nearer points, and those behind it, are in no image
_FARTHEST_OFF = 0.8  # of the half image: where the middle of the body is at most

# Capsules: two points of the body, each the mean of some, and a radius in metres.
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
        focal: (N,) pixels. centre: (N,2) principal point. size: (N,2) width and height of the image, pixels.
        R: (N,3,3) from the y-up world to the optical frame. anchor: (N,3) a point of the world, metres.
        place: (N,3) where that is in the optical frame.
    """

    focal: np.ndarray
    centre: np.ndarray
    size: np.ndarray
    R: np.ndarray
    anchor: np.ndarray
    place: np.ndarray

    def see(self, points: np.ndarray) -> np.ndarray:
        """World points (N,P,3) in the optical frames."""
        return (points - self.anchor[:, None]) @ self.R.transpose(0, 2, 1) + self.place[:, None]

    def project(self, points: np.ndarray) -> np.ndarray:
        """Points (N,P,3) of the optical frames in pixels (N,P,2); those behind the camera somewhere outside."""
        depth = np.maximum(points[..., 2:], _NEAREST)
        return self.focal[:, None, None] * points[..., :2] / depth + self.centre[:, None]

    def rays(self, xy: np.ndarray) -> np.ndarray:
        """Pixels (N,P,2) as x/z and y/z."""
        return (xy - self.centre[:, None]) / self.focal[:, None, None]

    def inside(self, points: np.ndarray, xy: np.ndarray) -> np.ndarray:
        """(N,P): in the image, whether or not something hides them."""
        return (points[..., 2] > _NEAREST) & ((xy >= 0) & (xy < self.size[:, None])).all(2)


def random_cameras(points: np.ndarray, views: Views, rng: np.random.Generator) -> Cameras:
    """A camera for each body (N,P,3) of a y-up world in metres, at random round it, with it somewhere in the image.

    A level or pitched camera, rolled a little: its height, its distance and the place of the body in the image settle
    how it is pitched.
    """
    N = len(points)
    middle = points.mean(1)
    distance = np.exp(rng.uniform(*np.log(views.distance), N))
    above = rng.uniform(*views.height, N) - (middle[:, 1] - points[..., 1].min(1))
    sine = np.clip(above / distance, -0.9, 0.9)
    aloft = rng.random(N) < views.aloft
    sine = np.where(aloft, np.sin(np.deg2rad(rng.uniform(*views.elevation, N))), sine)
    focal = WIDTH / 2 / np.tan(np.deg2rad(rng.uniform(*views.field, N) / 2))
    size = np.stack([np.full(N, float(WIDTH)), WIDTH * rng.choice(_ASPECTS, N)], axis=1)
    centre = size / 2 + WIDTH * _PRINCIPAL * rng.standard_normal((N, 2))
    off = np.clip(views.off_axis * rng.standard_normal((N, 2)), -_FARTHEST_OFF, _FARTHEST_OFF) * size / 2
    ray = np.concatenate([off / focal[:, None], np.ones((N, 1))], axis=1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    tilted = rng.random(N) < views.tilted
    roll = np.deg2rad(np.where(tilted, views.tilt, views.roll) * rng.standard_normal(N))
    R = _orientation(ray, roll, sine, rng.uniform(0, 2 * np.pi, N))
    return Cameras(focal, centre, size, R, middle, distance[:, None] * ray)


def _orientation(ray: np.ndarray, roll: np.ndarray, sine: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Rotations (N,3,3), world to camera, of cameras with a roll (N,) whose rays (N,3) point down by asin(sine).

    Before the roll is undone, R ray has downward part A sin(pitch + b), with (y, z) = A (sin b, cos b).
    """
    level = np.einsum("nji,nj->ni", turn(roll, 2), ray)
    reach = np.hypot(level[:, 1], level[:, 2])
    pitch = np.arcsin(np.clip(sine / reach, -1, 1)) - np.arctan2(level[:, 1], level[:, 2])
    to_optical = np.diag([1.0, -1.0, -1.0])  # y up to y down, and z into the scene
    return turn(roll, 2) @ turn(pitch, 0) @ to_optical @ turn(yaw, 1)


def hidden_by_body(points: np.ndarray) -> np.ndarray:
    """Which points the body itself hides (N,P), being behind the head, the trunk or a limb.

    Args:
        points: (N,P,3) of the layout ``human`` in optical frames, metres.

    A limb is a capsule about its bone; a point is behind it where it lies in its outline in the image and deeper than
    its axis by half its radius. Points of a limb lie on its axis and so are hidden by other limbs only; the spine lies
    within the trunk, and people mark it wherever they see the trunk.
    """
    points = points.astype(np.float32)
    depth = np.maximum(points[..., 2], np.float32(_NEAREST))
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
    """An end of a capsule, (N,1) each: image place and depth."""
    place = points[:, [human_layout().names.index(name) for name in names]].mean(1)
    depth = np.maximum(place[:, 2:], np.float32(_NEAREST))
    return place[:, :1] / depth, place[:, 1:2] / depth, depth
