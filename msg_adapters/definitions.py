# SPDX-License-Identifier: Apache-2.0
"""Definitions of the foreign types that the adapters read, for recordings that hold none.

Recorders leave a definition empty if the message package is not installed where they run, and those before ROS 2 Iron
record none. CDR cannot be read without all fields in their order. So each family lists its versions, the newest first;
the last one has only the fields that the adapter reads, as small publishers of the same type send them.

The fields are those of the packages' .msg files: yolo_ros 4, zed-ros2-interfaces 5, hri_msgs 2, D-Robotics' hobot_msgs,
OpenDR 3, openpose_ros2 and ros_openpose. Types without a package are of the family's own.
"""

from __future__ import annotations

Definition = dict[str, str]
"""Name of a type in the package -> text of its .msg file."""

_YOLO_POINTS: Definition = {
    "DetectionArray": "std_msgs/Header header\nDetection[] detections",
    "Point2D": "float64 x\nfloat64 y",
    "KeyPoint2D": "int32 id\nPoint2D point\nfloat64 score",
    "KeyPoint2DArray": "KeyPoint2D[] data",
}
_YOLO = (
    {
        **_YOLO_POINTS,
        "Vector2": "float64 x\nfloat64 y",
        "Pose2D": "Point2D position\nfloat64 theta",
        "BoundingBox2D": "Pose2D center\nVector2 size",
        "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\nstring frame_id",
        "Mask": "int32 height\nint32 width\nPoint2D[] data",
        "KeyPoint3D": "int32 id\ngeometry_msgs/Point point\nfloat64 score",
        "KeyPoint3DArray": "KeyPoint3D[] data\nstring frame_id",
        "Detection": "int32 class_id\nstring class_name\nfloat64 score\nstring id\nBoundingBox2D bbox\n"
        "BoundingBox3D bbox3d\nMask mask\nKeyPoint2DArray keypoints\nKeyPoint3DArray keypoints3d",
    },
    {
        **_YOLO_POINTS,
        "Detection": "int32 class_id\nstring class_name\nfloat64 score\nstring id\nKeyPoint2DArray keypoints",
    },
)

_ZED_SKELETON: Definition = {
    "ObjectsStamped": "std_msgs/Header header\nObject[] objects",
    "Keypoint2Df": "float32[2] kp",
    "Skeleton2D": "Keypoint2Df[70] keypoints",
}
_ZED_BOXES: Definition = {
    **_ZED_SKELETON,
    "Keypoint2Di": "uint32[2] kp",
    "Keypoint3D": "float32[3] kp",
    "BoundingBox2Di": "Keypoint2Di[4] corners",
    "BoundingBox2Df": "Keypoint2Df[4] corners",
    "BoundingBox3D": "Keypoint3D[8] corners",
    "Skeleton3D": "Keypoint3D[70] keypoints",
}
_ZED_OBJECT = (
    "string label\nint16 label_id\nstring sublabel\nfloat32 confidence\nfloat32[3] position\n"
    "float32[6] position_covariance\nfloat32[3] velocity\nbool tracking_available\nint8 tracking_state\n"
    "int8 action_state\nBoundingBox2Di bounding_box_2d\nBoundingBox3D bounding_box_3d\nfloat32[3] dimensions_3d\n"
    "bool skeleton_available\nint8 body_format\nBoundingBox2Df head_bounding_box_2d\n"
    "BoundingBox3D head_bounding_box_3d\nfloat32[3] head_position\nSkeleton2D skeleton_2d\nSkeleton3D skeleton_3d"
)
_ZED = (
    {**_ZED_BOXES, "Object": f"{_ZED_OBJECT}\nfloat32[70] skeleton_keypoint_confidence"},
    {**_ZED_BOXES, "Object": _ZED_OBJECT},
    {
        **_ZED_SKELETON,
        "Object": "string label\nint16 label_id\nfloat32 confidence\nbool skeleton_available\nint8 body_format\n"
        "Skeleton2D skeleton_2d",
    },
)

