"""From points to cells: canonical cell numbering, voxelisation, and scatter reductions.

Canonical order: cells sorted by (b, z, y, x). It is the order of one integer key per cell, so one
stable radix sort of the keys gives the cells, the points of each cell, and their number. The sums are
`embedding_bag` over that order, which is several times as fast as `index_add_` and adds the points of a
cell in their order in the scan: the same bits whatever the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from lidarfw.types import Grid, Points, Voxels

_INT32_CELLS = 2**31 - 1


@dataclass
class CellAssignment:
    """Which cell each point fell into, cells in canonical order."""

    index: Tensor  # (V, 4) int64 b, z, y, x, sorted, each cell once
    counts: Tensor  # (V,) int64 points in each cell
    order: Tensor  # (M,) int64 points inside the grid, sorted by cell, in a cell by their number
    points: int  # N, those outside the grid too

    @property
    def starts(self) -> Tensor:
        """(V + 1,) int64: the points of cell v are order[starts[v]:starts[v + 1]]."""
        return row_starts(self.counts)

    @cached_property
    def inverse(self) -> Tensor:
        """(N,) int64 row of `index` for each point, -1 outside the grid."""
        inverse = torch.full((self.points,), -1, device=self.order.device)
        rows = torch.arange(len(self.counts), device=self.order.device)
        return inverse.index_copy_(
            0, self.order, torch.repeat_interleave(rows, self.counts, output_size=len(self.order))
        )


def row_starts(counts: Tensor) -> Tensor:
    """Exclusive running sum (V + 1,) of counts (V,), in their type."""
    return F.pad(counts.cumsum(0, dtype=counts.dtype), (1, 0))


def key_type(cells: int) -> torch.dtype:
    """The narrowest integer type that numbers so many cells and one more; narrow keys sort faster."""
    return torch.int32 if cells < _INT32_CELLS else torch.int64


def cell_key(columns: tuple[Tensor, Tensor, Tensor, Tensor], shape: tuple[int, int, int]) -> Tensor:
    """Key ((b*D + z)*H + y)*W + x of cells given as four vectors (N,)."""
    b, z, y, x = columns
    return ((b * shape[0] + z) * shape[1] + y) * shape[2] + x


def cell_columns(key: Tensor, shape: tuple[int, int, int]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Inverse of `cell_key`: b, z, y, x (N,), in the type of the key."""
    columns = []
    for size in reversed(shape):
        quotient = torch.div(key, size, rounding_mode="floor")
        columns.append(torch.sub(key, quotient, alpha=size))
        key = quotient
    x, y, z = columns
    return key, z, y, x


def cell_index(columns: tuple[Tensor, ...]) -> Tensor:
    """(N, 4) int64 b, z, y, x of four vectors (N,)."""
    return torch.stack(columns, 1).long()


def _point_keys(xyz: Tensor, batch: Tensor, cells: int, grid: Grid, pillars: bool) -> Tensor:
    """Key of each point's cell, `cells` where it lies outside; the arithmetic of `Grid.index`, column by column."""
    key, inside = batch.to(key_type(cells)), torch.ones(len(xyz), dtype=torch.bool, device=xyz.device)
    for axis, size in zip((2, 1, 0), grid.shape(), strict=True):
        cell = (xyz[:, axis] - xyz.new_tensor(grid.lower[axis])).div_(xyz.new_tensor(grid.cell[axis])).floor_()
        clamped = cell.clamp(0, size - 1)
        inside.logical_and_(clamped == cell)  # False for NaN
        if not (pillars and axis == 2):
            key = (key * size).add_(clamped.to(key.dtype))
    return torch.where(inside, key, cells)


def assign_cells(xyz: Tensor, batch: Tensor, batch_size: int, grid: Grid, pillars: bool = False) -> CellAssignment:
    """The cell of every point, as `Grid.index` gives it.

    Args:
        xyz: (N, 3) metres.
        batch: (N,) int64, sample of each point, below `batch_size`.
        pillars: one cell over the whole height of the grid (z index 0); the z range still bounds the points.
    """
    depth, height, width = grid.shape()
    shape = (1 if pillars else depth, height, width)
    cells = batch_size * shape[0] * height * width
    key = _point_keys(xyz.detach(), batch, cells, grid, pillars)
    key, order = torch.sort(key, stable=True)
    inside = int((key < cells).sum())
    unique, counts = torch.unique_consecutive(key[:inside], return_counts=True)
    return CellAssignment(cell_index(cell_columns(unique, shape)), counts, order[:inside], len(xyz))


