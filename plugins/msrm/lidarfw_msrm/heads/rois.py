"""Regions of interest: their frame, the boxes they overlap, and which of them are trained on.

Sources: the MSRM paper, section II-C; where it is silent, CasA (Wu et al., TGRS 2022), as its configuration for KITTI.
"""

from __future__ import annotations

import math

import torch
from lidarfw.components.heads.anchor import decode, encode
from lidarfw.ops import iou_3d
from lidarfw.types import Boxes
from torch import Tensor

SMALLEST = 0.01  # metres; a stage must not hand a box without extent to the next
HARD = 0.1  # IoU from which a background region is a hard one
HARD_SHARE = 0.8  # of the background


def to_local(boxes: Tensor, rois: Tensor) -> Tensor:
    """Boxes (N, 7) seen from regions (N, 7): centre and yaw relative to the region's."""
    offset, yaw = boxes[:, :3] - rois[:, :3], rois[:, 6]
    return torch.cat([_turned(offset, -yaw), boxes[:, 3:6], (boxes[:, 6] - yaw)[:, None]], 1)


def to_sensor(boxes: Tensor, rois: Tensor) -> Tensor:
    """The inverse of `to_local`."""
    yaw = rois[:, 6]
    return torch.cat([_turned(boxes[:, :3], yaw) + rois[:, :3], boxes[:, 3:6], (boxes[:, 6] + yaw)[:, None]], 1)


def _turned(xyz: Tensor, angle: Tensor) -> Tensor:
    cos, sin = angle.cos(), angle.sin()
    x, y, z = xyz.unbind(1)
    return torch.stack([x * cos - y * sin, x * sin + y * cos, z], 1)


def fold(yaw: Tensor) -> Tensor:
    """The same axis with a yaw in (-pi/2, pi/2]."""
    return math.pi / 2 - (math.pi / 2 - yaw).remainder(math.pi)


def _upright(rois: Tensor) -> Tensor:
    """The regions in their own frame: at the origin, yaw 0."""
    size = rois[:, 3:6].clamp(min=SMALLEST)
    return torch.cat([torch.zeros_like(size), size, torch.zeros_like(size[:, :1])], 1)


def residuals(boxes: Tensor, rois: Tensor) -> Tensor:
    """What takes regions (N, 7) to boxes (N, 7), in the region's frame; a box may point the other way."""
    local = to_local(boxes, rois)
    return encode(torch.cat([local[:, :6], fold(local[:, 6:])], 1), _upright(rois))


def refine(residual: Tensor, rois: Tensor) -> Tensor:
    """Boxes (N, 7) of residuals (N, 7), the inverse of `residuals`."""
    boxes = to_sensor(decode(residual, _upright(rois)), rois)
    return torch.cat([boxes[:, :3], boxes[:, 3:6].clamp(min=SMALLEST), boxes[:, 6:]], 1)


def best_overlap(boxes: Tensor, rois: Boxes, others: Boxes) -> tuple[Tensor, Tensor]:
    """3D IoU (N,) of boxes (N, 7), one for each region, with the best of `others` of its sample and class, and its
    row (N,); 0 and 0 where there is none. A box of label -1 stands for every class."""
    if len(others) == 0:
        return boxes.new_zeros(len(boxes)), rois.label.new_zeros(len(boxes))
    comparable = (rois.label[:, None] == others.label) | (others.label == -1)
    comparable &= rois.batch[:, None] == others.batch
    best: tuple[Tensor, Tensor] = torch.where(comparable, iou_3d(boxes, others.tensor), 0.0).max(1)
    return best


def sampled(overlap: Tensor, foreground: Tensor, batch: Tensor, batch_size: int, count: int) -> Tensor:
    """Rows of at most `count` regions a sample, in their old order: half of them foreground, the others background
    of which 80 % are hard; whatever is there fills up what is short.

    Args:
        overlap: (N,) best IoU of each region.
        foreground: (N,) IoU from which the region is foreground.
        batch: (N,) sample of each region.
    """
    kind = torch.where(overlap >= foreground, 0, torch.where(overlap >= HARD, 1, 2))
    group = batch * 3 + kind
    there = group.bincount(minlength=batch_size * 3).view(batch_size, 3)
    objects = there[:, 0].clamp(max=count // 2)
    hard = torch.minimum(there[:, 1], (HARD_SHARE * (count - objects)).long())
    easy = torch.minimum(there[:, 2], count - objects - hard)
    quota = torch.stack([objects, hard, easy], 1).flatten()
    chosen = _random_rank(group) < quota[group]
    # regions that no quota wanted come last in their sample's order
    order = _random_rank(batch * 2 + (~chosen).long()) + torch.where(chosen, 0, len(batch))
    rank = _rank(batch, order)
    return (rank < count).nonzero()[:, 0]


def _random_rank(group: Tensor) -> Tensor:
    """Place (N,) of each row in a random order of its group."""
    return _rank(group, torch.randperm(len(group), device=group.device))


def _rank(group: Tensor, order: Tensor) -> Tensor:
    """Place (N,) of each row in its group by `order` (N,)."""
    rows = order.argsort(stable=True)
    rows = rows[group[rows].argsort(stable=True)]
    starts = group.bincount().cumsum(0) - group.bincount()
    rank = torch.empty_like(rows)
    rank[rows] = torch.arange(len(rows), device=rows.device) - starts[group[rows]]
    return rank
