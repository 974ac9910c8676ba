# SPDX-License-Identifier: Apache-2.0
"""Simulated views of bodies: each through a random camera and an imperfect detector. NumPy only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from msg_adapters.intrinsics import Intrinsics
from paul_ros.placement import centred_view
from training.people.cameras import Cameras, hidden_by_body, random_cameras
from training.people.detector import Detections, detect, redefined, reported
from training.people.view_settings import ViewSettings

_MIN_DEPTH = 0.3
"""Metres in front of a virtual camera; nearer points have no ray in ``marked``."""


@dataclass(frozen=True)
class SimulatedViews:
    """N views of bodies, in the order of the layout ``human``.

    Virtual cameras are turned towards the visible points, as the Lifter turns them.

    Attributes:
        W: (N,2,P) float32 rays (x/z, y/z) of the virtual cameras, with the detector's errors; 0 where hidden.
        visible: (N,P) whether the detector reports the point.
        marked: (N,2,P) float32 true rays of all points; NaN for points too near to the virtual camera.
        S: (N,3,P) float32 truth in the virtual cameras' frames, metres.
        confidence: (N,P) from 0 to 1; 0 where hidden.
        xy: (N,P,2) pixels of the real cameras, with the detector's errors; NaN where hidden.
        points: (N,P,3) truth in the real cameras' optical frames, metres.
        cameras: the real cameras.
        level: (N,) levels of the detectors' errors.
        layout: (N,) indices of the detectors' layouts in ``ViewSettings.layouts``.
    """

    W: np.ndarray
    visible: np.ndarray
    marked: np.ndarray
    S: np.ndarray
    confidence: np.ndarray
    xy: np.ndarray
    points: np.ndarray
    cameras: Cameras
    level: np.ndarray
    layout: np.ndarray


def simulate_views(points: np.ndarray, views: ViewSettings, rng: np.random.Generator) -> SimulatedViews:
    """View each body through a camera and a detector of its own.

    Args:
        points: (N,P,3) bodies of the layout ``human`` in a y-up world, metres.
        views: distributions of cameras and detectors.
        rng: source of randomness.
    """
    N = len(points)
    cameras = random_cameras(points, views, rng)
    truth = cameras.to_optical(points)
    level = rng.uniform(*views.level, N)
    marked = redefined(truth, level, rng)
    xy = cameras.project(marked)
    inside = cameras.inside(marked, xy) if views.border else truth[..., 2] > 0
    occluded = hidden_by_body(truth) if views.occlusion else np.zeros(inside.shape, bool)
    found = detect(xy, image_heights(cameras, truth), occluded, level, views, rng)
    missed = rng.random(inside.shape) < rng.uniform(*views.hidden, (N, 1))
    found.visible[:] &= inside & ~missed & ~_behind_obstacle(cameras.rays(xy), views, rng)
    shares = np.array([share for _, share in views.layouts], float)
    layout = rng.choice(len(shares), N, p=shares / shares.sum())
    return _from_virtual_cameras(reported(found, layout, views), truth, cameras, level, layout)


def _from_virtual_cameras(
    found: Detections, truth: np.ndarray, cameras: Cameras, level: np.ndarray, layout: np.ndarray
) -> SimulatedViews:
    """Turn the views as the Lifter does; if no point is visible, towards the whole body."""
    some = found.visible | ~found.visible.any(1, keepdims=True)
    view = centred_view(cameras.rays(found.xy), some, Intrinsics(1.0, 1.0, 0.0, 0.0, 0, 0))
    visible = found.visible & np.isfinite(view.W).all(1)
    S = (truth @ view.turn).transpose(0, 2, 1)
    depth = S[:, 2:]
    return SimulatedViews(
        W=np.where(visible[:, None], view.W, 0).astype(np.float32),
        visible=visible,
        marked=np.where(depth > _MIN_DEPTH, S[:, :2] / np.maximum(depth, _MIN_DEPTH), np.nan).astype(np.float32),
        S=S.astype(np.float32),
        confidence=np.where(visible, found.confidence, 0.0),
        xy=np.where(visible[..., None], found.xy, np.nan),
        points=truth,
        cameras=cameras,
        level=level,
        layout=layout,
    )


def image_heights(cameras: Cameras, truth: np.ndarray) -> np.ndarray:
    """Return the bodies' heights in the image (N,), pixels, or their widths if larger, without perspective."""
    span = np.ptp(truth[..., :2], axis=1).max(1)
    return cameras.focal * span / np.linalg.norm(cameras.place, axis=1)


def _behind_obstacle(rays: np.ndarray, views: ViewSettings, rng: np.random.Generator) -> np.ndarray:
    """Return which points (N,P) an object in front hides.

    It covers the body beyond a line: from below, as a table, or from a side, as a door.
    """
    N = len(rays)
    side = rng.choice(3, N, p=[0.7, 0.15, 0.15])
    along = np.where((side == 0)[:, None], rays[..., 1], np.where((side == 1)[:, None], 1, -1) * rays[..., 0])
    low, high = along.min(1, keepdims=True), along.max(1, keepdims=True)
    line = low + rng.uniform(0.35, 1.0, (N, 1)) * (high - low)
    return (rng.random((N, 1)) < views.obstacle) & (along > line)
