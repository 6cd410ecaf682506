"""The detection figures of nuScenes: mAP over centre distances, five errors of the true positives, and their score.

Source: Caesar et al., "nuScenes: a multimodal dataset for autonomous driving", CVPR 2020, section 3.1, with the
limits of its 2019 detection challenge (range by class, recall and precision above 0.1, 500 boxes a frame). Own
implementation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from lidarfw.components.matching import greedy_match
from lidarfw.components.per_class import per_class
from lidarfw.interfaces import Metric
from lidarfw.types import Boxes, Spec, Targets

Array = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

DISTANCES = (0.5, 1.0, 2.0, 4.0)  # metres between centres up to which a detection is right
_ERRORS_AT = DISTANCES.index(2.0)
ERRORS = ("ate", "ase", "aoe", "ave", "aae")  # translation m, scale 1 - IoU, orientation rad, velocity m/s, attribute
USUAL_RANGE = {
    "car": 50.0, "truck": 50.0, "bus": 50.0, "trailer": 50.0, "construction_vehicle": 50.0, "pedestrian": 40.0,
    "motorcycle": 40.0, "bicycle": 40.0, "traffic_cone": 30.0, "barrier": 30.0,
}  # fmt: skip
UNDEFINED = {"traffic_cone": ("aoe", "ave", "aae"), "barrier": ("ave", "aae")}  # errors that a class does not have
_HALF_TURN = ("barrier",)  # classes whose front and back look alike
_MOST_BOXES = 500  # of a frame
_RECALLS = np.linspace(0, 1, 101)
_FIRST = 11  # recalls up to 0.1 are left out
_LEAST_PRECISION = 0.1
_WIDTH = 2 + len(DISTANCES) + len(ERRORS)


def curve(score: Array, true: Bool, objects: int) -> tuple[Array, Array]:
    """Precision and score (101,) at the recalls 0, 0.01 ... 1; 0 beyond the highest recall.

    `score` (N,) falling, `true` (N,) which detections are right; at least one is.
    """
    found = true.cumsum()
    recall, precision = found / objects, found / np.arange(1, len(true) + 1)
    return np.interp(_RECALLS, recall, precision, right=0), np.interp(_RECALLS, recall, score, right=0)


def average_precision(precision: Array) -> float:
    """Area of the curve above 0.1 recall and 0.1 precision, scaled to 0..1."""
    return float((precision[_FIRST:] - _LEAST_PRECISION).clip(0).mean() / (1 - _LEAST_PRECISION))


def mean_error(score: Array, error: Array, confidence: Array) -> float:
    """Mean over the recalls from 0.11 to the highest one of the error so far; 1 where 0.11 is not reached.

    `score`, `error` (N,) of the true positives by falling score, NaN where the error is not known; `confidence`
    (101,) the score at each recall. Where no error is known at all it is 1.
    """
    known = ~np.isnan(error)
    so_far = np.nan_to_num(error).cumsum() / np.maximum(known.cumsum(), 1) if known.any() else np.ones(len(error))
    reached = np.flatnonzero(confidence).max(initial=0)
    if reached < _FIRST:
        return 1.0
    over_recall = np.interp(confidence[::-1], score[::-1], so_far[::-1])[::-1]
    return float(over_recall[_FIRST : reached + 1].mean())


class NuscenesDetection(Metric):
    """mAP, the five true-positive errors and the detection score (NDS) of nuScenes.

    By falling score each detection takes the nearest free object of its class in the frame, if the centres are
    closer than 0.5, 1, 2 or 4 m on the ground: four verdicts. AP is the area under precision over recall above 0.1
    of both; `{class}_ap` the mean over the four. At 2 m the true positives have errors: translation (`ate`, m),
    scale (`ase`, 1 - IoU of the boxes laid on each other), orientation (`aoe`, radians, half a turn for barriers),
    velocity (`ave`, m/s), attribute (`aae`, share of wrong ones). Cones and barriers lack some of them.

    NDS = (5 mAP + the sum over the errors of 1 - min(1, mean error)) / 10. Where labels give no velocity or no
    attribute at all, the error of the class is 1, as in the devkit. A detection without velocity is taken to stand,
    one without attribute is wrong. Objects and detections beyond the range of their class (`max_range` by class
    name, nuScenes' by default; `default_range` for the others), metres on the ground from the sensor, do not count,
    and of a frame only the 500 detections of the highest scores do. `Targets.ignored` plays no part: what nuScenes
    does not ask for, it does not excuse.

    `compute` gives `{class}_ap`, `{class}_ap_{distance}m` and `{class}_{error}` of the classes with an object, and
    over those `map`, `mate`, `mase`, `maoe`, `mave`, `maae` and `nds`; without any object `map` and `nds` are 0, the
    errors 1. Frames without box labels are not counted. Kept are verdicts and errors of each detection, no boxes.
    Raises ConfigError for a class in `max_range` that the data does not have.
    """

    monitor: ClassVar[str] = "nds"
    higher_is_better = True
    full_state_update = False
    detections: list[Tensor]  # (N, 11) label, score, right at each distance, errors at 2 m (NaN where not right)
    objects: Tensor  # (K,) int64

    def __init__(self, boxes: Spec, *, max_range: dict[str, float] | None = None, default_range: float = 50.0) -> None:
        super().__init__()
        usual = {name: value for name, value in USUAL_RANGE.items() if name in boxes.classes}
        self.classes = boxes.classes
        self.range = per_class(boxes.classes, {**usual, **(max_range or {})}, default_range, "max_range")
        self.period = [math.pi if name in _HALF_TURN else 2 * math.pi for name in boxes.classes]
        self.add_state("detections", default=[], dist_reduce_fx="cat")
        self.add_state("objects", default=torch.zeros(len(boxes.classes), dtype=torch.long), dist_reduce_fx="sum")
        self._start()

    def _start(self) -> None:
        # never an empty list: processes that saw no frame must take part in the exchange of the others
        self.detections.append(torch.zeros(0, _WIDTH, dtype=torch.float64, device=self.device))

    def reset(self) -> None:
        """Forget all counts."""
        super().reset()
        self._start()

    def update(self, boxes: Boxes, targets: Targets) -> None:
        """Count the detections of one frame, or of a batch of frames, in."""
        if targets.boxes is None:
            return
        truth = self._within(targets.boxes)
        boxes = self._within(_best(boxes))
        distance = torch.cdist(boxes.center[:, :2].double(), truth.center[:, :2].double())
        distance[(boxes.label[:, None] != truth.label) | (boxes.batch[:, None] != truth.batch)] = torch.inf
        taken = [greedy_match(torch.where(distance < limit, -distance, -torch.inf)) for limit in DISTANCES]
        errors = torch.full((len(boxes), len(ERRORS)), torch.nan, dtype=torch.float64, device=boxes.score.device)
        right = taken[_ERRORS_AT] >= 0
        errors[right] = self._errors(boxes[right], truth[taken[_ERRORS_AT][right]])
        columns = [boxes.label.double(), boxes.score.double(), *((rows >= 0).double() for rows in taken)]
        self.detections.append(torch.cat([torch.stack(columns, 1), errors], 1).to(self.device))
        self.objects += truth.label.bincount(minlength=len(self.classes)).to(self.device)

    def _within(self, boxes: Boxes) -> Boxes:
        limit = boxes.center.new_tensor(self.range)[boxes.label]
        return boxes[boxes.center[:, :2].norm(dim=1) < limit]

    def _errors(self, boxes: Boxes, truth: Boxes) -> Tensor:
        """(N, 5) errors of pairs; NaN where the label does not say."""
        period = boxes.yaw.new_tensor(self.period).double()[boxes.label]
        turn = (boxes.yaw.double() - truth.yaw.double()) % period
        common = torch.minimum(boxes.size, truth.size).double().prod(1)
        union = boxes.size.double().prod(1) + truth.size.double().prod(1) - common
        columns = [(boxes.center - truth.center)[:, :2].double().norm(dim=1), 1 - common / union.clamp(min=1e-12)]
        columns += [torch.minimum(turn, period - turn), _velocity_errors(boxes, truth), _attribute_errors(boxes, truth)]
        return torch.stack(columns, 1)

    def compute(self) -> dict[str, Any]:
        """The figures, as floats."""
        # after an exchange between processes the state is one tensor instead of a list
        rows = (torch.cat(self.detections) if isinstance(self.detections, list) else self.detections).cpu().numpy()
        counts = self.objects.tolist()
        found = {
            name: _figures(rows[rows[:, 0] == label], counts[label], UNDEFINED.get(name, ()))
            for label, name in enumerate(self.classes)
            if counts[label]
        }
        figures = {
            f"{name.lower().replace(' ', '_')}_{key}": value
            for name, own in found.items()
            for key, value in own.items()
        }
        ap = _mean([own["ap"] for own in found.values()], 0.0)
        errors = {f"m{key}": _mean([own[key] for own in found.values() if key in own], 1.0) for key in ERRORS}
        return {**figures, "map": ap, **errors, "nds": detection_score(ap, list(errors.values()))}


def detection_score(ap: float, errors: Sequence[float]) -> float:
    """NDS of a mean AP and the mean errors: the AP counts as much as all errors together."""
    good: float = sum(1 - min(1.0, error) for error in errors)
    return (len(errors) * ap + good) / (2 * len(errors))


def _mean(values: list[float], default: float) -> float:
    return sum(values) / len(values) if values else default


def _best(boxes: Boxes) -> Boxes:
    """The boxes by falling score, at most 500 of each frame."""
    boxes = boxes[boxes.score.argsort(descending=True, stable=True)]
    by_frame = boxes.batch.argsort(stable=True)
    counts = boxes.batch.bincount(minlength=boxes.batch_size)
    start = (counts.cumsum(0) - counts)[boxes.batch[by_frame]]
    rank = torch.empty_like(by_frame)
    rank[by_frame] = torch.arange(len(boxes), device=rank.device) - start
    return boxes[rank < _MOST_BOXES]


def _velocity_errors(boxes: Boxes, truth: Boxes) -> Tensor:
    if truth.velocity is None:
        return torch.full_like(boxes.score, torch.nan, dtype=torch.float64)
    velocity = torch.zeros_like(truth.velocity) if boxes.velocity is None else boxes.velocity.nan_to_num()
    error: Tensor = (velocity.double() - truth.velocity.double()).norm(dim=1)
    return error


def _attribute_errors(boxes: Boxes, truth: Boxes) -> Tensor:
    if truth.attribute is None:
        return torch.full_like(boxes.score, torch.nan, dtype=torch.float64)
    said = torch.full_like(truth.attribute, -1) if boxes.attribute is None else boxes.attribute
    wrong: Tensor = (said != truth.attribute).double()
    return wrong.masked_fill(truth.attribute < 0, torch.nan)


def _figures(rows: Array, objects: int, undefined: tuple[str, ...]) -> dict[str, float]:
    """Figures of one class."""
    rows = rows[np.argsort(-rows[:, 1], kind="stable")]
    score, right, errors = rows[:, 1], rows[:, 2 : 2 + len(DISTANCES)] > 0, rows[:, 2 + len(DISTANCES) :]
    ap = [average_precision(curve(score, true, objects)[0]) if true.any() else 0.0 for true in right.T]
    figures = {"ap": sum(ap) / len(ap), **{f"ap_{d:g}m": value for d, value in zip(DISTANCES, ap, strict=True)}}
    true = right[:, _ERRORS_AT]
    confidence = curve(score, true, objects)[1] if true.any() else np.zeros(len(_RECALLS))
    for key, error in zip(ERRORS, errors.T, strict=True):
        if key not in undefined:
            figures[key] = mean_error(score[true], error[true], confidence)
    return figures
