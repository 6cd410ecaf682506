"""How many of the objects near by and in plain sight are found, and how many of the detections there are right."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

from lidarfw.components.metrics.box_ap import FALSE, IGNORED, MEASURES, TRUE, BoxAP
from lidarfw.components.per_class import per_class
from lidarfw.types import Boxes, Points, Spec, Targets

KINDS = ("recall", "precision", "f1")


class BoxRecall(BoxAP):
    """Recall, precision and F1 of rotated boxes, by 3D and bird's-eye-view IoU, at one score.

    Asked for are the objects whose centre is at most `max_range` metres away and of which the labels say at most
    `max_occlusion` and `max_truncation` (where they say it). All others are ignored, and so is a detection beyond
    `max_range` that matches nothing. Detections below `min_score` are left out. Matching and `min_points` are
    those of `box_ap`; `iou` gives thresholds by class name, `default_iou` that of the others.

    `compute` gives `{class}_{3d,bev}_{recall,precision,f1}` of the classes with an object, and
    `mean_{3d,bev}_{recall,precision,f1}` (0 without any object), all 0..1, and `{class}_objects`, their number.
    Raises ConfigError for a class in `iou` that the data does not have.
    """

    monitor: ClassVar[str] = "mean_bev_recall"

    def __init__(
        self,
        boxes: Spec,
        points: Spec | None = None,
        *,
        iou: dict[str, float] | None = None,
        default_iou: float = 0.5,
        max_range: float = 30.0,
        max_occlusion: int = 0,
        max_truncation: float = 0.5,
        min_score: float = 0.3,
        min_points: int = 0,
    ) -> None:
        thresholds = per_class(boxes.classes, iou or {}, default_iou, "iou")
        super().__init__(boxes, points, iou=dict(zip(boxes.classes, thresholds)), min_points=min_points)
        self.max_range, self.max_occlusion, self.max_truncation = max_range, max_occlusion, max_truncation
        self.min_score = min_score

    def update(self, boxes: Boxes, targets: Targets, points: Points | None = None) -> None:
        """Count the detections of one frame, or of a batch of frames, in."""
        if targets.boxes is None:
            return
        asked = self._asked(targets.boxes)
        others = targets.boxes[~asked]
        ignored = others if targets.ignored is None else Boxes.cat([others, targets.ignored])
        wanted = Targets(boxes=targets.boxes[asked], ignored=ignored)
        super().update(boxes[boxes.score >= self.min_score], wanted, points)

    def _asked(self, truth: Boxes) -> Tensor:
        asked = _range(truth) <= self.max_range
        for value, limit in ((truth.occlusion, self.max_occlusion), (truth.truncation, self.max_truncation)):
            asked &= True if value is None else value <= limit
        return asked

    def _judge(self, boxes: Boxes, truth: Boxes, ignored: Boxes | None, measure: str) -> Tensor:
        verdict = super()._judge(boxes, truth, ignored, measure)
        return torch.where((verdict == FALSE) & (_range(boxes) > self.max_range), IGNORED, verdict)

    def compute(self) -> dict[str, Any]:
        """The figures, as floats."""
        # after an exchange between processes the state is one tensor instead of a list
        rows = torch.cat(self.detections) if isinstance(self.detections, list) else self.detections
        asked = {name: int(count) for name, count in zip(self.classes, self.objects) if count}
        figures: dict[str, float] = {f"{_key(name)}_objects": float(count) for name, count in asked.items()}
        for column, measure in enumerate(MEASURES, 2):
            found = [
                _rates(rows[rows[:, 0] == self.classes.index(name), column], count) for name, count in asked.items()
            ]
            for place, kind in enumerate(KINDS):
                figures |= {f"{_key(name)}_{measure}_{kind}": rates[place] for name, rates in zip(asked, found)}
                figures[f"mean_{measure}_{kind}"] = sum(rates[place] for rates in found) / max(len(found), 1)
        return figures


def _key(name: str) -> str:
    return name.lower().replace(" ", "_")


def _range(boxes: Boxes) -> Tensor:
    """Metres (N,) on the level from the sensor."""
    distance: Tensor = boxes.center[:, :2].norm(dim=1)
    return distance


def _rates(verdict: Tensor, objects: int) -> tuple[float, float, float]:
    """Recall, precision and F1 of detections with these verdicts, of so many objects."""
    right, wrong = int((verdict == TRUE).sum()), int((verdict == FALSE).sum())
    recall, precision = right / objects, right / max(right + wrong, 1)
    return recall, precision, f1_score(precision, recall)


def f1_score(precision: float, recall: float) -> float:
    """Their harmonic mean; 0 where both are 0."""
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0
