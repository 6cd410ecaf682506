"""Rotated boxes (N, 7) x, y, z, l, w, h, yaw: corners, points inside, intersection over union.

Metres and radians; (x, y, z) is the geometric centre, l lies along the heading, yaw turns counter-clockwise
from x.

The overlap of two rotated rectangles needs no polygon and no sorting. By Green's theorem its area is half the
sum of cross products over its boundary, and the boundary is the part of A's edges inside B and the part of
B's edges inside A. An edge against a rectangle, seen in that rectangle's own frame, is a clip to two slabs
(Liang and Barsky, 1984). Edges that lie on each other would count twice: B grows by a hair for A's edges,
and A shrinks by it for B's. The hair is 1e-9 m in float64 and 1e-5 m otherwise, which bounds the error.

All overlaps compute in float64 where a box tensor is float64, in float32 otherwise, and are differentiable.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

_PAIRS = 8192  # pairs per chunk: its vectors stay in the processor's cache
_MASK = 2**20  # elements of a pair mask formed at once


def box_corners(boxes: Tensor) -> Tensor:
    """Corners (N, 8, 3) of boxes (N, 7): the bottom four counter-clockwise from front left, then the top four."""
    signs = boxes.new_tensor([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / 2
    x, y = (boxes[:, None, 3:5] * signs).unbind(-1)
    cos, sin = boxes[:, 6:7].cos(), boxes[:, 6:7].sin()
    plane = torch.stack([x * cos - y * sin, x * sin + y * cos], -1) + boxes[:, None, :2]
    half = boxes[:, None, 5:6] / 2
    bottom, top = (z.expand(-1, 4, 1) for z in (boxes[:, None, 2:3] - half, boxes[:, None, 2:3] + half))
    return torch.cat([torch.cat([plane, bottom], 2), torch.cat([plane, top], 2)], 1)


def _containing_pairs(
    xyz: Tensor, boxes: Tensor, xyz_batch: Tensor | None, box_batch: Tensor | None
) -> tuple[Tensor, Tensor]:
    """(point, box) pairs, each (P,) int64, of all points inside a box of their sample, ascending."""
    radius = boxes[:, 3:5].norm(dim=1) / 2
    rows = max(_MASK // max(len(boxes), 1), 1)
    parts = []
    for start in range(0, len(xyz), rows):
        part = xyz[start : start + rows]
        near = (part[:, :1] - boxes[:, 0]) ** 2 + (part[:, 1:2] - boxes[:, 1]) ** 2 <= (radius * 1.001) ** 2
        if xyz_batch is not None and box_batch is not None:
            near &= xyz_batch[start : start + rows, None] == box_batch
        parts.append(near.nonzero() + near.new_tensor([start, 0], dtype=torch.long))
    pairs = torch.cat(parts) if parts else torch.zeros(0, 2, dtype=torch.long, device=xyz.device)
    inside = _inside(xyz[pairs[:, 0]], boxes[pairs[:, 1]])
    return pairs[inside, 0], pairs[inside, 1]


def _inside(xyz: Tensor, boxes: Tensor) -> Tensor:
    """(P,) bool: point p lies in box p or on its surface."""
    offset = xyz - boxes[:, :3]
    cos, sin = boxes[:, 6].cos(), boxes[:, 6].sin()
    along = offset[:, 0] * cos + offset[:, 1] * sin
    across = offset[:, 1] * cos - offset[:, 0] * sin
    local = torch.stack([along, across, offset[:, 2]], 1)
    return (local.abs() <= boxes[:, 3:6] / 2).all(1)


def points_in_boxes_mask(
    xyz: Tensor, boxes: Tensor, xyz_batch: Tensor | None = None, box_batch: Tensor | None = None
) -> Tensor:
    """(N, M) bool: point lies in box or on its surface. With the batches, only boxes of the point's sample count."""
    mask = torch.zeros(len(xyz), len(boxes), dtype=torch.bool, device=xyz.device)
    mask[_containing_pairs(xyz, boxes, xyz_batch, box_batch)] = True
    return mask


