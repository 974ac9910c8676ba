# SPDX-License-Identifier: Apache-2.0
"""Messages of packages that are not on PyPI: definitions reduced to the used fields, and builders for poses.

A pose is {keypoint name: (x, y)} in pixels, with the names of layouts. Every builder takes a message factory `make`:
LiveMake for messages as rclpy delivers them, conftest.BagMake for messages as a bag delivers them.
"""

from __future__ import annotations

import array
from types import SimpleNamespace

import numpy as np

CLOUD, POSES, YOLO = ("sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/PoseArray", "yolo_msgs/msg/DetectionArray")
HRI, ZED, AI = ("hri_msgs/msg/Skeleton2D", "zed_msgs/msg/ObjectsStamped", "ai_msgs/msg/PerceptionTargets")
FORMER_YOLO, FORMER_ZED = "yolov8_msgs/msg/DetectionArray", "zed_interfaces/msg/ObjectsStamped"
OPENDR = "opendr_interface/msg/OpenDRPose2D"
OPENPOSE_LIST, OPENPOSE_FRAME = "openpose_ros2_msgs/msg/PoseKeyPointsList", "ros_openpose/msg/Frame"

#: Type name -> text of its .msg file, in the order of dependence.
DEFINITIONS = {
    "yolo_msgs/msg/Point2D": "float64 x\nfloat64 y\n",
    "yolo_msgs/msg/KeyPoint2D": "int32 id\nyolo_msgs/Point2D point\nfloat64 score\n",
    "yolo_msgs/msg/KeyPoint2DArray": "yolo_msgs/KeyPoint2D[] data\n",
    "yolo_msgs/msg/Detection": "int32 class_id\nstring class_name\nfloat64 score\nstring id\n"
    "yolo_msgs/KeyPoint2DArray keypoints\n",
    YOLO: "std_msgs/Header header\nyolo_msgs/Detection[] detections\n",
    "hri_msgs/msg/NormalizedPointOfInterest2D": "float32 x\nfloat32 y\nfloat32 c\n",
    HRI: "std_msgs/Header header\nhri_msgs/NormalizedPointOfInterest2D[18] skeleton\n",
    "hri_msgs/msg/IdsList": "std_msgs/Header header\nstring[] ids\n",
    "zed_msgs/msg/Keypoint2Df": "float32[2] kp\n",
    "zed_msgs/msg/Skeleton2D": "zed_msgs/Keypoint2Df[70] keypoints\n",
    "zed_msgs/msg/Object": "string label\nint16 label_id\nfloat32 confidence\nbool skeleton_available\n"
    "int8 body_format\nzed_msgs/Skeleton2D skeleton_2d\n",
    ZED: "std_msgs/Header header\nzed_msgs/Object[] objects\n",
    "ai_msgs/msg/Point": "string type\ngeometry_msgs/Point32[] point\nfloat32[] confidence\n",
    "ai_msgs/msg/Target": "string type\nuint64 track_id\nai_msgs/Point[] points\n",
    AI: "std_msgs/Header header\nint16 fps\nai_msgs/Target[] targets\nai_msgs/Target[] disappeared_targets\n",
    "opendr_interface/msg/OpenDRPose2DKeypoint": "string kpt_name\nint32 x\nint32 y\n",
    OPENDR: "std_msgs/Header header\nint32 pose_id\nfloat32 conf\n"
    "opendr_interface/OpenDRPose2DKeypoint[] keypoint_list\n",
    "openpose_ros2_msgs/msg/PoseKeyPoint": "float32 x\nfloat32 y\nfloat32 score\n",
    "openpose_ros2_msgs/msg/PoseKeyPoints": "openpose_ros2_msgs/PoseKeyPoint[] pose_key_points\n",
    OPENPOSE_LIST: "std_msgs/Header header\nopenpose_ros2_msgs/PoseKeyPoints[] pose_key_points_list\n",
    "ros_openpose/msg/Pixel": "float32 x\nfloat32 y\n",
    "ros_openpose/msg/BodyPart": "float32 score\nros_openpose/Pixel pixel\ngeometry_msgs/Point32 point\n",
    "ros_openpose/msg/Person": "ros_openpose/BodyPart[] bodyParts\nros_openpose/BodyPart[] leftHandParts\n"
    "ros_openpose/BodyPart[] rightHandParts\n",
    OPENPOSE_FRAME: "std_msgs/Header header\nros_openpose/Person[] persons\n",
    # Published by the node if these packages are installed.
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "foxglove_msgs/msg/Color": "float64 r\nfloat64 g\nfloat64 b\nfloat64 a\n",
    "foxglove_msgs/msg/Point2": "float64 x\nfloat64 y\n",
    "foxglove_msgs/msg/PointsAnnotation": "builtin_interfaces/Time timestamp\nuint8 type\n"
    "foxglove_msgs/Point2[] points\n"
    "foxglove_msgs/Color outline_color\nfoxglove_msgs/Color[] outline_colors\nfoxglove_msgs/Color fill_color\n"
    "float64 thickness\n",
    "foxglove_msgs/msg/ImageAnnotations": "foxglove_msgs/PointsAnnotation[] points\n",
}

