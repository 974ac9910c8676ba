# SPDX-License-Identifier: Apache-2.0
"""From image to rays and from shape units to metres: what the camera's intrinsics add to an orthographic lift.

Weak perspective holds on the optical axis, and people stand beside it.  So each person is first seen by a virtual
camera turned towards it: the rays of its keypoints are rotated until the person's own direction is the optical axis.
Lifting happens there; the result is rotated back.  With scale ``s`` (normalised image units per model unit) and ``m``
metres per model unit, similar triangles give the distance ``m / s``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from msg_adapters.keypoints import Intrinsics

_HALF_FIELD = 0.5  # cosine of 60 degrees


@dataclass(frozen=True)
class CentredView:
    """N persons as N virtual cameras see them, each turned to its person.

    Attributes:
        W: (N,2,P) normalised image points (unit focal length) in the virtual cameras; NaN where hidden, or farther than
            60 degrees from the person's direction: taken for a misdetection.
        turn: (N,3,3) rotations from the virtual cameras to the real one.
    """

    W: np.ndarray
    turn: np.ndarray


def centred_view(xy: np.ndarray, visible: np.ndarray, camera: Intrinsics) -> CentredView:
    """Turn a virtual camera towards every person.

    Args:
        xy: (N,P,2) pixels, rectified image; anything where hidden.
        visible: (N,P) bool, at least one point a person.
        camera: pinhole intrinsics in pixels.
    """
    rays = np.stack(
        [(xy[..., 0] - camera.cx) / camera.fx, (xy[..., 1] - camera.cy) / camera.fy, np.ones(xy.shape[:2])], axis=2
    )
    # Unit rays, so that one wild detection cannot turn the camera away from all the others.
    rays = np.where(visible[..., None], rays / np.linalg.norm(rays, axis=2, keepdims=True), np.nan)
    towards = np.nanmean(rays, axis=1)
    turn = _turn_from_axis(towards / np.linalg.norm(towards, axis=1, keepdims=True))
    seen = np.einsum("nji,npj->nip", turn, rays)
    with np.errstate(invalid="ignore"):
        return CentredView(np.where(seen[:, 2:] > _HALF_FIELD, seen[:, :2] / seen[:, 2:], np.nan), turn)


def _turn_from_axis(direction: np.ndarray) -> np.ndarray:
    """Smallest rotations (N,3,3) that take the optical axis (0,0,1) to unit directions (N,3) with z > 0."""
    x, y, z = direction.T
    k = 1.0 / (1.0 + z)
    return np.stack(
        [
            np.stack([1 - k * x * x, -k * x * y, x], axis=1),
            np.stack([-k * x * y, 1 - k * y * y, y], axis=1),
            np.stack([-x, -y, z], axis=1),
        ],
        axis=1,
    )


def undo_perspective(W: np.ndarray, shape: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """The image points that weak perspective would have given, from those of a pinhole camera.

    A pinhole camera at distance d sees ``u = X / (d + Z)``, weak perspective ``X / d = u (1 + Z / d)``.

    Args:
        W: (N,2,P) normalised image points of centred views.
        shape: (N,3,P) the shapes as they stand in those views, model units, from a first guess of their pose.
        scale: (N,) normalised image units per model unit, 1/d, from the same guess.
    """
    # The limits hold off a guess so wrong that it would put points behind the camera.
    return W * np.clip(1 + scale[:, None, None] * shape[:, 2:], 0.5, 2.0)


def place(
    shape: np.ndarray, scale: np.ndarray, translation: np.ndarray, turn: np.ndarray, metres_per_unit: float
) -> np.ndarray:
    """Put lifted shapes where the camera saw them.

    Args:
        shape: (N,3,P) model units, rotated into the virtual camera's frame.
        scale: (N,) normalised image units per model unit, from OnP.
        translation: (N,2) normalised image position of the shape's origin, from OnP.
        turn: (N,3,3) virtual camera to real camera.
        metres_per_unit: size of the model unit.

    Returns:
        points (N,P,3) in metres in the real camera's optical frame (REP-103: z forward, x right, y down).
    """
    distance = metres_per_unit / scale
    origin = np.concatenate([translation, np.ones((len(translation), 1))], axis=1) * distance[:, None]
    return np.einsum("nij,njp->npi", turn, metres_per_unit * shape + origin[..., None])
