# SPDX-License-Identifier: Apache-2.0
"""Training on several processes or machines, started by torch's own ``torchrun``.

Every process draws the same batch from the same generator and computes its share of it, so that any number of
processes trains the same but for rounding.  DistributedDataParallel averages the gradients; the first process alone
reads and writes files.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist
from torch import Tensor

_PATIENCE = timedelta(hours=12)  # the others wait while the first process looks for a start


@contextmanager
def joined(device: torch.device) -> Iterator[None]:
    """Join the processes that ``torchrun`` started, if it did; leave them at the end."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield
        return
    dist.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=_PATIENCE)
    try:
        yield
    finally:
        dist.destroy_process_group()


def processes() -> int:
    """How many train together."""
    return dist.get_world_size() if dist.is_initialized() else 1


def is_first() -> bool:
    """Whether this process is the one that reads and writes files and talks."""
    return not dist.is_initialized() or dist.get_rank() == 0


def from_first(find: Callable[[], bytes | None], device: torch.device) -> bytes | None:
    """What ``find`` gives the first process, in every process; it is called in that one alone."""
    data = find() if is_first() else None
    if processes() == 1:
        return data
    size = torch.tensor([-1 if data is None else len(data)], device=device)
    dist.broadcast(size, 0)
    if size.item() < 0:
        return None
    content = torch.frombuffer(bytearray(data or b"\0" * size.item()), dtype=torch.uint8).to(device)
    dist.broadcast(content, 0)
    return content.cpu().numpy().tobytes()


@dataclass(frozen=True)
class Share:
    """The part of a batch of ``total`` frames that this process computes; None: all of it."""

    total: int | None

    @property
    def part(self) -> slice:
        """Which frames these are."""
        if self.total is None:
            return slice(None)
        rank, count = dist.get_rank(), dist.get_world_size()
        return slice(self.total * rank // count, self.total * (rank + 1) // count)

    def whole(self, x: Tensor) -> Tensor:
        """Values (N,...) of all processes' frames from this one's, with gradients for DistributedDataParallel."""
        return x if self.total is None else _Whole.apply(x, self.total, self.part)


WHOLE = Share(None)


def share_of(total: int) -> Share:
    """This process's share of a batch."""
    return Share(total) if processes() > 1 else WHOLE


class _Whole(torch.autograd.Function):
    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, x: Tensor, total: int, part: slice) -> Tensor:
        ctx.part = part
        everything = x.new_zeros(total, *x.shape[1:])
        everything[part] = x
        dist.all_reduce(everything)
        return everything

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, gradient: Tensor) -> tuple[Tensor, None, None]:
        # Every process has the whole gradient; the average over processes then has to be their sum.
        return gradient[ctx.part] * dist.get_world_size(), None, None
