# SPDX-License-Identifier: Apache-2.0
"""Judging of a replay: errors against the ground truth, stated doubt against real errors, flips in depth."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from paul_ros.lifted import AMBIGUOUS
from paul_ros.lifter import Lifter
from paul_ros.offline import truth_units
from paul_ros.offline.depth_flips import FlipCounter
from paul_ros.offline.replay import LiftedFrame, Replay
from paul_ros.offline.truth_errors import ERROR_KEYS, TruthErrors, number
from paul_ros.stream.stream import LiftStream
from paul_ros.versions import versions

_BATCH = 256
"""Frames that are compared with their truth at once."""

_PATIENCE = 60_000_000_000
"""Nanoseconds of stamps by which a frame and its ground truth may come apart, if the later one goes on meanwhile."""

_NE_KEYS = ("ne_flip_frame_percent", "ne_flip_global_percent")
_ROOT_KEYS = ("root_error_median_mm", "root_error_median_percent")
_DISTANCE_KEYS = ("distance_within_1_sigma_share", "distance_within_2_sigma_share")
_METRIC_KEYS = (*_NE_KEYS, *_ROOT_KEYS, "distance_sigma_median_m", *_DISTANCE_KEYS)
_ALL_KEYS = (
    *("n_mpjpe_mm", "pa_mpjpe_mm", "points_with_truth_share", *_METRIC_KEYS, "flips_per_1000_frames"),
    *("reprojection_median_px", "certified_share", "ambiguous_share", "lift_us_median", "lift_us_p99"),
)


class Judge:
    """Judges the frames of a bag while it is replayed, and keeps a few numbers for each person."""

    def __init__(self, stream: LiftStream, expects_truth: bool) -> None:
        """Make a judge.

        Args:
            stream: that lifts the bag.
            expects_truth: whether frames are to wait for a ground truth that comes after them.
        """
        self._stream, self._expects_truth = stream, expects_truth
        self._rigid = Lifter(stream.lifter.model.rigid())
        self._waiting: dict[int, list[LiftedFrame]] = {}
        self._truth: dict[int, np.ndarray] = {}
        self._batch: list[tuple[LiftedFrame, np.ndarray]] = []
        self._errors, self._rigid_errors, self._flips = TruthErrors(), TruthErrors(), FlipCounter()
        self._frames_in_metres = self._frames_without_metres = 0
        self._certified = self._ambiguous = 0
        self._reprojection, self._sigma, self._in_sigmas = array("d"), array("d"), array("d")
        self._sizes, self._angles, self._truths = array("d"), array("d"), 0

    def add_frame(self, frame: LiftedFrame) -> None:
        """Take the next frame; it waits for its ground truth if that has not come."""
        self._count(frame)
        if not frame.lifted.ok.any():
            return
        if frame.stamp in self._truth:
            self.add_pair(frame, self._truth[frame.stamp])
        elif self._expects_truth:
            self._waiting.setdefault(frame.stamp, []).append(frame)
        _forget(self._truth, frame.stamp - _PATIENCE)

    def add_truth(self, stamp: int, points: np.ndarray) -> None:
        """Take a ground truth (N,P,3); it waits for its frame if that has not come."""
        frames = self._waiting.pop(stamp, [])
        for frame in frames:
            self.add_pair(frame, points)
        if not frames:
            self._truth[stamp] = points
        _forget(self._waiting, stamp - _PATIENCE)

    def add_pair(self, frame: LiftedFrame, truth: np.ndarray) -> None:
        """Compare a frame with its ground truth (N,P,3)."""
        self._batch.append((frame, truth))
        if len(self._batch) >= _BATCH:
            self._judge_batch()

    def report(self, done: Replay) -> dict:
        """Return what `evaluate` explains."""
        self._judge_batch()
        self._check_truth(done)
        stream, described = self._stream, self._stream.describe()
        model, lifted = stream.lifter.model, len(self._reprojection)
        report = {
            "bag": str(done.bag),
            "keypoints_topic": done.topics.keypoints,
            "camera_info_topic": done.topics.camera_info,
            "frames": stream.counts["frames"],
            "persons": stream.counts["persons"],
            "lifted": stream.counts["lifted"],
            "frames_without_metres": self._frames_without_metres,
            "dropped": dict(sorted(stream.ledger.drops.items())),
            "noted": dict(sorted(stream.ledger.notes.items())),
            "advice": dict(sorted(stream.ledger.advice.items())),
            "units": self._units(),
            **{key: described[key] for key in ("image", "distortion", "scale_source")},
            **self._errors.report(),
            "reprojection_median_px": _median(self._reprojection),
            "certified_share": self._certified / lifted if lifted else None,
            "ambiguous_share": self._ambiguous / lifted if lifted else None,
            "lift_us_median": _median(stream.lift_us),
            "lift_us_p99": number(np.percentile(stream.lift_us, 99)) if stream.lift_us else None,
            "distance_sigma_median_m": _median(self._sigma),
            **dict(zip(_DISTANCE_KEYS, (_share_within(self._in_sigmas, sigmas) for sigmas in (1, 2)))),
            **self._flips.report(),
            "baseline": self._rigid_errors.report(),
            "model": model.name,
            "model_sha256": model.sha256,
            "layout": done.layout.name,
            "input_layout": stream.route.given.name,
            "damage": str(done.damage) if done.damage else None,
            "versions": versions(),
        }
        return {**report, "unavailable": {key: why for key, why in self._whys(done).items() if report[key] is None}}

    def _count(self, frame: LiftedFrame) -> None:
        """Take the figures that need no truth."""
        self._flips.add(frame)
        lifted, ok = frame.lifted, frame.lifted.ok
        if not ok.any():
            return
        self._certified += int(lifted.certified[ok].sum())
        self._ambiguous += int((lifted.ambiguity[ok] >= AMBIGUOUS).sum())
        self._reprojection.extend(lifted.reprojection[ok].tolist())
        if lifted.units == "m":
            self._frames_in_metres += 1
            self._sigma.extend(lifted.distance_sigma[ok].tolist())
        else:
            self._frames_without_metres += 1

    def _judge_batch(self) -> None:
        route = self._stream.route
        root = route.output.root
        self._errors.add([(frame.lifted, truth) for frame, truth in self._batch], root)
        rigid = [(rigid_frame(frame, self._rigid, self._stream).lifted, truth) for frame, truth in self._batch]
        self._rigid_errors.add(rigid, root)
        metres = self._stream.lifter.metres_per_unit
        self._truths += len(self._batch)
        for frame, truth in self._batch:
            self._sizes.extend(truth_units.size_ratios(frame.lifted, truth, metres))
            self._angles.extend(truth_units.angles_between(frame.lifted, truth))
            self._in_sigmas.extend(_errors_in_sigmas(frame, truth, root).tolist())
        self._batch.clear()

    def _check_truth(self, done: Replay) -> None:
        """Discard a ground truth that is not in metres, and the errors against it; note one of another frame."""
        if problem := truth_units.problem(self._sizes):
            self._stream.ledger.drop("truth_not_metres", problem, self._truths)
            self._errors, self._rigid_errors, self._in_sigmas = TruthErrors(), TruthErrors(), array("d")
            self._sizes = array("d")
            done.truth.clear()
        elif problem := truth_units.frame_problem(self._angles):
            self._stream.ledger.note("truth_of_another_frame", problem, self._truths)
        self._angles = array("d")

    def _units(self) -> str:
        if self._frames_in_metres and self._frames_without_metres:
            return "mixed"
        if self._frames_in_metres or self._frames_without_metres:
            return "m" if self._frames_in_metres else "model"
        return self._stream.units

    def _whys(self, done: Replay) -> dict[str, str]:
        """Return why each figure would be None, in a few words."""
        if not self._reprojection:
            return dict.fromkeys(_ALL_KEYS, "nobody was lifted")
        no_pairs = "no person was lifted in two successive frames" if self._flips.named else "no person has an id"
        no_metres = dict.fromkeys(_METRIC_KEYS, f"no metres: {_no_metres(done)}") if not self._frames_in_metres else {}
        if not self._errors.persons:
            no_truth = dict.fromkeys((*ERROR_KEYS, "points_with_truth_share", *_DISTANCE_KEYS), _no_truth(done))
            return {"flips_per_1000_frames": no_pairs, **no_metres, **no_truth}
        no_root = dict.fromkeys((*_ROOT_KEYS, *_DISTANCE_KEYS), "the ground truth lacks the root")
        no_metric_truth = dict.fromkeys(_NE_KEYS, "nobody with a ground truth was lifted in metres")
        return {"flips_per_1000_frames": no_pairs, **no_root, **no_metric_truth, **no_metres}


def evaluate(done: Replay) -> dict:
    """Judge a replay that kept all frames.

    Shape errors are means over all points of a lifted person that have a ground truth, hidden points included. Figures
    that need metres leave out the persons of frames without metres.

    Returns:
        The report, ready for JSON. A value is None where it cannot be had.

        - bag, model, model_sha256, layout, input_layout, damage, versions: what was judged.
        - keypoints_topic, camera_info_topic: the topics that were read; None = the bag has no CameraInfo.
        - units: 'm', 'model', or 'mixed' if some frames with lifted persons had no metres.
        - image, distortion: which image the keypoints are taken to lie in, 'raw' or 'rectified', and what is done about
          its distortion; None without a camera.
        - scale_source: where the scale comes from, or after "none: " why there is none.
        - frames, persons, lifted: counts of messages, of persons in them, and of lifted persons.
        - frames_without_metres: count of frames whose persons were lifted in model units.
        - dropped, noted: reason -> count of discarded, and of odd but used, messages and persons.
        - advice: reason -> what to do about it.
        - persons_with_truth: count of persons that the errors are about.
        - persons_with_truth_in_metres: count of those that the errors in metres are about.
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
        - distance_sigma_median_m: median of the stated standard deviation of the distance, in metres. Needs metres.
        - distance_within_1_sigma_share: share (0 to 1) of persons whose distance error is within that deviation.
        - distance_within_2_sigma_share: share (0 to 1) of persons whose distance error is within twice that deviation.
        - pairs_of_frames, flips_per_1000_frames: see `FlipCounter`.
        - lift_us_median, lift_us_p99: time to lift a message, in microseconds.
        - unavailable: key of a figure that is None -> why.
    """
    judge = Judge(done.stream, expects_truth=False)
    for frame in done.frames:
        judge.add_frame(frame)
        if frame.stamp in done.truth:
            judge.add_pair(frame, done.truth[frame.stamp])
    return judge.report(done)


def rigid_frame(frame: LiftedFrame, rigid: Lifter, stream: LiftStream) -> LiftedFrame:
    """Return the same frame lifted with the model's rigid mean shape, which is the baseline."""
    lifted = rigid.lift(frame.given.xy, frame.given.visible, frame.camera)
    return replace(frame, lifted=stream.route.lifted_out(lifted))


