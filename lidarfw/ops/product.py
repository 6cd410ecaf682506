"""The product of many rows and a small matrix, by the fastest library that comes with torch.

`torch.mm` is MKL's, which keeps to AVX2 on processors that are not Intel's. oneDNN uses what the processor has:
with AVX-512 that is twice the rate at 64 channels. It compiles a kernel for every new shape, which takes a third
of a millisecond, so the number of rows is rounded up to one of a few.
"""

from __future__ import annotations

import functools
from pathlib import Path

import torch
from torch import Tensor

_STEP, _MOST = 512, 4096  # rows: of what oneDNN gets a multiple, and the most at a time; a compiled shape takes 0.1 MB
_WORTH = 32 * 64  # elements of the matrix from which oneDNN's gain exceeds the copy of its result


def padded(rows: int) -> int:
    """The rows that the first argument of `multiply` must have for so many."""
    return -(-rows // _STEP) * _STEP


def multiply(rows: Tensor, weight: Tensor, out: Tensor) -> None:
    """out (N, C_out) = rows[:N] @ weight (C_in, C_out); rows (at least padded(N), C_in), the rest of any content.

    Which library computes depends on the shape of the weight alone, so a row's result does not depend on the others.
    """
    if not _onednn_is_faster() or rows.dtype != torch.float32 or rows.device.type != "cpu" or weight.numel() < _WORTH:
        torch.mm(rows[: len(out)], weight, out=out)
        return
    for begin in range(0, len(out), _MOST):
        part = out[begin : begin + _MOST]
        whole = rows[begin : begin + padded(len(part))]
        part.copy_(torch.ops.mkldnn._linear_pointwise(whole, weight.t(), None, "none", [], "")[: len(part)])


@functools.cache
def _onednn_is_faster() -> bool:
    """Whether the processor has AVX-512 and is not Intel's, and torch has oneDNN."""
    if torch.backends.cpu.get_cpu_capability() != "AVX512" or not torch.backends.mkldnn.is_available():  # type: ignore[no-untyped-call]
        return False
    cpuinfo = Path("/proc/cpuinfo")
    known = cpuinfo.exists() and "GenuineIntel" not in cpuinfo.read_text()
    return known and hasattr(torch.ops.mkldnn, "_linear_pointwise")