_AI_POINTS: Definition = {"Point": "string type\ngeometry_msgs/Point32[] point\nfloat32[] confidence"}
_AI = (
    {
        **_AI_POINTS,
        "PerceptionTargets": "std_msgs/Header header\nint16 fps\nPerf[] perfs\nTarget[] targets\n"
        "Target[] disappeared_targets",
        "Perf": "string type\nbuiltin_interfaces/Time stamp_start\nbuiltin_interfaces/Time stamp_end\n"
        "float64 time_ms_duration",
        "Roi": "string type\nsensor_msgs/RegionOfInterest rect\nfloat32 confidence",
        "Attribute": "string type\nfloat32 value\nfloat32 confidence",
        "DBResult": "string db_type\nstring match_id\nfloat32 distance\nfloat32 similarity",
        "Capture": "std_msgs/Header header\nsensor_msgs/Image img\nfloat32[] features\nDBResult db_result",
        "Target": "string type\nuint64 track_id\nRoi[] rois\nAttribute[] attributes\nPoint[] points\n"
        "Capture[] captures",
    },
    {
        **_AI_POINTS,
        "PerceptionTargets": "std_msgs/Header header\nint16 fps\nTarget[] targets\nTarget[] disappeared_targets",
        "Target": "string type\nuint64 track_id\nPoint[] points",
    },
)

_OPENPOSE_LIST: Definition = {
    "PoseKeyPointsList": "std_msgs/Header header\nPoseKeyPoints[] pose_key_points_list",
    "PoseKeyPoint": "float32 x\nfloat32 y\nfloat32 score",
}

_FAMILIES: dict[str, tuple[Definition, ...]] = {
    "yolo_msgs/msg/DetectionArray": _YOLO,
    "yolov8_msgs/msg/DetectionArray": _YOLO,
    "zed_msgs/msg/ObjectsStamped": _ZED,
    "zed_interfaces/msg/ObjectsStamped": _ZED,
    "ai_msgs/msg/PerceptionTargets": _AI,
    "hri_msgs/msg/Skeleton2D": (
        {
            "Skeleton2D": "std_msgs/Header header\nNormalizedPointOfInterest2D[18] skeleton",
            "NormalizedPointOfInterest2D": "float32 x\nfloat32 y\nfloat32 c",
        },
    ),
    "opendr_interface/msg/OpenDRPose2D": (
        {
            "OpenDRPose2D": "std_msgs/Header header\nint32 pose_id\nfloat32 conf\nOpenDRPose2DKeypoint[] keypoint_list",
            "OpenDRPose2DKeypoint": "string kpt_name\nint32 x\nint32 y",
        },
    ),
    "openpose_ros2_msgs/msg/PoseKeyPointsList": (
        {**_OPENPOSE_LIST, "PoseKeyPoints": "PoseKeyPoint[18] pose_key_points"},
        {**_OPENPOSE_LIST, "PoseKeyPoints": "PoseKeyPoint[] pose_key_points"},
    ),
    "ros_openpose/msg/Frame": (
        {
            "Frame": "std_msgs/Header header\nPerson[] persons",
            "Person": "BodyPart[] bodyParts\nBodyPart[] leftHandParts\nBodyPart[] rightHandParts",
            "BodyPart": "float32 score\nPixel pixel\ngeometry_msgs/Point32 point",
            "Pixel": "float32 x\nfloat32 y",
        },
    ),
}


def definitions(type_name: str) -> list[dict[str, str]]:
    """Return the known definitions of a foreign type, the newest first: type name -> text of its .msg file each.

    The standard types of ROS 2 that they contain are left out. An unknown type has none.
    """
    package = type_name.partition("/")[0]
    return [
        {f"{package}/msg/{name}": f"{text}\n" for name, text in version.items()}
        for version in _FAMILIES.get(type_name, ())
    ]
