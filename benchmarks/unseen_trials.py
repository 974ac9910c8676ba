#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""The human model on every motion-capture trial that it never saw, not only on those of the recordings in bags/.

    python benchmarks/unseen_trials.py CMU_FOLDER [--model M]

Each trial at 10 Hz, root fixed 4 m in front of a level camera, from four sides; true 2D, all points visible.
Prints a Markdown table: lifted, and in brackets the rigid mean shape.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from msg_adapters import Intrinsics
from paul_ros import metrics
from paul_ros.lifter import Lifter
from paul_ros.model import DEFAULT_MODEL, load_model
from paul_ros.skeleton import load_layout
from training.human_data import HELD_OUT, read_clips
from training.mocap import layout_points

CAMERA = Intrinsics(900.0, 900.0, 640.0, 360.0, 1280, 720)
HIPS = [11, 12]


def seen_from(points: np.ndarray, yaw: float) -> np.ndarray:
    """World points (F,17,3), y up, in the optical frame of a level camera 4 m from the hips."""
    sin, cos = np.sin(yaw), np.cos(yaw)
    turn = np.array([[cos, 0, sin], [0, -1, 0], [sin, 0, -cos]])
    return (points - points[:, HIPS].mean(1, keepdims=True)) @ turn.T + [0, 0, 4.0]


def figures(lifter: Lifter, truth: np.ndarray) -> np.ndarray:
    """PA-MPJPE and N-MPJPE in mm, NE per-frame and global flip in %, median root error in mm."""
    xy = truth[..., :2] / truth[..., 2:] * CAMERA.fx + [CAMERA.cx, CAMERA.cy]
    lifted = lifter.lift(xy, np.ones(xy.shape[:2], bool), CAMERA)
    root = np.linalg.norm(lifted.root - truth[:, HIPS].mean(1), axis=1)
    return np.array(
        [
            1e3 * metrics.pa_mpjpe(lifted.points, truth).mean(),
            1e3 * metrics.n_mpjpe(lifted.points, truth).mean(),
            1e2 * metrics.normalised_error_flip_frame(lifted.points, truth).mean(),
            1e2 * metrics.normalised_error_flip_global(lifted.points, truth).mean(),
            1e3 * np.median(root),
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="npz files of CMU-31 joints, as training/README.md says")
    parser.add_argument("--model", default=DEFAULT_MODEL)
    args = parser.parse_args()
    model = load_model(args.model)
    lifters = Lifter(model), Lifter(model.rigid())
    clips = {name: joints for name, joints in read_clips(args.folder) if name.startswith(HELD_OUT)}
    print("| trial | PA-MPJPE mm | N-MPJPE mm | NE % frame flip | NE % global flip | root mm |\n|" + "---|" * 6)
    rows = []
    for name, joints in sorted(clips.items()):
        views = [seen_from(layout_points(joints[::12], load_layout("coco17")), yaw) for yaw in (0.3, 1.87, 3.44, 5.01)]
        rows.append([np.mean([figures(lifter, view) for view in views], axis=0) for lifter in lifters])
        print_row(name, *rows[-1])
    print_row("mean", *np.mean(rows, axis=0))


def print_row(name: str, lifted: np.ndarray, rigid: np.ndarray) -> None:
    print(f"| {name} | " + " | ".join(f"{a:.0f} ({b:.0f})" for a, b in zip(lifted, rigid)) + " |")


if __name__ == "__main__":
    main()