SIZE = (640, 480)

# The orders of points, repeated on purpose: from the constants and enumerations in the packages' documentation.
_RIGHT_FIRST = "nose neck RSHO RELB RWRI LSHO LELB LWRI {} RHIP RKNE RANK LHIP LKNE LANK REYE LEYE REAR LEAR"
_WORDS = {
    "SHO": "shoulder",
    "ELB": "elbow",
    "WRI": "wrist",
    "HIP": "hip",
    "KNE": "knee",
    "ANK": "ankle",
    "EYE": "eye",
    "EAR": "ear",
    "BIG": "big_toe",
    "SML": "small_toe",
    "HEE": "heel",
}


def _names(text: str) -> list[str]:
    """Return names for abbreviations: LSHO = left_shoulder, - = a point that no layout has."""

    def name(word: str) -> str:
        if word[1:] in _WORDS:
            return {"L": "left_", "R": "right_"}[word[0]] + _WORDS[word[1:]]
        return word

    return [name(word) for word in text.split()]


OPENPOSE18 = _names(_RIGHT_FIRST.format(""))
BODY25 = _names(_RIGHT_FIRST.format("pelvis") + " LBIG LSML LHEE RBIG RSML RHEE")
HRI18 = OPENPOSE18[:14] + _names("LEYE REYE LEAR REAR")
ZED34 = _names(
    "- - - - - LSHO LELB LWRI - - - - RSHO RELB RWRI - - - LHIP LKNE LANK - RHIP RKNE RANK - "
    "- nose LEYE LEAR REYE REAR LHEE RHEE"
)
ZED38 = _names(
    "- - - - - nose LEYE REYE LEAR REAR - - LSHO RSHO LELB RELB LWRI RWRI LHIP RHIP LKNE RKNE LANK RANK "
    "LBIG RBIG LSML RSML LHEE RHEE - - - - - - - -"
)
ZED_ORDERS = {0: OPENPOSE18, 1: ZED34, 2: ZED38}
OPENDR_NAMES = (
    "nose neck r_sho r_elb r_wri l_sho l_elb l_wri r_hip r_knee r_ank l_hip l_knee l_ank r_eye l_eye r_ear l_ear"
)


class LiveMake:
    """Message factory with the attributes of rclpy's messages; the packages are not installed."""

    def __call__(self, type_name: str, **fields) -> SimpleNamespace:
        return SimpleNamespace(**fields)

    @staticmethod
    def floats(values) -> array.array:
        """Return the value of a float32[] field."""
        return array.array("f", values)

    @staticmethod
    def through_cdr(msg):
        """Return the message as it is."""
        return msg


def hri(make, header, pose: dict, confidence: float = 0.9):
    """Make one body; points that the pose lacks keep the defaults."""
    points = [(pose[n][0] / SIZE[0], pose[n][1] / SIZE[1], confidence) if n in pose else (0.0,) * 3 for n in HRI18]
    return make(HRI, header=header, skeleton=[hri_point(make, *map(float, point)) for point in points])


