"""Average precision of moving and of static objects apart (TACO, section 4: what IDCL is to bring together)."""

from __future__ import annotations

import dataclasses

import torch
from lidarfw.components.metrics.box_ap import USUAL_IOU, BoxAP
from lidarfw.components.per_class import per_class
from lidarfw.errors import ConfigError
from lidarfw.types import Boxes, Points, Spec, Targets

STATES = ("moving", "static")


class MotionAP(BoxAP):
    """`box_ap` of every class twice: of its moving objects and of its static ones.

    Objects of the other state, and those whose state is not known, are ignored: a detection of them counts neither
    for nor against. False detections have no motion state and count against both. Options and keys are those of
    `box_ap`, `{state}_{class}_3d_ap` with moving and static. Needs boxes that say what moves, as the transform
    `motion_state` does; ConfigError without.
    """

    def __init__(
        self,
        boxes: Spec,
        points: Spec | None = None,
        *,
        iou: dict[str, float] | None = None,
        default_iou: float = 0.5,
        min_points: int = 0,
    ) -> None:
        usual = {name: value for name, value in USUAL_IOU.items() if name in boxes.classes}
        overlaps = per_class(boxes.classes, {**usual, **(iou or {})}, default_iou, "iou")
        names = [f"{state} {name}" for state in STATES for name in boxes.classes]
        both = dict(zip(names, [*overlaps, *overlaps], strict=True))
        twice = dataclasses.replace(boxes, classes=tuple(names))
        super().__init__(twice, points, iou=both, default_iou=default_iou, min_points=min_points)

    def update(self, boxes: Boxes, targets: Targets, points: Points | None = None) -> None:
        """Count the detections of one frame, or of a batch of frames, in."""
        truth = targets.boxes
        if truth is None:
            return
        if truth.moving is None and len(truth):
            raise ConfigError(
                "metric.motion_ap needs boxes that say what moves, and the dataset gives none.\n"
                "  fix: transform=[motion_state,...] works it out from velocities, or from tracks or boxes over time"
            )
        state = torch.full_like(truth.label, -1) if truth.moving is None else truth.moving
        moving, static = self._twice(truth)
        asked = Boxes.cat([moving[state == 1], static[state == 0]])
        others = [moving[state != 1], static[state != 0]]
        others += [] if targets.ignored is None else self._twice(targets.ignored)
        split = targets.replace(boxes=asked, ignored=Boxes.cat(others))
        super().update(Boxes.cat(self._twice(boxes)), split, points)

    def _twice(self, boxes: Boxes) -> list[Boxes]:
        """The boxes as objects of the moving classes, and of the static ones; label -1 stays."""
        other = torch.where(boxes.label < 0, boxes.label, boxes.label + len(self.classes) // 2)
        return [boxes, boxes.replace(label=other)]
