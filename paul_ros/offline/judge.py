# SPDX-License-Identifier: Apache-2.0
"""Judging of a replay: errors against the ground truth, stated doubt against real errors, flips in depth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from paul_ros import metrics
from paul_ros.lifted import AMBIGUOUS, Lifted
from paul_ros.lifter import Lifter
from paul_ros.offline.replay import LiftedFrame, Replay
from paul_ros.versions import versions

#: Keys of a report that hold errors; its baseline has the same.
ERROR_KEYS = (
    "n_mpjpe_mm",
    "pa_mpjpe_mm",
    "ne_flip_frame_percent",
    "ne_flip_global_percent",
    "root_error_median_mm",
    "root_error_median_percent",
)

#: Least number of points with a ground truth for a person to be judged: three fit nearly any shape.
MIN_TRUTH_POINTS = 4

_MM = 1000.0
_FLIP_SHARE = 0.3  # least movement of a flip, and least movement in the image that excuses it, over the person's size
_MIN_TRUTH_EXTENT = 1e-6  # metres; a ground truth with all points in one place is missing

Pairs = Sequence[tuple[Lifted, np.ndarray]]
"""(Lifted of N persons, their ground truth (N,P,3) in metres) of several frames."""


def evaluate(done: Replay) -> dict:
    """Judge a replay.

    Shape errors are means over all points of a lifted person that have a ground truth, hidden points included.

    Returns:
        The report, ready for JSON. A value is None where it cannot be had.

        - bag, model, model_sha256, layout, input_layout, units ('m' or 'model'), damage, versions: what was judged.
        - scale_source: where the scale comes from, or after "none: " why there is none.
        - frames, persons, lifted: counts of messages, of persons in them, and of lifted persons.
        - dropped, noted: reason -> count of discarded, and of odd but used, messages and persons.
        - advice: reason -> what to do about it.
        - persons_with_truth: count of persons that the errors are about.
        - points_with_truth_share: share (0 to 1) of their points that have a ground truth.
        - n_mpjpe_mm: mean point error after scaling, in mm.
        - pa_mpjpe_mm: mean point error after a similarity transform, in mm.
        - ne_flip_frame_percent: normalised error in %, of the better mirror image of each person. Needs metres.
        - ne_flip_global_percent: normalised error in %, of the better mirror image of all together. Needs metres.
        - root_error_median_mm: error of the root's position in mm. Needs metres.
        - root_error_median_percent: the same in % of the distance from the camera. Needs metres.
        - baseline: the same six errors of the model's rigid mean shape.
        - reprojection_median_px: median distance of the lifted points from the keypoints, in pixels.
        - certified_share: share (0 to 1) of lifted persons whose pose is proven optimal.
        - ambiguous_share: share (0 to 1) of lifted persons whose mirror image fits nearly as well.
        - distance_sigma_median_m: median of the stated standard deviation of the distance, in metres.
        - distance_within_1_sigma_share: share (0 to 1) of persons whose distance error is within that deviation.
        - distance_within_2_sigma_share: share (0 to 1) of persons whose distance error is within twice that deviation.
        - pairs_of_frames, flips_per_1000_frames: see `count_flips`.
        - lift_us_median, lift_us_p99: time to lift a message, in microseconds.
    """
    stream = done.stream
    model = stream.lifter.model
    lifts = [frame.lifted for frame in done.frames]
    ok = [lifted.ok for lifted in lifts]
    times = np.array(stream.lift_us) if stream.lift_us else np.full(1, np.nan)
    return {
        "bag": str(done.bag),
        "frames": stream.counts["frames"],
        "persons": stream.counts["persons"],
        "lifted": stream.counts["lifted"],
        "dropped": dict(sorted(stream.ledger.drops.items())),
        "noted": dict(sorted(stream.ledger.notes.items())),
        "advice": dict(sorted(stream.ledger.advice.items())),
        "units": stream.units,
        "scale_source": stream.describe()["scale_source"],
        **error_measures(pairs_with_truth(done, done.frames), done.layout.root),
        "reprojection_median_px": _median([lift.reprojection[good] for lift, good in zip(lifts, ok)]),
        "certified_share": _mean([lift.certified[good] for lift, good in zip(lifts, ok)]),
        "ambiguous_share": _mean([lift.ambiguity[good] >= AMBIGUOUS for lift, good in zip(lifts, ok)]),
        "lift_us_median": _number(np.median(times)),
        "lift_us_p99": _number(np.percentile(times, 99)),
        **_distance_doubt(done),
        **count_flips(done.frames),
        "baseline": error_measures(pairs_with_truth(done, rigid_frames(done)), done.layout.root),
        "model": model.name,
        "model_sha256": model.sha256,
        "layout": done.layout.name,
        "input_layout": stream.route.given.name,
        "damage": str(done.damage) if done.damage else None,
        "versions": versions(),
    }


def rigid_frames(done: Replay) -> list[LiftedFrame]:
    """Return the same frames lifted with the model's mean shape, which is the baseline."""
    rigid = Lifter(done.stream.lifter.model.rigid())
    return [
        replace(
            frame, lifted=done.stream.route.lifted_out(rigid.lift(frame.given.xy, frame.given.visible, frame.camera))
        )
        for frame in done.frames
    ]


