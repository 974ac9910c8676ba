# SPDX-License-Identifier: Apache-2.0
"""Evaluation of models and reconstructions against 3D truth; the trainer reads none of it."""
