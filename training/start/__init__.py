# SPDX-License-Identifier: Apache-2.0
"""Starts: the 3D shapes that a run begins with, found from 2D points alone."""