def points_in_boxes(
    xyz: Tensor, boxes: Tensor, xyz_batch: Tensor | None = None, box_batch: Tensor | None = None
) -> Tensor:
    """(N,) int64: the first box that contains each point, -1 where none does.

    Args:
        xyz: (N, 3) metres.
        boxes: (M, 7).
        xyz_batch, box_batch: (N,), (M,) int64; with both, only boxes of the point's sample count.
    """
    point, box = _containing_pairs(xyz, boxes, xyz_batch, box_batch)
    first = torch.full((len(xyz),), len(boxes), dtype=torch.long, device=xyz.device)
    first.scatter_reduce_(0, point, box, "amin")
    return torch.where(first < len(boxes), first, -1)


def points_per_box(
    xyz: Tensor, boxes: Tensor, xyz_batch: Tensor | None = None, box_batch: Tensor | None = None
) -> Tensor:
    """(M,) int64: how many points (N, 3) lie in each box (M, 7) or on its surface; batches as in `points_in_boxes`."""
    return _containing_pairs(xyz, boxes, xyz_batch, box_batch)[1].bincount(minlength=len(boxes))


def _clipped_share(start: tuple[Tensor, Tensor], step: tuple[Tensor, Tensor], half: tuple[Tensor, Tensor]) -> Tensor:
    """Share 0..1 of each edge start + t step, t in 0..1, that lies in the rectangle |x| <= half x, |y| <= half y."""
    low, high = torch.zeros_like(start[0]), torch.ones_like(start[0])
    tiny = torch.finfo(low.dtype).tiny ** 0.5
    for origin, direction, extent in zip(start, step, half, strict=True):
        inverse = 1 / torch.where(direction.abs() < tiny, tiny, direction)
        first, second = (-extent - origin) * inverse, (extent - origin) * inverse
        low = torch.maximum(low, torch.minimum(first, second))
        high = torch.minimum(high, torch.maximum(first, second))
    return (high - low).clamp(min=0)


