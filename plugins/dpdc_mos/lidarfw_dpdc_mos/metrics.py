"""Where moving points are found and missed: near and far, at the edges, object by object."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from lidarfw.components.per_class import check_names
from lidarfw.errors import DataError
from lidarfw.interfaces import Metric
from lidarfw.ops import range_project
from lidarfw.types import DataSpec, PointLabels, Points, Spec, Targets
from torch import Tensor

from lidarfw_dpdc_mos.bayes import range_view
from lidarfw_dpdc_mos.distance import distance_maps, on_pixels

_PARTS = ("iou", "near_iou", "far_iou", "boundary_iou")


class MosDetail(Metric):
    """IoU of the class `moving` over all points of all frames, in parts.

    `near_iou` and `far_iou`: points up to `near` metres, and beyond (the paper's section 4.2). `boundary_iou`: pixels
    of the range image within `band` pixels of the edge of what truly moves. `object_recall`: share of the moving
    objects (by instance) of which at least half of the points are found. All 0..1, and 0 where there is nothing.
    """

    higher_is_better = True
    full_state_update = False
    monitor: ClassVar[str] = "iou"
    example: ClassVar[dict[str, Any]] = {"moving": "Car"}
    counts: Tensor  # (5, 2) int64: right and of how many, of _PARTS and of objects

    def __init__(
        self,
        labels: Spec,
        points: Spec,
        data: DataSpec,
        *,
        moving: str = "moving",
        near: float = 30.0,
        band: int = 2,
    ) -> None:
        super().__init__()
        check_names(labels.classes, [moving], "metric.mos_detail.moving")
        self.moving, self.near, self.band = labels.classes.index(moving), near, band
        self.view = range_view(data)
        self.add_state("counts", default=torch.zeros(len(_PARTS) + 1, 2, dtype=torch.long), dist_reduce_fx="sum")

    def update(self, labels: PointLabels, points: Points, targets: Targets) -> None:
        """Count the points of one frame, or of a batch of frames, in."""
        known = targets.points
        if known is None:
            return
        if not len(labels) == len(known) == len(points):
            raise DataError(f"{len(labels)} points are predicted, {len(known)} labelled, the scan has {len(points)}")
        truth, found = known.label == self.moving, labels.label == self.moving
        found &= known.label >= 0
        near = points.xyz.norm(dim=1) <= self.near
        parts = [_overlap(truth[rows], found[rows]) for rows in (slice(None), near, ~near)]
        parts += [self._boundary(truth, found, points), self._objects(truth, found, known)]
        self.counts += torch.tensor(parts, device=self.counts.device)

    def _boundary(self, truth: Tensor, found: Tensor, points: Points) -> tuple[int, int]:
        image = range_project(points, self.view)
        true, seen = (on_pixels(part, image, points) for part in (truth, found))
        phi = distance_maps(true.long(), 2)[:, 0]
        edged = true.flatten(1).any(1)[:, None, None] & image.mask
        rows = edged & (phi > -self.band) & (phi <= self.band)
        return _overlap(true[rows], seen[rows])

    def _objects(self, truth: Tensor, found: Tensor, known: PointLabels) -> tuple[int, int]:
        if known.instance is None:
            return 0, 0
        rows = truth & (known.instance > 0)
        owner = torch.unique(known.batch[rows] * 2**32 + known.instance[rows], return_inverse=True)[1]
        points = torch.bincount(owner)
        hit = torch.bincount(owner, weights=found[rows].double())
        return int((2 * hit >= points).sum()), len(points)

    def compute(self) -> dict[str, Any]:
        """The figures, as floats."""
        values = (self.counts[:, 0] / self.counts[:, 1].clamp(min=1)).tolist()
        return dict(zip((*_PARTS, "object_recall"), values, strict=True))


def _overlap(truth: Tensor, found: Tensor) -> tuple[int, int]:
    """Right, and right + wrong + missed."""
    return int((truth & found).sum()), int((truth | found).sum())
