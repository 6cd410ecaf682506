"""The tracker to use: a Kalman filter, two-stage matching, and a learned confidence that decides what comes out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from lidarfw.components.per_class import per_class
from lidarfw.interfaces import Tracker
from lidarfw.types import Boxes, FrameResult, Poses, Spec, Tracks

from lidarfw_time3d.assignment import gated_hungarian
from lidarfw_time3d.confidence import FEATURES, Confidence, Evidence, check_calibration, features, log_odds
from lidarfw_time3d.frames import (
    array,
    boxes_of,
    pose_of,
    rows_of,
    seconds_since,
    to_map,
    to_sensor,
    velocity_of,
)
from lidarfw_time3d.kalman import Array, Int, Motion, Noise

NOISE = Noise(measured=0.1, place=0.02, shape=0.01, velocity=0.2, first=0.1, first_velocity=100.0)
_RIVAL = FEATURES.index("rival_same")
_HOPELESS = 0.015  # chance at which an unseen track ends
REST = 0.7  # m/s below which an unseen object is taken to stand still
_NEWBORN = 1.5  # times the gate for a track whose velocity is not known yet
_GROWTH = 0.12  # of the gate per unseen frame


@dataclass
class KalmanConfidenceState:
    """The T tracks alive, in the tracking frame: the map where poses are given, else the sensor's."""

    motion: Motion
    evidence: Evidence
    label: Int  # (T,)
    id: Int  # (T,)
    pose: Array  # (4, 4) sensor to tracking frame, of the last frame that had one
    frames: int = 0  # seen so far
    time: float | None = None  # seconds, of the last frame
    next_id: int = 1