def pairs_with_truth(done: Replay, frames: Sequence[LiftedFrame]) -> Pairs:
    """Return the frames whose stamp has a ground truth, each beside it."""
    return [(frame.lifted, done.truth[frame.stamp]) for frame in frames if frame.stamp in done.truth]


# --- errors against the ground truth


def error_measures(pairs: Pairs, root: Sequence[int]) -> dict:
    """Return the errors of lifted persons, with the keys that `evaluate` explains.

    Args:
        pairs: lifted persons beside their ground truth.
        root: indices of the points whose mean is the root.
    """
    both = match_truth(pairs)
    found: dict = {
        "persons_with_truth": len(both.truth),
        "points_with_truth_share": None,
        **dict.fromkeys(ERROR_KEYS),
    }
    if not len(both.truth):
        return found
    found["points_with_truth_share"] = float(both.present.mean())
    found["n_mpjpe_mm"] = _number(_MM * both.distances(metrics.n_mpjpe).mean())
    found["pa_mpjpe_mm"] = _number(_MM * both.distances(metrics.pa_mpjpe).mean())
    if all(lifted.units == "m" for lifted, _ in pairs):
        found.update(_metric_errors(both, list(root)))
    return found


def _metric_errors(both: Matched, root: list[int]) -> dict:
    """Return the errors that need metres: NE, and the root's position for persons whose ground truth has the root."""
    per_frame, for_all = metrics.normalised_error_flip_frame, metrics.normalised_error_flip_global
    found = {
        "ne_flip_frame_percent": _number(100 * per_frame(both.predicted, both.truth).mean()),
        "ne_flip_global_percent": _number(100 * for_all(both.predicted, both.truth).mean()),
    }
    placed = both.present[:, root].all(axis=1)
    if placed.any():
        true_root = both.truth[placed][:, root].mean(1)
        error = np.linalg.norm(both.predicted[placed][:, root].mean(1) - true_root, axis=1)
        found["root_error_median_mm"] = _number(_MM * np.median(error))
        with np.errstate(divide="ignore", invalid="ignore"):  # a truth without position has its root in the camera
            share = error / np.linalg.norm(true_root, axis=1)
        found["root_error_median_percent"] = _number(100 * np.median(share))
    return found


