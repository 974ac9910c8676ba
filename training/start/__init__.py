# SPDX-License-Identifier: Apache-2.0
"""The start of a training run: 3D shapes from 2D points alone, by an annealed linear Procrustean model."""
