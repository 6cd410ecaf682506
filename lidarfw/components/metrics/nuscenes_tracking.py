"""The tracking figures of nuScenes: AMOTA and AMOTP over recalls, and CLEAR MOT at the best of them.

Source: Caesar et al., "nuScenes: a multimodal dataset for autonomous driving", CVPR 2020, section 3.1 and its
tracking challenge; averages over recalls after Weng et al., "3D multi-object tracking: a baseline and new evaluation
metrics", IROS 2020. Own implementation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from lidarfw.components.metrics.nuscenes_detection import USUAL_RANGE
from lidarfw.components.metrics.sequence import sequence_number
from lidarfw.components.per_class import per_class
from lidarfw.errors import ConfigError, DataError
from lidarfw.interfaces import Metric
from lidarfw.mot import RULES, best_pairs
from lidarfw.types import FrameMeta, Poses, Spec, Targets, Tracks, take

Array = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

DISTANCE = 2.0  # metres between centres up to which a box may be matched; also the worst AMOTP
RECALLS = np.linspace(0.1, 1, 40).round(12)
_NONE = -1
_SEQUENCE, _FRAME, _LABEL, _ID, _X, _Y, _SCORE = range(7)  # columns
_MOTAR = ("devkit", "definition")
_MEANS = ("amota", "amotp", "mota", "motp", "recall")


class NuscenesTracking(Metric):
    """AMOTA and AMOTP of nuScenes, and MOTA, MOTP, recall, switches and more at the threshold of the highest MOTA.

    Boxes are matched by the distance of their centres on the ground, below 2 m, frame by frame: an object first
    keeps the track that it had, wherever that is still near; the rest is matched as many as possible at the least
    summed distance. Gaps of labelled and of tracked objects are filled by interpolation over time first, in the map
    where the poses are labelled, else in the sensor frame. `rules="devkit"` does that as the devkit does, which swaps
    the weights of the two sightings beside a gap (it makes no difference in the middle); "clean" does it right.

    A track is kept or dropped as a whole by its mean score. At 40 recalls from 0.1 to 1 the score threshold is read
    off the matches; AMOTA is the mean of MOTAR over them, AMOTP that of the matches' distance (m); recalls that are
    not reached count as 0 and 2 m. MOTAR is max(0, 1 - false positives / matches that are no switch) with
    `motar="devkit"`, which published figures use, so that a switch costs nothing there. The formula of the challenge
    with the recall of all matches, max(0, 1 - (switches + false positives) / matches), is `motar="definition"`.

    Objects and tracks beyond the range of their class (`max_range` by class name, nuScenes' by default;
    `default_range` for the others), metres on the ground from the sensor, do not count. `compute` gives for classes
    with an object `{class}_{amota,amotp,mota,motp,recall,ids,frag,mt,ml,tp,fp,fn}` and the means `amota`, `amotp`,
    `mota`, `motp`, `recall`; without any object 0, and 2 m. Frames without track labels are not counted. Kept are
    the centres, since interpolation needs what comes later. Raises ConfigError for unknown `rules` or `motar` and for
    a class in `max_range` that the data does not have, DataError where an id occurs twice in a frame.
    """

    monitor: ClassVar[str] = "amota"
    higher_is_better = True
    full_state_update = False
    objects: list[Tensor]  # (G, 7) sequence, frame, label, id, x, y, score
    boxes: list[Tensor]  # (T, 7) the same
    frames: list[Tensor]  # (F, 3) sequence, frame, seconds

    def __init__(
        self,
        tracks: Spec,
        *,
        max_range: dict[str, float] | None = None,
        default_range: float = 50.0,
        rules: str = "devkit",
        motar: str = "devkit",
    ) -> None:
        super().__init__()
        if rules not in RULES:
            raise ConfigError(f"metric.nuscenes_tracking has no rules '{rules}'.\n  fix: rules=devkit or rules=clean")
        if motar not in _MOTAR:
            raise ConfigError(
                f"metric.nuscenes_tracking has no motar '{motar}'.\n  fix: motar=devkit or motar=definition"
            )
        usual = {name: value for name, value in USUAL_RANGE.items() if name in tracks.classes}
        self.classes, self.rules, self.motar = tracks.classes, rules, motar
        self.range = per_class(tracks.classes, {**usual, **(max_range or {})}, default_range, "max_range")
        for name in ("objects", "boxes", "frames"):
            self.add_state(name, default=[], dist_reduce_fx="cat")
        self._start()

    def _start(self) -> None:
        # never an empty list: processes that saw no frame must take part in the exchange of the others
        for state, width in ((self.objects, 7), (self.boxes, 7), (self.frames, 3)):
            state.append(torch.zeros(0, width, dtype=torch.float64, device=self.device))

    def reset(self) -> None:
        """Forget all frames."""
        super().reset()
        self._start()

    def update(self, tracks: Tracks, targets: Targets, meta: list[FrameMeta]) -> None:
        """Count the tracks of frames in."""
        if targets.tracks is None:
            return
        for number, frame in enumerate(meta):
            sequence, pose = sequence_number(frame.sequence), take(targets.poses, number)
            place = torch.tensor([[sequence, frame.index, frame.time]], dtype=torch.float64, device=self.device)
            self.frames.append(place)
            for state, what in ((self.objects, targets.tracks), (self.boxes, tracks)):
                state.append(self._rows(take(what, number), pose, frame, place))

    def _rows(self, tracks: Tracks, pose: Poses | None, meta: FrameMeta, place: Tensor) -> Tensor:
        boxes = tracks.boxes
        if len(set(tracks.id.tolist())) != len(tracks.id):
            raise DataError(f"frame {meta.id}: an id occurs twice: {sorted(tracks.id.tolist())}")
        near = boxes.center[:, :2].norm(dim=1) < boxes.center.new_tensor(self.range)[boxes.label]
        center = boxes.center.double()
        if pose is not None and bool(pose.ok[0]):
            matrix = pose.matrix[0].to(center)
            center = center @ matrix[:3, :3].T + matrix[:3, 3]
        columns = [boxes.label.double(), tracks.id.double(), center[:, 0], center[:, 1], boxes.score.double()]
        rows = torch.stack(columns, 1)[near].to(self.device)
        return torch.cat([place[:, :2].expand(len(rows), 2), rows], 1)

    def compute(self) -> dict[str, Any]:
        """The figures, as floats."""
        objects, boxes, frames = (_whole(state) for state in (self.objects, self.boxes, self.frames))
        found: dict[str, dict[str, float]] = {}
        for label, name in enumerate(self.classes):
            own, own_boxes = (rows[rows[:, _LABEL] == label] for rows in (objects, boxes))
            if len(own):
                known, tracked = (_objects(rows, frames, self.rules) for rows in (own, own_boxes))
                found[name] = evaluate(known, tracked, self.motar)
        figures = {
            f"{name.lower().replace(' ', '_')}_{key}": value
            for name, own in found.items()
            for key, value in own.items()
        }
        worst = dict.fromkeys(_MEANS, 0.0) | {"amotp": DISTANCE, "motp": DISTANCE}
        means = {key: float(np.mean([own[key] for own in found.values()] or [worst[key]])) for key in _MEANS}
        return {**figures, **means}


def _whole(state: list[Tensor] | Tensor) -> Array:
    """All rows; after an exchange between processes the state is one tensor instead of a list."""
    rows: Array = (torch.cat(state) if isinstance(state, list) else state).cpu().numpy()
    return rows


@dataclass(frozen=True, eq=False)
class Objects:
    """N labelled or tracked objects of one class, in all frames of all sequences."""

    frame: Int  # (N,) number of the frame through all sequences, in time order each
    step: Int  # (N,) number of the frame in its sequence
    track: Int  # (N,) 0, 1 ... through all sequences
    place: Array  # (N, 2) metres
    score: Array  # (N,) mean of the track


def _objects(rows: Array, frames: Array, rules: str) -> Objects:
    """Objects with their mean score and without gaps; the filled ones come last."""
    frames = frames[np.lexsort((frames[:, 1], frames[:, 0]))]
    names, sequence = np.unique(frames[:, 0], return_inverse=True)
    # sequence and place in it as one number that sorts as both do
    spread = frames[:, 1].max(initial=0) + 1
    own = np.searchsorted(names, rows[:, _SEQUENCE])
    rows = rows[np.lexsort((rows[:, _FRAME], own))]
    own = np.sort(own)
    frame = np.searchsorted(sequence.reshape(-1) * spread + frames[:, 1], own * spread + rows[:, _FRAME])
    track = np.unique(rows[:, [_SEQUENCE, _ID]], axis=0, return_inverse=True)[1].reshape(-1)
    by_track = np.argsort(track, kind="stable")
    parts = np.split(rows[by_track, _SCORE], np.bincount(track).cumsum()[:-1])
    mean = np.array([part.mean() for part in parts if len(part)])  # in the rounding of the devkit: scores are compared
    values = np.stack([rows[:, _X], rows[:, _Y], mean[track]], 1)
    frame, track, values = _fill_gaps(frame, track, values, frames[:, 2], rules)
    step = np.arange(len(frames)) - np.searchsorted(sequence.reshape(-1), sequence.reshape(-1))
    return Objects(frame, step[frame], track, values[:, :2], values[:, 2])


def _fill_gaps(frame: Int, track: Int, values: Array, time: Array, rules: str) -> tuple[Int, Int, Array]:
    """Frames, tracks and values (N, C) with those between two sightings of a track added at the end."""
    order = np.lexsort((frame, track))
    before, after = order[:-1], order[1:]
    gap = np.where(track[before] == track[after], frame[after] - frame[before] - 1, 0)
    before, after = np.repeat(before, gap), np.repeat(after, gap)
    added = frame[before] + 1 + np.arange(len(before)) - np.repeat(gap.cumsum() - gap, gap)
    left, whole = time[frame[after]] - time[added], time[frame[after]] - time[frame[before]]
    even = (frame[after] - added) / np.maximum(frame[after] - frame[before], 1)  # where times do not grow
    share = np.where(whole > 0, left / np.where(whole > 0, whole, 1), even)[:, None]
    if rules == "devkit":  # it gives the share that is left to the later sighting
        between = (1 - share) * values[before] + share * values[after]
    else:
        between = values[after] + share * (values[before] - values[after])
    return np.append(frame, added), np.append(track, track[before]), np.concatenate([values, between])


def _near_pairs(objects: Objects, boxes: Objects) -> tuple[Int, Int, Array]:
    """Rows and distance of all pairs of the same frame below 2 m, sorted by object."""
    order = np.argsort(boxes.frame, kind="stable")
    low, high = (np.searchsorted(boxes.frame[order], objects.frame, side) for side in ("left", "right"))
    count = high - low
    row = np.repeat(np.arange(len(count)), count)
    box = order[np.arange(len(row)) - np.repeat(count.cumsum() - count, count) + low[row]]
    distance = np.linalg.norm(objects.place[row] - boxes.place[box], axis=1)
    near = distance < DISTANCE
    return row[near], box[near], distance[near]


@dataclass(frozen=True, eq=False)
class Following:
    """Which boxes follow the G objects, for each of W score thresholds."""

    box: Int  # (W, G) row of the box, -1 for none
    distance: Array  # (W, G) metres, 0 for none
    switch: Bool  # (W, G) another track than the last one of the object


def follow(objects: Objects, boxes: Objects, thresholds: Array) -> Following:
    """Match objects and boxes through time, for all thresholds (W,) and sequences at once.

    Sequences and thresholds do not touch each other, so each step serves one frame of all of them.
    """
    row, box, distance = _near_pairs(objects, boxes)
    world, pair = np.nonzero(boxes.score[box] >= thresholds[:, None])
    sizes = len(objects.track), len(boxes.track), int(objects.track.max(initial=-1)) + 1
    row_in, box_in = row[pair] + world * sizes[0], box[pair] + world * sizes[1]
    trajectory, track, metres = objects.track[row[pair]] + world * sizes[2], boxes.track[box[pair]], distance[pair]
    last = np.full(sizes[2] * len(thresholds), _NONE)
    taken, switch = np.full(sizes[0] * len(thresholds), _NONE), np.zeros(sizes[0] * len(thresholds), dtype=bool)
    step = objects.step[row[pair]]
    for used in np.split(np.argsort(step, kind="stable"), np.bincount(step).cumsum()[:-1]):
        chosen = _match(row_in[used], box_in[used], metres[used], last[trajectory[used]] == track[used])
        chosen = used[chosen]
        before = last[trajectory[chosen]]
        switch[row_in[chosen]] = (before != _NONE) & (before != track[chosen])
        last[trajectory[chosen]], taken[row_in[chosen]] = track[chosen], chosen
    shape = len(thresholds), sizes[0]
    hit = taken != _NONE
    found, far = np.full(len(taken), _NONE), np.zeros(len(taken))
    found[hit], far[hit] = box[pair][taken[hit]], metres[taken[hit]]
    return Following(found.reshape(shape), far.reshape(shape), switch.reshape(shape))


def _match(row: Int, box: Int, distance: Array, continues: Bool) -> Int:
    """Positions of the pairs that are matched: first those that continue, then the rest at the least distance."""
    kept = np.flatnonzero(continues)
    kept = kept[np.unique(box[kept], return_index=True)[1]]  # two objects may have had the track: the first keeps it
    rest = np.flatnonzero(~np.isin(row, row[kept]) & ~np.isin(box, box[kept]))
    # one more pair is worth more than any distance
    return np.concatenate([kept, rest[best_pairs(row[rest], box[rest], 1000 - distance[rest])]])


def score_thresholds(scores: Array, objects: int) -> Array:
    """(40,) score at each of the recalls, by linear interpolation between the matches' scores; NaN if not reached."""
    falling = -np.sort(-scores)
    recall = np.arange(1, len(falling) + 1) / objects
    if len(falling) == 0:
        return np.full(len(RECALLS), np.nan)
    return np.where(recall[-1] >= RECALLS, np.interp(RECALLS, recall, falling), np.nan)


