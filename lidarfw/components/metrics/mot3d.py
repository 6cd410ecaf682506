"""Figures of 3D multi-object tracking by the rules of KITTI and of the AB3DMOT paper."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from lidarfw.components.metrics.kitti_ap import heights, rectangles_of, share_covered
from lidarfw.components.metrics.sequence import sequence_number
from lidarfw.components.per_class import per_class
from lidarfw.errors import ConfigError, DataError
from lidarfw.interfaces import Metric
from lidarfw.kitti import IMAGE, RECTIFIED, level_boxes
from lidarfw.mot import RULES, Scene, evaluate, make_scene
from lidarfw.ops import iou_3d
from lidarfw.types import Boxes, FrameMeta, Spec, Targets, Tracks, take

Array = npt.NDArray[np.float64]

MAX_OCCLUSION, MAX_TRUNCATION = 2, 0.0  # labelled objects above either are ignored
MIN_HEIGHT = 25.0  # pixels; boxes up to this height that match nothing are no errors
MAX_COVERED = 0.5  # nor those of which more than this share lies in a DontCare region
_NO_TRACK = -1
_WIDTHS = {"objects": 5, "boxes": 6, "pairs": 3, "counts": 3}
_MEANS = ("samota", "amota", "amotp", "mota", "hota", "idf1")


class Mot3D(Metric):
    """sAMOTA, AMOTA, AMOTP, CLEAR MOT, IDF1 and HOTA of 3D tracks, per class and as means over the classes.

    Boxes are matched by 3D IoU (`iou` by class name, `default_iou` for the others), frame by frame. Tracks are kept
    or dropped as a whole by their mean score: sAMOTA, AMOTA and AMOTP are means over 40 recall points, all other
    figures are those at the score threshold of the highest MOTA, and `{class}_hota_all`, `{class}_idf1_all` of all
    tracks. The figures and their sources stand in `lidarfw.mot`.

    Ignored are objects of occlusion above 2 or any truncation, and `Targets.ignored`. A box that matches nothing is
    excused where it is at most 25 pixels high in the picture or lies by more than half in a DontCare region; this
    needs `box2d`, or KITTI's cameras in the meta of the frame, in whose frame overlaps are then measured too.

    `rules="devkit"` gives figures that compare with published ones of KITTI, oddities included: rounded mean scores
    (a tracker of constant scores may get 0), a memory of boxes that were matched once, and neutral objects of
    Pedestrian are not known. `rules="clean"` is without them. A class without an object has no figures; frames
    without track labels are not counted. Ids are unique in a sequence (`FrameMeta.sequence`), and so is the place of
    a frame (`FrameMeta.index`).

    Kept are, per object and box, sequence, frame, label, id and what makes it count, and the IoU of those that
    overlap; no boxes. Raises ConfigError for unknown rules and for a class in `iou` that the data does not have,
    DataError where an id occurs twice in a frame.
    """

    monitor: ClassVar[str] = "mean_samota"
    higher_is_better = True
    full_state_update = False
    objects: list[Tensor]  # (G, 5) sequence, frame, label, id, ignored
    boxes: list[Tensor]  # (T, 6) sequence, frame, label, id, score, excusable
    pairs: list[Tensor]  # (P, 3) object and box of the frame, IoU
    counts: list[Tensor]  # (F, 3) numbers of the frame's objects, boxes, pairs

    def __init__(
        self, tracks: Spec, *, iou: dict[str, float] | None = None, default_iou: float = 0.25, rules: str = "devkit"
    ) -> None:
        super().__init__()
        if rules not in RULES:
            raise ConfigError(f"metric.mot3d has no rules '{rules}'.\n  fix: rules=devkit or rules=clean")
        self.classes, self.rules = tracks.classes, rules
        self.iou = per_class(tracks.classes, iou, default_iou, "iou")
        for name in _WIDTHS:
            self.add_state(name, default=[], dist_reduce_fx="cat")
        self._start()

    def _start(self) -> None:
        # never an empty list: processes that saw no frame must take part in the exchange of the others
        for name, width in _WIDTHS.items():
            self._append(name, np.zeros((0, width)))

    def _append(self, name: str, rows: Array) -> None:
        getattr(self, name).append(torch.tensor(rows, dtype=torch.float64, device=self.device))

    def reset(self) -> None:
        """Forget all frames."""
        super().reset()
        self._start()

    def update(self, tracks: Tracks, targets: Targets, meta: list[FrameMeta]) -> None:
        """Count the tracks of frames in."""
        if targets.tracks is None:
            return
        known = targets.tracks
        ignored = known.boxes[:0] if targets.ignored is None else targets.ignored
        for number, frame in enumerate(meta):
            self._add(take(tracks, number), take(known, number), ignored.sample(number), frame)

    def _add(self, found: Tracks, known: Tracks, ignored: Boxes, meta: FrameMeta) -> None:
        for what, ids in (("tracks", found.id), ("labels", known.id)):
            if len(set(ids.tolist())) != len(ids):
                raise DataError(f"frame {meta.id}: an id occurs twice in the {what}: {sorted(ids.tolist())}")
        neutral = self._neutral(ignored)
        truth = Boxes.cat([_bare(known.boxes), _bare(neutral)])
        overlap = _overlaps(truth, found.boxes, meta)
        object_, box = np.nonzero(overlap > 0)
        out = np.concatenate([_beyond_limits(known.boxes), np.ones(len(neutral))])
        ids = torch.cat([known.id, torch.full_like(neutral.label, _NO_TRACK)])
        self._append("objects", np.stack([*_place(meta, len(truth)), _array(truth.label), _array(ids), out], 1))
        columns = [*map(_array, (found.boxes.label, found.id, found.boxes.score)), _excusable(found, ignored, meta)]
        self._append("boxes", np.stack([*_place(meta, len(found.id)), *columns], 1))
        self._append("pairs", np.stack([object_, box, overlap[object_, box]], 1))
        self._append("counts", np.array([[len(truth), len(found.id), len(box)]]))

    def _neutral(self, ignored: Boxes) -> Boxes:
        """Ignored objects with a box in space."""
        known = (ignored.label >= 0) & (ignored.size > 0).all(1)
        if self.rules == "devkit" and "Pedestrian" in self.classes:  # it looks for a name that no label has
            known &= ignored.label != self.classes.index("Pedestrian")
        return ignored[known]

    def compute(self) -> dict[str, Any]:
        """The figures, as floats."""
        objects, boxes, pairs, counts = (_whole(getattr(self, name)) for name in _WIDTHS)
        numbers = counts.astype(np.int64)
        pairs[:, :2] += np.repeat(numbers.cumsum(0) - numbers, numbers[:, 2], axis=0)[:, :2]
        figures: dict[str, float] = {}
        found = []
        for label, name in enumerate(self.classes):
            scene = _scene(label, objects, boxes, pairs)
            if not scene.ignored.all():
                result = evaluate(scene, self.iou[label], self.rules)
                whole = {f"{key}_all": result.whole[key] for key in ("hota", "idf1")}
                found.append({**result.averages, **result.best, **whole})
                figures |= {f"{name.lower().replace(' ', '_')}_{key}": value for key, value in found[-1].items()}
        count = max(len(found), 1)
        return figures | {f"mean_{key}": sum(values[key] for values in found) / count for key in _MEANS}


def _whole(state: list[Tensor] | Tensor) -> Array:
    """A copy of all rows; after an exchange between processes the state is one tensor instead of a list."""
    rows: Array = (torch.cat(state) if isinstance(state, list) else state.clone()).cpu().numpy()
    return rows


def _scene(label: int, objects: Array, boxes: Array, pairs: Array) -> Scene:
    """One class of the whole."""
    own, own_boxes = objects[:, 2] == label, boxes[:, 2] == label
    rows = pairs[:, :2].astype(np.int64)
    used = own[rows[:, 0]] & own_boxes[rows[:, 1]]
    place, box_place = np.cumsum(own) - 1, np.cumsum(own_boxes) - 1
    known, found = objects[own], boxes[own_boxes]
    return make_scene(
        (known[:, 1].astype(np.int64), _tracks(known), known[:, 4] > 0),
        (found[:, 1].astype(np.int64), _tracks(found), found[:, 4], found[:, 5] > 0),
        (place[rows[used, 0]], box_place[rows[used, 1]], pairs[used, 2]),
    )


def _tracks(rows: Array) -> npt.NDArray[np.int64]:
    """One number for each sequence and id."""
    return np.unique(rows[:, [0, 3]], axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)


def _bare(boxes: Boxes) -> Boxes:
    return Boxes.from_tensor(boxes.tensor, boxes.label)


def _array(tensor: Tensor) -> Array:
    rows: Array = tensor.detach().cpu().double().numpy()
    return rows


def _place(meta: FrameMeta, count: int) -> tuple[Array, Array]:
    """Number of the sequence, and place of the frame."""
    return np.full(count, sequence_number(meta.sequence)), np.full(count, float(meta.index))


def _overlaps(truth: Boxes, boxes: Boxes, meta: FrameMeta) -> Array:
    """(G, T) 3D IoU, 0 for boxes of different classes."""
    if RECTIFIED in meta.cameras:
        level = [torch.from_numpy(level_boxes(part, meta.cameras)) for part in (truth, boxes)]
    else:
        level = [part.tensor.detach().cpu().double() for part in (truth, boxes)]
    overlap: Array = iou_3d(*level).numpy()
    return np.where(_array(truth.label)[:, None] == _array(boxes.label), overlap, 0.0)


def _beyond_limits(boxes: Boxes) -> Array:
    """(G,) 1 for objects that are too occluded or truncated to be asked for."""
    beyond = np.zeros(len(boxes), dtype=bool)
    if boxes.occlusion is not None:
        beyond |= _array(boxes.occlusion) > MAX_OCCLUSION
    if boxes.truncation is not None:
        beyond |= _array(boxes.truncation) > MAX_TRUNCATION
    return beyond.astype(np.float64)


def _excusable(found: Tracks, ignored: Boxes, meta: FrameMeta) -> Array:
    """(T,) 1 for boxes that are too low in the picture or lie in a DontCare region; 0 without a picture."""
    boxes = found.boxes
    if boxes.box2d is None and not {IMAGE, RECTIFIED} <= meta.cameras.keys():
        return np.zeros(len(boxes))
    level = np.zeros((0, 7)) if boxes.box2d is not None else level_boxes(boxes, meta.cameras)
    rectangles = rectangles_of(boxes, level, meta.cameras)
    regions = ignored[ignored.label < 0].box2d
    covered = share_covered(rectangles, np.zeros((0, 4)) if regions is None else _array(regions))
    return ((heights(rectangles) <= MIN_HEIGHT) | (covered > MAX_COVERED)).astype(np.float64)
