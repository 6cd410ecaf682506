"""Detections clean the scene coordinates: what stands on a movable object says nothing about the place."""

from __future__ import annotations

import torch
from lidarfw.interfaces import PostProcessor
from lidarfw.ops import points_in_boxes
from lidarfw.types import Boxes, SceneCoords, Spec


class DynamicCorrespondence(PostProcessor):
    """Weigh the pairs on detected objects, before the pose is found (beyond the paper: one task helps the other).

    Pairs inside a box with a score of at least `score_threshold`, grown by `margin` metres to every side, have their
    weight multiplied by `factor`: 0 drops them. Select it between `nms` and `pose_ransac`.
    """

    def __init__(
        self,
        scene_coords: Spec,
        boxes: Spec,
        *,
        score_threshold: float = 0.3,
        margin: float = 0.2,
        factor: float = 0.0,
    ) -> None:
        super().__init__()
        self.score_threshold, self.margin, self.factor = score_threshold, margin, factor
        self.provides = scene_coords

    def forward(self, scene_coords: SceneCoords, boxes: Boxes) -> SceneCoords:
        """The same pairs with other weights."""
        boxes = boxes[boxes.score >= self.score_threshold]
        grown = boxes.replace(size=boxes.size + 2 * self.margin).tensor.to(scene_coords.source.dtype)
        inside = points_in_boxes(scene_coords.source, grown, scene_coords.batch, boxes.batch) >= 0
        return scene_coords.replace(weight=torch.where(inside, self.factor, 1.0) * scene_coords.weight)
