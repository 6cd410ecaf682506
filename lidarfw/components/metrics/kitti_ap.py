"""Average precision by the rules of the KITTI object benchmark.

Source: Geiger et al., "Are we ready for autonomous driving? The KITTI vision benchmark suite", CVPR 2012, and the
rules of its object development kit; 40 recall positions after Simonelli et al., "Disentangling Monocular 3D Object
Detection", ICCV 2019, section 5. Own implementation in numpy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from lidarfw.errors import ConfigError, DataError
from lidarfw.interfaces import Metric
from lidarfw.kitti import Array, level_boxes, observation_angles, project_level_boxes
from lidarfw.ops import iou_3d, iou_bev
from lidarfw.types import Boxes, Camera, FrameMeta, Spec, Targets

Bool = npt.NDArray[np.bool_]
Int = npt.NDArray[np.int64]

POSITIONS = 41  # recalls 0, 1/40 ... 1 at which the devkit looks
_MEASURES = ("2d", "bev", "3d")


@dataclass(frozen=True)
class Level:
    """A difficulty: objects beyond these limits are ignored."""

    name: str
    height: float  # pixels of the 2D box; labels must be higher, detections at least as high
    occlusion: int
    truncation: float


LEVELS = (Level("easy", 40, 0, 0.15), Level("moderate", 25, 1, 0.3), Level("hard", 25, 2, 0.5))
STRICT = {  # overlap that a detection must exceed in the picture, the bird's-eye view and in 3D
    "Car": {"2d": 0.7, "bev": 0.7, "3d": 0.7},
    "Pedestrian": {"2d": 0.5, "bev": 0.5, "3d": 0.5},
    "Cyclist": {"2d": 0.5, "bev": 0.5, "3d": 0.5},
}
LOOSE = {
    "Car": {"bev": 0.5, "3d": 0.5},
    "Pedestrian": {"bev": 0.25, "3d": 0.25},
    "Cyclist": {"bev": 0.25, "3d": 0.25},
}
_LOOSEST = 0.25


class KittiAP(Metric):
    """The KITTI benchmark's average precision: 2D, orientation (AOS), bird's eye and 3D; easy, moderate, hard.

    For each class, difficulty and measure the devkit takes up to 41 score thresholds from the true positives, each
    the nearest to a recall of k/40, and averages the highest precision at each or any later one: over 11 positions
    (`r11`) or over 40 without the first (`r40`). With fewer than 41 objects not every threshold exists and even
    perfect results stay below 1; the metric `box_ap` has no such bound.

    Ignored, so that finding them costs nothing: objects beyond the limits of the difficulty, Van for Car,
    Person_sitting for Pedestrian, and 2D detections that lie in a DontCare region. Detections lower than the height of
    the difficulty are ignored, those of other classes too, as the devkit does. Objects are matched in the order of
    the label file (`Boxes.row`). Overlaps are measured in the frame of the labels.

    `compute` gives `{class}_{measure}_{r11,r40}_{difficulty}` 0..1 with measures 2d, aos, bev, 3d, and bev_loose,
    3d_loose with IoU 0.5 for Car, 0.25 for the others; and `mean_3d_r40_moderate` over the classes, which stands for
    the metric. Needs KITTI's cameras in the meta of the frames. Frames without box labels are not counted.

    Kept from update to compute, in float64: per detection label, score, 2D height, share in DontCare, angle; per
    object label, whether neutral, 2D height, occlusion, truncation, angle; per pair of both that overlaps by more than
    0.25 the three overlaps. No boxes.
    """

    monitor: ClassVar[str] = "mean_3d_r40_moderate"
    higher_is_better = True
    full_state_update = False
    detections: list[Tensor]  # (D, 5) label, score, height, share in DontCare, alpha
    objects: list[Tensor]  # (G, 6) label, neutral, height, occlusion, truncation, alpha; in file order
    pairs: list[Tensor]  # (P, 5) detection and object of the frame, overlaps 2d, bev, 3d
    frames: list[Tensor]  # (F, 3) numbers of the frame's detections, objects, pairs

    def __init__(self, boxes: Spec) -> None:
        super().__init__()
        self.classes = {name: boxes.classes.index(name) for name in STRICT if name in boxes.classes}
        if not self.classes:
            raise ConfigError(
                f"metric.kitti_ap knows {', '.join(STRICT)}, the data has {', '.join(boxes.classes) or 'no classes'}.\n"
                f"  fix: metric=box_ap"
            )
        for name in ("detections", "objects", "pairs", "frames"):
            self.add_state(name, default=[], dist_reduce_fx="cat")
        self._start()

    def _start(self) -> None:
        # never an empty list: processes that saw no frame must take part in the exchange of the others
        for state, width in ((self.detections, 5), (self.objects, 6), (self.pairs, 5), (self.frames, 3)):
            state.append(torch.zeros(0, width, dtype=torch.float64, device=self.device))

    def reset(self) -> None:
        """Forget all frames."""
        super().reset()
        self._start()

    def update(self, boxes: Boxes, targets: Targets, meta: list[FrameMeta]) -> None:
        """Count the detections of frames in; those without a box2d get the rectangle round the projected box."""
        if targets.boxes is None:
            return
        ignored = targets.boxes[:0] if targets.ignored is None else targets.ignored
        for number, frame in enumerate(meta):
            truth, neutral = targets.boxes.sample(number), ignored.sample(number)
            self._add(boxes.sample(number), truth, neutral, frame)

    def _add(self, found: Boxes, truth: Boxes, ignored: Boxes, meta: FrameMeta) -> None:
        _require_labels([truth, ignored], meta)
        regions = _field(ignored[ignored.label < 0], "box2d", 4)
        objects = _in_file_order(truth, ignored[ignored.label >= 0])
        neutral = _field(objects, "score") == 0
        level, level_found = level_boxes(objects, meta.cameras), level_boxes(found, meta.cameras)
        rectangles, rectangles_found = (
            _field(objects, "box2d", 4).round(3),
            rectangles_of(found, level_found, meta.cameras),
        )
        overlaps = np.stack([_overlap_2d(rectangles_found, rectangles), *_overlaps_3d(level_found, level)])
        near = np.argwhere((overlaps > _LOOSEST).any(0))
        detections = [_field(found, "label"), _field(found, "score"), heights(rectangles_found)]
        detections += [share_covered(rectangles_found, regions), _alphas(found, level_found)]
        limits = [_field(objects, "occlusion"), _field(objects, "truncation").round(6), _alphas(objects, level)]
        labels = [_field(objects, "label"), neutral, heights(rectangles)]
        self._append(self.detections, np.stack(detections, 1))
        self._append(self.objects, np.stack([*labels, *limits], 1))
        self._append(self.pairs, np.concatenate([near, overlaps[:, near[:, 0], near[:, 1]].T], 1))
        self._append(self.frames, np.array([[len(found), len(objects), len(near)]]))

    def _append(self, state: list[Tensor], rows: npt.NDArray[Any]) -> None:
        state.append(torch.tensor(rows, dtype=torch.float64, device=self.device))

    def compute(self) -> dict[str, Any]:
        """The figures, as floats."""
        table = _Table(*(_whole(state) for state in (self.detections, self.objects, self.pairs, self.frames)))
        figures: dict[str, float] = {}
        for name, label in self.classes.items():
            for level in LEVELS:
                for measure, overlap in STRICT[name].items():
                    precision, similarity = table.curves(label, measure, overlap, level)
                    figures |= _averages(f"{name}_{measure}", level, precision)
                    figures |= _averages(f"{name}_aos", level, similarity) if measure == "2d" else {}
                for measure, overlap in LOOSE[name].items():
                    figures |= _averages(
                        f"{name}_{measure}_loose", level, table.curves(label, measure, overlap, level)[0]
                    )
        means = [figures[f"{name.lower()}_3d_r40_moderate"] for name in self.classes]
        return figures | {"mean_3d_r40_moderate": sum(means) / len(means)}


def _averages(name: str, level: Level, curve: Array) -> dict[str, float]:
    name = name.lower()
    return {f"{name}_r11_{level.name}": float(curve[::4].mean()), f"{name}_r40_{level.name}": float(curve[1:].mean())}


def _whole(state: list[Tensor] | Tensor) -> Array:
    """All rows; after an exchange between processes the state is one tensor instead of a list."""
    rows: Array = (torch.cat(state) if isinstance(state, list) else state).cpu().numpy()
    return rows


def _require_labels(labels: list[Boxes], meta: FrameMeta) -> None:
    names = ("box2d", "occlusion", "truncation")
    missing = [name for name in names if any(len(boxes) and getattr(boxes, name) is None for boxes in labels)]
    if missing:
        raise DataError(
            f"frame {meta.id}: kitti_ap needs {', '.join(missing)} of every label for its difficulties.\n"
            f"  fix: metric=box_ap, or a dataset that gives them (dataset=kitti)"
        )


def _in_file_order(truth: Boxes, ignored: Boxes) -> Boxes:
    """Objects to find (score 1) and neutral ones (score 0), by their row in the label file where it is known."""
    objects = Boxes.cat([truth.replace(score=torch.ones_like(truth.score)), ignored.replace(score=0 * ignored.score)])
    return objects if objects.row is None else objects[objects.row.argsort(stable=True)]


def _field(boxes: Boxes, name: str, width: int = 0) -> Array:
    """A field as float64 (M,) or (M, width); without a value (no rows carry it) it is empty."""
    value = getattr(boxes, name)
    if value is None:
        return np.zeros((0, width) if width else 0)
    rows: Array = value.detach().cpu().double().numpy()
    return rows


def rectangles_of(boxes: Boxes, level: Array, cameras: Mapping[str, Camera]) -> Array:
    """2D boxes (M, 4) in pixels: those given, else round the projected boxes `level` (M, 7)."""
    return project_level_boxes(level, cameras) if boxes.box2d is None else _field(boxes, "box2d", 4)


def _alphas(boxes: Boxes, level: Array) -> Array:
    return observation_angles(level) if boxes.alpha is None else _field(boxes, "alpha")


def heights(rectangles: Array) -> Array:
    """(M,) heights of rectangles (M, 4), pixels."""
    return rectangles[:, 3] - rectangles[:, 1]


def _areas(rectangles: Array) -> Array:
    area: Array = np.prod(rectangles[:, 2:] - rectangles[:, :2], axis=1)
    return area


def _common_area(a: Array, b: Array) -> Array:
    """(N, M) common area of rectangles a (N, 4) and b (M, 4)."""
    low, high = np.maximum(a[:, None, :2], b[:, :2]), np.minimum(a[:, None, 2:], b[:, 2:])
    area: Array = (high - low).clip(0).prod(2)
    return area


def _overlap_2d(a: Array, b: Array) -> Array:
    """(N, M) intersection over union of rectangles."""
    common = _common_area(a, b)
    return common / np.maximum(_areas(a)[:, None] + _areas(b) - common, 1e-12)


def share_covered(a: Array, regions: Array) -> Array:
    """(N,) largest share of each rectangle that lies in one of the regions (M, 4)."""
    share: Array = (_common_area(a, regions) / np.maximum(_areas(a), 1e-12)[:, None]).max(1, initial=0)
    return share


def _overlaps_3d(a: Array, b: Array) -> list[Array]:
    first, second = torch.from_numpy(a), torch.from_numpy(b)
    return [measure(first, second).numpy() for measure in (iou_bev, iou_3d)]


class _Table:
    """All frames together: detections, objects, and the pairs of them that overlap, by row numbers."""

    def __init__(self, detections: Array, objects: Array, pairs: Array, frames: Array) -> None:
        self.label, self.score, self.height, self.covered, self.alpha = detections.T
        self.object_label, self.neutral, self.object_height, self.occlusion, self.truncation, self.object_alpha = (
            objects.T
        )
        counts = frames.astype(np.int64)
        starts = counts.cumsum(0) - counts
        self.frame = np.repeat(np.arange(len(counts)), counts[:, 2])
        detection, found = (pairs[:, i].astype(np.int64) + starts[self.frame, i] for i in range(2))
        order = np.lexsort((detection, found))
        self.frame, self.detection, self.object = self.frame[order], detection[order], found[order]
        self.overlap = dict(zip(_MEASURES, pairs[order, 2:].T, strict=True))

    def curves(self, label: int, measure: str, overlap: float, level: Level) -> tuple[Array, Array]:
        """Precision and orientation similarity (41,), each the highest at this position or a later one."""
        low = self.height < level.height
        counted, taken_up = (self.label == label) & ~low, (self.label == label) | low
        beyond = (self.occlusion > level.occlusion) | (self.truncation > level.truncation)
        beyond |= (self.object_height <= level.height) | (self.neutral == 1)
        asked = (self.object_label == label) & ~beyond
        used = (self.overlap[measure] > overlap) & taken_up[self.detection] & (self.object_label == label)[self.object]
        pairs = _Pairs(self.frame[used], self.detection[used], self.object[used])
        true = asked[pairs.object] & counted[pairs.detection]
        hits = pairs.match(self.score[pairs.detection], np.ones((len(pairs.object), 1), dtype=bool))[:, 0]
        thresholds = score_thresholds(self.score[pairs.detection[hits & true]], int(asked.sum()))
        # an overlap is the greater the better; a detection that is too low only where there is no other, the first one
        priority = np.where(counted[pairs.detection], self.overlap[measure][used], -1.0 - pairs.detection)
        matched = pairs.match(priority, self.score[pairs.detection, None] >= thresholds)
        free = counted & ~((self.covered > overlap) & (measure == "2d"))
        wrong = (self.score[free, None] >= thresholds).sum(0) - matched[free[pairs.detection]].sum(0)
        agreement = (1 + np.cos(self.object_alpha[pairs.object] - self.alpha[pairs.detection])) / 2
        right = matched & true[:, None]
        number = np.maximum(right.sum(0) + wrong, 1)
        return _best_from_here(right.sum(0) / number), _best_from_here((right * agreement[:, None]).sum(0) / number)


def _best_from_here(values: Array) -> Array:
    """(41,) the highest of this and all later values; positions without a threshold have 0."""
    curve = np.zeros(POSITIONS)
    curve[: len(values)] = values
    best: Array = np.maximum.accumulate(curve[::-1])[::-1]
    return best


def score_thresholds(scores: Array, objects: int) -> Array:
    """At most 41 scores, descending: the one whose recall comes nearest to 0, then to 1/40, 2/40 ... of `objects`."""
    scores = -np.sort(-scores)
    recall = np.arange(1, len(scores) + 1) / max(objects, 1)
    later = np.append(recall[1:], recall[-1:])
    chosen: list[int] = []
    start, goal = 0, 0.0
    while start < len(scores):
        near = ~((later[start:] - goal) < (goal - recall[start:]))
        near[-1] = True  # the lowest score is always taken
        chosen.append(start + int(near.argmax()))
        start, goal = chosen[-1] + 1, goal + 1 / (POSITIONS - 1)
    return scores[chosen]


class _Pairs:
    """Detections that an object may be given, sorted by object, then detection."""

    def __init__(self, frame: Int, detection: Int, object_: Int) -> None:
        self.detection, self.object = detection, object_
        _, first, group = np.unique(object_, return_index=True, return_inverse=True)
        _, start = np.unique(frame[first], return_index=True)  # of each frame among the objects
        turn = np.arange(len(first)) - np.repeat(start, np.diff([*start, len(first)]))
        self.turns = [np.flatnonzero(turn[group] == number) for number in range(turn.max(initial=-1) + 1)]

    def match(self, priority: Array, allowed: Bool) -> Bool:
        """(P, T) which pairs are matched, for T sets of allowed pairs (P, T).

        Object after object takes the detection of the highest priority, the first among equals, that is allowed and
        not taken. Objects of different frames do not compete, so every turn serves one object of each frame.
        """
        matched = np.zeros(allowed.shape, dtype=bool)
        taken = np.zeros((self.detection.max(initial=-1) + 1, allowed.shape[1]), dtype=bool)
        for rows in self.turns:
            detection, object_ = self.detection[rows], self.object[rows]
            starts = np.flatnonzero(np.diff(object_, prepend=-1))
            group = np.repeat(np.arange(len(starts)), np.diff([*starts, len(rows)]))
            value = np.where(allowed[rows] & ~taken[detection], priority[rows, None], -np.inf)
            best = np.maximum.reduceat(value, starts)[group]
            place = np.where((value == best) & (value > -np.inf), np.arange(len(rows))[:, None], len(rows))
            matched[rows] = place == np.minimum.reduceat(place, starts)[group]
            matched[rows] &= place < len(rows)
            taken[detection] |= matched[rows]
        return matched