def evaluate(objects: Objects, boxes: Objects, motar: str = "devkit") -> dict[str, float]:
    """All figures of one class with at least one object; `motar` as `NuscenesTracking` has it."""
    whole = follow(objects, boxes, np.array([-np.inf]))
    matched = whole.box[0][(whole.box[0] != _NONE) & ~whole.switch[0]]
    thresholds = score_thresholds(boxes.score[matched], len(objects.track))
    reached = thresholds[~np.isnan(thresholds)]
    if len(reached) == 0:
        figures = dict.fromkeys(("mota", "recall", "ids", "frag", "mt", "tp", "fp"), 0.0)
        return {
            "amota": 0.0,
            "amotp": DISTANCE,
            **figures,
            "motp": DISTANCE,
            "ml": 1.0,
            "fn": float(len(objects.track)),
        }
    rows = _clear_mot(objects, boxes, follow(objects, boxes, reached), reached, motar)
    missing = len(RECALLS) - len(reached)
    amota, amotp = rows["motar"].sum() / len(RECALLS), (rows["motp"].sum() + missing * DISTANCE) / len(RECALLS)
    best = len(reached) - 1 - int(rows["mota"][::-1].argmax())  # of equal ones that of the highest recall
    own = {key: float(values[best]) for key, values in rows.items() if key != "motar"}
    return {"amota": float(amota), "amotp": float(amotp), **own}


