#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Errors of human models on held-out motion capture, seen as robots see people: the figures of the model card.

    python benchmarks/human_model.py CMU_FOLDER [--models human,other.npz] [--json F] [--plot F.png] [--trials]

Frames are chosen evenly from each held-out trial.  Each has a camera of its own, as in the training views
(training/people/view_settings.py), but bodies lie whole in the image and keep the captured people's proportions.
Frames are lifted alone, with the camera's intrinsics.

Rows differ in the detector's layout, the level of its errors (1: the measured noise profile), the share of points that
it misses, and the distance.  Errors are means over all points of the detector's layout that the model has, hidden ones
included, and over the 12 joints of the limbs that all layouts have.  Errors of the root's position are medians.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from msg_adapters import Intrinsics
from paul_ros import metrics
from paul_ros.errors import PaulError
from paul_ros.files import write_atomically
from paul_ros.layout import load_layout
from paul_ros.lifted import Lifted
from paul_ros.lifter import Lifter
from paul_ros.model_file import DEFAULT_MODEL, load_model
from training.judge.pictures import COLOURS, new_figure, save_figure, titled
from training.people.clips import read_clips
from training.people.human_data import views_of
from training.people.human_points import human_layout, human_points
from training.people.poses import HELD_OUT
from training.people.simulated_views import SimulatedViews, simulate_views
from training.recipe import Recipe

LAYOUTS = ("coco17", "body25", "openpose18", "h36m17", "mediapipe33")
FOCAL = 1000.0
"""Focal length that all views are brought to, pixels, because the lifter takes one camera a call."""

LIMBS = [
    f"{side}_{joint}" for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for side in ("left", "right")
]


@dataclass(frozen=True)
class Condition:
    """The condition of one row.

    Attributes:
        layout: of the detector.
        level: of its errors.
        hidden: share of points that it misses.
        distance: least and greatest distance, metres.
    """

    layout: str = "coco17"
    level: float = 0.0
    hidden: float = 0.0
    distance: tuple[float, float] = (1.5, 10.0)

    def __str__(self) -> str:
        noise = {0.0: "true 2D", 1.0: "noise profile"}.get(self.level, f"noise level {self.level:g}")
        hidden = f", {self.hidden:.0%} hidden" if self.hidden else ""
        near, far = self.distance
        return f"{self.layout}, {noise}{hidden}" + (f", {near:g}-{far:g} m" if self.distance != (1.5, 10.0) else "")


CONDITIONS = (
    *(Condition(layout) for layout in LAYOUTS),
    *(Condition(layout, level=1.0) for layout in LAYOUTS),
    Condition(level=0.5),
    *(Condition(level=1.0, hidden=share) for share in (0.2, 0.4, 0.6)),
    *(Condition(hidden=share) for share in (0.2, 0.4, 0.6)),
    *(Condition(distance=bounds) for bounds in ((1.5, 2.5), (2.5, 4.0), (4.0, 6.0), (6.0, 10.0))),
)


def views_under(points: np.ndarray, condition: Condition, seed: int = 0) -> SimulatedViews:
    """Simulate views of bodies (N,43,3) under a condition."""
    views = replace(
        views_of(Recipe.load("human")),
        layouts=((condition.layout, 1.0),),
        level=(condition.level,) * 2,
        hidden=(condition.hidden,) * 2,
        distance=condition.distance,
        border=False,
        occlusion=False,
        obstacle=0.0,
    )
    return simulate_views(points, views, np.random.default_rng(seed))


def lift(lifter: Lifter, seen: SimulatedViews) -> tuple[Lifted, SimulatedViews]:
    """Lift the bodies; returns the persons that were lifted, and their views."""
    model = lifter.model.layout
    to_model = human_layout().map_to(model)
    rays = seen.cameras.rays(seen.xy)
    xy, _, visible = to_model(FOCAL * rays, seen.confidence, seen.visible)
    lifted = lifter.lift(xy, visible, Intrinsics(FOCAL, FOCAL, 0.0, 0.0, 0, 0))
    ok = lifted.ok
    arrays = {name: getattr(lifted, name)[ok] for name in ("points", "root")}
    return replace(lifted, **arrays), replace(seen, points=seen.points[ok])


def figures(lifter: Lifter, seen: SimulatedViews, layout: str) -> dict[str, float]:
    """Return the errors of one row."""
    lifted, shown = lift(lifter, seen)
    names = lifter.model.layout.names
    some = [name for name in load_layout(layout).names if name in names]

    def both(chosen: list[str]) -> tuple[np.ndarray, np.ndarray]:
        own, true = ([known.index(name) for name in chosen] for known in (names, human_layout().names))
        return lifted.points[:, own], shown.points[:, true]

    points, truth = both(some)
    root, true_root = lifted.root, shown.points[:, list(human_layout().root)].mean(1)
    off = np.linalg.norm(root - true_root, axis=1)
    away = np.linalg.norm(root, axis=1) / np.linalg.norm(true_root, axis=1) - 1
    return {
        "persons": len(seen.xy),
        "lifted": len(points),
        "pa_mpjpe_mm": 1e3 * float(metrics.pa_mpjpe(points, truth).mean()),
        "n_mpjpe_mm": 1e3 * float(metrics.n_mpjpe(points, truth).mean()),
        "pa_mpjpe_limbs_mm": 1e3 * float(metrics.pa_mpjpe(*both(LIMBS)).mean()),
        "ne_flip_frame_percent": 1e2 * float(metrics.normalised_error_flip_frame(points, truth).mean()),
        "ne_flip_global_percent": 1e2 * float(metrics.normalised_error_flip_global(points, truth).mean()),
        "root_error_median_mm": 1e3 * float(np.median(off)),
        "root_error_median_percent": 1e2 * float(np.median(off / np.linalg.norm(true_root, axis=1))),
        "distance_error_median_percent": 1e2 * float(np.median(np.abs(away))),
    }


