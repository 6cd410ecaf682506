"""How well boxes sit on the objects that were found, and what is found, by distance and visibility.

Two detectors of equal average precision may differ in how tight their boxes are; refinement is about that.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import torch
from lidarfw.components.metrics.box_ap import (
    FALSE,
    USUAL_IOU,
    average_precision,
    objects_taken,
    overlaps,
    verdict,
)
from lidarfw.components.per_class import per_class
from lidarfw.interfaces import Metric
from lidarfw.types import Boxes, Spec, Targets
from torch import Tensor

BINS: dict[str, tuple[float, float]] = {"near": (0, 20), "middle": (20, 40), "far": (40, math.inf)}  # metres
VISIBILITY = {"visible": 0, "partly": 1, "largely": 2}  # occlusion as labelled
LABEL, SCORE, VERDICT, RANGE, OCCLUSION, MATCHED, IOU, CENTER, YAW = range(9)  # columns of a detection


class BoxQuality(Metric):
    """Overlap and errors of the boxes that match an object, and average precision, by distance and visibility.

    By falling score each detection takes the free object of its class with the highest 3D IoU of at least `matched`;
    of these pairs are `{class}_iou`, the mean IoU, `{class}_center`, metres between the centres, `{class}_yaw`,
    radians between the axes (a box may point either way), and `{class}_recall`, the share of objects in a pair. The
    mean over classes is called `mean_...`. Where nothing matches there is no such figure, but `mean_iou` is 0.

    `{class}_ap_{bin}` is the average precision of `box_ap` at the IoU of `iou` (Car 0.7, Pedestrian and Cyclist 0.5
    where not given), `{class}_iou_{bin}` the mean IoU, of the objects of a bin: near (up to 20 m), middle (to 40 m),
    far; visible, partly, largely, where occlusion is labelled. False detections count in the bin of their own
    distance, and in all bins of visibility. `{class}_objects_{bin}` is the number of objects.

    Detections that hit an ignored object count neither for nor against. Frames without box labels are not counted.
    """

    monitor: ClassVar[str] = "mean_iou"
    higher_is_better = True
    full_state_update = False
    detections: list[Tensor]  # (N, 9) see the columns above
    objects: list[Tensor]  # (M, 3) label, range, occlusion

    def __init__(
        self, boxes: Spec, *, matched: float = 0.3, iou: dict[str, float] | None = None, default_iou: float = 0.5
    ) -> None:
        super().__init__()
        usual = {name: value for name, value in USUAL_IOU.items() if name in boxes.classes}
        self.classes, self.matched = boxes.classes, matched
        self.iou = per_class(boxes.classes, {**usual, **(iou or {})}, default_iou, "iou")
        self.add_state("detections", default=[], dist_reduce_fx="cat")
        self.add_state("objects", default=[], dist_reduce_fx="cat")
        self._start()

    def _start(self) -> None:
        # never an empty list: processes that saw no frame must take part in the exchange of the others
        self.detections.append(torch.zeros(0, 9, device=self.device))
        self.objects.append(torch.zeros(0, 3, device=self.device))

    def reset(self) -> None:
        """Forget all counts."""
        super().reset()
        self._start()

    def update(self, boxes: Boxes, targets: Targets) -> None:
        """Count the detections of one frame, or of a batch of frames, in."""
        if targets.boxes is None:
            return
        truth = targets.boxes
        boxes = boxes[boxes.score.argsort(descending=True, stable=True)]
        overlap, fits = overlaps(boxes, truth, targets.ignored, "3d")
        strict = overlap.new_tensor(self.iou)[boxes.label][:, None]
        judged = objects_taken(overlap, fits & (overlap >= strict), len(truth))
        paired = objects_taken(overlap, fits & (overlap >= self.matched), len(truth))
        self.detections.append(_rows(boxes, truth, overlap, judged, paired).to(self.device))
        self.objects.append(torch.stack([truth.label.float(), _range(truth), _occlusion(truth)], 1).to(self.device))

    def compute(self) -> dict[str, Any]:
        """The figures, as floats."""
        # after an exchange between processes the state is one tensor instead of a list
        rows, objects = (
            torch.cat(state) if isinstance(state, list) else state for state in (self.detections, self.objects)
        )
        figures: dict[str, float] = {}
        means: dict[str, list[float]] = {}
        for label, name in enumerate(self.classes):
            mine, there = rows[rows[:, LABEL] == label], objects[objects[:, 0] == label]
            if len(there) == 0:
                continue
            key = name.lower().replace(" ", "_")
            whole = _quality(mine, len(there))
            figures |= {f"{key}_{what}": value for what, value in (whole | _by_bin(mine, there)).items()}
            for what, value in whole.items():
                means.setdefault(what, []).append(value)
        return (
            {"mean_iou": 0.0, "mean_recall": 0.0} | figures | {f"mean_{w}": sum(v) / len(v) for w, v in means.items()}
        )


def _rows(boxes: Boxes, truth: Boxes, overlap: Tensor, judged: Tensor, paired: Tensor) -> Tensor:
    """(N, 9) of the detections."""
    count = len(truth)
    matched = (paired >= 0) & (paired < count)
    hit = torch.where((judged >= 0) & (judged < count), judged, torch.where(matched, paired, -1))
    distance, occlusion = _range(boxes), torch.full_like(boxes.score, -1)
    iou, center, yaw = (torch.full_like(boxes.score, math.nan) for _ in range(3))
    if count:
        at = hit.clamp(min=0)
        distance = torch.where(hit >= 0, _range(truth)[at], distance)
        occlusion = torch.where(hit >= 0, _occlusion(truth)[at], occlusion)
        at = paired.clamp(min=0, max=count - 1)
        iou = overlap.gather(1, at[:, None])[:, 0].to(iou)
        center = (boxes.center - truth.center[at]).norm(dim=1)
        turn = (boxes.yaw - truth.yaw[at]).remainder(math.pi)
        yaw = torch.minimum(turn, math.pi - turn)
    columns = (boxes.label, boxes.score, verdict(judged, count), distance, occlusion, matched, iou, center, yaw)
    return torch.stack([column.float() for column in columns], 1)


def _range(boxes: Boxes) -> Tensor:
    distance: Tensor = boxes.center[:, :2].norm(dim=1)
    return distance


def _occlusion(truth: Boxes) -> Tensor:
    """As labelled, -1 where it is not."""
    return torch.full_like(truth.score, -1) if truth.occlusion is None else truth.occlusion.to(truth.score)


def _quality(rows: Tensor, objects: int) -> dict[str, float]:
    pairs = rows[rows[:, MATCHED] == 1]
    found = {"recall": len(pairs) / objects}
    if len(pairs):
        mean = pairs.mean(0)
        found |= {"iou": float(mean[IOU]), "center": float(mean[CENTER]), "yaw": float(mean[YAW])}
    return found


def _by_bin(rows: Tensor, objects: Tensor) -> dict[str, float]:
    """Average precision, mean IoU and number of objects of every bin that has objects."""
    found = dict[str, float]()
    for name, (low, high) in BINS.items():
        here = (rows[:, RANGE] >= low) & (rows[:, RANGE] < high)
        found |= _in_bin(name, rows[here], int(((objects[:, 1] >= low) & (objects[:, 1] < high)).sum()))
    for name, value in VISIBILITY.items():
        here = (rows[:, OCCLUSION] == value) | (rows[:, VERDICT] == FALSE)
        found |= _in_bin(name, rows[here], int((objects[:, 2] == value).sum()))
    return found


def _in_bin(name: str, rows: Tensor, objects: int) -> dict[str, float]:
    if objects == 0:
        return {}
    precision = average_precision(rows[:, SCORE], rows[:, VERDICT], objects)
    pairs = rows[rows[:, MATCHED] == 1]
    found = {f"ap_{name}": precision, f"objects_{name}": float(objects)}
    return found | ({f"iou_{name}": float(pairs[:, IOU].mean())} if len(pairs) else {})
