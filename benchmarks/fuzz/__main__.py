# SPDX-License-Identifier: Apache-2.0
"""Run ``python -m benchmarks.fuzz``."""

import sys

from benchmarks.fuzz.command import main

sys.exit(main())
