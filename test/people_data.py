# SPDX-License-Identifier: Apache-2.0
"""Captured and made-up people for tests."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

SOURCE = Path(__file__).resolve().parent.parent / "bags" / "source"


@cache
def captured_joints() -> np.ndarray:
    """Return CMU-31 joints (F,31,3) of three people in motion."""
    clips = [captured_clip(name) for name in ("01_14", "03_04", "29_01")]
    return np.concatenate(clips).astype(float)


def captured_clip(name: str) -> np.ndarray:
    """Return every fourth frame of a trial, CMU-31 joints (F,31,3)."""
    return np.load(SOURCE / f"{name}.npz", allow_pickle=False)["joints"][::4]


def made_up_clip(seed: int, frames: int = 60) -> np.ndarray:
    """Return a moving skeleton without human proportions, (F,31,3)."""
    rng = np.random.default_rng(seed)
    base, sway = rng.standard_normal((31, 3)), rng.standard_normal((31, 3))
    return base + 0.3 * np.sin(np.linspace(0, 6, frames))[:, None, None] * sway
