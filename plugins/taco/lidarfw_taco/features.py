"""Vectors out of bird's-eye-view maps: of objects, of the strongest cells, and how alike they are.

Nothing here has parameters. Vectors are float32 whatever the map is, since sums of products overflow in 16 bits.
Source: TACO, section 4; what it leaves open is said where it is decided.
"""

from __future__ import annotations

import torch
from lidarfw.components.losses.bev import footprints, has_extent, inside_grid
from lidarfw.errors import AssemblyError
from lidarfw.types import BEV, Boxes, Spec
from torch import Tensor, nn

MODES = ("raw", "relu", "square")
POOLING = ("mean", "center")
SMALLEST = 1e-6  # norm below which a vector counts as 0, and its cosine with anything too


def require_equal_widths(loss: str, detection: Spec, localization: Spec) -> None:
    """AssemblyError unless both taps have the same number of channels."""
    if detection.channels != localization.channels:
        raise AssemblyError(
            f"{loss} compares the taps of two heads, but detection has {detection.channels} channels and localization "
            f"{localization.channels}.\n  fix: equal widths, for example head.center.channels={localization.channels}"
        )


def object_features(bev: BEV, boxes: Boxes, pooling: str = "mean") -> tuple[Tensor, Tensor]:
    """One vector (M', C) of each object with its centre on the map, and the rows (M',) of `boxes` they belong to.

    `mean`: of the cells whose centre lies in the footprint; of an object that covers none, the cell of its centre.
    `center`: bilinear at the centre.
    """
    rows = inside_grid(boxes, bev.grid, bev.stride).nonzero()[:, 0]
    kept = boxes[rows]
    if pooling == "center":
        return _at(bev, kept.batch, kept.center[:, :2]), rows
    owner, cell = footprints(kept, bev.grid, bev.stride, centers=False)
    none = torch.ones_like(rows, dtype=torch.bool).index_fill(0, owner, False)
    alone = none.nonzero()[:, 0]
    place = bev.grid.pixel(kept.center[alone, :2], bev.stride).floor().long()
    owner, cell = torch.cat([owner, alone]), torch.cat([cell, place])
    vectors = bev.features[kept.batch[owner], :, cell[:, 1], cell[:, 0]].float()
    total = vectors.new_zeros(len(kept), vectors.shape[1]).index_add(0, owner, vectors)
    return total / owner.bincount(minlength=len(kept)).clamp(min=1)[:, None], rows


def cell_features(bev: BEV, boxes: Boxes) -> tuple[Tensor, Tensor]:
    """Vectors (P, C) of all cells whose centre lies in a footprint, and the sample (P,) of each."""
    kept = boxes[has_extent(boxes)]
    owner, cell = footprints(kept, bev.grid, bev.stride, centers=False)
    batch = kept.batch[owner]
    return bev.features[batch, :, cell[:, 1], cell[:, 0]].float(), batch


def _at(bev: BEV, batch: Tensor, xy: Tensor) -> Tensor:
    """Vectors (M, C) bilinear at places (M, 2) in metres; beyond the outermost cell centres, those cells."""
    _, _, height, width = bev.features.shape
    pixel = bev.grid.pixel(xy, bev.stride) - 0.5
    limit = pixel.new_tensor([width - 1, height - 1])
    pixel = torch.minimum(pixel.clamp(min=0), limit)
    low = torch.minimum(pixel.floor(), (limit - 1).clamp(min=0)).long()
    high, share = torch.minimum(low + 1, limit.long()), pixel - low

    def look(column: Tensor, row: Tensor) -> Tensor:
        return bev.features[batch, :, row, column].float()

    right, up = share[:, :1], share[:, 1:]
    below: Tensor = look(low[:, 0], low[:, 1]) * (1 - right) + look(high[:, 0], low[:, 1]) * right
    above: Tensor = look(low[:, 0], high[:, 1]) * (1 - right) + look(high[:, 0], high[:, 1]) * right
    mixed: Tensor = below * (1 - up) + above * up
    return mixed


def occupied(bev: BEV, boxes: Boxes) -> Tensor:
    """Cells (B, H, W) bool that lie in the footprint of an object, or hold its centre."""
    kept = boxes[has_extent(boxes)]
    owner, cell = footprints(kept, bev.grid, bev.stride)
    mask = torch.zeros(bev.features[:, 0].shape, dtype=torch.bool, device=bev.features.device)
    mask[kept.batch[owner], cell[:, 1], cell[:, 0]] = True
    return mask


def top_cells(bev: BEV, count: int, excluded: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """The `count` cells of each sample whose vectors are longest, fewer where there are not so many.

    Empty cells (vector 0) and those in `excluded` (B, H, W) are never among them; of equal ones the first comes
    first. Returns the vectors (B, n, C), whether there is a cell (B, n), and its flat index (B, n). The choice has no
    gradient, the vectors have.
    """
    cells = bev.features.flatten(2)
    with torch.no_grad():
        norm = torch.linalg.vector_norm(cells.float(), dim=1)
        norm = norm if excluded is None else norm.masked_fill(excluded.flatten(1), 0)
        norm, index = norm.sort(dim=1, descending=True, stable=True)
        norm, index = norm[:, :count], index[:, :count]
    chosen = cells.gather(2, index[:, None].expand(-1, cells.shape[1], -1))
    return chosen.transpose(1, 2).float(), norm > 0, index


def unit(vectors: Tensor) -> Tensor:
    """Vectors of length 1 along the last axis; those shorter than SMALLEST stay (almost) 0."""
    norm: Tensor = torch.linalg.vector_norm(vectors, dim=-1, keepdim=True)
    return vectors / norm.clamp(min=SMALLEST)


def mean_similarity(cells: Tensor, valid: Tensor, objects: Tensor, batch: Tensor, mode: str = "raw") -> Tensor:
    """(B,) mean over all pairs of a cell and an object of the same sample; 0 where a sample lacks one of them.

    `cells` (B, n, C) with `valid` (B, n), `objects` (M, C) with their samples `batch` (M,). By `mode` the cosine as it
    is, its positive part, or its square.
    """
    with torch.autocast(cells.device.type, enabled=False):
        cosine = torch.einsum("mc,mnc->mn", unit(objects), unit(cells)[batch])
    if mode == "relu":
        cosine = nn.functional.relu(cosine)
    elif mode == "square":
        cosine = cosine**2
    each = (cosine * valid[batch]).sum(1)
    total = each.new_zeros(len(cells)).index_add(0, batch, each)
    pairs = valid.sum(1) * batch.bincount(minlength=len(cells))
    return total / pairs.clamp(min=1)
