"""The standard baseline: a Kalman filter and one-to-one matching by 3D overlap."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from lidarfw.components.per_class import check_names
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Tracker
from lidarfw.ops import giou_3d, iou_3d
from lidarfw.types import Boxes, FrameResult, Poses, Spec, Tracks

from lidarfw_time3d.assignment import greedy, hungarian
from lidarfw_time3d.frames import array, boxes_of, pose_of, rows_of, seconds_since, to_map, to_sensor
from lidarfw_time3d.kalman import Motion, Noise

Array = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]

MEASURES = ("giou_3d", "iou_3d", "distance")
MATCHINGS = ("hungarian", "greedy")


@dataclass
class AB3DMOTState:
    """The T tracks alive, in the tracking frame: the map where poses are given, else the sensor's."""

    motion: Motion
    label: Int  # (T,)
    id: Int  # (T,)
    score: Array  # (T,) of the last detection
    hits: Int  # (T,) detections so far
    missed: Int  # (T,) frames since the last one
    pose: Array  # (4, 4) sensor to tracking frame, of the last frame that had one
    frames: int = 0  # seen so far
    time: float | None = None  # seconds, of the last frame
    next_id: int = 1


class AB3DMOT(Tracker):
    """Follow boxes with a Kalman filter and match them one-to-one by 3D overlap (Weng et al., IROS 2020, section III).

    Per class, tracks are moved on by their velocity, detections and tracks are matched by `measure` (`giou_3d`,
    `iou_3d`, or `distance` of the centres in metres) with the `hungarian` algorithm or `greedy`, and pairs beyond
    `limit` (the least overlap, or the largest distance) are struck off. A track comes out once it has `min_hits`
    detections (at once in the first `min_hits` frames) and as long as it was seen in the last `max_age - 1` frames;
    unseen for `max_age` frames it ends. Boxes are the filtered ones; their score is that of the last detection.

    `classes` sets other values of these five options for some classes: `{Pedestrian: {matching: greedy}}`. The
    variances are those of the paper, for frames 0.1 s apart. With a `pose` input the tracker works in the map, so
    that the motion of the sensor does not matter. Raises ConfigError for unknown options, values and classes.
    """

    def __init__(
        self,
        boxes: Spec,
        *,
        measure: str = "giou_3d",
        limit: float = -0.2,
        matching: str = "hungarian",
        min_hits: int = 3,
        max_age: int = 2,
        classes: dict[str, Any] | None = None,
        frame_time: float = 0.1,
    ) -> None:
        super().__init__()
        usual = {
            "measure": measure, "limit": limit, "matching": matching, "min_hits": min_hits, "max_age": max_age,
        }  # fmt: skip
        check_names(boxes.classes, classes or {}, "classes")
        self.rules = [_rule(usual, (classes or {}).get(name, {}), name) for name in boxes.classes]
        self.min_hits = np.array([rule["min_hits"] for rule in self.rules], dtype=np.int64)
        self.max_age = np.array([rule["max_age"] for rule in self.rules], dtype=np.int64)
        self.frame_time = frame_time
        # the paper's velocities are metres per frame: variances of 1e4 and 0.01 (m/frame)^2
        self.noise = Noise(first_velocity=1e4 / frame_time**2, velocity=0.01 / frame_time**2)
        self.provides = Spec(Tracks, classes=boxes.classes)

    def start(self) -> AB3DMOTState:
        """No tracks."""
        number = np.zeros(0, dtype=np.int64)
        return AB3DMOTState(
            Motion.start(np.zeros((0, 7)), self.noise), number, number, np.zeros(0), number, number, np.eye(4)
        )

    def step(
        self, state: AB3DMOTState, frame: FrameResult, boxes: Boxes, pose: Poses | None = None
    ) -> list[FrameResult]:
        """The frame with the tracks that come out now, by id."""
        passed = seconds_since(state.time, frame.meta, self.frame_time)
        state.time, state.frames, state.pose = frame.meta.time, state.frames + 1, pose_of(pose, state.pose)
        found, label, score = to_map(rows_of(boxes), state.pose), boxes.label.cpu().numpy(), array(boxes.score)
        state.motion.predict(passed, passed / self.frame_time, self.noise)
        state.missed = state.missed + 1
        detection, track = self._match(state, found, label)
        state.motion.update(track, found[detection], self.noise)
        state.score[track], state.missed[track] = score[detection], 0
        state.hits[track] += 1
        new = np.delete(np.arange(len(found)), detection)
        self._start(state, found[new], label[new], score[new])
        self._end(state)
        return [replace(frame, tracks=self._tracks(state, boxes))]

    def _match(self, state: AB3DMOTState, found: Array, label: Int) -> tuple[Int, Int]:
        """Detections and the tracks that they belong to."""
        pairs = [np.zeros((0, 2), dtype=np.int64)]
        for number in np.intersect1d(label, state.label).tolist():
            rule = self.rules[number]
            rows, columns = np.flatnonzero(label == number), np.flatnonzero(state.label == number)
            cost, limit = _cost(found[rows], state.motion.box[columns], rule["measure"]), rule["limit"]
            match = hungarian if rule["matching"] == "hungarian" else greedy
            chosen = match(cost, limit if rule["measure"] == "distance" else -limit)
            pairs.append(np.stack([rows[chosen[:, 0]], columns[chosen[:, 1]]], 1))
        joined = np.concatenate(pairs)
        return joined[:, 0], joined[:, 1]

    def _start(self, state: AB3DMOTState, found: Array, label: Int, score: Array) -> None:
        count = len(found)
        state.motion = state.motion.join(Motion.start(found, self.noise))
        state.label, state.score = np.concatenate([state.label, label]), np.concatenate([state.score, score])
        state.id = np.concatenate([state.id, state.next_id + np.arange(count)])
        state.hits = np.concatenate([state.hits, np.ones(count, dtype=np.int64)])
        state.missed = np.concatenate([state.missed, np.zeros(count, dtype=np.int64)])
        state.next_id += count

    def _end(self, state: AB3DMOTState) -> None:
        alive = state.missed < self.max_age[state.label]
        state.motion = state.motion.take(alive)
        for name in ("label", "id", "score", "hits", "missed"):
            setattr(state, name, getattr(state, name)[alive])

    def _tracks(self, state: AB3DMOTState, like: Boxes) -> Tracks:
        least = self.min_hits[state.label]
        shown = np.flatnonzero((state.hits >= least) | (state.frames <= least))
        rows = to_sensor(state.motion.box[shown], state.pose)
        velocity = (state.motion.velocity[shown] @ state.pose[:3, :3])[:, :2]
        boxes = boxes_of(rows, state.label[shown], state.score[shown], like, velocity)
        return Tracks(boxes, torch.from_numpy(state.id[shown]).to(like.label))


def _rule(usual: dict[str, Any], own: dict[str, Any], name: str) -> dict[str, Any]:
    unknown = sorted(set(own) - set(usual))
    if unknown:
        raise ConfigError(f"classes.{name} has no option {unknown[0]!r}.\n  options: {', '.join(usual)}")
    rule = usual | own
    for key, values in (("measure", MEASURES), ("matching", MATCHINGS)):
        if rule[key] not in values:
            raise ConfigError(f"{key} of {name}: expected one of {', '.join(values)}, found {rule[key]!r}")
    return rule


def _cost(found: Array, tracked: Array, measure: str) -> Array:
    """(N, M) cost of the pairs of detections (N, 7) and tracks (M, 7)."""
    if measure == "distance":
        apart: Array = np.linalg.norm(found[:, None, :3] - tracked[None, :, :3], axis=2)
        return apart
    one, two = (torch.from_numpy(rows[:, [0, 1, 2, 4, 5, 6, 3]]) for rows in (found, tracked))
    return -array(giou_3d(one, two) if measure == "giou_3d" else iou_3d(one, two))