@dataclass(frozen=True)
class Matched:
    """M lifted persons beside their ground truth.

    Attributes:
        predicted: (M,P,3). A point without a ground truth holds the mean of the person's other points, so that it
            moves no centre and has no error.
        truth: (M,P,3) metres, filled in the same way.
        present: (M,P) bool, the points that have a ground truth.
    """

    predicted: np.ndarray
    truth: np.ndarray
    present: np.ndarray

    def distances(self, measure: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
        """Return (M,) values of a measure that is a mean over points, taken over the points with a ground truth."""
        return measure(self.predicted, self.truth) / self.present.mean(axis=1)


def match_truth(pairs: Pairs) -> Matched:
    """Return all lifted persons with MIN_TRUTH_POINTS true points or more that are not all in one place."""
    # Before the first person is seen, the layout may be unknown, and empty arrays have another number of points.
    pairs = [(lifted, truth) for lifted, truth in pairs if len(truth) == len(lifted.points) > 0]
    if not pairs:
        return Matched(np.zeros((0, 1, 3)), np.zeros((0, 1, 3)), np.zeros((0, 1), bool))
    truth = np.concatenate([truth for _, truth in pairs])
    present = np.isfinite(truth).all(axis=2)
    usable = np.concatenate([lifted.ok for lifted, _ in pairs]) & (present.sum(axis=1) >= MIN_TRUTH_POINTS)
    predicted = np.concatenate([lifted.points for lifted, _ in pairs])[usable]
    present = present[usable]
    predicted, truth = metrics.fill_absent(predicted, present), metrics.fill_absent(truth[usable], present)
    sized = np.ptp(truth, axis=1).max(axis=1) > _MIN_TRUTH_EXTENT
    return Matched(predicted[sized], truth[sized], present[sized])


# --- doubt and flips


def _distance_doubt(done: Replay) -> dict:
    """Return the median stated deviation of the distance, and how often the real error is within it."""
    metric = [frame for frame in done.frames if frame.lifted.units == "m"]
    in_sigmas = []
    for frame in metric:
        if len(done.truth.get(frame.stamp, ())) == len(frame.lifted.ok) > 0:
            root = done.truth[frame.stamp][:, list(done.layout.root)].mean(1)
            judged = frame.lifted.ok & np.isfinite(root).all(1)
            error = np.abs(_length(frame.lifted.root) - _length(root))
            in_sigmas.append((error / frame.lifted.distance_sigma)[judged])
    return {
        "distance_sigma_median_m": _median([frame.lifted.distance_sigma[frame.lifted.ok] for frame in metric]),
        "distance_within_1_sigma_share": _mean([errors <= 1 for errors in in_sigmas]),
        "distance_within_2_sigma_share": _mean([errors <= 2 for errors in in_sigmas]),
    }


def count_flips(frames: Sequence[LiftedFrame]) -> dict:
    """Count how often the depth of a tracked person turns over from one frame to the next.

    Only persons with an id that are lifted in two successive frames are counted. The points are taken about their
    mean, and the previous pose is mirrored across the plane that faces the camera. It is a flip if

    - the person is nearer to its previous mirror image than to its previous pose,
    - it has moved by more than 30 % of its size, and
    - it has moved by less than 30 % of its size in the image.

    So a flip is a body that turns front to back, or one that takes its mirror image: the 2D shows neither.

    Returns:
        pairs_of_frames: number of persons in two successive frames.
        flips_per_1000_frames: flips per 1000 such pairs; None without pairs.
    """
    pairs = flips = 0
    before: dict[str, tuple[LiftedFrame, int]] = {}
    for frame in frames:
        now = {name: (frame, row) for row, name in enumerate(frame.keypoints.ids) if name and frame.lifted.ok[row]}
        both = [(before[name], now[name]) for name in now if name in before]
        pairs += len(both)
        flips += sum(_flipped(*pair) for pair in both)
        before = now
    return {"pairs_of_frames": pairs, "flips_per_1000_frames": 1000 * flips / pairs if pairs else None}


def _flipped(before: tuple[LiftedFrame, int], now: tuple[LiftedFrame, int]) -> bool:
    """Return whether a person, given as frame and row, flipped between two frames."""
    old, new = (_about_mean(frame.lifted.points[row]) for frame, row in (before, now))
    frame, row = before
    ray = _viewing_direction(*before)
    mirrored = old - 2 * (old @ ray)[:, None] * ray
    seen_twice = before[0].given.visible[before[1]] & now[0].given.visible[now[1]]
    images = [_about_mean(frame.given.xy[row][seen_twice]) for frame, row in (before, now)]
    still = np.linalg.norm(images[1] - images[0]) < _FLIP_SHARE * np.linalg.norm(images[0])
    moved = np.linalg.norm(new - old)
    return bool(still and np.linalg.norm(new - mirrored) < moved and moved > _FLIP_SHARE * np.linalg.norm(old))


def _viewing_direction(frame: LiftedFrame, row: int) -> np.ndarray:
    """Return the unit direction (3,) in which a person is seen; along z without a camera."""
    ray = np.array([0.0, 0.0, 1.0])
    if frame.lifted.units == "m":
        ray = frame.lifted.root[row]
    elif camera := frame.camera:
        # In model units the root is the origin.
        x, y = frame.given.xy[row][frame.given.visible[row]].mean(0)
        ray = np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0])
    return ray / _length(ray)


def _about_mean(points: np.ndarray) -> np.ndarray:
    return points - points.mean(0)


def _length(vectors: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vectors, axis=-1)


def _median(parts: Sequence[np.ndarray]) -> float | None:
    return _number(np.median(np.concatenate(parts))) if any(map(len, parts)) else None


def _mean(parts: Sequence[np.ndarray]) -> float | None:
    return _number(np.concatenate(parts).mean()) if any(map(len, parts)) else None


def _number(value: float) -> float | None:
    """Return a Python float; None for NaN, which JSON lacks."""
    return float(value) if np.isfinite(value) else None
