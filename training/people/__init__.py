# SPDX-License-Identifier: Apache-2.0
"""2D training views of people, simulated from motion capture. NumPy only, no torch."""
