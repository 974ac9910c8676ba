# SPDX-License-Identifier: Apache-2.0
"""Draw ``docs/perspective.png``: what weak perspective costs near the camera, and what the pinhole model gives back.

    python docs/perspective_picture.py

The poses of the persons in ``bags/``, their truth turned and put at every distance before the bags' camera, true 2D,
all points visible; once with their shape known, once lifted by the shipped model. Prints the figures as well. Needs
matplotlib and rosbags; the same run gives the same picture.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from msg_adapters import Intrinsics
from paul_ros import metrics
from paul_ros.files import write_atomically
from paul_ros.layout import load_layout
from paul_ros.model import load_model
from paul_ros.offline.bag_reader import read_messages
from paul_ros.onp import OnP, onp
from paul_ros.pinhole_pose import refine
from paul_ros.placement import centred_view, place

HERE = Path(__file__).resolve().parent
CAMERA = Intrinsics(900.0, 900.0, 640.0, 360.0, 1280, 720)
DISTANCES = (1.5, 2.0, 2.5, 3.0, 4.0, 6.0, 10.0)
DIRECTIONS = {"on the axis": (0.0, 0.0, 1.0), "32 degrees beside it": (0.5, 0.2, 0.84)}
METHODS = ("weak perspective", "one step of undoing it", "refined")
MEASURES = ("points, where they stand (mm)", "shape and attitude, N-MPJPE (mm)", "reprojection (px)")
_COLOURS = ("#D55E00", "#E69F00", "#009E73")  # Okabe and Ito
_EVERY = 4  # frames of the bags


def bodies() -> np.ndarray:
    """(N,17,3) metres about the hips, of both bags."""
    found = []
    for bag in ("one_person", "two_persons_crossing"):
        for _, _, message, _ in read_messages(HERE.parent / "bags" / f"{bag}.mcap", ["/ground_truth/poses"]):
            found += [(p.position.x, p.position.y, p.position.z) for p in message.poses]
    points = np.array(found).reshape(-1, 17, 3)[::_EVERY]
    return points - points[:, [11, 12]].mean(1, keepdims=True)


def placed(points: np.ndarray, direction: tuple, distance: float) -> np.ndarray:
    """Turned about the vertical at random and put there; those that would reach behind the camera are left out."""
    a = np.random.default_rng(0).uniform(0, 2 * np.pi, len(points))
    turn = np.zeros((len(points), 3, 3))
    turn[:, 0, 0] = turn[:, 2, 2] = np.cos(a)
    turn[:, 0, 2], turn[:, 2, 0], turn[:, 1, 1] = np.sin(a), -np.sin(a), 1.0
    there = points @ turn.transpose(0, 2, 1) + distance * np.array(direction)
    return there[(there[..., 2] > 0.3).all(1)]


def in_space(pose: OnP, S: np.ndarray) -> np.ndarray:
    """Shapes as a weak-perspective pose places them (N,3,P), shape units."""
    T = np.concatenate([pose.translation, np.ones((len(S), 1))], axis=1) / pose.scale[:, None]
    return pose.R @ S + T[:, :, None]


def solutions(S: np.ndarray, W: np.ndarray, visible: np.ndarray) -> list[np.ndarray]:
    """Shapes as each of METHODS places them, (N,3,P) in shape units."""
    weak = onp(S, W, visible)
    # A pinhole camera at distance 1/s sees u = X / (1/s + Z); weak perspective would have seen s X = u (1 + s Z).
    undone = W * (1 + weak.scale[:, None, None] * (weak.R @ S)[:, 2:])
    step = onp(S, undone, visible)
    start = in_space(weak, np.zeros_like(S))[:, :, 0]
    fine = refine(S, W, visible, weak.R, start)
    return [in_space(weak, S), in_space(step, S), fine.R @ S + fine.T[:, :, None]]


def figures(truth: np.ndarray, known: bool) -> list[list[float]]:
    """Of each method the MEASURES."""
    model = load_model()
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
        found = place(shape, view.turn, model.metres_per_unit)
        missed = np.linalg.norm(found - truth, axis=2).mean(), metrics.n_mpjpe(found, truth).mean()
        rows.append([*(1000 * value for value in missed), np.linalg.norm(pixels(found) - xy, axis=2)[visible].mean()])
    return rows


def pixels(points: np.ndarray) -> np.ndarray:
    return points[..., :2] / points[..., 2:] * CAMERA.fx + [CAMERA.cx, CAMERA.cy]


def table() -> np.ndarray:
    """(shape known or not, direction, distance, method, measure)."""
    points = bodies()
    return np.array(
        [
            [[figures(placed(points, way, d), known) for d in DISTANCES] for way in DIRECTIONS.values()]
            for known in (True, False)
        ]
    )


def draw(values: np.ndarray, path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 8.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(MEASURES), 2, sharex=True)
    for column, title in enumerate(("shape known", "lifted by the shipped model")):
        axes[0, column].set_title(title)
        for row, measure in enumerate(MEASURES):
            ax = axes[row, column]
            for way, style in enumerate(("-", "--")):
                for method, colour in enumerate(_COLOURS):
                    ax.plot(DISTANCES, values[column, way, :, method, row], style, color=colour, marker=".")
            ax.set(xscale="log", ylim=(0, None), xticks=DISTANCES, ylabel="" if column else measure)
            ax.set_xticklabels([f"{d:g}" for d in DISTANCES])
            ax.minorticks_off()
            ax.spines[["top", "right"]].set_visible(False)
    for ax in axes[-1]:
        ax.set_xlabel("distance of the hips (m)")
    for colour, method in zip(_COLOURS, METHODS):
        axes[0, 0].plot([], [], color=colour, label=method)
    for style, way in zip(("-", "--"), DIRECTIONS):
        axes[0, 0].plot([], [], style, color="#555555", label=way)
    axes[0, 0].legend(frameon=False, fontsize=9)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100, metadata={"Software": None})
    write_atomically(path, buffer.getvalue())


def main() -> None:
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
