# SPDX-License-Identifier: Apache-2.0
"""One path from a 2D keypoint message to 3D messages, shared by the node and the replay; knows no ROS library."""
