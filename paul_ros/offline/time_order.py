# SPDX-License-Identifier: Apache-2.0
"""Merge of sorted sources that are opened only when their time has come."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator

from paul_ros.offline.bag_records import Record

Source = tuple[int, Callable[[], Iterator[Record]]]
"""First log time of some messages, and a function that opens them, sorted by log time."""


def merge_by_time(sources: Iterable[Source]) -> Iterator[Record]:
    """Yield the messages of all sources in the order of log time.

    A source is opened when the merge reaches its first log time. Messages of equal times keep the order of the sources.
    """
    waiting = sorted(((first, number, open_) for number, (first, open_) in enumerate(sources)), reverse=True)
    opened: list[tuple[int, int, Record, Iterator[Record]]] = []
    while waiting or opened:
        if waiting and (not opened or waiting[-1][0] <= opened[0][0]):
            _, number, open_ = waiting.pop()
            messages = open_()
            record = next(messages, None)
            if record is not None:
                heapq.heappush(opened, (record.log_time, number, record, messages))
            continue
        _, number, record, messages = opened[0]
        yield record
        following = next(messages, None)
        if following is None:
            heapq.heappop(opened)
        else:
            heapq.heapreplace(opened, (following.log_time, number, following, messages))
