# SPDX-License-Identifier: Apache-2.0
"""The offline trainer: learns a 3D shape model from 2D keypoints alone. The only room that imports torch."""
