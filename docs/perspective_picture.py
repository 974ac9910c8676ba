# SPDX-License-Identifier: Apache-2.0
"""Draw ``docs/perspective.png``: the errors of weak perspective near the camera, and of the pinhole model.

    python docs/perspective_picture.py

The true poses of the persons in ``bags/`` are turned and placed at every distance before the bags' camera.  Their 2D
points are exact and all visible.  The shape is known in one column, and lifted by the shipped model in the other.  The
figures are printed as well.  Every run draws the same picture.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from msg_adapters import Intrinsics
from paul_ros import metrics
from paul_ros.layout import load_layout
from paul_ros.model_file import load_model
from paul_ros.offline.bag_reader import read_messages
from paul_ros.offline.figures import new_figure, save_figure
from paul_ros.orthographic_n_point import OnP, onp
from paul_ros.pinhole_pose import refine
from paul_ros.placement import centred_view, place

HERE = Path(__file__).resolve().parent
CAMERA = Intrinsics(900.0, 900.0, 640.0, 360.0, 1280, 720)
DISTANCES = (1.5, 2.0, 2.5, 3.0, 4.0, 6.0, 10.0)
DIRECTIONS = {"on the axis": (0.0, 0.0, 1.0), "32 degrees beside it": (0.5, 0.2, 0.84)}
METHODS = ("weak perspective", "one step of undoing it", "refined")
MEASURES = ("points, where they stand (mm)", "shape and attitude, N-MPJPE (mm)", "reprojection (px)")
_COLOURS = ("#D55E00", "#E69F00", "#009E73")  # Okabe and Ito
_EVERY = 4  # every fourth frame of the bags is used


def bodies() -> np.ndarray:
    """Return the true poses (N,17,3) of both bags, metres from the middle of the hips."""
    found = []
    for bag in ("one_person", "two_persons_crossing"):
        for _, _, message, _ in read_messages(HERE.parent / "bags" / f"{bag}.mcap", ["/ground_truth/poses"]):
            found += [(p.position.x, p.position.y, p.position.z) for p in message.poses]
    points = np.array(found).reshape(-1, 17, 3)[::_EVERY]
    return points - points[:, [11, 12]].mean(1, keepdims=True)


def placed(points: np.ndarray, direction: tuple[float, float, float], distance: float) -> np.ndarray:
    """Turn bodies about the vertical at random and place them; bodies that would reach behind the camera are dropped.

    Args:
        points: (N,P,3) bodies, metres.
        direction: from the camera, in its optical frame.
        distance: in units of the direction, metres.
    """
    a = np.random.default_rng(0).uniform(0, 2 * np.pi, len(points))
    turn = np.zeros((len(points), 3, 3))
    turn[:, 0, 0] = turn[:, 2, 2] = np.cos(a)
    turn[:, 0, 2], turn[:, 2, 0], turn[:, 1, 1] = np.sin(a), -np.sin(a), 1.0
    there = points @ turn.transpose(0, 2, 1) + distance * np.array(direction)
    return there[(there[..., 2] > 0.3).all(1)]


def in_space(pose: OnP, S: np.ndarray) -> np.ndarray:
    """Return shapes (N,3,P) as a weak-perspective pose places them, shape units."""
    T = np.concatenate([pose.translation, np.ones((len(S), 1))], axis=1) / pose.scale[:, None]
    return pose.R @ S + T[:, :, None]


def solutions(S: np.ndarray, W: np.ndarray, visible: np.ndarray) -> list[np.ndarray]:
    """Return the shapes (N,3,P) as each of METHODS places them, shape units."""
    weak = onp(S, W, visible)
    # A pinhole camera at distance 1/s sees u = X / (1/s + Z); weak perspective would have seen s X = u (1 + s Z).
    undone = W * (1 + weak.scale[:, None, None] * (weak.R @ S)[:, 2:])
    step = onp(S, undone, visible)
    start = in_space(weak, np.zeros_like(S))[:, :, 0]
    fine = refine(S, W, visible, weak.R, start)
    return [in_space(weak, S), in_space(step, S), fine.R @ S + fine.T[:, :, None]]


def figures(truth: np.ndarray, known: bool) -> list[list[float]]:
    """Return a row for each method with its MEASURES.

    Args:
        truth: (N,17,3) bodies in the optical frame, metres.
        known: whether the shapes are known; otherwise the shipped model lifts them.
    """
    model = load_model()
    assert model.metres_per_unit is not None
    xy, visible = pixels(truth), np.ones(truth.shape[:2], bool)
    view = centred_view(xy, visible, CAMERA)
    visible &= np.isfinite(view.W).all(1)
    own = [model.layout.names.index(name) for name in load_layout("coco17").names]
    W, seen = np.zeros((len(truth), 2, len(model.layout.names))), np.zeros((len(truth), len(model.layout.names)), bool)
    W[:, :, own], seen[:, own] = np.nan_to_num(view.W), visible
    S = model.shape(W, seen)[:, :, own].astype(float)
    if known:
        S = truth.transpose(0, 2, 1) / model.metres_per_unit
        S = S - S.mean(2, keepdims=True)
    rows = []
    for shape in solutions(S, view.W, visible):
        found = place(shape, view, model.metres_per_unit)
        missed = np.linalg.norm(found - truth, axis=2).mean(), metrics.n_mpjpe(found, truth).mean()
        rows.append([*(1000 * value for value in missed), np.linalg.norm(pixels(found) - xy, axis=2)[visible].mean()])
    return rows


def pixels(points: np.ndarray) -> np.ndarray:
    """Project points (...,3) of the optical frame to pixels (...,2)."""
    return points[..., :2] / points[..., 2:] * CAMERA.fx + [CAMERA.cx, CAMERA.cy]


def table() -> np.ndarray:
    """Return all figures, by (shape known or lifted, direction, distance, method, measure)."""
    points = bodies()
    return np.array(
        [
            [[figures(placed(points, way, d), known) for d in DISTANCES] for way in DIRECTIONS.values()]
            for known in (True, False)
        ]
    )


def draw(values: np.ndarray, path: Path) -> None:
    """Draw the figures over distance."""
    figure = new_figure(9, 8.5, extra="docs")
    axes = figure.subplots(len(MEASURES), 2, sharex=True)
    for column, title in enumerate(("shape known", "lifted by the shipped model")):
        axes[0, column].set_title(title)
        for row, measure in enumerate(MEASURES):
            ax = axes[row, column]
            for way, style in enumerate(("-", "--")):
                for index, colour in enumerate(_COLOURS):
                    ax.plot(DISTANCES, values[column, way, :, index, row], style, color=colour, marker=".")
            ax.set(xscale="log", ylim=(0, None), xticks=DISTANCES, ylabel="" if column else measure)
            ax.set_xticklabels([f"{d:g}" for d in DISTANCES])
            ax.minorticks_off()
            ax.spines[["top", "right"]].set_visible(False)
    for ax in axes[-1]:
        ax.set_xlabel("distance of the hips (m)")
    for colour, method in zip(_COLOURS, METHODS):
        axes[0, 0].plot([], [], color=colour, label=method)
    for line_style, direction in zip(("-", "--"), DIRECTIONS):
        axes[0, 0].plot([], [], line_style, color="#555555", label=direction)
    axes[0, 0].legend(frameon=False, fontsize=9)
    save_figure(figure, path, dpi=100)


def main() -> None:
    """Print the figures and draw them."""
    values = table()
    for known, kind in zip(values, ("known shape", "lifted")):
        print(f"{kind}: {', '.join(MEASURES)}, each for {' / '.join(METHODS)}")
        for way, of_way in zip(DIRECTIONS, known):
            for distance, of_methods in zip(DISTANCES, of_way):
                cells = "   ".join(" / ".join(f"{value:.1f}" for value in measure) for measure in of_methods.T)
                print(f"  {way:<22}{distance:>5} m   {cells}")
    draw(values, HERE / "perspective.png")


if __name__ == "__main__":
    main()
