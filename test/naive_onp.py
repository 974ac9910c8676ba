# SPDX-License-Identifier: Apache-2.0
"""A naive orthographic-N-point solver: Levenberg-Marquardt over rotation vectors from several starts.

It works on the points themselves and shares neither a formula nor a line with ``paul_ros.onp``, which it judges.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

STARTS = Rotation.random(8, random_state=0).as_rotvec()


def centred(points: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return points (D,P) minus their mean under weights (P,)."""
    return points - np.average(points, axis=1, weights=w)[:, None]


def rms(points: np.ndarray, w: np.ndarray) -> float:
    """Return the weighted rms length of vectors (D,P) under weights (P,)."""
    return float(np.sqrt(np.average((points**2).sum(0), weights=w)))


def naive_residual(S: np.ndarray, W: np.ndarray, w: np.ndarray, scale: str) -> float:
    """Return the smallest weighted rms distance that the search finds, in image units.

    Args:
        S: (3,P) shape.
        W: (2,P) image points.
        w: (P,) weights; points of weight 0 may be NaN.
        scale: ``"free"`` or ``"unit"``.
    """
    seen = w > 0
    S, W, w = centred(S[:, seen], w[seen]), centred(W[:, seen], w[seen]), w[seen]
    image, shape = rms(W, w), rms(S, w)
    zoom = image / shape if scale == "free" else 1.0  # so that the search starts near scale 1
    unit = max(image, zoom * shape)
    root = np.sqrt(w / w.sum())
    S, W = zoom / unit * S * root, W / unit * root

    def errors(x: np.ndarray) -> np.ndarray:
        factor = np.exp(x[3]) if scale == "free" else 1.0
        return (factor * Rotation.from_rotvec(x[:3]).as_matrix()[:2] @ S - W).ravel()

    size = 4 if scale == "free" else 3
    found = (
        least_squares(errors, np.append(x, 0.0)[:size], method="lm", xtol=1e-10, ftol=1e-13, max_nfev=300)
        for x in STARTS
    )
    return unit * float(np.sqrt(2 * min(one.cost for one in found)))
