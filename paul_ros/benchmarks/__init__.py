# SPDX-License-Identifier: Apache-2.0
"""Benchmarks of this package: `onp` compares solvers, `node` measures the ROS 2 node. Each has a report beside it."""
