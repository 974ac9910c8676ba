# SPDX-License-Identifier: Apache-2.0
"""The table of all reasons by which a stream counts drops and notes; documentation and runtime advice come from it."""

from __future__ import annotations

from dataclasses import dataclass

from paul_ros.lifted import MAX_DISTANCE

DROP = "drop"
"""Kind: a whole message was not used."""

PERSON = "person"
"""Kind: one person was left out of the outputs; the others of its message were lifted."""

NOTE = "note"
"""Kind: something was irregular or worth counting, but was used."""


@dataclass(frozen=True)
class Reason:
    """One reason.

    Attributes:
        slug: key in the ledger, in JSON reports and, after ``dropped_`` or ``noted_``, in /diagnostics.
        kind: DROP, PERSON or NOTE.
        what: what happened, one sentence without a full stop.
        fix: what to do, one or two sentences.
    """

    slug: str
    kind: str
    what: str
    fix: str

    @property
    def advice(self) -> str:
        """Both sentences, for a log line or a report."""
        return f"{self.what}. {self.fix}"


_ALL = (
    # --- messages of keypoints that cannot be read
    Reason(
        "unknown_type",
        DROP,
        "No adapter reads this message type",
        "Publish one of the supported types, or install a package with an adapter for yours.",
    ),
    Reason(
        "damaged_bytes",
        DROP,
        "The serialised PointCloud2 cannot be decoded",
        "Run the same ROS distribution on every machine.",
    ),
    Reason(
        "undecodable",
        DROP,
        "A message in the bag does not decode as the type that the bag states",
        "Record the bag again, or check that its message definitions are those of the publisher.",
    ),
    Reason(
        "wrong_point_count",
        DROP,
        "The number of keypoints differs from the layout's",
        "Set `layout` (paul: `--layout`) to the layout of your detector, or to the path of your own layout file.",
    ),
    Reason(
        "layout_unknown",
        DROP,
        "A message holds one list of keypoints that may be one body or several, and the layout is not known yet",
        "Set `layout` to the layout of your detector. A message with one person makes it known too.",
    ),
    Reason(
        "no_common_names",
        DROP,
        "The message names keypoints, and the layout has none of them",
        "Set `layout` (paul: `--layout`) to a layout of the same kind of object.",
    ),
    Reason(
        "not_2d",
        DROP,
        "The message holds 3D points",
        "Remap `keypoints` to 2D keypoints: x and y in pixels. In a PoseArray z is the confidence.",
    ),
    Reason(
        "wrong_fields",
        DROP,
        "The fields of the PointCloud2 are not those of 2D keypoints",
        "Send x and y, and optionally confidence and person_id, each as one number per point.",
    ),
    Reason(
        "wrong_steps",
        DROP,
        "The point_step, the row_step or a field's offset contradicts the fields of the PointCloud2",
        "Correct the publisher: fields must lie inside a point, and rows must hold all points.",
    ),
    Reason(
        "truncated_data",
        DROP,
        "The data of a PointCloud2 or depth image is shorter than its stated size",
        "Correct the publisher or the camera's driver.",
    ),
    Reason(
        "wrong_keypoint_id",
        DROP,
        "A keypoint id is lower than 1; yolo_msgs counts from 1",
        "Correct the detector.",
    ),
    Reason(
        "wrong_confidence_count",
        DROP,
        "The number of confidences differs from the number of keypoints",
        "Send one confidence per keypoint, or none.",
    ),
    Reason(
        "unknown_body_format",
        DROP,
        "The ZED wrapper uses a body_format that is not known",
        "Set its body_format to 18, 34 or 38 points.",
    ),
    Reason(
        "wrong_skeleton_size",
        DROP,
        "The number of keypoints is not that of hri_msgs/Skeleton2D",
        "Send all 18 keypoints, with those that were not detected marked as missing.",
    ),
    Reason(
        "not_normalised",
        DROP,
        "Coordinates of hri_msgs/Skeleton2D lie outside 0..1",
        "Divide x by the image's width and y by its height.",
    ),
    Reason(
        "normalised",
        DROP,
        "All keypoints of a message lie within 0..1, where pixels are expected",
        "Multiply x by the image's width and y by its height in the detector.",
    ),
    Reason(
        "no_image_size",
        DROP,
        "Keypoints of hri_msgs/Skeleton2D need the image size, and no CameraInfo has come",
        "Publish CameraInfo, or record it in the bag, before the keypoints.",
    ),
    Reason(
        "broken_adapter",
        DROP,
        "The adapter of another Python package cannot be loaded, or two packages bring one for this type",
        "Repair or uninstall the package that the log names.",
    ),
    Reason(
        "adapter_failed",
        DROP,
        "The adapter of another Python package raised an error or returned invalid keypoints",
        "Report it to the authors of the package that the log names, or uninstall it.",
    ),
    Reason(
        "too_many_persons",
        DROP,
        "The image shows more persons than `max_persons`",
        "Raise the parameter `max_persons` if the number is right; otherwise check the detector.",
    ),
    Reason(
        "repeated_person",
        DROP,
        "A person came twice in one image, from a detector that sends one message per person; the last is used",
        "Check for two publishers, or a relay that sends messages twice, on the topic of the keypoints.",
    ),
    Reason(
        "missed",
        DROP,
        "Messages were lost on the way, or were replaced by newer ones before they could be lifted",
        "Lower the detector's rate, free the CPU, or set the reliability of publisher and subscription to reliable.",
    ),
    Reason(
        "internal_error",
        DROP,
        "A fault of paul_ros: a message could not be lifted or published",
        "Report it with the traceback in the log.",
    ),
    # --- other inputs
    Reason(
        "bad_intrinsics",
        DROP,
        "CameraInfo has a focal length, principal point, roi or binning that no camera has",
        "Calibrate the camera, or correct its driver. Until then earlier intrinsics stay in use, or model units.",
    ),
    Reason(
        "depth_encoding",
        DROP,
        "The depth image has an encoding that cannot be read",
        "Publish 16UC1 (millimetres) or 32FC1 (metres), aligned to the image of the keypoints.",
    ),
    Reason(
        "truth_wrong_point_count",
        DROP,
        "The number of ground-truth points is not a multiple of the input layout's points",
        "Record the ground truth in the layout of the keypoints, person by person.",
    ),
    Reason(
        "truth_not_metres",
        DROP,
        "The ground truth is many times as large or as small as the persons that were lifted, so it is not in metres",
        "Record the ground truth in metres, in the frame of the camera.",
    ),
    # --- persons
    Reason(
        "person_too_few_points",
        PERSON,
        "A person is left out of the outputs: too few of its keypoints are visible",
        "Lower the parameter `min_confidence` if the detector is unsure of points that are right.",
    ),
    Reason(
        "person_degenerate_points",
        PERSON,
        "A person is left out of the outputs: its keypoints lie on one line, in two places or within about a pixel",
        "Use a larger image if persons are far away; otherwise check the detector.",
    ),
    Reason(
        "person_too_far",
        PERSON,
        f"A person is left out of the outputs: it would stand more than {MAX_DISTANCE:.0f} m away",
        "Check camera_info if the person is nearer.",
    ),
    Reason(
        "person_behind_camera",
        PERSON,
        "A person is left out of the outputs: it would stand beside or behind the camera",
        "Check camera_info and the layout of the keypoints.",
    ),
    # --- notes
    Reason(
        "image_assumed",
        NOTE,
        "CameraInfo has distortion and a P that differs from K, so the keypoints are taken as those of the rectified "
        "image",
        "Set `image` to raw if the detector sees the raw image, or to rectified to confirm.",
    ),
    Reason(
        "rectified_without_p",
        NOTE,
        "`image` is rectified, but P of CameraInfo is not filled, so K is used",
        "Let the camera's driver fill P, or set `image` to raw.",
    ),
    Reason(
        "distortion_ignored",
        NOTE,
        "The image is raw, and the distortion in CameraInfo cannot be used, so it is not corrected",
        "Calibrate the camera, or let the detector see the rectified image.",
    ),
    Reason(
        "no_ray",
        NOTE,
        "A keypoint of the raw image lies where the camera's distortion model has no ray, or 89 degrees or more from "
        "the optical axis, and is hidden",
        "If it is counted for most persons, calibrate the camera with images that reach to its borders.",
    ),
    Reason(
        "outside_image",
        NOTE,
        "Keypoints lie outside the image that CameraInfo states, as if the image was resized or is another camera's",
        "Remap `camera_info` to that of the image that the detector sees, with the same size. Send points that the "
        "detector guesses outside the image with a low confidence.",
    ),
    Reason(
        "corner_of_image",
        NOTE,
        "All keypoints so far lie in the upper left quarter of the image that CameraInfo states",
        "If the detector sees a smaller, resized image, remap `camera_info` to that of the resized image; otherwise no "
        "action is needed.",
    ),
    Reason(
        "another_frame",
        NOTE,
        "The frame_id of the keypoints differs from that of CameraInfo",
        "Check that both come from one camera. Let the detector use the optical frame: outputs keep its frame_id and "
        "have x right, y down, z forward.",
    ),
    Reason(
        "confidence_range",
        NOTE,
        "Confidences lie outside 0..1 and are clipped, so `min_confidence` hides other points than it says",
        "Send 0..1: divide percentages by 100, or send the sigmoid of logits.",
    ),
    Reason(
        "unused_fields",
        NOTE,
        "A PointCloud2 has fields that are not used",
        "Send one confidence (0 to 1) as the field confidence and ids as person_id, and leave other fields out.",
    ),
    Reason(
        "unlike_the_model",
        NOTE,
        "The keypoints of a person hardly fit any shape of the model",
        "If many persons are counted, set `layout` (paul: `--layout`) to the layout of your detector, or train the "
        "model on more poses.",
    ),
    Reason(
        "duplicate_ids",
        NOTE,
        "Several persons of one image have the same id, so they count as persons without an id for half a second",
        "Turn on the detector's tracker, or choose another: persons without an id have no transform and no smoothing.",
    ),
    Reason(
        "smoothing_without_ids",
        NOTE,
        "`smoothing` is set, and a person without an id cannot be smoothed",
        "Remap `keypoints` to tracked keypoints, such as /yolo/tracking, or set `smoothing` to 0.",
    ),
    Reason(
        "no_stamp",
        NOTE,
        "The keypoints have no stamp, so the time of their arrival is used",
        "Let the detector copy the header of its image. Until then depth images and transforms are late by its delay.",
    ),
    Reason(
        "invalid_stamp",
        NOTE,
        "A stamp that is negative, or has nanoseconds of a second or more, is replaced by the time of arrival",
        "Correct the clock or the arithmetic of the detector.",
    ),
    Reason(
        "no_frame",
        NOTE,
        "The keypoints have no frame_id, so CameraInfo's is used; without a CameraInfo it stays empty",
        "Let the detector copy the header of its image, or publish CameraInfo. Transforms need a frame.",
    ),
    Reason(
        "stamp_backwards",
        NOTE,
        "A stamp is earlier than the one before, as when a bag loops",
        "Check for two publishers on the topic of the keypoints if no bag loops.",
    ),
    Reason(
        "clock_set_back",
        NOTE,
        "Simulated time was set back, as when a bag loops",
        "No action is needed.",
    ),
    Reason(
        "depth_used",
        NOTE,
        "A person was placed at the distance that the depth image shows",
        "No action is needed.",
    ),
    Reason(
        "depth_disagrees",
        NOTE,
        "A depth implies an impossible size of the person and is ignored, as when something hides the hips",
        "If it is counted for most persons, check that `depth` is aligned to the image of the keypoints.",
    ),
    Reason(
        "depth_of_another_size",
        NOTE,
        "Depth images differ in size from CameraInfo, so they are not aligned to the image of the keypoints and are "
        "ignored",
        "Remap `depth` to the aligned images.",
    ),
    Reason(
        "depth_of_another_time",
        NOTE,
        "No depth image within 20 ms of the keypoints' stamp had come, so their distances were not measured",
        "Check that both use the same clock and that `depth` has at least the rate of the keypoints.",
    ),
)

REASONS: dict[str, Reason] = {reason.slug: reason for reason in _ALL}
"""Slug -> Reason, in the order of the documentation: messages, other inputs, persons, notes."""
