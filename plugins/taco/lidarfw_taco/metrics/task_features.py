"""What the contrastive losses of TACO are meant to change, measured on the maps that the heads read."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

import torch
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Metric
from lidarfw.types import BEV, Boxes, SceneCoords, Spec, Tap, Targets
from torch import Tensor

from lidarfw_taco.features import (
    mean_similarity,
    object_features,
    occupied,
    require_equal_widths,
    top_cells,
    unit,
)


class TaskFeatures(Metric):
    """Mechanism figures of ITCL, ILCL and IDCL, from the taps of a detection and a localization head.

    `cross_task_cosine`: mean cosine of the `top` longest localization vectors outside of all objects with the object
    vectors on the detection map, averaged over the frames that have objects; what ITCL lowers.
    `parked_cosine`: the same with the vectors of static objects on the localization map; what ILCL lowers.
    `parked_share`: of the `top` longest localization vectors, objects included, the share that lies in the footprint
    of a static object, and `parked_area`: the share of those footprints in the cells that are not empty, which
    `parked_share` is by chance. ILCL sees directions only, so it changes them by way of the task, if at all.
    `neighbor_accuracy`: how often the object of the opposite motion state that is most alike on the detection map, by
    cosine and in the same frame, is of the same class; of objects that have both right and wrong ones to choose from;
    what IDCL raises. Objects of unknown motion state play no part.

    All are 0 where there is nothing to measure; `frames` counts those with objects. Only sums are kept.
    """

    monitor: ClassVar[str] = "neighbor_accuracy"
    higher_is_better = True
    sums: Tensor  # (10,) float64: two cosines, each with its frames; parked, chosen, parked cells, cells; right, of all

    def __init__(self, detection: Spec, localization: Spec, *, top: int = 128) -> None:
        super().__init__()
        require_equal_widths("metric.task_features", detection, localization)
        if top <= 0:
            raise ConfigError(f"metric.task_features.top must be above 0, got {top}")
        self.top = top
        self.add_state("sums", default=torch.zeros(10, dtype=torch.float64), dist_reduce_fx="sum")

    def update(
        self,
        detection: Annotated[BEV, Tap(Boxes)],
        localization: Annotated[BEV, Tap(SceneCoords)],
        targets: Targets,
    ) -> None:
        """Count the maps of one frame, or of a batch of frames, in."""
        if targets.boxes is None:
            return
        boxes = targets.boxes
        objects, rows = object_features(detection, boxes)
        moving = torch.full_like(boxes.label, -1) if boxes.moving is None else boxes.moving
        static = boxes[moving == 0]
        cells = top_cells(localization, self.top, occupied(localization, boxes))[:2]
        across = _cosine(*cells, objects, boxes.batch[rows])
        pseudo, parts = object_features(localization, static)
        within = _cosine(*cells, pseudo, static.batch[parts])
        parked = self._parked(localization, static)
        right = neighbors(objects, boxes.label[rows], moving[rows], boxes.batch[rows])
        self.sums += torch.stack([*across, *within, *parked, *right]).to(self.sums)

    def _parked(self, localization: BEV, static: Boxes) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        _, valid, index = top_cells(localization, self.top)
        there = occupied(localization, static).flatten(1)
        filled = (localization.features != 0).any(1).flatten(1)
        return (there.gather(1, index) & valid).sum(), valid.sum(), (there & filled).sum(), filled.sum()

    def compute(self) -> dict[str, Any]:
        """The figures, as floats."""
        across, frames, within, static_frames, parked, chosen, parked_cells, cells, right, queries = self.sums.tolist()
        return {
            "cross_task_cosine": across / max(frames, 1),
            "parked_cosine": within / max(static_frames, 1),
            "parked_share": parked / max(chosen, 1),
            "parked_area": parked_cells / max(cells, 1),
            "neighbor_accuracy": right / max(queries, 1),
            "frames": frames,
        }


def _cosine(cells: Tensor, valid: Tensor, objects: Tensor, batch: Tensor) -> tuple[Tensor, Tensor]:
    """Sum over the samples that have cells and objects of their mean cosine, and how many these are."""
    counted = (batch.bincount(minlength=len(cells)) > 0) & valid.any(1)
    return mean_similarity(cells, valid, objects, batch)[counted].sum(), counted.sum()


def neighbors(vectors: Tensor, label: Tensor, moving: Tensor, batch: Tensor) -> tuple[Tensor, Tensor]:
    """How many objects (M, C) have as nearest one of the opposite motion state one of their class, of how many."""
    known = moving >= 0
    candidates = (batch[:, None] == batch) & (moving[:, None] != moving) & known[:, None] & known
    alike = label[:, None] == label
    asked = (candidates & alike).any(1) & (candidates & ~alike).any(1)
    if not bool(asked.any()):
        return asked.sum(), asked.sum()
    normed = unit(vectors)
    nearest = (normed @ normed.T).masked_fill(~candidates, -torch.inf).argmax(1)
    return ((label[nearest] == label) & asked).sum(), asked.sum()
