# SPDX-License-Identifier: Apache-2.0
"""Fuzz test of all input from outside: does anything crash, is any message lost without being counted?

    python -m benchmarks.fuzz [--cases 100000] [--seed 0] [--only KIND] [--json fuzz.json]

A case is one message, serialised message, bag, model file or layout.  It is made whole and then broken in a few places:

- fields: messages of every supported type.  Every field keeps its type, with NaN, infinite, huge or negative values,
  odd lengths and odd text.  Even a drop as `internal_error` is a crash here.
- junk: the same with values of any type, None, nested rubbish and missing fields.  DDS cannot deliver such messages.
- cdr: PointCloud2 as bytes, for the reader of serialised messages.  rosbags must read the same from them.
- ids: images whose persons have odd or equal ids, from detectors that send no stamps or no frames.  An oracle knows
  which persons belong together, and their ids, numbers and stamps.
- bags: bits flipped, bytes cut off, inserted and exchanged, and intact bags of broken messages; read and replayed.
- models: the file, or its contents under a correct checksum.
- layouts: the YAML text, or the values in it.

A crash is an exception that the documentation does not promise, a warning of NumPy, or an output that is not finite.
A message is lost uncounted if it becomes neither a frame, nor a part of one, nor a drop.

A few cases make a session and share a stream.  `--only KIND --session NUMBER` repeats one session.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

# The messages of foreign packages are those of the tests.
sys.path.append(str(Path(__file__).resolve().parents[2] / "test"))
