# SPDX-License-Identifier: Apache-2.0
"""Fuzz test of all input from outside: does anything crash, get lost without being counted, or mislead in silence?

    python -m benchmarks.fuzz [--cases 100000] [--seed 0] [--only KIND] [--json fuzz.json]

A case is one message, serialised message, scene, bag, recording, model file, layout or request.  Most are made whole
and then broken in a few places:

- fields: messages of every supported type.  Every field keeps its type, with NaN, infinite, huge or negative values,
  odd lengths and odd text.  Even a drop as `internal_error` is a crash here.
- junk: the same with values of any type, None, nested rubbish and missing fields.  DDS cannot deliver such messages.
- cdr: PointCloud2 as bytes, for the reader of serialised messages.  rosbags must read the same from them.
- ids: images whose persons have odd or equal ids, from detectors that send no stamps or no frames.  An oracle knows
  which persons belong together, and their ids, numbers and stamps.
- bags: bits flipped, bytes cut off, inserted and exchanged, and intact bags of broken messages; read and replayed.
- scenes: persons before cameras with distortion, windows and binning, in messages whose pixels, confidences, ids or
  order mean something else.  The truth is known.
- recordings: split, unordered, compressed, cut, incomplete, beside foreign channels, in sqlite3.  All messages are
  known.
- models: the file, or its contents under a correct checksum.
- layouts: the YAML text, or the values in it.
- services: requests to the services of a node, in this process.  Each must be answered as the node's state and the
  values demand, and the node must lift the next frame.
- requests: the same to a node of its own process over DDS.  Each must be answered, and the node must live and lift.

A crash is an exception that the documentation does not promise, a warning of NumPy, or an output that is not finite.
A message is lost uncounted if it becomes neither a frame, nor a part of one, nor a drop.  A silent misreading is an
output that differs from the truth although no note and no drop says so, or a note about something that is right.

A few cases make a session and share a stream.  `--only KIND --session NUMBER` repeats one session.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")
# Before rclpy starts: only this machine, and a domain of this run's own.
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))

# The messages of foreign packages are those of the tests.
sys.path.append(str(Path(__file__).resolve().parents[2] / "test"))