def hri_point(make, x: float, y: float, c: float):
    return make("hri_msgs/msg/NormalizedPointOfInterest2D", x=x, y=y, c=c)


def zed(make, header, poses: list[dict], body_format: int = 2, ids=None):
    ids = range(len(poses)) if ids is None else ids
    return make(ZED, header=header, objects=[zed_body(make, p, body_format, i) for p, i in zip(poses, ids)])


def zed_body(make, pose: dict, body_format: int, ident: int, skeleton: bool = True):
    xy = np.zeros((70, 2), np.float32)
    for slot, name in enumerate(ZED_ORDERS.get(body_format, [])):
        if name in pose:
            xy[slot] = pose[name]
    slots = [make("zed_msgs/msg/Keypoint2Df", kp=kp) for kp in xy]
    return make(
        "zed_msgs/msg/Object",
        label=f"Body_{ident}",
        label_id=ident,
        confidence=20.0,
        skeleton_available=skeleton,
        body_format=body_format,
        skeleton_2d=make("zed_msgs/msg/Skeleton2D", keypoints=slots),
    )


def ai(make, header, targets: list):
    return make(AI, header=header, fps=30, targets=targets, disappeared_targets=[])


def ai_target(make, ident: int, **points):
    """Make a target; points: type -> (rows of x, y; confidences)."""
    groups = [
        make(
            "ai_msgs/msg/Point",
            type=kind,
            point=[make("geometry_msgs/msg/Point32", x=float(x), y=float(y), z=0.0) for x, y in rows],
            confidence=make.floats(confidence),
        )
        for kind, (rows, confidence) in points.items()
    ]
    return make("ai_msgs/msg/Target", type="person", track_id=ident, points=groups)


def opendr(make, header, pose: dict, ident: int = 1, conf: float = 17.5):
    """Make one person without the points that the pose lacks."""
    named = zip(OPENDR_NAMES.split(), OPENPOSE18)
    return opendr_of(make, header, [(short, *pose[name]) for short, name in named if name in pose], ident, conf)


def opendr_of(make, header, rows: list, ident: int = 1, conf: float = 17.5):
    """Make one person of rows (kpt_name, x, y)."""
    keypoints = [
        make("opendr_interface/msg/OpenDRPose2DKeypoint", kpt_name=name, x=round(x), y=round(y)) for name, x, y in rows
    ]
    return make(OPENDR, header=header, pose_id=ident, conf=conf, keypoint_list=keypoints)


def openpose_list(make, header, persons: list):
    """Make a list of persons, each with rows (x, y, score) from openpose_rows()."""
    lists = [
        make(
            "openpose_ros2_msgs/msg/PoseKeyPoints",
            pose_key_points=[make("openpose_ros2_msgs/msg/PoseKeyPoint", x=x, y=y, score=s) for x, y, s in rows],
        )
        for rows in persons
    ]
    return make(OPENPOSE_LIST, header=header, pose_key_points_list=lists)


def openpose_frame(make, header, persons: list):
    """Make a frame of persons like openpose_list, with hands, which must be ignored."""

    def part(x, y, score):
        nowhere = make("geometry_msgs/msg/Point32", x=0.0, y=0.0, z=0.0)
        pixel = make("ros_openpose/msg/Pixel", x=x, y=y)
        return make("ros_openpose/msg/BodyPart", score=score, pixel=pixel, point=nowhere)

    hand = [part(1.0, 2.0, 0.9)] * 21
    people = [
        make(
            "ros_openpose/msg/Person",
            bodyParts=[part(*row) for row in rows],
            leftHandParts=hand,
            rightHandParts=hand,
        )
        for rows in persons
    ]
    return make(OPENPOSE_FRAME, header=header, persons=people)


def openpose_rows(pose: dict, order: list[str], score: float = 0.8) -> list:
    return [(float(pose[n][0]), float(pose[n][1]), score) if n in pose else (0.0, 0.0, 0.0) for n in order]
