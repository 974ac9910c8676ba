#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Human models on motion capture that none of them was trained on, seen as robots see people: the model card's figures.

    python benchmarks/human_model.py CMU_FOLDER [--models human,other.npz] [--json F] [--plot F.png] [--trials]

Frames of the held-out trials, evenly chosen from each, every one from a camera of its own
(training/people/view_settings.py, but whole in the image and of the captured people's own proportions), lifted one by
one with the camera's intrinsics.
What differs from row to row is the detector's layout, the level of its errors (1: the measured noise profile), the
share of points that it misses and the distance.  Errors are over all points of the detector's layout that the model
has, hidden ones too, and over the 12 joints of the limbs that all layouts have; of the root's position the median is
told.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from msg_adapters import Intrinsics
from paul_ros import metrics
from paul_ros.files import write_atomically
from paul_ros.layout import load_layout
from paul_ros.lifter import Lifted, Lifter
from paul_ros.model import DEFAULT_MODEL, load_model
from training.judge.pictures import COLOURS, new_figure, save_figure, titled
from training.people.human_data import HELD_OUT, Seen, read_clips, see, views_of
from training.people.mocap import human_layout, human_points
from training.recipe import Recipe

LAYOUTS = ("coco17", "body25", "openpose18", "h36m17", "mediapipe33")
FOCAL = 1000.0
"""Pixels: every view is brought to one focal length, as the lifter takes a camera for all persons of a call."""

LIMBS = [
    f"{side}_{joint}" for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for side in ("left", "right")
]


@dataclass(frozen=True)
class Condition:
    """One row: a detector's layout, its level of errors, the share of points missed, distances in metres."""

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


def seen_as(points: np.ndarray, condition: Condition, seed: int = 0) -> Seen:
    """Views of bodies (N,43,3) under a condition."""
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
    return see(points, views, np.random.default_rng(seed))


def lift(lifter: Lifter, seen: Seen) -> tuple[Lifted, Seen]:
    """The persons that were lifted, and what was seen of them."""
    model = lifter.model.layout
    to_model = human_layout().map_to(model)
    rays = seen.cameras.rays(seen.xy)
    xy, _, visible = to_model(FOCAL * rays, seen.confidence, seen.visible)
    lifted = lifter.lift(xy, visible, Intrinsics(FOCAL, FOCAL, 0.0, 0.0, 0, 0))
    ok = lifted.ok
    arrays = {name: getattr(lifted, name)[ok] for name in ("points", "root")}
    return replace(lifted, **arrays), replace(seen, points=seen.points[ok])


def figures(lifter: Lifter, seen: Seen, layout: str) -> dict[str, float]:
    """The errors of one row."""
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
    """Bodies (n,43,3) of evenly chosen frames of every trial that is kept for judging."""
    clips = {name: joints for name, joints in read_clips(folder) if name.startswith(HELD_OUT)}
    if not clips:
        raise SystemExit(f"'{folder}' holds none of the trials that are kept for judging: {', '.join(HELD_OUT)}")
    chosen = {name: np.unique(np.linspace(0, len(clip) - 1, frames).astype(int)) for name, clip in clips.items()}
    return {name: human_points(clips[name][rows]) for name, rows in sorted(chosen.items())}


def measure(models: list[str], trials: dict[str, np.ndarray], each: bool) -> list[dict]:
    """A row for every model and condition; with `each`, for every model and trial too, COCO-17 and true 2D."""
    everybody = np.concatenate(list(trials.values()))
    cases = [(str(condition), everybody, condition) for condition in CONDITIONS]
    cases += [(name, np.repeat(points, 2, axis=0), Condition()) for name, points in trials.items() if each]
    lifters = {name: Lifter(load_model(name)) for name in models}
    lifters["rigid mean shape"] = Lifter(next(iter(lifters.values())).model.rigid())
    rows = []
    for what, points, condition in tqdm(cases, desc="conditions", leave=False):
        seen = seen_as(points, condition)
        rows += [
            {"model": name, "what": what, **figures(lifter, seen, condition.layout)} for name, lifter in lifters.items()
        ]
    return rows


def table(rows: list[dict]) -> str:
    """Markdown."""
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


def draw(rows: list[dict], path: Path) -> None:
    """PA-MPJPE of every model under every condition."""
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
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="motion capture, as training/README.md says")
    parser.add_argument("--models", default=DEFAULT_MODEL, metavar="A,B", help="names or files (default: %(default)s)")
    parser.add_argument("--frames", type=int, default=150, help="of each trial (default: %(default)s)")
    parser.add_argument("--trials", action="store_true", help="a row for every trial too")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all rows")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draw the conditions")
    args = parser.parse_args()
    rows = measure(args.models.split(","), held_out(args.folder, args.frames), args.trials)
    print(table(rows))
    if args.json:
        write_atomically(args.json, json.dumps({"rows": rows}, indent=1).encode())
    if args.plot:
        draw(rows, args.plot)


if __name__ == "__main__":
    main()
