"""Non-maximum suppression: of boxes that stand for the same object, keep the one with the highest score."""

from __future__ import annotations

import torch
from torch import Tensor

from lidarfw.components.per_class import per_class
from lidarfw.interfaces import PostProcessor
from lidarfw.ops import nms_circle, nms_rotated
from lidarfw.types import Boxes, Spec


def best_per_frame(boxes: Boxes, score_threshold: float, count: int) -> Boxes:
    """The `count` boxes of highest score of each frame, with a score of at least `score_threshold`.

    Sorted by frame and falling score; equal scores keep their order.
    """
    boxes = boxes[boxes.score >= score_threshold]
    order = boxes.score.argsort(descending=True, stable=True)
    order = order[boxes.batch[order].argsort(stable=True)]
    frame = boxes.batch[order]
    size = frame.bincount(minlength=boxes.batch_size)
    rank = torch.arange(len(frame), device=frame.device) - (size.cumsum(0) - size)[frame]
    return boxes[order[rank < count]]


class NMS(PostProcessor):
    """Suppress boxes whose footprints overlap a better box of the same frame by more than `iou_threshold`.

    The IoU is that of the rotated boxes in bird's-eye view. With `class_wise`, boxes of different classes never
    suppress each other. Per frame the `max_candidates` best go in and at most `max_per_frame` come out, by falling
    score; boxes below `score_threshold` are dropped first. All fields of the boxes are kept.
    """

    idempotent = True

    def __init__(
        self,
        boxes: Spec,
        *,
        iou_threshold: float = 0.2,
        class_wise: bool = False,
        score_threshold: float = 0.1,
        max_candidates: int = 4096,
        max_per_frame: int = 500,
    ) -> None:
        super().__init__()
        self.iou_threshold, self.class_wise, self.score_threshold = iou_threshold, class_wise, score_threshold
        self.max_candidates, self.max_per_frame = max_candidates, max_per_frame
        self.provides = boxes

    def forward(self, boxes: Boxes) -> Boxes:
        """The boxes that are left."""
        boxes = best_per_frame(boxes, self.score_threshold, self.max_candidates)
        groups = boxes.label * boxes.batch_size + boxes.batch if self.class_wise else boxes.batch
        kept = boxes[nms_rotated(boxes.tensor, boxes.score, self.iou_threshold, groups)]
        return best_per_frame(kept, self.score_threshold, self.max_per_frame)


class CircleNMS(PostProcessor):
    """Suppress boxes whose centre lies within a radius of a better box of the same frame and class.

    For the maps of center heads (CenterPoint, Yin et al., CVPR 2021): cheaper than rotated NMS. `radius`
    gives the radius in metres by class name, `default_radius` that of the others. The other options are those of
    `nms`. Raises ConfigError for a class that the data does not have.
    """

    idempotent = True

    def __init__(
        self,
        boxes: Spec,
        *,
        radius: dict[str, float] | None = None,
        default_radius: float = 1.0,
        score_threshold: float = 0.1,
        max_candidates: int = 4096,
        max_per_frame: int = 500,
    ) -> None:
        super().__init__()
        self.score_threshold = score_threshold
        self.max_candidates, self.max_per_frame = max_candidates, max_per_frame
        values = per_class(boxes.classes, radius, default_radius, "radius")
        self.register_buffer("radius", torch.tensor(values), persistent=False)
        self.provides = boxes

    radius: Tensor

    def forward(self, boxes: Boxes) -> Boxes:
        """The boxes that are left."""
        boxes = best_per_frame(boxes, self.score_threshold, self.max_candidates)
        groups = boxes.label * boxes.batch_size + boxes.batch
        kept = boxes[nms_circle(boxes.center[:, :2], boxes.score, self.radius[boxes.label], groups)]
        return best_per_frame(kept, self.score_threshold, self.max_per_frame)
