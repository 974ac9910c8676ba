# SPDX-License-Identifier: Apache-2.0
"""Lift 2D keypoints to 3D on the robot: what runs there needs NumPy, PyYAML and ROS, nothing heavier."""

__version__ = "0.1.0"