class _SegmentSum(torch.autograd.Function):
    """Sums of rows in sorted segments; the gradient of a row is that of its segment."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, order: Tensor, starts: Tensor, inverse: Tensor) -> Tensor:
        ctx.save_for_backward(inverse)
        return segment_sum(features, order, starts)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None]:
        (inverse,) = ctx.saved_tensors
        padded = torch.cat([gradient.new_zeros(1, gradient.shape[1]), gradient])
        return padded.index_select(0, inverse + 1), None, None, None


def segment_sum(features: Tensor, order: Tensor, starts: Tensor) -> Tensor:
    """(V, C) sums: row v adds features[order[starts[v]:starts[v + 1]]], in that order. Not differentiable."""
    if not order.numel() or not features.shape[1]:  # embedding_bag refuses rows of no width on some processors
        return features.new_zeros(len(starts) - 1, features.shape[1])
    return F.embedding_bag(order, features.detach(), starts, mode="sum", include_last_offset=True)


def _segments(inverse: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Rows sorted by segment and the segments' starts; segment 0 holds the rows with -1."""
    order = torch.sort(inverse, stable=True)[1]
    return order, row_starts(torch.bincount(inverse + 1, minlength=size + 1))


def scatter_sum(features: Tensor, inverse: Tensor, size: int) -> Tensor:
    """(size, C) sums of the rows of features (N, C) by inverse (N,) int64; -1 is ignored, empty rows are 0."""
    order, starts = _segments(inverse, size)
    ignored = torch.where(inverse < 0, -1, inverse + 1)  # the extra row 0 is cut off: its gradient stays 0
    summed: Tensor = _SegmentSum.apply(features, order, starts, ignored)  # type: ignore[no-untyped-call]
    return summed[1:]


def scatter_mean(features: Tensor, inverse: Tensor, size: int) -> Tensor:
    """(size, C) means of the rows of features (N, C) by inverse (N,) int64; -1 is ignored, empty rows are 0."""
    counts = torch.bincount(inverse + 1, minlength=size + 1)[1:]
    return scatter_sum(features, inverse, size) / counts.clamp(min=1)[:, None].to(features.dtype)


def scatter_max(features: Tensor, inverse: Tensor, size: int) -> Tensor:
    """(size, C) maxima of the rows of features (N, C) by inverse (N,) int64; -1 is ignored, empty rows are 0.

    Where several rows share the maximum, they share its gradient.
    """
    keep = inverse >= 0
    features = torch.where(keep[:, None], features, -torch.inf)
    target = inverse.clamp(min=0)[:, None].expand(-1, features.shape[1])
    rows = max(size, 1)  # ignored rows need a target, even where every row is ignored
    empty = features.new_full((rows, features.shape[1]), -torch.inf)
    highest = empty.scatter_reduce(0, target, features, "amax")[:size]
    return torch.where(torch.isneginf(highest), 0, highest)


def voxelize_mean(points: Points, grid: Grid) -> Voxels:
    """Voxels whose features (V, 3 + C) are the mean of [x, y, z, features] of their points.

    Points outside the grid are dropped. Differentiable with respect to the points' features.
    """
    cells = assign_cells(points.xyz, points.batch, points.batch_size, grid)
    features = points.features.to(points.xyz.dtype)
    starts = cells.starts
    summed = [segment_sum(points.xyz, cells.order, starts), _sum_features(features, cells, starts)]
    mean = torch.cat(summed, 1) / cells.counts[:, None].to(points.xyz.dtype)
    return Voxels(mean, cells.index, grid, grid.shape(), batch_size=points.batch_size)


def _sum_features(features: Tensor, cells: CellAssignment, starts: Tensor) -> Tensor:
    """(V, C) sums of features by cell, differentiable where the features are."""
    if not features.requires_grad:
        return segment_sum(features, cells.order, starts)
    summed: Tensor = _SegmentSum.apply(features, cells.order, starts, cells.inverse)  # type: ignore[no-untyped-call]
    return summed


def group_points(cells: CellAssignment, maximum: int) -> tuple[Tensor, Tensor]:
    """The first points of every cell, padded.

    Returns:
        rows: (V, maximum) int64 point numbers, in the scan's order, 0 where there is none.
        mask: (V, maximum) bool, True where there is a point. Index with rows, then zero by mask.
    """
    slot = torch.arange(maximum, device=cells.order.device)
    mask = slot < cells.counts[:, None]
    position = torch.where(mask, cells.starts[:-1, None] + slot, 0)
    rows = cells.order[position] if cells.order.numel() else position
    return torch.where(mask, rows, 0), mask


def find_voxels(voxels: Voxels, batch: Tensor, cell: Tensor) -> Tensor:
    """Row (...) of each cell (..., 3) z, y, x of a sample (...), len(voxels) where that cell is empty or outside."""
    b, z, y, x = voxels.index.unbind(1)
    keys = cell_key((b, z, y, x), voxels.shape)
    z, y, x = cell.unbind(-1)
    wanted = cell_key((batch, z, y, x), voxels.shape)
    within = ((cell >= 0) & (cell < cell.new_tensor(voxels.shape))).all(-1)
    rows = torch.searchsorted(keys, wanted)
    found = within & (torch.cat([keys, keys.new_tensor([-1])])[rows] == wanted)
    return torch.where(found, rows, len(voxels))
