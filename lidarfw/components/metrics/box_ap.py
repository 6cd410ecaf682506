"""Average precision of boxes for any classes and any dataset."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

from lidarfw.components.matching import greedy_match
from lidarfw.components.per_class import per_class
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Metric
from lidarfw.ops import iou_3d, iou_bev, points_per_box
from lidarfw.types import Boxes, Points, Spec, Targets

MEASURES = {"3d": iou_3d, "bev": iou_bev}
USUAL_IOU = {"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5}  # KITTI's
RECALLS = 40
FALSE, IGNORED, TRUE = -1, 0, 1  # verdicts


def average_precision(score: Tensor, verdict: Tensor, objects: int) -> float:
    """Mean over r = k/40, k = 1..40, of the highest precision at any recall >= r; 0 where nothing was found.

    `score`, `verdict` (N,) of the detections, `objects` how many there were to find. Detections of equal score form
    one step of the curve; IGNORED ones are left out.
    """
    score, true = score[verdict != IGNORED].double(), verdict[verdict != IGNORED] == TRUE
    if objects == 0 or not true.any():
        return 0.0
    order = score.argsort(descending=True, stable=True)
    score, true = score[order], true[order]
    last = torch.cat([score[1:] != score[:-1], score.new_ones(1, dtype=torch.bool)])  # of each step
    found = true.cumsum(0)[last].double()
    precision = found / (last.nonzero()[:, 0] + 1)
    best = precision.flip(0).cummax(0).values.flip(0)  # at this recall or a higher one
    # recall >= k/40 without rounding: 40 * found >= k * objects
    grid = torch.arange(1, RECALLS + 1, device=score.device, dtype=torch.float64) * objects
    step = torch.searchsorted(found * RECALLS, grid)
    return float(torch.cat([best, best.new_zeros(1)])[step].sum() / RECALLS)


def seen(truth: Boxes, ignored: Boxes | None, points: Points, least: int) -> tuple[Boxes, Boxes]:
    """Objects with at least so many points in their box, and the ignored ones with the others among them."""
    inside = points_per_box(points.xyz, truth.tensor.to(points.xyz), points.batch, truth.batch)
    hidden = truth[inside < least]
    return truth[inside >= least], hidden if ignored is None else Boxes.cat([ignored, hidden])


def overlaps(boxes: Boxes, truth: Boxes, ignored: Boxes | None, measure: str) -> tuple[Tensor, Tensor]:
    """IoU (N, M) of detections with objects, ignored ones last, and whether they are of one frame and class.

    Ignored regions known only in the picture, which have no size, are left out; label -1 is of any class.
    """
    ignored = Boxes.empty(device=truth.batch.device) if ignored is None else ignored
    ignored = ignored[(ignored.size > 0).all(1)]
    label, batch = torch.cat([truth.label, ignored.label]), torch.cat([truth.batch, ignored.batch])
    overlap: Tensor = MEASURES[measure](boxes.tensor.double(), torch.cat([truth.tensor, ignored.tensor]).double())
    fits = (boxes.label[:, None] == label) | (label == -1)
    return overlap, fits & (boxes.batch[:, None] == batch)


def objects_taken(overlap: Tensor, fits: Tensor, count: int) -> Tensor:
    """Object (N,) that each detection takes in turn, -1 for none; the `count` to be found come before ignored ones."""
    found_first = torch.arange(overlap.shape[1], device=overlap.device) < count
    return greedy_match(torch.where(fits, overlap + found_first * 2, -torch.inf))


def verdict(taken: Tensor, count: int) -> Tensor:
    """TRUE, FALSE or IGNORED (N,) for detections that take these objects; the first `count` are those to be found."""
    found = torch.where(taken >= 0, IGNORED, FALSE)
    found[(taken >= 0) & (taken < count)] = TRUE
    return found


class BoxAP(Metric):
    """Average precision of rotated boxes, per class and as the mean over classes, by 3D and bird's-eye-view IoU.

    By falling score each detection takes the free object of its class, in the same frame, with the highest IoU at or
    above the threshold. `iou` gives thresholds by class name (Car 0.7, Pedestrian and Cyclist 0.5 where not given),
    `default_iou` that of the others. A detection that hits only an ignored object (`Targets.ignored`; label -1 is
    for any class) counts neither for nor against; ignored regions known only in the picture play no part here. Objects
    with fewer than `min_points` points in their box are ignored too: nobody finds what the sensor did not see, and
    nuScenes leaves out objects without any point, Waymo's first level those with up to five (`min_points=6`).

    Precision is averaged over 40 recalls, which is defined for any number of objects. KITTI's own procedure takes
    its score thresholds from the true positives and needs more than 40 of them to reach its upper bound; that one,
    with difficulty levels, is the metric `kitti_ap`.

    `compute` gives `{class}_3d_ap`, `{class}_bev_ap` of the classes with an object, and `mean_3d_ap`, `mean_bev_ap`
    (0 without any object), all 0..1. Frames without box labels are not counted. Only scores, verdicts and counts are
    kept. Raises ConfigError for a class in `iou` that the data does not have, and for `min_points` without points.
    """

    monitor: ClassVar[str] = "mean_3d_ap"
    higher_is_better = True
    full_state_update = False
    detections: list[Tensor]  # (N, 4) label, score, verdict by 3D IoU, by BEV IoU
    objects: Tensor  # (K,) int64

    def __init__(
        self,
        boxes: Spec,
        points: Spec | None = None,
        *,
        iou: dict[str, float] | None = None,
        default_iou: float = 0.5,
        min_points: int = 0,
    ) -> None:
        super().__init__()
        if min_points and points is None:
            raise ConfigError("box_ap.min_points counts points, and the dataset gives none.\n  fix: min_points=0")
        self.min_points = min_points
        usual = {name: value for name, value in USUAL_IOU.items() if name in boxes.classes}
        self.classes = boxes.classes
        self.iou = per_class(boxes.classes, {**usual, **(iou or {})}, default_iou, "iou")
        self.add_state("detections", default=[], dist_reduce_fx="cat")
        self.add_state("objects", default=torch.zeros(len(boxes.classes), dtype=torch.long), dist_reduce_fx="sum")
        self._start()

    def _start(self) -> None:
        # never an empty list: processes that saw no frame must take part in the exchange of the others
        self.detections.append(torch.zeros(0, 4, device=self.device))

    def reset(self) -> None:
        """Forget all counts."""
        super().reset()
        self._start()

    def update(self, boxes: Boxes, targets: Targets, points: Points | None = None) -> None:
        """Count the detections of one frame, or of a batch of frames, in."""
        if targets.boxes is None:
            return
        truth, ignored = targets.boxes, targets.ignored
        if points is not None and self.min_points:
            truth, ignored = seen(truth, ignored, points, self.min_points)
        boxes = boxes[boxes.score.argsort(descending=True, stable=True)]
        verdicts = [self._judge(boxes, truth, ignored, measure).float() for measure in MEASURES]
        rows = torch.stack([boxes.label.float(), boxes.score.float(), *verdicts], 1)
        self.detections.append(rows.to(self.device))
        self.objects += truth.label.bincount(minlength=len(self.classes)).to(self.device)

    def _judge(self, boxes: Boxes, truth: Boxes, ignored: Boxes | None, measure: str) -> Tensor:
        """Verdict (N,) on each detection; they are sorted by falling score."""
        overlap, fits = overlaps(boxes, truth, ignored, measure)
        threshold = overlap.new_tensor(self.iou)[boxes.label]
        return verdict(objects_taken(overlap, fits & (overlap >= threshold[:, None]), len(truth)), len(truth))

    def compute(self) -> dict[str, Any]:
        """The figures, as floats."""
        # after an exchange between processes the state is one tensor instead of a list
        rows = torch.cat(self.detections) if isinstance(self.detections, list) else self.detections
        figures: dict[str, float] = {}
        for column, measure in enumerate(MEASURES, 2):
            found = {}
            for label, name in enumerate(self.classes):
                own = rows[rows[:, 0] == label]
                if self.objects[label] > 0:
                    key = f"{name.lower().replace(' ', '_')}_{measure}_ap"
                    found[key] = average_precision(own[:, 1], own[:, column], int(self.objects[label]))
            figures |= found | {f"mean_{measure}_ap": sum(found.values()) / max(len(found), 1)}
        return figures