def _edges(x: Tensor, y: Tensor) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Starts and steps of the edges between consecutive corners x, y (4, P)."""
    return (x, y), (x.roll(-1, 0) - x, y.roll(-1, 0) - y)


def _overlap_area(a: Tensor, b: Tensor) -> Tensor:
    """Common BEV area (P,) of box p of a (7, P) and box p of b (7, P)."""
    hair = 1e-9 if a.dtype == torch.float64 else 1e-5
    corners = a.new_tensor([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])[:, :, None] / 2
    cos_b, sin_b, dx, dy = b[6].cos(), b[6].sin(), a[0] - b[0], a[1] - b[1]
    x, y = dx * cos_b + dy * sin_b, dy * cos_b - dx * sin_b  # centre of A in B's frame
    cos, sin = (a[6] - b[6]).cos(), (a[6] - b[6]).sin()
    along, across = corners[:, 0] * a[3], corners[:, 1] * a[4]
    start, step = _edges(x + along * cos - across * sin, y + along * sin + across * cos)
    share = _clipped_share(start, step, (b[3] / 2 + hair, b[4] / 2 + hair))
    boundary_a = (share * (start[0] * step[1] - start[1] * step[0])).sum(0)
    along, across = corners[:, 0] * b[3] - x, corners[:, 1] * b[4] - y
    start, step = _edges(along * cos + across * sin, across * cos - along * sin)  # B in A's frame
    share = _clipped_share(start, step, ((a[3] / 2 - hair).clamp(min=0), (a[4] / 2 - hair).clamp(min=0)))
    boundary_b = share.sum(0) * (b[3] * b[4] / 2)  # every edge of B spans half its area with B's centre
    return ((boundary_a + boundary_b) / 2).clamp(min=0)


def _overlap_height(a: Tensor, b: Tensor) -> Tensor:
    top = torch.minimum(a[2] + a[5] / 2, b[2] + b[5] / 2)
    return (top - torch.maximum(a[2] - a[5] / 2, b[2] - b[5] / 2)).clamp(min=0)


def _ratio(common: Tensor, size_a: Tensor, size_b: Tensor) -> Tensor:
    return common / (size_a + size_b - common).clamp(min=torch.finfo(common.dtype).tiny ** 0.5)


def plane_ratio(a: Tensor, b: Tensor) -> Tensor:
    """(P,) IoU in the ground plane of boxes a and b, (7, P) both."""
    return _ratio(_overlap_area(a, b), a[3] * a[4], b[3] * b[4])


def volume_ratio(a: Tensor, b: Tensor) -> Tensor:
    """(P,) volumetric IoU of boxes a and b, (7, P) both."""
    common = _overlap_area(a, b) * _overlap_height(a, b)
    return _ratio(common, a[3] * a[4] * a[5], b[3] * b[4] * b[5])


def _cross(x: Tensor, y: Tensor, u: Tensor, v: Tensor) -> Tensor:
    return x * v - y * u


def _hull_area(x: Tensor, y: Tensor) -> Tensor:
    """Area (P,) of the convex hull of points x, y (K, P), by gift wrapping from the lowest point."""
    here = torch.argmin(y.detach(), 0, keepdim=True)
    first_x = here_x = x.gather(0, here)[0]
    first_y = here_y = y.gather(0, here)[0]
    area, open_hull = torch.zeros_like(first_x), torch.ones_like(first_x, dtype=torch.bool)
    for _ in range(len(x)):
        next_x, next_y = x[0], y[0]
        for other_x, other_y in zip(x[1:], y[1:], strict=True):
            turn = _cross(next_x - here_x, next_y - here_y, other_x - here_x, other_y - here_y)
            farther = (other_x - here_x).hypot(other_y - here_y) > (next_x - here_x).hypot(next_y - here_y)
            better = (turn < 0) | ((turn == 0) & farther)
            next_x, next_y = torch.where(better, other_x, next_x), torch.where(better, other_y, next_y)
        swept = _cross(here_x - first_x, here_y - first_y, next_x - first_x, next_y - first_y)
        area = area + torch.where(open_hull, swept, 0)
        open_hull = open_hull & ((next_x != first_x) | (next_y != first_y))
        here_x, here_y = next_x, next_y
    return area / 2


def _generalized(a: Tensor, b: Tensor) -> Tensor:
    common = _overlap_area(a, b) * _overlap_height(a, b)
    union = a[3] * a[4] * a[5] + b[3] * b[4] * b[5] - common
    corners = torch.cat([box_corners(a.t())[:, :4], box_corners(b.t())[:, :4]], 1)
    height = torch.maximum(a[2] + a[5] / 2, b[2] + b[5] / 2) - torch.minimum(a[2] - a[5] / 2, b[2] - b[5] / 2)
    hull = _hull_area(corners[..., 0].t(), corners[..., 1].t()) * height
    tiny = torch.finfo(union.dtype).tiny ** 0.5
    return common / union.clamp(min=tiny) - (hull - union) / hull.clamp(min=tiny)


def _precise(*boxes: Tensor) -> list[Tensor]:
    """The boxes in float64 where one of them is, in float32 otherwise."""
    wide = any(b.dtype == torch.float64 for b in boxes)
    return [b.to(torch.float64 if wide else torch.float32) for b in boxes]


def close_pairs(a: Tensor, b: Tensor) -> Tensor:
    """(N, M) bool: the circles round the BEV rectangles touch; where they do not, there is no overlap."""
    reach = a[:, None, 3:5].norm(dim=2) / 2 + b[None, :, 3:5].norm(dim=2) / 2
    apart: Tensor = (a[:, None, 0] - b[:, 0]) ** 2 + (a[:, None, 1] - b[:, 1]) ** 2
    close: Tensor = apart < reach**2
    return close


def overlap_at(
    a: Tensor, b: Tensor, pairs: Tensor, measure: Callable[[Tensor, Tensor], Tensor] = plane_ratio
) -> Tensor:
    """`measure` (P,) of the boxes a[pairs[:, 0]] and b[pairs[:, 1]], in chunks."""
    chunks = pairs.split(_PAIRS)  # type: ignore[no-untyped-call]
    values = [measure(a[p[:, 0]].t().contiguous(), b[p[:, 1]].t().contiguous()) for p in chunks]
    return torch.cat(values)


def _matrix(a: Tensor, b: Tensor, measure: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """(N, M) values of `measure` where the circles touch, 0 elsewhere."""
    a, b = _precise(a, b)
    rows = max(_MASK // max(len(b), 1), 1)
    parts = [close_pairs(a[i : i + rows].detach(), b.detach()).nonzero() for i in range(0, len(a), rows)]
    for number, part in enumerate(parts):
        part[:, 0] += number * rows
    pairs = torch.cat(parts) if parts else torch.zeros(0, 2, dtype=torch.long, device=a.device)
    return a.new_zeros(len(a), len(b)).index_put((pairs[:, 0], pairs[:, 1]), overlap_at(a, b, pairs, measure))


def iou_bev(a: Tensor, b: Tensor) -> Tensor:
    """(N, M) intersection over union in the ground plane of boxes a (N, 7) and b (M, 7)."""
    return _matrix(a, b, plane_ratio)


def iou_3d(a: Tensor, b: Tensor) -> Tensor:
    """(N, M) volumetric intersection over union of boxes a (N, 7) and b (M, 7)."""
    return _matrix(a, b, volume_ratio)


def giou_3d(a: Tensor, b: Tensor) -> Tensor:
    """(N, M) generalized IoU of boxes a (N, 7) and b (M, 7), -1..1.

    Rezatofighi et al., "Generalized Intersection over Union" (CVPR 2019), algorithm 1, with the upright prism
    over the convex hull of both boxes' ground outlines as the enclosing shape.
    """
    a, b = _precise(a, b)
    every = torch.ones(len(a), len(b), dtype=torch.bool, device=a.device).nonzero()
    return overlap_at(a, b, every, _generalized).reshape(len(a), len(b))


def _paired(a: Tensor, b: Tensor, measure: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    if a.shape != b.shape:
        raise ValueError(f"paired overlap: as many boxes on both sides, got {tuple(a.shape)} and {tuple(b.shape)}")
    a, b = _precise(a, b)
    return measure(a.t(), b.t())


def paired_iou_bev(a: Tensor, b: Tensor) -> Tensor:
    """(N,) BEV IoU of box i of a (N, 7) with box i of b (N, 7); differentiable."""
    return _paired(a, b, plane_ratio)


def paired_iou_3d(a: Tensor, b: Tensor) -> Tensor:
    """(N,) 3D IoU of box i of a (N, 7) with box i of b (N, 7); differentiable."""
    return _paired(a, b, volume_ratio)


def paired_giou_3d(a: Tensor, b: Tensor) -> Tensor:
    """(N,) generalized 3D IoU of box i of a (N, 7) with box i of b (N, 7); differentiable."""
    return _paired(a, b, _generalized)


def nearest_bev_iou(a: Tensor, b: Tensor) -> Tensor:
    """(N, M) IoU of the boxes' axis-aligned BEV rectangles, yaw rounded to 0 or 90 degrees.

    The measure by which SECOND (Yan et al., 2018) and its followers match anchors.
    """
    a, b = _precise(a, b)
    (left_a, low_a, right_a, high_a, area_a), (left_b, low_b, right_b, high_b, area_b) = map(_upright, (a, b))
    width = torch.minimum(right_a[:, None], right_b).sub_(torch.maximum(left_a[:, None], left_b)).clamp_(min=0)
    height = torch.minimum(high_a[:, None], high_b).sub_(torch.maximum(low_a[:, None], low_b)).clamp_(min=0)
    return _ratio(width.mul_(height), area_a[:, None], area_b)


def _upright(boxes: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Left, low, right, high (N,) and area of the boxes with yaw rounded to a multiple of 90 degrees."""
    boxes = boxes.detach()
    turned = torch.round(boxes[:, 6] / (math.pi / 2)).long() % 2 == 1
    size_x = torch.where(turned, boxes[:, 4], boxes[:, 3])
    size_y = torch.where(turned, boxes[:, 3], boxes[:, 4])
    x, y = boxes[:, 0], boxes[:, 1]
    return x - size_x / 2, y - size_y / 2, x + size_x / 2, y + size_y / 2, size_x * size_y
