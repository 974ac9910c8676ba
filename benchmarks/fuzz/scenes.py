# SPDX-License-Identifier: Apache-2.0
"""Scenes of known truth: what is lifted must stand where it stands, or a note or a drop must say why it does not.

The camera here is an independent forward model: it bends, crops and bins the image as sensor_msgs/CameraInfo and the
pages of OpenCV's calib3d describe. Nothing of the package's own camera code is used.
"""

from __future__ import annotations

import array
import random
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import foreign_messages as foreign
import numpy as np

from benchmarks.fuzz.bench import Bench
from benchmarks.fuzz.messages import BUILDERS, Make, Pose, header
from benchmarks.fuzz.tally import Tally
from paul_ros.layout import load_layout
from paul_ros.lifter import Lifter
from paul_ros.stream.stream import LiftStream

TOLERANCE = 0.10
"""Largest error of a root over its distance, for the model's own mean shape. Without faults 99.9 % are below 0.06."""

_FULL = (1280, 960)
_CALM = {"depth_used", "image_assumed"}
"""Notes that no wrong place can hide behind."""

FAULTS = ("none", "none", "none", "enlarged", "normalised", "percent", "same_ids", "other_order", "text_ids")
"""Faults of a message, each as likely."""

_FAMILIES = (foreign.CLOUD, foreign.YOLO, foreign.AI, foreign.ZED)
_POSSIBLE = {
    "percent": (foreign.CLOUD, foreign.YOLO),
    "text_ids": (foreign.YOLO,),
    # These families neither name nor number the points, or their layout was stated.
    "other_order": (foreign.CLOUD, foreign.YOLO),
}
"""Fault -> types of messages that can have it; other faults suit all."""

_TEXTS = ("ab12c", "qwert", "zzzzz", "person")


