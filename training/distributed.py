# SPDX-License-Identifier: Apache-2.0
"""Training on several processes or machines, started by torch's own ``torchrun``.

Every process draws the same batch from the same generator and computes its share of it. Any number of processes thus
trains the same, up to rounding. DistributedDataParallel averages the gradients. Only the first process reads and writes
files.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

_TIMEOUT = timedelta(hours=12)
"""Longest wait for another process; the first one may search for a start for long."""


@contextmanager
def joined(device: torch.device) -> Iterator[None]:
    """Join the processes that ``torchrun`` started, if any; leave them at the end."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield
        return
    dist.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=_TIMEOUT)
    try:
        yield
    finally:
        dist.destroy_process_group()


def processes() -> int:
    """Return the number of processes that train together."""
    return dist.get_world_size() if dist.is_initialized() else 1


def is_first() -> bool:
    """Return whether this process is the one that reads and writes files and prints."""
    return not dist.is_initialized() or dist.get_rank() == 0


def from_first(find: Callable[[], bytes | None], device: torch.device) -> bytes | None:
    """Call ``find`` in the first process, and return its result in every process."""
    data = find() if is_first() else None
    if processes() == 1:
        return data
    length = torch.tensor([-1 if data is None else len(data)], device=device)
    dist.broadcast(length, 0)
    size = int(length.item())
    if size < 0:
        return None
    content = torch.frombuffer(bytearray(data or b"\0" * size), dtype=torch.uint8).to(device)
    dist.broadcast(content, 0)
    return content.cpu().numpy().tobytes()


@dataclass(frozen=True)
class Share:
    """The part of a batch that this process computes.

    Attributes:
        total: frames of the batch; None if this process computes all of them.
    """

    total: int | None

    @property
    def part(self) -> slice:
        """The slice of the batch."""
        if self.total is None:
            return slice(None)
        rank, count = dist.get_rank(), dist.get_world_size()
        return slice(self.total * rank // count, self.total * (rank + 1) // count)

    def whole(self, x: Tensor) -> Tensor:
        """Gather values (N,...) of all processes' frames, with gradients for DistributedDataParallel."""
        return x if self.total is None else _Whole.apply(x, self.total, self.part)


WHOLE = Share(None)


def share_of(total: int) -> Share:
    """Return this process's share of a batch of so many frames."""
    return Share(total) if processes() > 1 else WHOLE


class _Whole(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, total: int, part: slice) -> Tensor:
        ctx.part = part
        everything = x.new_zeros(total, *x.shape[1:])
        everything[part] = x
        dist.all_reduce(everything)
        return everything

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        # Every process has the whole gradient: scale it so that the average over processes is their sum.
        return gradient[ctx.part] * dist.get_world_size(), None, None
