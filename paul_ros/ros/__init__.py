# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 node `lifter`: thin shells over `paul_ros.stream`; the only place that imports rclpy.

`lifter_process` runs the node; `node` has its life cycle and parameters; `pipeline` has its data path.
"""
