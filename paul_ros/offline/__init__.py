# SPDX-License-Identifier: Apache-2.0
"""Work on recordings: read and write bags, replay, judge, report, film, demo."""
