"""Time3D's tracker: a memory of five frames, learned affinity to each, and one assignment over their sum."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
import numpy.typing as npt
import torch
from lidarfw.components.per_class import per_class
from lidarfw.errors import ConfigError, DataError
from lidarfw.interfaces import Tracker
from lidarfw.types import Boxes, FrameMeta, FrameResult, Poses, Record, Spec, Tracks
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from lidarfw_time3d.flow import (
    CUES,
    FLOWS,
    GEOMETRIES,
    STATES,
    CueEmbedding,
    SpatialFlow,
    TemporalFlow,
    association,
    refine,
    unimodal,
)

Int = npt.NDArray[np.int64]

AFFINITIES = ("learned", "geometric", "appearance", "sum")
SIMILARITIES = ("sum", "mean", "last")
_MOVING, _EVIDENCE, _SURE = 0.3, math.log(0.7 / 0.3), 5.0  # m/s; log-odds that one frame adds, and their limit


@dataclass
class Time3DOutput(Record):
    """P pairs of frames of a batch (an earlier one and now) with places for K boxes in each; M boxes in all."""

    logits: Tensor  # (P, K + 1, K + 1) affinity, rows past, columns now, the last ones "none"
    velocity: Tensor  # (P, K, 3) m/s of the boxes now, in the sensor frame of now
    refinement: Tensor  # (P, K, 6) metres of x, y, z, w, h, l of the boxes now
    attribute: Tensor  # (P, K, 3) logits of the motion attributes of the boxes now
    past: Tensor  # (P, K) row of each box among the M, -1 for none
    now: Tensor  # (P, K)
    frames: Tensor  # (P, 2) the samples of the pair
    seconds: Tensor  # (P,)
    boxes: Boxes
    pose: Tensor  # (B, 4, 4) sensor to map; the identity where poses are not given

    def seen_from_now(self, boxes: Boxes, rows: Tensor, pair: Tensor) -> Tensor:
        """Boxes `rows` (N,) of a batch as (N, 7) in the sensor frame of now of their pairs (N,)."""
        pose = self.pose.detach()  # given, not learned
        return moved(boxes.tensor[rows], pose[boxes.batch[rows]], pose[self.frames[pair, 1]])


def moved(boxes: Tensor, source: Tensor, goal: Tensor) -> Tensor:
    """Boxes (..., 7) from the frames of poses `source` (..., 4, 4) to those of `goal`; the heading turns with them."""
    change = torch.linalg.solve(goal.double(), source.double())
    center = torch.einsum("...ij,...j->...i", change[..., :3, :3], boxes[..., :3].double()) + change[..., :3, 3]
    turn = torch.atan2(change[..., 1, 0], change[..., 0, 0])
    yaw = boxes[..., 6].double() + turn
    return torch.cat([center, boxes[..., 3:6].double(), yaw[..., None]], -1).to(boxes)


@dataclass
class Slots:
    """The N boxes of a frame in memory."""

    boxes: Boxes  # in the sensor frame of then
    pose: Tensor  # (4, 4) of then
    time: float  # seconds
    track: Int  # (N,) id of each box's track


@dataclass
class Time3DState:
    """The memory, oldest frame first, and the T tracks that have a box in it."""

    memory: list[Slots] = field(default_factory=list)
    id: Int = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # (T,)
    label: Int = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # (T,)
    hits: Int = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # (T,)
    center: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))  # (T, 3) in the map, last seen
    velocity: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))  # (T, 3) m/s in the map
    seen: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))  # (T,) time of it
    moving: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))  # (T,) log-odds
    time: float | None = None
    pose: Tensor = field(default_factory=lambda: torch.eye(4, dtype=torch.float64))
    next_id: int = 1


class Time3D(Tracker):
    """Learned spatial-temporal tracking (Li and Jin, "Time3D", CVPR 2022, sections 3.2, 3.3 and 3.5) of any boxes.

    `forward` trains it on batches of frames: every frame with each earlier one of its sequence among the last
    `memory` frames is a pair, and the losses `association` and `temporal_consistency` read what it gives. `step` runs
    it: boxes from `threshold` are compared with those of the last `memory` frames, the association probabilities of a
    track over those frames are joined by `similarity` (`sum` as in the paper, `mean`, `last`), and one Hungarian
    assignment with a "lost" option per track decides. Boxes without a track and a score from `birth` start one; a
    track comes out from `min_hits` boxes and ends when no frame in memory has it. Pairs of other classes, or farther
    apart than 2 m and what `max_speed` (m/s by class name, `default_max_speed` for the others) makes possible, are
    never joined. Ties go to the older track, then to the first box.

    `affinity`: `learned`; `geometric` (distance from the place where the velocity leads, no training), `appearance`
    (cosine of `Boxes.embedding`), or the `sum` of learned and geometric. Boxes are seen from the sensor of now, also
    those in memory, so that where the drive is does not matter (the paper keeps them in the frame of the first pose
    and their features in memory). With `refine`
    boxes are corrected by the network, with `attributes` they carry the motion attribute that it sees.

    `cues` are what the network looks at: `box3d`, `box2d`, `appearance` (`Boxes.embedding`, where the detector gives
    it), `category`; `geometry` how boxes are told: by `ordered` corners, `unordered` ones, or `raw` numbers.
    `spatial_flow` and `temporal_flow` are `attention`, or `mlp`: networks of the same size without a look at other
    boxes or the past, to compare with. Unless `end_to_end`, the losses do not reach the detector.

    Output: boxes of this frame with ids, velocity and log-odds of moving. Raises ConfigError for unknown words, and
    DataError where time does not grow within a sequence.
    """

    example: ClassVar = {"width": 32, "layers": 1, "heads": 4, "affinity": "sum"}  # untrained, "learned" knows nobody

    def __init__(
        self,
        boxes: Spec,
        *,
        width: int = 256,
        layers: int = 3,
        heads: int = 8,
        cues: tuple[str, ...] = ("box3d", "box2d", "appearance", "category"),
        geometry: str = "ordered",
        spatial_flow: str = "attention",
        temporal_flow: str = "attention",
        memory: int = 5,
        slots: int = 128,
        threshold: float = 0.1,
        birth: float = 0.3,
        min_hits: int = 1,
        affinity: str = "learned",
        similarity: str = "sum",
        refine: bool = False,
        attributes: bool = False,
        end_to_end: bool = True,
        max_speed: dict[str, float] | None = None,
        default_max_speed: float = 40.0,
        max_gap: float = 3.0,
    ) -> None:
        super().__init__()
        words = (
            ("affinity", affinity, AFFINITIES), ("similarity", similarity, SIMILARITIES),
            ("geometry", geometry, GEOMETRIES),
            ("spatial_flow", spatial_flow, FLOWS), ("temporal_flow", temporal_flow, FLOWS),
            *(("cues", cue, CUES) for cue in cues),
        )  # fmt: skip
        for name, value, known in words:
            if value not in known:
                raise ConfigError(f"{name}: expected one of {', '.join(known)}, found {value!r}")
        if affinity == "appearance" and not boxes.channels:
            raise ConfigError(
                "affinity=appearance needs boxes with an embedding, and the detector gives none.\n"
                "  fix: a head that gives one (km3d does), or affinity=geometric"
            )
        if attributes and affinity not in ("learned", "sum"):
            raise ConfigError(f"attributes=true needs affinity=learned or sum, found {affinity}")
        self.embedding = CueEmbedding(len(boxes.classes), width, boxes.channels, tuple(cues), geometry)
        self.spatial = SpatialFlow(width, layers, heads, spatial_flow)
        self.temporal = TemporalFlow(width, heads, temporal_flow)
        self.max_speed = np.array(per_class(boxes.classes, max_speed, default_max_speed, "max_speed"))
        self.memory, self.slots, self.threshold, self.birth, self.min_hits = memory, slots, threshold, birth, min_hits
        self.affinity, self.similarity, self.refine, self.max_gap = affinity, similarity, refine, max_gap
        self.appearance, self.attributes, self.end_to_end = boxes.channels, attributes, end_to_end
        self.provides = Spec(Tracks, classes=boxes.classes)

    # training

    def forward(self, boxes: Boxes, meta: list[FrameMeta], pose: Poses | None = None) -> Time3DOutput:
        """Affinities of all pairs of frames of the batch."""
        boxes = _last_stage(boxes if self.end_to_end else boxes.detach())
        count = boxes.batch_size
        poses = torch.eye(4, device=boxes.center.device, dtype=torch.float64).repeat(count, 1, 1)
        if pose is not None:
            poses[pose.ok] = pose.matrix[pose.ok].to(poses)
        frames = torch.tensor(_pairs(meta, self.memory), dtype=torch.long, device=poses.device).reshape(-1, 2)
        rows = places(boxes.batch, boxes.score, count, self.slots)
        times = torch.tensor([m.time for m in meta], dtype=torch.float64, device=poses.device)
        seconds = (times[frames[:, 1]] - times[frames[:, 0]]).float()
        past, now = rows[frames[:, 0]], rows[frames[:, 1]]
        before = self._flow(boxes, past, poses, frames[:, 1])
        # each frame once as "now", then by pair
        current = self._flow(boxes, rows, poses, torch.arange(count, device=poses.device))[frames[:, 1]]
        logits, velocity, change, state = self.temporal(before, current, past >= 0, now >= 0, seconds)
        return Time3DOutput(logits, velocity, change, state, past, now, frames, seconds, boxes, poses)

    def _flow(self, boxes: Boxes, rows: Tensor, poses: Tensor, goal: Tensor) -> Tensor:
        """F^ (P, K, d) of boxes at rows (P, K), seen from the sensor at frames `goal` (P,)."""
        mask = rows >= 0
        if len(boxes) == 0:
            return poses.new_zeros(*rows.shape, self.embedding.width, dtype=torch.float32)
        at = rows.clamp(min=0)
        seen = moved(boxes.tensor[at].float(), poses[boxes.batch[at]], poses[goal][:, None].expand(*at.shape, 4, 4))
        box2d = None if boxes.box2d is None else boxes.box2d[at].float()
        look = boxes.embedding[at].float() if self.appearance and boxes.embedding is not None else None
        vectors = self.embedding(seen, boxes.label[at], boxes.score[at].float(), box2d, look)
        flowed: Tensor = self.spatial(vectors * mask[..., None], mask)
        return flowed

    # tracking

    def start(self) -> Time3DState:
        """An empty memory."""
        return Time3DState()

    def step(
        self,
        state: Time3DState,
        frame: FrameResult,
        boxes: Boxes,
        meta: list[FrameMeta],
        pose: Poses | None = None,
    ) -> list[FrameResult]:
        """The frame with its tracks, by falling score of their boxes."""
        self._tick(state, meta[0], pose)
        order = boxes.score.argsort(descending=True, stable=True)
        order = order[boxes.score[order] >= self.threshold][: self.slots]
        found = boxes[order].to("cpu")
        logits, change, attribute = self._compare(state, found)
        track = self._assign(state, found, logits)
        if self.refine and state.memory:
            refined = refine(found.tensor, change[-1].to(found.tensor))
            found = found.replace(center=refined[:, :3], size=refined[:, 3:6])
        if self.attributes:
            found = found.replace(attribute=attribute[-1].argmax(1))
        return [replace(frame, tracks=self._update(state, found, track))]

    def _tick(self, state: Time3DState, meta: FrameMeta, pose: Poses | None) -> None:
        if state.time is not None and meta.time <= state.time:
            raise DataError(
                f"frame {meta.id}: expected a time after {state.time:g} s, found {meta.time:g} s.\n"
                "  fix: frames in order of time, each with its own"
            )
        if state.time is not None and meta.time - state.time > self.max_gap:
            state.memory = []
            self._forget(state)
        state.time = meta.time
        if pose is not None and bool(pose.ok[0]):
            state.pose = pose.matrix[0].detach().cpu().double()

    def _compare(self, state: Time3DState, found: Boxes) -> tuple[list[Tensor], Tensor, Tensor]:
        """Logits (N_f + 1, n + 1) to every frame in memory; refinement (F, n, 6), attribute (F, n, 3) by each."""
        change, attribute = torch.zeros(1, len(found), 6), torch.zeros(1, len(found), STATES)
        if not state.memory:
            return [], change, attribute
        learned = []
        if self.affinity in ("learned", "sum"):
            everything = Boxes.cat([*(slots.boxes for slots in state.memory), found], as_batch=True)
            poses = torch.stack([*(slots.pose for slots in state.memory), state.pose])
            rows = places(everything.batch, everything.score, len(poses), self.slots)
            last = len(poses) - 1
            features = self._flow(everything, rows, poses, torch.full((len(poses),), last))
            seconds = torch.tensor([(state.time or 0.0) - slots.time for slots in state.memory]).float()
            now = features[-1:].expand(last, -1, -1)
            mask = rows >= 0
            logits, _, change, attribute = self.temporal(
                features[:-1], now, mask[:-1], mask[-1:].expand(last, -1), seconds
            )
            learned = [_cut(table, len(slots.track), len(found)) for table, slots in zip(logits, state.memory)]
            change, attribute = change[:, : len(found)], attribute[:, : len(found)]
        tables = [
            self._logits(state, slots, found, learned[k] if learned else None) for k, slots in enumerate(state.memory)
        ]
        return tables, change, attribute

    def _logits(self, state: Time3DState, slots: Slots, found: Boxes, learned: Tensor | None) -> Tensor:
        if self.affinity == "learned":
            assert learned is not None
            return learned
        if self.affinity == "appearance":
            return appearance_logits(slots.boxes, found)
        place = np.searchsorted(state.id, slots.track)
        velocity = torch.from_numpy(state.velocity[place]) * ((state.time or 0.0) - slots.time)
        past = _centers(slots.boxes, slots.pose) + velocity
        geometric = geometric_logits(past, _centers(found, state.pose))
        return geometric if learned is None else learned + geometric

    def _assign(self, state: Time3DState, found: Boxes, tables: list[Tensor]) -> Int:
        """Row of the track of each box, -1 for none (H7): one assignment with a "lost" column per track."""
        count, n = len(state.id), len(found)
        score, lost = np.zeros((count, n)), np.zeros(count)
        frames = np.zeros(count)
        for logits, slots in zip(tables, state.memory, strict=True):
            if self.similarity == "last":
                newest = np.searchsorted(state.id, slots.track)
                score[newest], lost[newest], frames[newest] = 0, 0, 0
            table, none = unimodal(logits).double().numpy(), association(logits)[0][:-1, -1].exp().double().numpy()
            place = np.searchsorted(state.id, slots.track)
            score[place] += table[:-1, :-1]
            lost[place] += none
            frames[place] += 1
        if self.similarity == "mean":
            score, lost = score / np.maximum(frames, 1)[:, None], lost / np.maximum(frames, 1)
        return assign(np.where(self._possible(state, found), score, -1e6), lost)

    def _possible(self, state: Time3DState, found: Boxes) -> npt.NDArray[np.bool_]:
        """(T, n) the same class, and near enough (section 7, step 4)."""
        passed = (state.time or 0.0) - state.seen
        center = _centers(found, state.pose).numpy()
        apart = np.linalg.norm(center[None] - (state.center + state.velocity * passed[:, None])[:, None], axis=2)
        reach = 2 + self.max_speed[state.label] * passed
        near: npt.NDArray[np.bool_] = (apart <= reach[:, None]) & (state.label[:, None] == found.label.numpy())
        return near

    def _update(self, state: Time3DState, found: Boxes, track: Int) -> Tracks:
        """Move, start and end tracks, and remember the frame."""
        score, time = found.score.double().numpy(), state.time or 0.0
        new = (track < 0) & (score >= self.birth)
        known = np.flatnonzero(track >= 0)
        center = _centers(found, state.pose).numpy()
        self._move(state, track[known], center[known], time)
        ids = np.full(len(found), -1)
        ids[known] = state.id[track[known]]
        ids[new] = state.next_id + np.arange(int(new.sum()))
        self._begin(state, ids[new], found.label.numpy()[new], center[new], time)
        kept = torch.from_numpy(np.flatnonzero(ids >= 0))
        remembered = found[kept].replace(batch=torch.zeros(len(kept), dtype=torch.long), batch_size=1)
        state.memory = [*state.memory, Slots(remembered, state.pose.clone(), time, ids[kept.numpy()])][-self.memory :]
        place = np.searchsorted(state.id, ids[kept.numpy()])
        shown = np.flatnonzero(state.hits[place] >= self.min_hits)
        place, kept = place[shown], kept[torch.from_numpy(shown)]
        speed = torch.from_numpy(state.velocity[place]) @ state.pose[:3, :3]
        boxes = found[kept].replace(velocity=speed[:, :2].to(found.center))
        tracks = Tracks(boxes, torch.from_numpy(state.id[place]), torch.from_numpy(state.moving[place]))
        self._forget(state)
        return tracks

    def _move(self, state: Time3DState, rows: Int, center: npt.NDArray[np.float64], time: float) -> None:
        velocity = (center - state.center[rows]) / (time - state.seen[rows])[:, None]
        first = state.hits[rows] == 1
        state.velocity[rows] = np.where(first[:, None], velocity, (state.velocity[rows] + velocity) / 2)
        state.center[rows], state.seen[rows] = center, time
        state.hits[rows] += 1
        fast = np.linalg.norm(state.velocity[rows, :2], axis=1) > _MOVING
        state.moving[rows] = np.clip(state.moving[rows] + np.where(fast, _EVIDENCE, -_EVIDENCE), -_SURE, _SURE)

    def _begin(self, state: Time3DState, ids: Int, label: Int, center: npt.NDArray[np.float64], time: float) -> None:
        count = len(ids)
        state.id, state.label = np.concatenate([state.id, ids]), np.concatenate([state.label, label])
        state.hits = np.concatenate([state.hits, np.ones(count, dtype=np.int64)])
        state.center = np.concatenate([state.center, center])
        state.velocity = np.concatenate([state.velocity, np.zeros((count, 3))])
        state.seen = np.concatenate([state.seen, np.full(count, time)])
        state.moving = np.concatenate([state.moving, np.zeros(count)])
        state.next_id += count

    def _forget(self, state: Time3DState) -> None:
        """End the tracks that no frame in memory has."""
        there = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(slots.track for slots in state.memory)]))
        alive = np.isin(state.id, there)
        for name in ("id", "label", "hits", "center", "velocity", "seen", "moving"):
            setattr(state, name, getattr(state, name)[alive])


def _last_stage(boxes: Boxes) -> Boxes:
    """Of a cascade the boxes of its last stage: in training no postprocessor has joined those of one object yet."""
    return boxes if boxes.stage is None or not len(boxes) else boxes[boxes.stage == boxes.stage.max()]


def _pairs(meta: list[FrameMeta], memory: int) -> list[tuple[int, int]]:
    """Samples (past, now) of the same sequence, at most `memory` frames apart."""
    return [
        (i, j)
        for j, now in enumerate(meta)
        for i, past in enumerate(meta)
        if past.sequence == now.sequence and past.time < now.time and 0 < now.index - past.index <= memory
    ]


def places(batch: Tensor, score: Tensor, count: int, most: int) -> Tensor:
    """(count, K) rows of each sample's boxes in their order, -1 where none; the `most` best of each."""
    order = score.argsort(descending=True, stable=True)
    order = order[batch[order].argsort(stable=True)]
    sizes = torch.bincount(batch, minlength=count)
    start = sizes.cumsum(0) - sizes
    rank = torch.arange(len(order), device=order.device) - start[batch[order]]
    kept = rank < most
    rows = torch.full((count, max(int(sizes.max()) if len(sizes) else 0, 0)), -1, device=order.device)
    rows = rows[:, :most]
    rows[batch[order[kept]], rank[kept]] = order[kept]
    return rows


