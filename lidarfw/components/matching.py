"""Greedy one-to-one matching, shared by metrics and trackers."""

from __future__ import annotations

import torch
from torch import Tensor


def greedy_match(preference: Tensor) -> Tensor:
    """Column taken by each row, -1 for none, when the rows choose one after the other.

    `preference` (N, M): how much row i wants column j, -inf where the pair is not allowed. Row 0 chooses first;
    each row takes the column it wants most among those still free. Ties go to the lower column.

    Computed for all rows at once as a deferred acceptance (Gale and Shapley 1962): every row asks for its favourite,
    each column keeps the first of those who ask, the others strike that column off and ask again. As all columns
    rank the rows alike, the stable matching is the one of choosing in turn.
    """
    rows, columns = preference.shape
    preference = preference.clone()
    if rows == 0 or columns == 0:
        return torch.full((rows,), -1, dtype=torch.long, device=preference.device)
    row = torch.arange(rows, device=preference.device)
    while True:
        best, choice = preference.max(1)
        asks = best > -torch.inf
        holder = torch.full((columns,), rows, dtype=torch.long, device=preference.device)
        holder.scatter_reduce_(0, choice[asks], row[asks], "amin")
        lost = asks & (holder[choice] != row)
        if not lost.any():
            return torch.where(asks, choice, -1)
        preference[row[lost], choice[lost]] = -torch.inf
