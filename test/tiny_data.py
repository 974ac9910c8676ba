# SPDX-License-Identifier: Apache-2.0
"""Small made-up sequences for tests of the trainer, and starts made from their truth."""

import numpy as np
from scipy.spatial.transform import Rotation

from paul_ros.layout import anonymous_layout
from training.data import TrainingData
from training.start.start import Start

POINTS = 9

FROM_RANDOM_WEIGHTS = ("--set", "start=random", "--set", "regression_steps=0")
"""Options of `paul train` that spare tests the search for a start."""


def sequence(frames=40, seed=0, hidden=0.0, bend=0.2, layout=None):
    """TrainingData of a body that bends one way; its camera-frame shapes (F,3,P) in image units; its rotations."""
    rng = np.random.default_rng(seed)
    points = POINTS if layout is None else len(layout.names)
    mean, way = rng.standard_normal((2, 3, points))
    S = mean + bend * np.sin(np.linspace(0, 6, frames))[:, None, None] * way
    S = S - S.mean(2, keepdims=True)
    R = Rotation.random(frames, random_state=seed).as_matrix()
    camera = 50 * R @ S
    visible = rng.random((frames, points)) >= hidden
    W = np.where(visible[:, None], camera[:, :2] + 200, 0).astype(np.float32)
    data = TrainingData(W, visible, layout or anonymous_layout(points), False, "made up", np.ones(frames, bool))
    return data, camera.astype(np.float32), R.astype(np.float32)


def true_start(data, camera, R):
    """Return the start that a perfect search finds if all views have one scale."""
    S = np.swapaxes(R, 1, 2) @ camera / data.image_unit
    return Start(np.arange(len(S)), S.astype(np.float32), R, -1.0, 2.5)


def centred(S, visible):
    """Shapes (F,3,P) about the mean of their visible points."""
    seen = visible[:, None]
    return S - (S * seen).sum(2, keepdims=True) / seen.sum(2, keepdims=True)
