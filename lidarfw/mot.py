"""Figures of 3D multi-object tracking: CLEAR MOT, sAMOTA / AMOTA / AMOTP, IDF1 and HOTA, as functions over arrays.

Sources: Bernardin and Stiefelhagen, "Evaluating multiple object tracking performance: the CLEAR MOT metrics", 2008;
Weng et al., "3D multi-object tracking: a baseline and new evaluation metrics" (AB3DMOT), IROS 2020, section IV;
Ristani et al., "Performance measures and a data set for multi-target, multi-camera tracking", ECCVW 2016 (IDF1);
Luiten et al., "HOTA: a higher order metric for evaluating multi-object tracking", IJCV 2021. What KITTI ignores and
how it counts switches and fragmentations follows the rules of its tracking development kit. Own implementation.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

Array = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

RULES = ("devkit", "clean")
RECALLS = 40  # recall points 1/40 ... 1 of the averages
ALPHAS = np.arange(1, 20) / 20  # localisation thresholds of HOTA
_NONE = -1


@dataclass(frozen=True, eq=False)
class Scene:
    """G labelled objects and T tracked boxes of one class in any number of sequences, and the P pairs that overlap.

    `make_scene` sorts and numbers the rows as it is said here.
    """

    trajectory: Int  # (G,) 0, 1 ... of the object; rows are sorted by trajectory, then time
    ignored: Bool  # (G,) neither asked for nor punished
    track: Int  # (T,) 0, 1 ... of the box; rows are sorted by time
    score: Array  # (T,)
    excusable: Bool  # (T,) no error where it matches nothing
    object: Int  # (P,) row of the object
    box: Int  # (P,) row of the box
    iou: Array  # (P,) above 0; only pairs of the same frame


def make_scene(
    objects: tuple[Int, Int, Bool], boxes: tuple[Int, Int, Array, Bool], pairs: tuple[Int, Int, Array]
) -> Scene:
    """The scene of arrays in any order.

    `objects`: frame, trajectory, ignored (G,). `boxes`: frame, track, score, excusable (T,). `pairs`: row of the
    object, row of the box, IoU (P,). Frames and tracks have different numbers in different sequences; frames grow
    with time.
    """
    frame, trajectory, ignored = objects
    box_frame, track, score, excusable = boxes
    order, box_order = np.lexsort((frame, trajectory)), np.argsort(box_frame, kind="stable")
    place, box_place = np.argsort(order), np.argsort(box_order)
    rows, box_rows, iou = pairs
    return Scene(
        _dense(trajectory[order]),
        ignored[order],
        _dense(track[box_order]),
        score[box_order],
        excusable[box_order],
        place[rows],
        box_place[box_rows],
        iou,
    )


def _dense(numbers: Int) -> Int:
    place: Int = np.unique(numbers, return_inverse=True)[1].reshape(-1)
    return place


def best_pairs(left: Int, right: Int, gain: Array) -> Int:
    """Which of the pairs (P,) make up the one-to-one assignment of the largest summed gain; gains are positive.

    Pairs that share no node with others never compete, so each connected component is solved by itself.
    """
    if len(left) == 0:
        return np.zeros(0, dtype=np.int64)
    nodes = int(left.max()) + 1, int(right.max()) + 1
    graph = coo_matrix((np.ones(len(left)), (left, right + nodes[0])), shape=(sum(nodes), sum(nodes)))
    component = _dense(connected_components(graph, directed=False)[1][left].astype(np.int64))
    order, size = np.argsort(component, kind="stable"), np.bincount(component)
    groups = np.split(order, np.cumsum(size)[:-1])
    contested = [_solve(left[rows], right[rows], gain[rows], rows) for rows in groups if len(rows) > 1]
    return np.concatenate([np.flatnonzero(size[component] == 1), *contested])


def _solve(left: Int, right: Int, gain: Array, names: Int) -> Int:
    row, column = _dense(left), _dense(right)
    table = np.zeros((row.max() + 1, column.max() + 1))
    name = np.full(table.shape, _NONE)
    table[row, column], name[row, column] = gain, names
    chosen = name[linear_sum_assignment(table, maximize=True)]
    real: Int = chosen[chosen != _NONE]
    return real


def match_boxes(scene: Scene, iou: float, kept: Bool) -> tuple[Int, Array]:
    """The kept box of each object (G,), -1 for none, and their IoU (G,), 0 for none.

    Frame by frame as many pairs of at least this IoU as possible, and of those matchings the one of the largest sum.
    """
    used = np.flatnonzero((scene.iou >= iou) & kept[scene.box])
    # one more pair is worth more than any sum of IoU in a frame
    chosen = used[best_pairs(scene.object[used], scene.box[used], 1000 + scene.iou[used])]
    matched, overlap = np.full(len(scene.ignored), _NONE), np.zeros(len(scene.ignored))
    matched[scene.object[chosen]], overlap[scene.object[chosen]] = scene.box[chosen], scene.iou[chosen]
    return matched, overlap


def trajectory_figures(trajectory: Int, ignored: Bool, track: Int) -> dict[str, float]:
    """Id switches, fragmentations, and the shares of mostly tracked and mostly lost trajectories, as KITTI counts.

    `trajectory` (G,) sorted, in time order each; `track` (G,) seen on the object, -1 for none. An ignored frame
    forgets the track before, except the first of a trajectory. A switch needs the object matched in the frame
    before: over a gap it is only a fragmentation. A fragmentation is a change of track, or a gap, that is followed
    by a matched frame; in the last frame even a first contact is one. Mostly tracked is more than 0.8 of the frames
    that are not ignored, mostly lost less than 0.2; trajectories that are ignored all along do not count.
    """
    count = len(track)
    if count == 0:
        return {"ids": 0.0, "frag": 0.0, "mt": 0.0, "ml": 0.0}
    first = np.diff(trajectory, prepend=-1) != 0
    last = np.append(first[1:], True)
    earlier = _track_before(first, ignored, track)
    before, after = np.roll(track, 1), np.roll(track, -1)
    now = ~ignored & ~first & (track != _NONE)
    switch = now & (before != _NONE) & (earlier != _NONE) & (earlier != track)
    broken = now & (before != track) & (last | ((earlier != _NONE) & (after != _NONE)))
    tracked = np.bincount(trajectory, now | (first & (track != _NONE)))
    frames = np.bincount(trajectory, ~ignored)
    share = tracked[frames > 0] / frames[frames > 0]
    total = max(len(share), 1)
    mostly = {"mt": float((share > 0.8).sum() / total), "ml": float((share < 0.2).sum() / total)}
    return {"ids": float(switch.sum()), "frag": float(broken.sum()), **mostly}


def _track_before(first: Bool, ignored: Bool, track: Int) -> Int:
    """(G,) the last track seen on the object before each row, since its last ignored frame; -1 for none."""
    row = np.arange(len(track))
    forgets = np.where(first, row - 1, np.where(ignored, row, _NONE))  # rows up to here are forgotten
    seen = np.where((track != _NONE) & (first | ~ignored), row, _NONE)
    forgotten, latest = (np.maximum.accumulate(rows) for rows in (forgets, seen))
    latest, forgotten = np.append(_NONE, latest[:-1]), np.append(_NONE, forgotten[:-1])
    return np.where(latest > forgotten, track[latest], _NONE)


def clear_mot(
    scene: Scene, match: tuple[Int, Array], kept: Bool, excusable: Bool, recall: float = 1.0
) -> dict[str, float]:
    """CLEAR MOT of the kept boxes, and `smota`, MOTA scaled by the recall that it could reach, within 0..1.

    `match` is what `match_boxes` found of them.

    As KITTI does, `tp`, `motp`, `recall` and `precision` count matches of ignored objects too. `excusable` (T,) are
    the boxes that are no false positives where they match nothing.
    """
    matched, overlap = match
    hit = matched != _NONE
    free = kept & ~excusable
    free[matched[hit]] = False
    tp, fp, fn = int(hit.sum()), int(free.sum()), int((~hit & ~scene.ignored).sum())
    asked = max(int((~scene.ignored).sum()), 1)
    track = np.where(hit, scene.track[matched], _NONE) if len(scene.track) else matched
    figures = trajectory_figures(scene.trajectory, scene.ignored, track)
    errors = fp + fn + figures["ids"]
    precision, found = tp / max(tp + fp, 1), tp / max(tp + fn, 1)
    return {
        "mota": 1 - errors / asked,
        "smota": float(np.clip(1 - (errors - (1 - recall) * asked) / (recall * asked), 0, 1)),
        "motp": float(overlap.sum() / max(tp, 1)),
        "recall": found,
        "precision": precision,
        "f1": 2 * precision * found / max(precision + found, 1e-12),
        **figures,
        "tp": float(tp),
        "fp": float(fp),
        "fn": float(fn),
    }


def recall_thresholds(scores: Array, objects: int) -> list[tuple[float, float]]:
    """Score threshold and recall of the points 1/40, 2/40 ... as far as the scores (N,) of the matches reach.

    Down the sorted scores, the one whose recall comes nearest to each point; the lowest is always taken.
    """
    falling = -np.sort(-scores)
    points: list[tuple[float, float]] = []
    wanted = 0.0  # added up as the devkit does: rounding decides between two scores that are equally near
    for rank, score in enumerate(falling.tolist(), 1):
        further = (rank + 1) / objects - wanted < wanted - rank / objects
        if rank == len(falling) or not further:
            points.append((score, wanted))
            wanted += 1 / RECALLS
    return points[1:]  # the first stands for recall 0


def idf1(scene: Scene, iou: float) -> dict[str, float]:
    """IDF1, IDP, IDR: the one-to-one choice of trajectories and tracks with the most frames of at least this IoU."""
    pairs, frames = _track_pairs(scene, scene.iou >= iou)
    true = float(frames[best_pairs(*pairs, frames.astype(float))].sum())
    objects, boxes = len(scene.ignored), len(scene.track)
    return {
        "idf1": 2 * true / max(objects + boxes, 1),
        "idp": true / max(boxes, 1),
        "idr": true / max(objects, 1),
    }


def _track_pairs(scene: Scene, used: Bool) -> tuple[tuple[Int, Int], Int]:
    """Trajectories and tracks that share used pairs, and how many."""
    both = np.stack([scene.trajectory[scene.object[used]], scene.track[scene.box[used]]], 1)
    pairs, frames = np.unique(both, axis=0, return_counts=True)
    return (pairs[:, 0], pairs[:, 1]), frames


def hota(scene: Scene) -> dict[str, float]:
    """HOTA, DetA, AssA, LocA as means over the 19 thresholds 0.05 ... 0.95 of the IoU.

    Frame by frame the boxes are matched by IoU times the global alignment of their tracks (soft count of
    their common frames over that of all their frames); each threshold then takes those matches that reach it.
    """
    pair = np.unique(np.stack([scene.trajectory[scene.object], scene.track[scene.box]], 1), axis=0, return_inverse=True)
    names, which = pair[0], pair[1].reshape(-1)
    length = np.bincount(scene.trajectory)[names[:, 0]] + np.bincount(scene.track)[names[:, 1]]
    beside = np.bincount(scene.object, scene.iou)[scene.object] + np.bincount(scene.box, scene.iou)[scene.box]
    common = np.bincount(which, scene.iou / (beside - scene.iou), len(names))
    alignment = common / np.maximum(length - common, 1e-12)
    chosen = best_pairs(scene.object, scene.box, alignment[which] * scene.iou)
    rows = [_hota_at(alpha, scene.iou[chosen], which[chosen], length, len(scene.ignored) + len(scene.track))
            for alpha in ALPHAS.tolist()]  # fmt: skip
    return dict(zip(("hota", "deta", "assa", "loca"), np.mean(rows, 0).tolist(), strict=True))


def _hota_at(alpha: float, iou: Array, pair: Int, length: Int, boxes: int) -> tuple[float, float, float, float]:
    right = iou >= alpha - 1e-12
    found = int(right.sum())
    common = np.bincount(pair[right], minlength=len(length))  # true positives of each trajectory and track
    detection = found / max(boxes - found, 1)
    association = float((common * common / np.maximum(length - common, 1)).sum()) / max(found, 1)
    return (detection * association) ** 0.5, detection, association, float(iou[right].mean()) if found else 1.0


def identity(scene: Scene, iou: float, kept: Bool) -> dict[str, float]:
    """IDF1 and HOTA of the kept boxes, without what is ignored.

    Left out are ignored objects, boxes that match them, and excusable boxes that match nothing.
    """
    matched, _ = match_boxes(scene, iou, kept)
    used = kept & ~scene.excusable
    used[matched[(matched != _NONE) & ~scene.ignored]] = True
    used[matched[(matched != _NONE) & scene.ignored]] = False
    rest = _subset(scene, ~scene.ignored, used)
    return {**idf1(rest, iou), **hota(rest)}


def _subset(scene: Scene, objects: Bool, boxes: Bool) -> Scene:
    pairs = objects[scene.object] & boxes[scene.box]
    row, box_row = np.cumsum(objects) - 1, np.cumsum(boxes) - 1
    return Scene(
        _dense(scene.trajectory[objects]),
        scene.ignored[objects],
        _dense(scene.track[boxes]),
        scene.score[boxes],
        scene.excusable[boxes],
        row[scene.object[pairs]],
        box_row[scene.box[pairs]],
        scene.iou[pairs],
    )


class _Choice:
    """Which boxes a score threshold keeps, and which boxes are excused."""

    def __init__(self, scene: Scene, rules: str) -> None:
        self.scene, self.devkit = scene, rules == "devkit"
        self.mean = self._mean(scene.score)
        self.excusable = scene.excusable.copy()

    def _mean(self, score: Array) -> Array:
        """(T,) mean score of the track of each box, added up in time order."""
        track = self.scene.track
        mean: Array = (np.bincount(track, score) / np.maximum(np.bincount(track), 1))[track]
        return mean

    def kept(self, threshold: float) -> Bool:
        """Boxes of the tracks whose mean score reaches the threshold."""
        if not self.devkit:
            return self.mean >= threshold - 1e-9 * max(1.0, abs(threshold))
        # the devkit overwrites scores by their mean and averages again: what rounding then drops is part of its figures
        self.mean = self._mean(self.mean)
        return self.mean >= threshold

    def figures(self, iou: float, kept: Bool, recall: float = 1.0) -> dict[str, float]:
        """CLEAR MOT of the kept boxes."""
        match = match_boxes(self.scene, iou, kept)
        if self.devkit:  # a box that was matched once is not excused at a later threshold
            self.excusable[match[0][match[0] != _NONE]] = False
        return clear_mot(self.scene, match, kept, self.excusable, recall)


@dataclass(frozen=True)
class Figures:
    """What `evaluate` finds."""

    averages: dict[str, float]  # samota, amota, amotp over the 40 recall points
    best: dict[str, float]  # CLEAR MOT, IDF1 and HOTA at the score threshold of the highest MOTA
    whole: dict[str, float]  # the same of all boxes
    threshold: float | None  # that threshold; None where no threshold has a positive MOTA
    curve: list[dict[str, float]] = field(default_factory=list)  # CLEAR MOT, threshold, point: by recall point


def evaluate(scene: Scene, iou: float = 0.25, rules: str = "devkit") -> Figures:
    """All figures of one class at a threshold on the 3D IoU.

    A track is kept or dropped as a whole by its mean score. `rules="devkit"` reproduces the evaluator that
    published KITTI figures were computed with; "clean" leaves out its oddities: averaging scores again for each
    threshold (rounding drops tracks) and the memory of matched boxes.
    """
    choice, everything = _Choice(scene, rules), np.ones(len(scene.track), dtype=bool)
    mean = choice.mean
    whole = choice.figures(iou, everything)
    matched, _ = match_boxes(scene, iou, everything)
    points = recall_thresholds(mean[matched[matched != _NONE]], max(int(whole["tp"] + whole["fn"]), 1))
    curve = []
    for threshold, recall in points:
        figures = choice.figures(iou, choice.kept(threshold), recall)
        curve.append({"threshold": threshold, "point": recall, **figures})
    top = max(curve, key=lambda figures: figures["mota"], default=None)
    chosen = top["threshold"] if top is not None and top["mota"] > 0 else None
    kept = everything if chosen is None else choice.kept(chosen)
    best = choice.figures(iou, kept) | identity(scene, iou, kept)
    names = {"samota": "smota", "amota": "mota", "amotp": "motp"}
    averages = {name: sum(figures[key] for figures in curve) / RECALLS for name, key in names.items()}
    return Figures(averages, best, whole | identity(scene, iou, everything), chosen, curve)
