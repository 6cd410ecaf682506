"""Cells of a bird's-eye-view map around and inside boxes, for losses that compare such maps with boxes."""

from __future__ import annotations

import torch
from torch import Tensor

from lidarfw.types import Boxes, Grid


def has_extent(boxes: Boxes) -> Tensor:
    """Whether each box (M,) is a place in space: finite, with positive sizes (2D-only labels are not)."""
    return boxes.tensor.isfinite().all(1) & (boxes.size > 0).all(1)


def inside_grid(boxes: Boxes, grid: Grid, stride: int) -> Tensor:
    """Whether each box (M,) has an extent and its centre in a cell of the BEV map."""
    _, height, width = grid.shape(stride)
    pixel = grid.pixel(boxes.center[:, :2], stride)
    in_map = (pixel >= 0).all(1) & (pixel < pixel.new_tensor([width, height])).all(1)
    return in_map & has_extent(boxes)


def windows(cell: Tensor, radius: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """The square windows of `radius` (M,) cells around cells (M, 2) column, row, cut at the border of the map.

    Returns the row number 0..M-1 and the cell (P, 2) column, row of every cell in a window.
    """
    side = 2 * radius + 1
    owner = torch.arange(len(cell), device=cell.device).repeat_interleave(side**2)
    start = (side**2).cumsum(0) - side**2
    number = torch.arange(len(owner), device=cell.device) - start[owner]
    offset = torch.stack([number % side[owner], number // side[owner]], 1) - radius[owner, None]
    place = cell[owner] + offset
    inside = ((place >= 0) & (place < place.new_tensor([width, height]))).all(1)
    return owner[inside], place[inside]


def footprints(boxes: Boxes, grid: Grid, stride: int, centers: bool = True) -> tuple[Tensor, Tensor]:
    """Cells whose centre lies in the footprint of a box, and, with `centers`, the cell of each box centre.

    Returns box number and cell (P, 2) column, row; a cell may come for several boxes.
    """
    _, height, width = grid.shape(stride)
    pixel = grid.pixel(boxes.center[:, :2], stride)
    cell = pixel.floor().long()
    size = pixel.new_tensor(grid.cell[:2]) * stride
    radius = (boxes.size[:, :2].norm(dim=1) / 2 / size.min()).ceil().long()
    owner, place = windows(cell, radius, height, width)
    offset = (place + 0.5 - pixel[owner]) * size
    cos, sin = boxes.yaw[owner].cos(), boxes.yaw[owner].sin()
    local = torch.stack([cos * offset[:, 0] + sin * offset[:, 1], cos * offset[:, 1] - sin * offset[:, 0]], 1)
    covered = (local.abs() <= boxes.size[owner, :2] / 2).all(1)
    if centers:
        covered = covered | (place == cell[owner]).all(1)
    return owner[covered], place[covered]
