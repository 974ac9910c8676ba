# SPDX-License-Identifier: Apache-2.0
"""Signals that end a process: a command stops by any of them as by Ctrl-C, and work that must be whole delays them."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals of Ctrl-C, of `kill` or a service manager, and of a terminal that is closed."""


class Stopped(KeyboardInterrupt):
    """A signal of ENDING came. (After a plain KeyboardInterrupt in exec, Python exits as by Ctrl-C.)"""


@contextmanager
def stoppable() -> Iterator[list[int]]:
    """Raise Stopped in the block when a signal of ENDING comes, unless it is ignored (`nohup`) or handled otherwise.

    Yields:
        The numbers of the signals that came, so far none.
    """
    received: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        received.append(number)
        for other in (signal.SIGTERM, signal.SIGHUP):
            if other != number:  # a service manager sends both, and the second one would break the tidying
                signal.signal(other, signal.SIG_IGN)
        raise Stopped

    usual = (signal.SIG_DFL, signal.default_int_handler)
    with _handlers(stop, [number for number in ENDING if signal.getsignal(number) in usual]):
        yield received


@contextmanager
def delayed_signals() -> Iterator[list[int]]:
    """Keep signals of ENDING from interrupting the block; hand the yielded list to `raise_signals` afterwards."""
    received: list[int] = []

    def receive(number: int, frame: FrameType | None) -> None:
        received.append(number)

    with _handlers(receive, ENDING):
        yield received


def raise_signals(received: Iterable[int]) -> None:
    """Send this process the signals that were delayed."""
    for number in received:
        signal.raise_signal(number)


@contextmanager
def _handlers(handler: Callable[[int, FrameType | None], None], numbers: Iterable[int]) -> Iterator[None]:
    """Set a handler during the block, in the main thread, which alone receives signals."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)