def rigid_frames(done: Replay) -> list[LiftedFrame]:
    """Return all kept frames of a replay lifted with the model's rigid mean shape."""
    rigid = Lifter(done.stream.lifter.model.rigid())
    return [rigid_frame(frame, rigid, done.stream) for frame in done.frames]


def _errors_in_sigmas(frame: LiftedFrame, truth: np.ndarray, root: Sequence[int]) -> np.ndarray:
    """Return the errors of the distances of a frame's persons over their stated deviations; none in model units."""
    lifted = frame.lifted
    if lifted.units != "m" or len(truth) != len(lifted.ok) or not lifted.ok.any():
        return np.zeros(0)
    true_root = truth[:, list(root)].mean(1)
    judged = lifted.ok & np.isfinite(true_root).all(1)
    error = np.abs(np.linalg.norm(lifted.root, axis=-1) - np.linalg.norm(true_root, axis=-1))
    return (error / lifted.distance_sigma)[judged]


def _forget(waiting: dict[int, Any], before: int) -> None:
    """Drop the oldest entries with a stamp before the given one."""
    while waiting and (stamp := next(iter(waiting))) < before:
        del waiting[stamp]


def _no_metres(done: Replay) -> str:
    """Return why no person was lifted in metres."""
    if done.stream.lifter.model.metres_per_unit is None:
        return "the model does not know its size"
    return "no usable CameraInfo came before the keypoints" if done.topics.camera_info else "the bag has no CameraInfo"


def _no_truth(done: Replay) -> str:
    """Return why no lifted person has a ground truth."""
    if done.topics.truth is None:
        return "the bag has no ground truth"
    return f"{done.topics.truth} has none for the lifted persons"


def _median(values: Sequence[float]) -> float | None:
    return number(np.median(np.asarray(values))) if len(values) else None


def _share_within(values: Sequence[float], most: float) -> float | None:
    return float((np.asarray(values) <= most).mean()) if len(values) else None
