# SPDX-License-Identifier: Apache-2.0
"""The reasons for which messages are dropped and persons are left out, a part of the table of `reasons`."""

from __future__ import annotations

from paul_ros.lifted import MAX_DISTANCE
from paul_ros.stream.reason import DROP, PERSON, SOME, Reason

DROP_REASONS = (
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
        "Set `layout` to the layout of your detector, or to the path of your own layout file.",
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
        "Set `layout` to a layout of the same kind of object.",
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
        "Raise `max_persons` if the number is right; otherwise check the detector.",
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
        warn_above=SOME,
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
        "Lower `min_confidence` if the detector is unsure of points that are right.",
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
        "Check `camera_info` if the person is nearer.",
    ),
    Reason(
        "person_behind_camera",
        PERSON,
        "A person is left out of the outputs: it would stand beside or behind the camera",
        "Check `camera_info` and `layout`.",
    ),
)
