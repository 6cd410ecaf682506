"""BEV IoU and greedy suppression compiled by numba, one pair of boxes at a time: a rival of `lidarfw bench ops`.

Imports numba, which lidarfw does not need; only `lidarfw.ops.rivals` imports this.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba  # type: ignore[import-not-found, unused-ignore]
import numpy as np

numba.config.THREADING_LAYER = "workqueue"  # its OpenMP layer would change the number of threads of torch
_compiled: Callable[[Any], Any] = numba.njit
_parallel: Callable[[Any], Any] = numba.njit(parallel=True)


def set_threads(count: int) -> None:
    """Of `matrix`, at most as many as there are."""
    numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))


@_compiled
def _clip(polygon: Any, count: int, clipped: Any, x0: float, y0: float, dx: float, dy: float) -> Any:
    """Write the part of the polygon left of the line from x0, y0 along dx, dy; the number of its corners."""
    kept = 0
    for i in range(count):
        j = (i + 1) % count
        x, y, u, v = polygon[i, 0], polygon[i, 1], polygon[j, 0], polygon[j, 1]
        here, there = dx * (y - y0) - dy * (x - x0), dx * (v - y0) - dy * (u - x0)
        if here >= 0:
            clipped[kept, 0], clipped[kept, 1] = x, y
            kept += 1
        if here * there < 0:
            t = here / (here - there)
            clipped[kept, 0], clipped[kept, 1] = x + t * (u - x), y + t * (v - y)
            kept += 1
    return kept


@_compiled
def _overlap(p: Any, q: Any) -> Any:
    """Area that two rectangles, four corners each, have in common."""
    polygon, clipped, count = np.empty((24, 2)), np.empty((24, 2)), 4
    polygon[:4] = p
    for edge in range(4):
        x, y, j = q[edge, 0], q[edge, 1], (edge + 1) % 4
        count = _clip(polygon, count, clipped, x, y, q[j, 0] - x, q[j, 1] - y)
        polygon, clipped = clipped, polygon
    area = 0.0
    for i in range(count):
        j = (i + 1) % count
        area += polygon[i, 0] * polygon[j, 1] - polygon[j, 0] * polygon[i, 1]
    return area / 2


@_compiled
def _iou(p: Any, q: Any, a: Any, b: Any, i: int, j: int) -> Any:
    """Of the boxes a[i] and b[j] with the corners p[i] and q[j]."""
    reach = (np.sqrt(a[i, 3] ** 2 + a[i, 4] ** 2) + np.sqrt(b[j, 3] ** 2 + b[j, 4] ** 2)) / 2
    if (a[i, 0] - b[j, 0]) ** 2 + (a[i, 1] - b[j, 1]) ** 2 >= reach * reach:
        return 0.0
    common = _overlap(p[i] - b[j, :2], q[j] - b[j, :2])
    return common / (a[i, 3] * a[i, 4] + b[j, 3] * b[j, 4] - common)


@_parallel
def matrix(p: Any, q: Any, a: Any, b: Any) -> Any:
    """(N, M) IoU of the boxes a (N, 7) and b (M, 7) with the corners p (N, 4, 2) and q (M, 4, 2)."""
    result = np.zeros((len(a), len(b)))
    for i in numba.prange(len(a)):
        for j in range(len(b)):
            result[i, j] = _iou(p, q, a, b, i, j)
    return result


@_compiled
def nms(p: Any, a: Any, threshold: float) -> Any:
    """(N,) bool, which of the boxes a (N, 7) with the corners p (N, 4, 2) stay; best first."""
    dropped = np.zeros(len(a), np.bool_)
    for i in range(len(a)):
        for j in range(i + 1, len(a)):
            if not dropped[i] and not dropped[j] and _iou(p, p, a, a, i, j) > threshold:
                dropped[j] = True
    return ~dropped
