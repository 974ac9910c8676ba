# SPDX-License-Identifier: Apache-2.0
"""Merge of sorted sources that are opened only when their time has come."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator

from paul_ros.offline.bag_records import Record

Source = tuple[int, Callable[[], Iterator[Record]]]
"""First log time of some messages, and a function that opens them, sorted by `Record.order`."""


def merge_by_time(sources: Iterable[Source]) -> Iterator[Record]:
    """Yield the messages of all sources by `Record.order`.

    A source is opened when the merge reaches its first log time. Messages of equal order keep that of the sources.
    """
    waiting = sorted(((first, number, open_) for number, (first, open_) in enumerate(sources)), reverse=True)
    opened: list[tuple[tuple[int, int], int, Record, Iterator[Record]]] = []
    while waiting or opened:
        if waiting and (not opened or waiting[-1][0] <= opened[0][2].log_time):
            _, number, open_ = waiting.pop()
            messages = open_()
            record = next(messages, None)
            if record is not None:
                heapq.heappush(opened, (record.order, number, record, messages))
            continue
        _, number, record, messages = opened[0]
        yield record
        following = next(messages, None)
        if following is None:
            heapq.heappop(opened)
        else:
            heapq.heapreplace(opened, (following.order, number, following, messages))
