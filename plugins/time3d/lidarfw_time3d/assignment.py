"""Which detection belongs to which track: one-to-one, by cost, deterministic."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

Array = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]

_NONE = np.zeros((0, 2), dtype=np.int64)


def hungarian(cost: Array, limit: float | Array) -> Int:
    """Pairs (P, 2) of row and column: of the cheapest assignment of `cost` (N, M), those within the limit.

    As in AB3DMOT all pairs take part in the assignment, and those above the limit are struck off afterwards.
    Pairs of infinite cost are never made.
    """
    possible = np.isfinite(cost)
    if not possible.any():
        return _NONE
    row, column = linear_sum_assignment(np.where(possible, cost, 1e6))
    good = possible[row, column] & (cost <= limit)[row, column]
    return np.stack([row[good], column[good]], 1)


def gated_hungarian(cost: Array, limit: float | Array) -> Int:
    """Pairs (P, 2) of row and column: as many within the limit as possible, and of those sets the cheapest."""
    possible = cost <= limit
    rows, columns = np.flatnonzero(possible.any(1)), np.flatnonzero(possible.any(0))
    if len(rows) == 0:
        return _NONE
    part, allowed = cost[rows[:, None], columns], possible[rows[:, None], columns]
    if (allowed.sum(0) == 1).all() and (allowed.sum(1) == 1).all():  # nobody competes
        row, column = allowed.nonzero()
    else:
        row, column = linear_sum_assignment(np.where(allowed, part, 1e6))
        row, column = row[allowed[row, column]], column[allowed[row, column]]
    return np.stack([rows[row], columns[column]], 1)


def greedy(cost: Array, limit: float | Array) -> Int:
    """Pairs (P, 2) of row and column, the cheapest pair first; ties go to the lower row, then column."""
    row, column = (cost <= limit).nonzero()
    order = np.lexsort((column, row, cost[row, column]))
    free_row, free_column = np.ones(cost.shape[0], dtype=bool), np.ones(cost.shape[1], dtype=bool)
    pairs = []
    for i, j in zip(row[order].tolist(), column[order].tolist()):
        if free_row[i] and free_column[j]:
            free_row[i] = free_column[j] = False
            pairs.append((i, j))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)
