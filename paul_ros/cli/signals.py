# SPDX-License-Identifier: Apache-2.0
"""Signals that end a command: it stops as by Ctrl-C, removes what is half done, and says so."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

ENDING = (signal.SIGTERM, signal.SIGHUP)
"""Signals beside Ctrl-C: of `kill`, of a service manager, of a terminal that is closed."""


@contextmanager
def stoppable() -> Iterator[list[int]]:
    """Raise KeyboardInterrupt in the block when a signal of ENDING comes, unless the signal is ignored (`nohup`).

    Yields:
        The numbers of the signals that came, so far none.
    """
    received: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        received.append(number)
        for other in ENDING:
            if other != number:  # a service manager sends both, and the second one would break the tidying
                signal.signal(other, signal.SIG_IGN)
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():  # only the main thread receives signals
        yield received
        return
    before = {number: signal.getsignal(number) for number in ENDING}
    try:
        for number, handler in before.items():
            if handler == signal.SIG_DFL:
                signal.signal(number, stop)
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