def _cut(table: Tensor, past: int, now: int) -> Tensor:
    """A padded table (K + 1, K + 1) without its empty places."""
    rows = [*range(past), table.shape[0] - 1]
    columns = [*range(now), table.shape[1] - 1]
    return table[rows][:, columns]


def _centers(boxes: Boxes, pose: Tensor) -> Tensor:
    """(N, 3) centres in the map."""
    return boxes.center.double() @ pose[:3, :3].T + pose[:3, 3]


def geometric_logits(past: Tensor, now: Tensor, sigma: float = 1.0, gate: float = 3.0) -> Tensor:
    """Affinity (n + 1, m + 1) by distance, without training: -d^2 / 2 sigma^2; "none" as if at the gate (metres)."""
    logits = past.new_full((len(past) + 1, len(now) + 1), -(gate**2) / (2 * sigma**2))
    logits[:-1, :-1] = -(torch.cdist(past, now) ** 2) / (2 * sigma**2)
    return logits


def appearance_logits(past: Boxes, now: Boxes, temperature: float = 0.1, none: float = 0.5) -> Tensor:
    """Affinity (n + 1, m + 1) by cosine of embeddings over a temperature; "none" is like a cosine of 0.5."""
    if past.embedding is None or now.embedding is None:
        raise DataError("affinity=appearance needs boxes with an embedding.\n  fix: a head that gives it, or geometric")
    one, two = (torch.nn.functional.normalize(b.embedding.float(), dim=1) for b in (past, now))  # type: ignore[union-attr]
    logits = one.new_full((len(one) + 1, len(two) + 1), none / temperature)
    logits[:-1, :-1] = one @ two.T / temperature
    return logits


def assign(score: npt.NDArray[np.float64], lost: npt.NDArray[np.float64]) -> Int:
    """Row of the track of each box, -1 for none: the assignment of the highest sum over [score | diag(lost)]."""
    count, n = score.shape
    track = np.full(n, -1)
    if count and n:
        options = np.full((count, count), -1e6)
        np.fill_diagonal(options, lost)
        row, column = linear_sum_assignment(np.concatenate([score, options], 1), maximize=True)
        chosen = (column < n) & (score[row, np.minimum(column, n - 1)] > -1e5)
        track[column[chosen]] = row[chosen]
    return track