def held_out(folder: Path, frames: int) -> dict[str, np.ndarray]:
    """Return bodies (n,43,3) of evenly chosen frames of every held-out trial, by its name."""
    clips = {name: joints for name, joints in read_clips(folder) if name.startswith(HELD_OUT)}
    if not clips:
        raise SystemExit(f"'{folder}' holds none of the held-out trials; add some of {', '.join(HELD_OUT)}")
    chosen = {name: np.unique(np.linspace(0, len(clip) - 1, frames).astype(int)) for name, clip in clips.items()}
    return {name: human_points(clips[name][rows]) for name, rows in sorted(chosen.items())}


def measure(models: list[str], trials: dict[str, np.ndarray], each: bool) -> list[dict[str, Any]]:
    """Measure every model under every condition.

    Args:
        models: names or files.
        trials: bodies (n,43,3) by the trial's name.
        each: whether to add a row for every trial, with COCO-17 and true 2D.

    Returns:
        A row for every model and condition, and for the rigid mean shape of the first model.
    """
    everybody = np.concatenate(list(trials.values()))
    cases = [(str(condition), everybody, condition) for condition in CONDITIONS]
    cases += [(name, np.repeat(points, 2, axis=0), Condition()) for name, points in trials.items() if each]
    lifters = {name: Lifter(load_model(name)) for name in models}
    lifters["rigid mean shape"] = Lifter(next(iter(lifters.values())).model.rigid())
    rows = []
    for what, points, condition in tqdm(cases, desc="conditions", leave=False):
        seen = views_under(points, condition)
        rows += [
            {"model": name, "what": what, **figures(lifter, seen, condition.layout)} for name, lifter in lifters.items()
        ]
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """Format the rows as a Markdown table."""
    models = list(dict.fromkeys(row["model"] for row in rows))
    heads = [f"{model}: PA-MPJPE (of the limbs), N-MPJPE mm, root mm (%)" for model in models]
    lines = ["| | " + " | ".join(heads) + " |", "|---" * (len(models) + 1) + "|"]
    for what in dict.fromkeys(row["what"] for row in rows):
        cells = [
            f"{row['pa_mpjpe_mm']:.1f} ({row['pa_mpjpe_limbs_mm']:.1f}), {row['n_mpjpe_mm']:.1f}, "
            f"{row['root_error_median_mm']:.0f} ({row['root_error_median_percent']:.1f})"
            + (f", {row['lifted']}/{row['persons']} lifted" if row["lifted"] < row["persons"] else "")
            for row in rows
            if row["what"] == what
        ]
        lines.append(f"| {what} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw the PA-MPJPE of every model under every condition."""
    models = list(dict.fromkeys(row["model"] for row in rows))
    conditions = [str(condition) for condition in CONDITIONS]
    figure = new_figure(9, 0.36 * len(conditions) + 1)
    axes = figure.subplots()
    for place, (model, colour) in enumerate(zip(models, COLOURS)):
        found = {row["what"]: row["pa_mpjpe_mm"] for row in rows if row["model"] == model}
        height = 0.8 / len(models)
        at = np.arange(len(conditions)) + (place - (len(models) - 1) / 2) * height
        axes.barh(at, [found[what] for what in conditions], height, color=colour, label=model)
    axes.set(yticks=range(len(conditions)), yticklabels=conditions, xlabel="PA-MPJPE, mm")
    axes.invert_yaxis()
    axes.legend(frameon=False)
    titled(axes, "people never seen in training")
    save_figure(figure, path)


def main() -> None:
    """Measure the models and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", metavar="CMU_FOLDER", type=Path, help="folder of motion capture")
    parser.add_argument("--models", default=DEFAULT_MODEL, metavar="A,B", help="names or files (default: %(default)s)")
    parser.add_argument("--frames", type=int, default=150, help="frames a trial (default: %(default)s)")
    parser.add_argument("--trials", action="store_true", help="add a row for every trial")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all rows as JSON")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draw the conditions")
    args = parser.parse_args()
    rows = measure(args.models.split(","), held_out(args.folder, args.frames), args.trials)
    print(table(rows))
    if args.json:
        write_atomically(args.json, json.dumps({"rows": rows}, indent=1).encode())
    if args.plot:
        draw(rows, args.plot)


if __name__ == "__main__":
    try:
        main()
    except PaulError as error:
        raise SystemExit(f"human_model: {error}") from None
