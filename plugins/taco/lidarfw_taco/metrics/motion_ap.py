"""Average precision of moving and of static objects apart (TACO, section 4: what IDCL is to bring together)."""

from __future__ import annotations

from lidarfw.components.metrics.box_ap import BoxAP
from lidarfw.errors import ConfigError
from lidarfw.types import Boxes, Spec, Targets

STATES = {"moving": 1, "static": 0}


class MotionAP(BoxAP):
    """`box_ap` of the objects of one motion state: `motion` is moving or static.

    The others, and those whose state is not known, are ignored: a detection of them counts neither for nor against.
    False detections have no motion state and count for both. Keys and other options are those of `box_ap`. Needs boxes
    that say what moves, as the transform `motion_state` does. For both states at once:
    `metric={moving_ap: {type: motion_ap, motion: moving}, static_ap: {type: motion_ap, motion: static}}`.
    """

    def __init__(
        self,
        boxes: Spec,
        *,
        motion: str = "moving",
        iou: dict[str, float] | None = None,
        default_iou: float = 0.5,
    ) -> None:
        super().__init__(boxes, iou=iou, default_iou=default_iou)
        if motion not in STATES:
            raise ConfigError(f"metric.motion_ap.motion is {motion!r}; use one of: {', '.join(STATES)}")
        self.state = STATES[motion]

    def update(self, boxes: Boxes, targets: Targets) -> None:
        """Count the detections of one frame, or of a batch of frames, in."""
        truth = targets.boxes
        if truth is None:
            return
        if truth.moving is None and len(truth):
            raise ConfigError(
                "metric.motion_ap needs boxes that say what moves, and the dataset gives none.\n"
                "  fix: transform=[motion_state,...] works it out from velocities, or from tracks or boxes over time"
            )
        if truth.moving is not None:
            others = truth[truth.moving != self.state]
            ignored = others if targets.ignored is None else Boxes.cat([targets.ignored, others])
            targets = targets.replace(boxes=truth[truth.moving == self.state], ignored=ignored)
        super().update(boxes, targets)
