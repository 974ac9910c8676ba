# SPDX-License-Identifier: Apache-2.0
"""One path from a 2D keypoint message to 3D messages, shared by the node and the replay. Imports no ROS library.

`stream` lifts messages into frames; `messages` turns frames into output messages. `session` holds what survives a swap
of model or layout. `ledger` counts drops and notes, and `reasons` lists them. `parameters` has the node's parameters.
"""
