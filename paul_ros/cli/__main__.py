# SPDX-License-Identifier: Apache-2.0
"""Run `paul` as `python -m paul_ros.cli`."""

import sys

from paul_ros.cli.launcher import main

if __name__ == "__main__":
    sys.exit(main())
