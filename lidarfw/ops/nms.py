"""Non-maximum suppression, in blocks, with the result of the greedy algorithm.

Boxes are taken in blocks of descending score. A block drops what the boxes kept so far suppress; what is
left is solved at once: a box stays unless a box of higher score that stays suppresses it. Repeating that
rule from "all stay" reaches the greedy answer, since after each round one more link of every chain is final.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from lidarfw.ops.boxes import close_pairs, overlap_at, plane_ratio, volume_ratio

_BLOCK = 256

Suppresses = Callable[[Tensor, Tensor], Tensor]  # rows (K,), rows (L,) -> (K, L) bool


def _greedy(scores: Tensor, suppresses: Suppresses) -> Tensor:
    """Rows kept, by descending score; of equal scores the first row counts as higher."""
    order = torch.argsort(scores.detach(), descending=True, stable=True)
    kept = order[:0]
    for block in order.split(_BLOCK):  # type: ignore[no-untyped-call]
        if len(kept):
            block = block[~suppresses(kept, block).any(0)]
        kept = torch.cat([kept, block[_settle(suppresses(block, block).triu(1))]])
    return kept


def _settle(edges: Tensor) -> Tensor:
    """(K,) bool who stays, given edges (K, K) bool from higher to lower scores."""
    stays = torch.ones(len(edges), dtype=torch.bool, device=edges.device)
    while True:
        now = ~(edges & stays[:, None]).any(0)
        if torch.equal(now, stays):
            return stays
        stays = now


def nms_rotated(
    boxes: Tensor, scores: Tensor, iou_threshold: float, groups: Tensor | None = None, *, volume: bool = False
) -> Tensor:
    """Rows of the boxes kept, int64, by descending score.

    Args:
        boxes: (N, 7) x, y, z, l, w, h, yaw.
        scores: (N,).
        iou_threshold: a box is dropped where its IoU with a kept box of higher score is above it.
        volume: take the 3D IoU in place of that in the ground plane.
        groups: (N,) int64; boxes of different groups (samples, classes) never suppress each other.
    """
    boxes = boxes.detach() if boxes.dtype == torch.float64 else boxes.detach().float()
    measure = volume_ratio if volume else plane_ratio

    def suppresses(high: Tensor, low: Tensor) -> Tensor:
        a, b = boxes[high], boxes[low]
        close = close_pairs(a, b)
        if groups is not None:
            close &= groups[high][:, None] == groups[low]
        if high is low:
            close = close.triu(1)
        pairs = close.nonzero()
        close[pairs[:, 0], pairs[:, 1]] = overlap_at(a, b, pairs, measure) > iou_threshold
        return close

    return _greedy(scores, suppresses)


def nms_circle(centers: Tensor, scores: Tensor, radius: float | Tensor, groups: Tensor | None = None) -> Tensor:
    """Rows of the centres kept, int64, by descending score.

    Args:
        centers: (N, 2) x, y in metres.
        scores: (N,).
        radius: metres, or (N,) metres of each row: a centre is dropped where a kept one of higher score
            is not farther than the radius of the higher one.
        groups: (N,) int64; rows of different groups never suppress each other.
    """
    radii = torch.as_tensor(radius, dtype=centers.dtype, device=centers.device).expand(len(centers))

    def suppresses(high: Tensor, low: Tensor) -> Tensor:
        close = (centers[high][:, None] - centers[low]).square().sum(2) <= radii[high][:, None] ** 2
        return close if groups is None else close & (groups[high][:, None] == groups[low])

    return _greedy(scores, suppresses)
