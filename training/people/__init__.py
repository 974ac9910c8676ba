# SPDX-License-Identifier: Apache-2.0
"""2D training views of people from motion capture: readers, cameras, a detector model. NumPy only."""
