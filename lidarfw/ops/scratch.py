"""Working memory that is kept between calls.

On a CPU a fresh large tensor costs more in page faults than the work on it, so each thread keeps one buffer
per purpose, which grows to the largest request. On a GPU the allocator of torch keeps blocks itself, and per
stream, so there a scratch tensor is an ordinary new one.
"""

from __future__ import annotations

import threading

import torch
from torch import Tensor

_STEP = 2**18  # elements: what is a little larger than before fits too

_local = threading.local()


def scratch(purpose: str, rows: int, columns: int, like: Tensor) -> Tensor:
    """An uninitialised (rows, columns) matrix of the type and device of `like`, good until the next call alike."""
    if like.device.type != "cpu":
        return like.new_empty(rows, columns)
    size = rows * columns
    return _buffer(purpose, size, like.dtype)[:size].view(rows, columns)


def zeroed(purpose: str, size: int, like: Tensor) -> Tensor:
    """A vector of so many zeros of the type and device of `like`. The caller zeroes again what it writes."""
    if like.device.type != "cpu":
        return like.new_zeros(size)
    return _buffer(purpose, size, like.dtype, zero=True)[:size]


def _buffer(purpose: str, size: int, dtype: torch.dtype, zero: bool = False) -> Tensor:
    buffers: dict[tuple[str, torch.dtype], Tensor] = _local.__dict__.setdefault("buffers", {})
    key = (purpose, dtype)
    if key not in buffers or len(buffers[key]) < size:
        buffers.pop(key, None)  # give the old one back first
        buffers[key] = (torch.zeros if zero else torch.empty)(-(-size // _STEP) * _STEP, dtype=dtype)
    return buffers[key]
