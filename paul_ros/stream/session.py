# SPDX-License-Identifier: Apache-2.0
"""The session of a stream: all that it remembers from message to message, whichever model and layouts lift them."""

from __future__ import annotations

from collections import Counter, deque
from typing import Any

from msg_adapters import Intrinsics, Keypoints2D, MessageError, image_size, in_pinhole, read_camera_info
from paul_ros.stream.advice import sentence
from paul_ros.stream.depth import DepthBuffer
from paul_ros.stream.image_bounds import ImageBounds
from paul_ros.stream.ledger import Ledger
from paul_ros.stream.person_ids import PersonIds
from paul_ros.stream.reasons import REASONS

_LIFT_TIMES_KEPT = 1000
"""Number of lift times kept for the median and the 99th percentile: the last half minute at 30 Hz."""


class Session:
    """The camera, its depth images and all counts. A stream with another model or layout continues the same session.

    Attributes:
        intrinsics: of the last usable CameraInfo; None before the first.
        image_size: width and height in pixels of the image of the last CameraInfo, calibrated or not; None before the
            first.
        image: the image of the keypoints: 'auto', 'rectified' or 'raw'; see `read_camera_info`.
        camera_frame: frame_id of the last CameraInfo; '' before the first.
        depths: the last depth images.
        person_ids: who is who.
        ledger: counts of drops and notes.
        counts: numbers of frames, of their persons, and of the persons that were lifted.
        lift_us: the last lift times in microseconds, of frames with persons.
    """

    def __init__(self, person_ids: PersonIds | None = None) -> None:
        """Begin a session; `person_ids` are those of an earlier session in this process, if there was one."""
        self.intrinsics: Intrinsics | None = None
        self.image_size: tuple[int, int] | None = None
        self.image = "auto"
        self.camera_frame = ""
        self.depths = DepthBuffer()
        self.person_ids = person_ids or PersonIds()
        self.ledger = Ledger()
        self.counts: Counter[str] = Counter(frames=0, persons=0, lifted=0)
        self.lift_us: deque[float] = deque(maxlen=_LIFT_TIMES_KEPT)
        self._last_stamp: int | None = None
        self._last_frame = ""
        self._camera_info: Any = None
        self._bounds = ImageBounds()

    def take_camera_info(self, msg: Any) -> None:
        """Store the camera of a CameraInfo.

        Raises:
            MessageError: the intrinsics are unusable. Size and frame are stored, and earlier intrinsics stay in use.
        """
        self.camera_frame = str(msg.header.frame_id)
        # An uncalibrated camera has a size too.
        self.image_size = image_size(msg)
        self.take_camera(read_camera_info(msg, self.image))
        self._camera_info = msg

    def take_camera(self, camera: Intrinsics) -> None:
        """Use a camera from now on. Count its notes only if they are new: CameraInfo comes with each image."""
        known = self.intrinsics.notes if self.intrinsics else ()
        for note in camera.notes:
            if note not in known:
                self.ledger.note(note.reason, sentence(note.text))
        self.intrinsics, self.image_size = camera, (camera.width, camera.height)

    def choose_image(self, image: str) -> None:
        """Take another image for that of the keypoints; the last usable CameraInfo is read again."""
        if image == self.image:
            return
        self.image = image
        if self._camera_info is not None:
            try:
                self.take_camera(read_camera_info(self._camera_info, image))
            except MessageError as error:
                self.ledger.drop(error.reason, str(error))

    def in_pinhole(self, keypoints: Keypoints2D, min_confidence: float) -> Keypoints2D:
        """Compare keypoints, as the adapter read them, with the image, and correct the distortion of the camera."""
        if self.image_size:
            self._bounds.check(keypoints, min_confidence, self.image_size, self.ledger)
        corrected = in_pinhole(keypoints, self.intrinsics)
        if corrected is not keypoints:
            hidden = int(keypoints.visible.sum() - corrected.visible.sum())
            self.ledger.note("no_ray", REASONS["no_ray"].advice, hidden)
        return corrected

    def check_header(self, stamp: int, frame_id: str) -> None:
        """Note a stamp (nanoseconds) that runs backwards, and a frame that is not the camera's or changes."""
        if self._last_stamp is not None and stamp < self._last_stamp:
            self.ledger.note("stamp_backwards")
        self._last_stamp = stamp
        # The image and the CameraInfo of one camera have one frame, its optical frame (REP-104).
        if self.camera_frame:
            if frame_id != self.camera_frame:
                self.ledger.note(
                    "another_frame",
                    f"The keypoints' frame_id is {frame_id!r}, CameraInfo's {self.camera_frame!r}. "
                    f"{REASONS['another_frame'].fix}",
                )
        elif self._last_frame and frame_id and frame_id != self._last_frame:
            self.ledger.note(
                "frame_changed",
                f"The keypoints' frame_id changed from {self._last_frame!r} to {frame_id!r}. "
                f"{REASONS['frame_changed'].fix}",
            )
        self._last_frame = frame_id or self._last_frame