def _clear_mot(objects: Objects, boxes: Objects, found: Following, thresholds: Array, motar: str) -> dict[str, Array]:
    """Figures (W,) at each threshold."""
    hit, total = found.box != _NONE, len(objects.track)
    tp, ids = hit.sum(1), found.switch.sum(1)
    fp = (boxes.score >= thresholds[:, None]).sum(1) - tp
    wrong, right = (fp, tp - ids) if motar == "devkit" else (fp + ids, tp)
    frag, mt, ml = _continuity(objects, hit)
    return {
        "motar": np.where(right > 0, 1 - wrong / np.maximum(right, 1), 0).clip(0),
        "mota": (1 - (total - tp + ids + fp) / total).clip(0),
        "motp": np.where(tp > 0, found.distance.sum(1) / np.maximum(tp, 1), DISTANCE),
        "recall": tp / total,
        "ids": ids,
        "frag": frag,
        "mt": mt,
        "ml": ml,
        "tp": tp,
        "fp": fp,
        "fn": total - tp,
    }


def _continuity(objects: Objects, hit: Bool) -> tuple[Array, Array, Array]:
    """Fragmentations, and shares of mostly tracked (at least 0.8) and mostly lost (below 0.2) objects; each (W,)."""
    order = np.lexsort((objects.frame, objects.track))
    starts = np.flatnonzero(np.diff(objects.track[order], prepend=-1))
    hit = hit[:, order]
    begins = hit & ~np.concatenate([np.zeros((len(hit), 1), dtype=bool), hit[:, :-1]], 1)
    begins[:, starts] = hit[:, starts]
    runs, frames = np.add.reduceat(begins, starts, axis=1, dtype=np.int64), np.diff([*starts, hit.shape[1]])
    share = np.add.reduceat(hit, starts, axis=1, dtype=np.int64) / frames
    return (runs - 1).clip(0).sum(1), (share >= 0.8).mean(1), (share < 0.2).mean(1)
