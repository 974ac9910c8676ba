# SPDX-License-Identifier: Apache-2.0
"""The baseline of `paul benchmark node`: a plain rclpy node that turns keypoints into poses without lifting.

It is written as a tutorial would write it, so that its cost is the usual cost of a node in Python.
"""

from __future__ import annotations


def main() -> None:
    """Read `keypoints` (PointCloud2 of float32 x, y, confidence, person_id), publish ~/poses (PoseArray)."""
    import numpy as np
    import rclpy
    from geometry_msgs.msg import Pose, PoseArray
    from rclpy.executors import ExternalShutdownException
    from rclpy.node import Node
    from sensor_msgs.msg import PointCloud2

    class Echo(Node):
        def __init__(self) -> None:
            super().__init__("echo")
            self.publisher = self.create_publisher(PoseArray, "~/poses", 10)
            self.create_subscription(PointCloud2, "keypoints", self.on_keypoints, 10)

        def on_keypoints(self, cloud: PointCloud2) -> None:
            poses = PoseArray()
            poses.header = cloud.header
            for x, y, confidence, _ in np.frombuffer(cloud.data, np.float32).reshape(-1, 4).tolist():
                pose = Pose()
                pose.position.x = x
                pose.position.y = y
                pose.position.z = confidence
                poses.poses.append(pose)
            self.publisher.publish(poses)

    rclpy.init()
    node = Echo()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
