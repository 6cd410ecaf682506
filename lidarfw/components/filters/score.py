"""Drop uncertain boxes."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from lidarfw.components.per_class import per_class
from lidarfw.interfaces import Filter
from lidarfw.types import Boxes, FrameResult, Spec


class ScoreFilter(Filter):
    """Drop boxes with a score below the one of their class: `score` by class name, `default_score` for the others.

    Raises ConfigError for a class that the data does not have.
    """

    def __init__(self, boxes: Spec, *, score: dict[str, float] | None = None, default_score: float = 0.3) -> None:
        super().__init__()
        values = per_class(boxes.classes, score, default_score, "score")
        self.register_buffer("score", torch.tensor(values), persistent=False)
        self.provides = boxes

    score: Tensor

    def step(self, state: Any, frame: FrameResult, boxes: Boxes) -> list[FrameResult]:
        """The frame with the boxes that are left."""
        return [frame.with_prediction(boxes, boxes[boxes.score >= self.score[boxes.label]])]
