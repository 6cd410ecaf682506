"""Sampling of points and search among them, sample by sample of a batch."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

_DISTANCES = 2**24  # distances formed at once on a GPU


def farthest_points(xyz: Tensor, batch: Tensor, batch_size: int, count: int) -> Tensor:
    """(batch_size, count) int64 rows: each next point is the farthest from those chosen, the first row first.

    Qi et al., "PointNet++" (NeurIPS 2017), section 3.2. A sample of fewer points repeats its first row; one of
    none gives -1. Steps follow each other, but all points and samples of a step are done at once.
    """
    rows, mask = _padded_rows(batch, batch_size)
    if rows.shape[1] == 0:
        return rows.new_full((batch_size, count), -1)
    places = torch.where(mask[..., None], xyz.detach()[rows], torch.nan).permute(2, 0, 1).contiguous()
    nearest = torch.where(mask, torch.inf, -1.0).to(xyz.dtype)
    chosen = rows.new_zeros(batch_size, count)
    for step in range(count):
        at = chosen[:, step, None]
        apart = sum((axis - axis.gather(1, at)) ** 2 for axis in places)
        nearest = torch.where(mask, torch.minimum(nearest, apart), nearest)
        if step + 1 < count:
            chosen[:, step + 1] = torch.where(nearest.amax(1) > 0, nearest.argmax(1), 0)
    return torch.where(mask.any(1, keepdim=True), rows.gather(1, chosen), -1)


def _padded_rows(batch: Tensor, batch_size: int) -> tuple[Tensor, Tensor]:
    """(B, L) int64 rows of each sample, ascending, and a mask; 0 where there is none."""
    order = torch.sort(batch, stable=True)[1]
    counts = torch.bincount(batch, minlength=batch_size)
    slot = torch.arange(int(counts.max()) if batch_size else 0, device=batch.device)
    mask = slot < counts[:, None]
    rows = torch.zeros(mask.shape, dtype=torch.long, device=batch.device)
    rows[mask] = order
    return rows, mask


def knn(
    query: Tensor,
    query_batch: Tensor,
    reference: Tensor,
    reference_batch: Tensor,
    count: int,
    radius: float = float("inf"),
) -> tuple[Tensor, Tensor]:
    """The nearest reference points of the same sample for every query point, nearest first.

    A k-d tree on the CPU; on a GPU all distances, in blocks. Not differentiable.

    Args:
        query, reference: (Q, 3), (R, 3) metres.
        query_batch, reference_batch: (Q,), (R,) int64.
        count: neighbours of each point.
        radius: metres beyond which there is no neighbour.

    Returns:
        index: (Q, count) int64 rows of reference, -1 where there are fewer.
        distance: (Q, count) metres, inf where index is -1.
    """
    index = torch.full((len(query), count), -1, dtype=torch.long, device=query.device)
    distance = query.new_full((len(query), count), torch.inf)
    search = _search_tree if query.device.type == "cpu" else _search_all
    for sample in torch.unique(query_batch).tolist():
        wanted = (query_batch == sample).nonzero().squeeze(1)
        there = (reference_batch == sample).nonzero().squeeze(1)
        if len(there):
            place, apart = search(query.detach()[wanted], reference.detach()[there], min(count, len(there)))
            found = apart <= radius
            index[wanted, : place.shape[1]] = torch.where(found, there[place], -1)
            distance[wanted, : place.shape[1]] = torch.where(found, apart, torch.inf)
    return index, distance


def _search_tree(query: Tensor, reference: Tensor, count: int) -> tuple[Tensor, Tensor]:
    tree = cKDTree(reference.numpy())
    apart, place = tree.query(query.numpy(), np.arange(1, count + 1), workers=torch.get_num_threads())
    return torch.from_numpy(place).long(), torch.from_numpy(apart).to(query.dtype)


def _search_all(query: Tensor, reference: Tensor, count: int) -> tuple[Tensor, Tensor]:
    exact = "donot_use_mm_for_euclid_dist"
    blocks = query.split(max(_DISTANCES // len(reference), 1))  # type: ignore[no-untyped-call]
    found = [torch.cdist(q, reference, compute_mode=exact).topk(count, largest=False) for q in blocks]
    return torch.cat([f.indices for f in found]), torch.cat([f.values for f in found])


def ball_query(
    query: Tensor, query_batch: Tensor, reference: Tensor, reference_batch: Tensor, radius: float, count: int
) -> Tensor:
    """(Q, count) int64 the nearest reference points within `radius` metres, -1 where there are fewer."""
    return knn(query, query_batch, reference, reference_batch, count, radius)[0]


def three_interpolate(
    query: Tensor, query_batch: Tensor, reference: Tensor, reference_batch: Tensor, features: Tensor
) -> Tensor:
    """(Q, C) features at the query points: mean of the three nearest reference points, weighted by 1 / distance^2.

    Qi et al., "PointNet++" (NeurIPS 2017), equation 2. Differentiable with respect to features (R, C). Zero
    where the sample has no reference point.
    """
    index, distance = knn(query, query_batch, reference, reference_batch, 3)
    weight = torch.where(index >= 0, 1 / distance.square().clamp(min=1e-8), 0).to(features.dtype)
    weight = weight / weight.sum(1, keepdim=True).clamp(min=torch.finfo(weight.dtype).tiny)
    if not len(features):
        return features.new_zeros(len(query), features.shape[1]) + features.sum()
    return (features[index.clamp(min=0)] * weight[..., None]).sum(1)
