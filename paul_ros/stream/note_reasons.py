# SPDX-License-Identifier: Apache-2.0
"""The reasons for which something irregular is noted but used, a part of the table of `reasons`."""

from __future__ import annotations

from paul_ros.stream.reason import AT_ONCE, MOST, NOTE, SOME, Reason

NOTE_REASONS = (
    Reason(
        "unknown_parameter",
        NOTE,
        "The node was given a parameter that it does not have",
        "Correct its name: the log says the nearest one at start.",
    ),
    Reason(
        "callback_failed",
        NOTE,
        "A fault of paul_ros or rclpy: a service request, a timer or an event ended in an error, and the node goes on",
        "Report it with the traceback in the log.",
        warn_above=AT_ONCE,
    ),
    Reason(
        "image_assumed",
        NOTE,
        "CameraInfo leaves open which image the detector sees; the likely one is taken, mostly the rectified one",
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
        warn_above=SOME,
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
        warn_above=AT_ONCE,
    ),
    Reason(
        "frame_changed",
        NOTE,
        "Without a CameraInfo, the frame_id of the keypoints changes, as if two cameras share a topic",
        "Start a lifter for each camera, with its own `keypoints` and `camera_info`.",
        warn_above=SOME,
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
        "If many persons are counted, set `layout` to the layout of your detector, or train the model on more poses.",
        warn_above=MOST,
        counts_persons=True,
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
        "Let the detector copy the header of its image. Until then no transforms are sent.",
    ),
    Reason(
        "invalid_stamp",
        NOTE,
        "A stamp that is negative, or has nanoseconds of a second or more, is replaced by the time of arrival",
        "Correct the clock or the arithmetic of the detector.",
    ),
    Reason(
        "stamp_ahead",
        NOTE,
        "A stamp is more than a day ahead of the clock at its arrival; it is used all the same",
        "Check the clocks of the machines, and the parameter `use_sim_time`.",
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
        counts_persons=True,
    ),
    Reason(
        "depth_disagrees",
        NOTE,
        "A depth implies an impossible size of the person and is ignored, as when something hides the hips",
        "If it is counted for most persons, check the unit of `depth`, and that it is aligned to the image of the "
        "keypoints.",
        warn_above=MOST,
        counts_persons=True,
    ),
    Reason(
        "depth_in_millimetres",
        NOTE,
        "A depth image of floats holds millimetres; 32FC1 means metres, so it is ignored",
        "Publish `depth` as 16UC1, or divide its values by 1000.",
        warn_above=AT_ONCE,
        counts_persons=True,
    ),
    Reason(
        "depth_of_another_size",
        NOTE,
        "Depth images differ in size from CameraInfo, so they are not aligned to the image of the keypoints and are "
        "ignored",
        "Remap `depth` to the aligned images.",
        warn_above=AT_ONCE,
    ),
    Reason(
        "depth_of_another_time",
        NOTE,
        "No depth image within 20 ms of the keypoints' stamp had come, so their distances were not measured",
        "Check that both use the same clock and that `depth` has at least the rate of the keypoints.",
        warn_above=MOST,
    ),
    Reason(
        "truth_of_another_frame",
        NOTE,
        "The ground truth lies in another direction than the persons that were lifted, so only PA-MPJPE has a meaning",
        "Record the ground truth in the camera's optical frame (x right, y down, z forward), or check that CameraInfo "
        "is that of the image.",
    ),
)