@dataclass(frozen=True)
class TrueCamera:
    """A camera whose images are known.

    Attributes:
        focal, centre: of the full image, in pixels.
        model, d: distortion.
        raw: whether the keypoints are of the raw image.
        rectified_focal: focal length of P; 0 if P is not filled.
        binning: pixels that are joined, in x and in y.
        roi: x, y, width and height of the window; zeros for the whole image.
    """

    focal: float
    centre: tuple[float, float]
    model: str
    d: tuple[float, ...]
    raw: bool
    rectified_focal: float
    binning: tuple[int, int]
    roi: tuple[int, int, int, int]

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the delivered image."""
        width, height = self.roi[2:] if any(self.roi) else _FULL
        return width / max(self.binning[0], 1), height / max(self.binning[1], 1)

    def image(self, points: np.ndarray) -> np.ndarray:
        """Return the pixels (...,2) of points (...,3) in the delivered image."""
        x, y = (points[..., :2] / points[..., 2:]).transpose()
        focal = self.focal if self.raw or not self.rectified_focal else self.rectified_focal
        if self.raw:
            x, y = distorted(x, y, self.model, self.d)
        full = focal * np.stack([x, y]).transpose() + self.centre
        return (full - self.roi[:2]) / np.maximum(self.binning, 1)

    def info(self, make: Make, head: Any) -> Any:
        """Return the CameraInfo of this camera."""
        (cx, cy), (left, top, width, height) = self.centre, self.roi
        k = [self.focal, 0.0, cx, 0.0, self.focal, cy, 0.0, 0.0, 1.0]
        f = self.rectified_focal
        p = [f, 0.0, cx, 0.0, 0.0, f, cy, 0.0, 0.0, 0.0, 1.0, 0.0] if f else [0.0] * 12
        region = make(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=left, y_offset=top, width=width, height=height, do_rectify=bool(width),
        )  # fmt: skip
        return make(
            "sensor_msgs/msg/CameraInfo", header=head, width=_FULL[0], height=_FULL[1], distortion_model=self.model,
            d=np.array(self.d), k=np.array(k), r=np.eye(3).ravel(), p=np.array(p),
            binning_x=self.binning[0], binning_y=self.binning[1], roi=region,
        )  # fmt: skip


def distorted(x: Any, y: Any, model: str, d: tuple[float, ...]) -> tuple[Any, Any]:
    """Bend a ray (x, y, 1) as a lens does: OpenCV, calib3d and fisheye, "Detailed Description"."""
    r = np.hypot(x, y)
    if model == "equidistant":
        angle = np.arctan(r)
        bent = angle * (1 + sum(k * angle ** (2 * power) for power, k in enumerate(d, 1)))
        factor = np.where(r > 1e-12, bent / np.maximum(r, 1e-12), 1.0)
        return x * factor, y * factor
    k1, k2, p1, p2, k3, k4, k5, k6 = (*d, *[0.0] * 8)[:8]
    q = r * r
    radial = (1 + k1 * q + k2 * q**2 + k3 * q**3) / (1 + k4 * q + k5 * q**2 + k6 * q**3)
    return (
        x * radial + 2 * p1 * x * y + p2 * (q + 2 * x * x),
        y * radial + p1 * (q + 2 * y * y) + 2 * p2 * x * y,
    )


def random_camera(rng: random.Random) -> TrueCamera:
    """Return a camera whose CameraInfo states all that it does."""
    focal = rng.uniform(500, 1300)
    model, d = rng.choice((("plumb_bob", 5), ("rational_polynomial", 8), ("equidistant", 4)))[:2]
    bent = rng.random() < 0.7
    numbers = [0.0] * d
    if bent:
        numbers = [rng.uniform(-0.06, 0.03) for _ in numbers] if model != "plumb_bob" else numbers
        if model != "equidistant":
            numbers[0] = rng.uniform(-0.25, 0.1)
            numbers[1] = rng.uniform(-0.02, 0.05)
            numbers[2], numbers[3] = rng.uniform(-0.002, 0.002), rng.uniform(-0.002, 0.002)
    raw = rng.random() < 0.6
    # P is not filled, is a copy of K, or is that of a rectified image.
    copied = rng.choice((0.0, focal))
    rectified_focal = copied if raw else focal * rng.uniform(0.75, 0.95)
    binning = rng.choice(((0, 0), (0, 0), (1, 1), (2, 2), (4, 4)))
    roi = rng.choice(((0, 0, 0, 0), (0, 0, 0, 0), (160, 80, 960, 800)))
    centre = (640 + rng.uniform(-40, 40), 480 + rng.uniform(-40, 40))
    return TrueCamera(focal, centre, model, tuple(numbers), raw, rectified_focal, binning, roi)


@dataclass
class Truth:
    """The content of one image.

    Attributes:
        fault: what is wrong with its message.
        roots: (N,3) metres.
        ids: of the persons, as sent.
        detectable: whether the message shows that it has the fault.
    """

    fault: str
    roots: np.ndarray
    ids: list[str]
    detectable: bool = True


@dataclass
class Scene:
    """A camera, a stream that was told of it, and what was sent."""

    camera: TrueCamera
    stream: LiftStream
    names: list[str]
    mean: np.ndarray
    root: list[int]
    truths: dict[int, Truth] = field(default_factory=dict)
    numbers: dict[str, float] = field(default_factory=dict)


def scene_session(bench: Bench, rng: random.Random, tally: Tally, cases: int, where: str) -> None:
    """Send scenes of one camera in messages of one type, some with a fault, and judge what comes out."""
    make = rng.choice((bench.live, bench.bag))
    type_name = rng.choice(_FAMILIES)
    camera = random_camera(rng)
    told = "auto" if rng.random() < 0.7 else "raw" if camera.raw else "rectified"
    # The shape of a rigid model is known exactly, so that every error is one of reading.
    model = bench.model.rigid()
    stream = LiftStream(Lifter(model), load_layout("coco17") if type_name == foreign.CLOUD else None, 0.3, 64)
    stream.session.choose_image(told)
    root = list(model.layout.root)
    shape = (model.mean_shape * model.metres_per_unit).T
    scene = Scene(camera, stream, list(model.layout.names), shape - shape[root].mean(0), root)
    stream.camera_info(camera.info(make, header(make, rng, 0)))
    where = f"{where} {type_name} {'raw' if camera.raw else 'rectified'} {told} {camera.model}"
    for number in range(1, cases + 1):
        fault = rng.choice(FAULTS)
        notes, drops = Counter(stream.ledger.notes), Counter(stream.ledger.drops)
        tally.cases += 1
        try:
            message, truth = _message(scene, make, type_name, number, fault, rng)
            frame = stream.keypoints(type_name, message).frame
            dropped = Counter(stream.ledger.drops) - drops
            noted = Counter(stream.ledger.notes) - notes
            tally.drops(dropped)
            tally.reasons += noted
            judge(scene, truth, frame, noted, dropped, bench, tally, f"{where} case {number} {truth.fault}")
        except Exception:
            tally.crash(f"{where} {fault}")


def _message(
    scene: Scene, make: Make, type_name: str, number: int, fault: str, rng: random.Random
) -> tuple[Any, Truth]:
    """Build a message of a few persons with a fault; a fault that the type cannot have becomes none."""
    if type_name not in _POSSIBLE.get(fault, _FAMILIES):
        fault = "none"
    bodies = [_standing(scene, rng) for _ in range(rng.choice((1, 1, 2, 3)))]
    if fault == "same_ids" and len(bodies) < 2:
        bodies.append(_standing(scene, rng))
    pixels = [scene.camera.image(body) for body in bodies]
    truth = Truth(fault, np.array([body[scene.root].mean(0) for body in bodies]), [str(n) for n in range(len(bodies))])
    width, height = scene.camera.size
    if fault == "enlarged":
        factor = rng.choice((1.5, 2.0, 3.0))
        pixels = [factor * xy for xy in pixels]
        beyond = [(xy > np.array([width, height]) * 1.15).any(1).mean() for xy in pixels]
        truth.detectable = np.mean(beyond) > 0.3
    if fault == "normalised":
        pixels = [xy / (width, height) for xy in pixels]
    poses = [dict(zip(scene.names, map(tuple, xy.tolist()))) for xy in pixels]
    if fault == "other_order":
        poses = [_shuffled(pose, rng) for pose in poses]
    message = BUILDERS[type_name](make, header(make, rng, number), poses, rng)
    if fault == "percent":
        _scale_confidence(message, type_name)
    if fault in ("same_ids", "text_ids"):
        truth.ids = ["7"] * len(bodies) if fault == "same_ids" else rng.sample(_TEXTS, len(bodies))
        _rename(message, type_name, truth.ids)
    return message, truth


def _standing(scene: Scene, rng: random.Random) -> np.ndarray:
    """Return the mean person (P,3), upright, somewhere in the delivered image."""
    for _ in range(200):
        z = rng.uniform(2.5, 8)
        place = np.array([z * rng.uniform(-0.6, 0.6), z * rng.uniform(-0.3, 0.3), z])
        turn = rng.uniform(0, 2 * np.pi)
        about_y = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
        body = scene.mean @ about_y.T + place
        xy = scene.camera.image(body)
        if ((xy > 2) & (xy < np.array(scene.camera.size) - 2)).all() and np.ptp(xy[:, 1]) > 40:
            return body
    return scene.mean + (0, 0, 8.0)


def _shuffled(pose: Pose, rng: random.Random) -> Pose:
    """Return a pose whose points have each other's names: the head is where the feet are."""
    names = list(pose)
    others = names[len(names) // 2 :] + names[: len(names) // 2]
    rng.shuffle(others)
    return {name: pose[other] for name, other in zip(names, others)}


def _scale_confidence(message: Any, type_name: str) -> None:
    """Give confidences in per cent."""
    if type_name == foreign.YOLO:
        for detection in message.detections:
            for keypoint in detection.keypoints.data:
                object.__setattr__(keypoint, "score", 90.0)
        return
    _put_column(message, "confidence", 90.0)


def _put_column(message: Any, name: str, values: Any) -> None:
    """Set a field of a PointCloud2 of float32 for all points."""
    column = [each.name for each in message.fields].index(name)
    data = np.frombuffer(bytes(message.data), "<f4").reshape(message.height, message.width, -1).copy()
    data[..., column] = values
    octets = data.tobytes()
    live = isinstance(message.data, array.array)
    object.__setattr__(message, "data", array.array("B", octets) if live else np.frombuffer(octets, np.uint8))


def _rename(message: Any, type_name: str, ids: list[str]) -> None:
    """Give the persons of a message these ids."""
    if type_name == foreign.CLOUD:
        _put_column(message, "person_id", np.array(ids, float)[:, None])
        return
    persons = {foreign.YOLO: "detections", foreign.AI: "targets", foreign.ZED: "objects"}[type_name]
    attribute = {foreign.YOLO: "id", foreign.AI: "track_id", foreign.ZED: "label_id"}[type_name]
    for person, name in zip(getattr(message, persons), ids):
        object.__setattr__(person, attribute, name if type_name == foreign.YOLO else int(name))


def judge(
    scene: Scene,
    truth: Truth,
    frame: Any,
    noted: Counter[str],
    dropped: Counter[str],
    bench: Bench,
    tally: Tally,
    where: str,
) -> None:
    """Compare a frame with the truth; a difference that nothing explains is a misreading."""
    explained = set(noted) - _CALM | set(dropped)
    if frame is None:
        if not dropped:
            tally.lost(where, "a message is neither a frame nor a drop")
        if truth.fault == "none":
            tally.misread(where, f"a message without fault is dropped: {dict(dropped)}")
        return
    ok, roots = frame.lifted.ok, frame.lifted.root
    if len(ok) != len(truth.roots):
        tally.misread(where, f"{len(truth.roots)} persons were sent, {len(ok)} read")
        return
    if truth.fault in ("none", "text_ids"):
        if not ok.all() or frame.lifted.units != "m":
            tally.misread(where, f"persons without fault are not in metres: {frame.lifted.reason} {dict(noted)}")
        elif explained:
            tally.misread(where, f"a false alarm: {sorted(explained)}")
    elif truth.fault in ("normalised", "percent", "same_ids", "other_order") and not explained:
        tally.misread(where, "a fault without a note or a drop")
    elif truth.fault == "enlarged" and truth.detectable and not explained:
        tally.misread(where, "an image of another size without a note")
    if frame.lifted.units == "m" and not explained and truth.detectable:
        error = np.linalg.norm(roots[ok] - truth.roots[ok], axis=1) / np.linalg.norm(truth.roots[ok], axis=1)
        if (error > TOLERANCE).any():
            tally.misread(where, f"a root is {100 * error.max():.0f} % of its distance off")
    _judge_ids(scene, truth, frame, bench, tally, where)


def _judge_ids(scene: Scene, truth: Truth, frame: Any, bench: Bench, tally: Tally, where: str) -> None:
    """Check that no two persons share a transform or a number, and that a text keeps its number."""
    built = bench.objects.messages(frame, ["keypoints3d", "transforms"])
    names = [transform.child_frame_id for transform in built["transforms"].transforms]
    if len(set(names)) < len(names):
        tally.misread(where, f"two transforms have one name: {names}")
    cloud = built["keypoints3d"]
    if not cloud.height:
        return
    values = np.frombuffer(bytes(cloud.data), "<f4").reshape(cloud.height, cloud.width, -1)
    numbers = values[:, 0, [each.name for each in cloud.fields].index("person_id")].tolist()
    known = [number for number in numbers if number >= 0]
    if truth.fault == "text_ids" and frame.lifted.ok.all():
        for name, number in zip(truth.ids, numbers):
            if scene.numbers.setdefault(name, number) != number:
                tally.misread(where, f"the number of {name} changed from {scene.numbers[name]} to {number}")
        if len(set(numbers)) < len(numbers):
            tally.misread(where, f"two persons share a number: {numbers}")
    elif len(set(known)) < len(known):
        tally.misread(where, f"two persons share a number: {numbers}")