class KalmanConfidence(Tracker):
    """Follow boxes with a Kalman filter and let each box out by the learned probability that it is right.

    Motion and correction are those of AB3DMOT (Weng et al., IROS 2020) with smaller variances. Detections and tracks
    of a class are matched by the distance of their centres on the ground, within `gate` metres (by class name,
    `default_gate` for the others; wider for new and for unseen tracks): first the detections that are more probably
    right than wrong, then the others with the tracks left (Zhang et al., "ByteTrack", ECCV 2022). Every detection
    without a track starts one, with the velocity that the detector gives, if it does.

    What comes out is decided by `confidence.Confidence`: from all that was seen of a track up to this frame (hits,
    age, scores, distance from the prediction, rivals at the same place) it gives the probability that its box is
    right, which is the score of the box. A detected box comes out from `min_seen`, an unseen one (coasted: moved on
    by the track's velocity) from `min_unseen`, as long as its centre is within `field_of_view` (radians about the
    forward axis). A track ends when it is unseen for `max_age` frames, unseen and hopeless, or unseen where a better
    one of its class is.

    Scores of the detector are probabilities, or are made log-odds by `calibration`, scale and offset by class name.
    `place_features` lets classes that have a network of their own (cars) also look at distance, direction, size and
    at what stands before them: right for KITTI's camera view and what is labelled there, wrong elsewhere.
    `weights` names a file of `python -m lidarfw_time3d.fit`; empty: those that were learned on KITTI's boxes.
    Without a `pose` input the motion of the sensor stays in the tracks: gates should be wider then, and fast turns
    lose tracks. Raises ConfigError for classes that the data does not have, DataError for scores that are no
    probabilities.
    """

    def __init__(
        self,
        boxes: Spec,
        *,
        gate: dict[str, float] | None = None,
        default_gate: float = 2.5,
        min_seen: float = 0.05,
        min_unseen: float = 0.15,
        max_age: int = 20,
        field_of_view: float = 6.2832,
        calibration: dict[str, list[float]] | None = None,
        place_features: bool = False,
        weights: str = "",
        frame_time: float = 0.1,
    ) -> None:
        super().__init__()
        self.gate = np.array(per_class(boxes.classes, gate, default_gate, "gate"))
        self.calibration = None
        if calibration is not None:
            check_calibration(boxes.classes, calibration, "calibration")
            self.calibration = np.array([calibration.get(name, (1.0, 0.0)) for name in boxes.classes])
        self.min_seen, self.min_unseen, self.max_age = min_seen, min_unseen, max_age
        self.field_of_view, self.frame_time = field_of_view, frame_time
        self.confidence = Confidence.load(weights, place_features)
        self.classes = boxes.classes
        self.provides = Spec(Tracks, classes=boxes.classes)

    def start(self) -> KalmanConfidenceState:
        """No tracks."""
        number, none = np.zeros(0, dtype=np.int64), np.zeros(0)
        return KalmanConfidenceState(
            Motion.start(np.zeros((0, 7)), NOISE), Evidence.start(none), number, number, np.eye(4)
        )

    def step(
        self, state: KalmanConfidenceState, frame: FrameResult, boxes: Boxes, pose: Poses | None = None
    ) -> list[FrameResult]:
        """The frame with the tracks that come out now, by id."""
        passed = seconds_since(state.time, frame.meta, self.frame_time)
        state.time, state.pose = frame.meta.time, pose_of(pose, state.pose)
        label = boxes.label.cpu().numpy()
        score = log_odds(array(boxes.score), label, self.calibration)
        self.advance(state, to_map(rows_of(boxes), state.pose), label, score, passed, velocity_of(boxes, state.pose))
        box = to_sensor(state.motion.box, state.pose)
        values = self.features(state, box)
        chance = self.confidence.probability(values, state.label, self.classes)
        # an unseen track with a better one of its class at its place is a second track of the same object
        double = (state.evidence.missed > 0) & (values[:, _RIVAL] > state.evidence.last - 2)
        chance[double] = 0
        tracks = self._tracks(state, box, chance, boxes)
        self._end(state, chance)
        return [replace(frame, tracks=tracks)]

    def advance(
        self,
        state: KalmanConfidenceState,
        found: Array,
        label: Int,
        score: Array,
        passed: float,
        velocity: Array | None = None,
    ) -> None:
        """Move the tracks on by `passed` seconds and join the detections (N, 7) of the tracking frame to them.

        New tracks start with the `velocity` (N, 3) that the detector gives, else at rest.
        """
        state.frames += 1
        slow = (state.evidence.missed > 0) & (np.hypot(*state.motion.velocity[:, :2].T) < REST)
        state.motion.velocity[slow] = 0
        state.motion.predict(passed, passed / self.frame_time, NOISE)
        state.evidence.wait()
        detection, track, off = self._match(state, found, label, score)
        state.motion.update(track, found[detection], NOISE)
        state.evidence.see(track, score[detection], off)
        new = np.delete(np.arange(len(found)), detection)
        state.motion = state.motion.join(Motion.start(found[new], NOISE, None if velocity is None else velocity[new]))
        state.evidence = state.evidence.join(Evidence.start(score[new]))
        state.label = np.concatenate([state.label, label[new]])
        state.id = np.concatenate([state.id, state.next_id + np.arange(len(new))])
        state.next_id += len(new)

    def features(self, state: KalmanConfidenceState, box: Array) -> Array:
        """(T, 24) what the confidence is told, for the boxes (T, 7) of the tracks in the sensor frame."""
        return features(state.evidence, box, state.label, state.frames, self.field_of_view)

    def _match(self, state: KalmanConfidenceState, found: Array, label: Int, score: Array) -> tuple[Int, Int, Array]:
        """Detections, the tracks that they belong to, and their distances as shares of the gate."""
        gate = self.gate[state.label] * np.where(state.evidence.hits == 1, _NEWBORN, 1)
        gate *= 1 + _GROWTH * (state.evidence.missed - 1)
        tracked = state.motion.box
        cost = np.hypot(found[:, None, 0] - tracked[:, 0], found[:, None, 1] - tracked[:, 1]) / gate
        cost[label[:, None] != state.label] = np.inf
        pairs = [np.zeros((0, 2), dtype=np.int64)]
        free = np.ones(len(state.label), dtype=bool)
        for rows in (np.flatnonzero(score >= 0), np.flatnonzero(score < 0)):
            columns = np.flatnonzero(free)
            chosen = gated_hungarian(cost[rows[:, None], columns], 1.0)
            pairs.append(np.stack([rows[chosen[:, 0]], columns[chosen[:, 1]]], 1))
            free[pairs[-1][:, 1]] = False
        detection, track = np.concatenate(pairs).T
        return detection, track, cost[detection, track]

    def _tracks(self, state: KalmanConfidenceState, box: Array, chance: Array, like: Boxes) -> Tracks:
        inside = np.abs(np.arctan2(box[:, 1], box[:, 0])) <= self.field_of_view / 2
        seen = state.evidence.missed == 0
        shown = np.flatnonzero(np.where(seen, chance >= self.min_seen, inside & (chance >= self.min_unseen)))
        velocity = (state.motion.velocity[shown] @ state.pose[:3, :3])[:, :2]
        boxes = boxes_of(box[shown], state.label[shown], chance[shown], like, velocity)
        return Tracks(boxes, torch.from_numpy(state.id[shown]).to(like.label))

    def _end(self, state: KalmanConfidenceState, chance: Array) -> None:
        missed = state.evidence.missed
        alive = (missed == 0) | ((missed < self.max_age) & (chance >= _HOPELESS))
        state.motion, state.evidence = state.motion.take(alive), state.evidence.take(alive)
        state.label, state.id = state.label[alive], state.id[alive]
