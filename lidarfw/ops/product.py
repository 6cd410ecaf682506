"""Products of many rows with small matrices, by the fastest library that comes with torch.

`torch.mm` is MKL's, which keeps to AVX2 on processors that are not Intel's. oneDNN uses what the processor has: with
AVX-512 that is twice the rate at 64 channels. torch hands float32 to oneDNN where oneDNN is allowed bfloat16 inside,
which it uses on processors with AMX only; whether all bits count is tried before it is taken. It compiles a kernel for
every new shape, in half a millisecond and as many megabytes, so it gets a few numbers of rows only.
"""

from __future__ import annotations

import contextlib
import functools
import threading
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from itertools import accumulate
from pathlib import Path

import torch
from torch import Tensor

from lidarfw.ops.scratch import scratch

_KERNELS: tuple[int, ...] = (*range(512, 4097, 512), 6144, 8192)  # numbers of rows that oneDNN gets
SLACK = 2048  # rows that matrices must have behind the last group: the largest gap between the numbers
_WORTH = 32 * 32  # elements of a weight from which oneDNN is faster
_WORTH_TRANSPOSED = 32 * 64  # the same where it is the rows that are summed over

_lock = threading.Lock()
_users, _before = 0, "none"  # how many threads use oneDNN at the moment, and the setting to restore after the last


def multiply(rows: Tensor, sizes: Sequence[int], weights: Sequence[Tensor], out: Tensor) -> None:
    """Every group of rows times a matrix of its own.

    Which library computes depends on the shape of the matrices alone, so a row's result does not depend on the others.

    Args:
        rows: (N, C_in), the groups one after another; `SLACK` rows of any content behind the last.
        sizes: rows of each group.
        weights: (C_in, C_out) of each group.
        out: (N, C_out), filled with the products; the slack rows are undefined afterwards.
    """
    if not weights or weights[0].numel() < _WORTH or not _is_for_onednn(rows):
        groups = (matrix[: sum(sizes)].split_with_sizes(tuple(sizes)) for matrix in (rows, out))
        for own, product, weight in zip(*groups, weights, strict=True):
            torch.mm(own, weight, out=product)
        return
    with _onednn():
        for start, size, weight in zip(accumulate(sizes, initial=0), sizes, weights):
            for begin in range(start, start + size, _KERNELS[-1]):  # the next group overwrites what is too much
                stretch = slice(begin, begin + _rounded_up(min(start + size - begin, _KERNELS[-1])))
                torch.mm(rows[stretch], weight, out=out[stretch])


def add_product(rows: Tensor, weight: Tensor, out: Tensor) -> None:
    """out (N, C_out) += rows (N, C_in) @ weight (C_in, C_out); as of `multiply`, a row's result is its own.

    Overwrites the scratch matrices "rows" and "products".
    """
    if weight.numel() < _WORTH or not _is_for_onednn(rows):
        out.addmm_(rows, weight)
        return
    with _onednn():
        for own, result in zip(torch.split(rows, _KERNELS[-1]), torch.split(out, _KERNELS[-1])):
            whole = scratch("rows", _rounded_up(len(own)), rows.shape[1], rows)
            whole[: len(own)] = own
            result += torch.mm(whole, weight, out=scratch("products", len(whole), out.shape[1], out))[: len(own)]


def add_transposed_product(rows: Tensor, others: Tensor, sizes: Sequence[int], outs: Sequence[Tensor]) -> None:
    """To the out (C, D) of each group its rows (N, C), transposed, times its others (N, D) are added."""
    groups = list(zip(*(matrix.split_with_sizes(tuple(sizes)) for matrix in (rows, others)), outs, strict=True))
    if outs and outs[0].numel() >= _WORTH_TRANSPOSED and _is_for_onednn(rows):
        with _onednn():
            groups = [_add_most(*group) for group in groups]
    for own, other, out in groups:
        if len(own):
            out.addmm_(own.t(), other)


def _add_most(rows: Tensor, others: Tensor, out: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Add the transposed product of all rows but the last, too few for the smallest kernel; what is left to add."""
    while len(rows) >= _KERNELS[0]:
        count = _KERNELS[bisect_right(_KERNELS, len(rows)) - 1]
        out.addmm_(rows[:count].t(), others[:count])
        rows, others = rows[count:], others[count:]
    return rows, others, out


def _rounded_up(rows: int) -> int:
    """The smallest number of rows that there is a kernel for, of at least so many."""
    return _KERNELS[bisect_left(_KERNELS, rows)]


def _is_for_onednn(rows: Tensor) -> bool:
    return rows.dtype == torch.float32 and rows.device.type == "cpu" and _onednn_is_faster()


@contextlib.contextmanager
def _onednn() -> Iterator[None]:
    """Within, torch computes float32 products by oneDNN. The setting is the whole process's, so threads share it."""
    global _users, _before
    setting = torch.backends.mkldnn.matmul  # type: ignore[attr-defined]
    with _lock:
        if not _users:
            _before, setting.fp32_precision = setting.fp32_precision, "bf16"
        _users += 1
    try:
        yield
    finally:
        with _lock:
            _users -= 1
            if not _users:
                setting.fp32_precision = "none"  # as that of all backends
                if setting.fp32_precision != _before:
                    setting.fp32_precision = _before


@functools.cache
def _onednn_is_faster() -> bool:
    """Whether the processor has AVX-512 and is not Intel's, and torch multiplies by oneDNN, in float32 throughout."""
    if torch.backends.cpu.get_cpu_capability() != "AVX512" or not torch.backends.mkldnn.is_available():  # type: ignore[no-untyped-call]
        return False
    cpuinfo = Path("/proc/cpuinfo")
    known = cpuinfo.exists() and "GenuineIntel" not in cpuinfo.read_text()
    return known and hasattr(torch.backends.mkldnn, "matmul") and _onednn_is_exact()


def _onednn_is_exact() -> bool:
    """Whether products of whole numbers that float32 holds and bfloat16 does not come out right."""
    rows = torch.arange(512 * 64).view(512, 64) * 7919 % 1999 - 999
    weight, others = rows[:64] % 201 - 100, rows % 33 - 16
    with _onednn():
        products = rows.float() @ weight.float(), rows.float().t() @ others.float()
    return torch.equal(products[0], (rows @ weight).float()) and torch.equal(products[1], (rows.t() @ others).float())
