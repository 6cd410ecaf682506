"""Tracks looked at again from the end: the Kalman filter of `kalman_confidence`, smoothed over whole sequences."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from lidarfw.types import Boxes, FrameResult, Poses, Tracks

from lidarfw_time3d.frames import array, boxes_of, rows_of, seconds_since, to_sensor
from lidarfw_time3d.kalman import Array, Int, Motion, wrap
from lidarfw_time3d.kalman_confidence import NOISE, REST, KalmanConfidence, KalmanConfidenceState


@dataclass
class Moment:
    """What the filter knew after one frame, of all T tracks alive."""

    id: Int  # (T,)
    motion: Motion
    missed: Array  # (T,) frames unseen
    pose: Array  # (4, 4)
    passed: float  # seconds since the frame before


@dataclass
class KalmanOfflineState:
    """The online tracker's state, and all frames so far with what the filter knew."""

    online: KalmanConfidenceState
    held: list[FrameResult] = field(default_factory=list)
    moments: list[Moment] = field(default_factory=list)


class KalmanOffline(KalmanConfidence):
    """`kalman_confidence` for recorded drives: every frame is held back until the end, and the boxes are smoothed.

    Which boxes come out, their ids and their scores are those of `kalman_confidence`. Their place, heading, size and
    velocity are the Rauch-Tung-Striebel smoother's (AIAA Journal 1965), so they use what was seen later too: a box
    that was coasted through a gap lies on the way to where its object was found again.
    """

    def start(self) -> KalmanOfflineState:  # type: ignore[override]
        """No tracks, no frames."""
        return KalmanOfflineState(super().start())

    def step(  # type: ignore[override]
        self, state: KalmanOfflineState, frame: FrameResult, boxes: Boxes, pose: Poses | None = None
    ) -> list[FrameResult]:
        """Nothing: the frames come out of `flush`."""
        passed = seconds_since(state.online.time, frame.meta, self.frame_time)
        state.held += super().step(state.online, frame, boxes, pose)
        online = state.online
        known = Motion(*(values.copy() for values in vars(online.motion).values()))
        missed = online.evidence.missed.astype(float)
        state.moments.append(Moment(online.id.copy(), known, missed, online.pose.copy(), passed))
        return []

    def flush(self, state: KalmanOfflineState) -> list[FrameResult]:
        """All frames, smoothed."""
        smoothed = smooth(state.moments, self.frame_time)
        return [
            replace(result, tracks=_placed(result.tracks, moment, motion))
            for result, moment, motion in zip(state.held, state.moments, smoothed, strict=True)
        ]


def smooth(moments: list[Moment], frame_time: float) -> list[Motion]:
    """The smoothed boxes and velocities of every frame (Rauch, Tung and Striebel 1965, equations 3.28 to 3.31).

    With m, P the filter's mean and covariance, F the motion and a tick what it predicts from them:
    gain G = P F' P'^-1, smoothed mean m + G (smoothed mean of the next frame - m').
    """
    done: list[Motion] = []
    for number in range(len(moments) - 1, -1, -1):
        now = Motion(*(values.copy() for values in vars(moments[number].motion).values()))
        if done:
            _step_back(now, moments[number], moments[number + 1], done[-1], frame_time)
        done.append(now)
    return done[::-1]


def _step_back(now: Motion, moment: Moment, later: Moment, after: Motion, frame_time: float) -> None:
    """Correct the filter's `now` by the smoothed `after` of the next frame, for tracks that are in both."""
    _, rows, columns = np.intersect1d(moment.id, later.id, return_indices=True)
    predicted = moment.motion.take(rows)
    slow = (moment.missed[rows] > 0) & (np.hypot(*predicted.velocity[:, :2].T) < REST)  # as the filter itself does
    predicted.velocity[slow] = 0
    predicted.predict(later.passed, later.passed / frame_time, NOISE)
    off = after.box[columns] - predicted.box
    off[:, 3] = wrap(off[:, 3])
    off[:, 3] = np.where(np.abs(off[:, 3]) > np.pi / 2, wrap(off[:, 3] + np.pi), off[:, 3])  # headings may be turned
    faster = after.velocity[columns] - predicted.velocity
    place, speed = _gain(moment.motion.place[rows], predicted.place, later.passed)
    now.box[rows, :3] += place[:, :1] * off[:, :3] + place[:, 1:] * faster
    now.velocity[rows] += speed[:, :1] * off[:, :3] + speed[:, 1:] * faster
    now.box[rows, 3:] += (moment.motion.shape[rows] / predicted.shape)[:, None] * off[:, 3:]
    now.box[rows, 3] = wrap(now.box[rows, 3])


def _gain(known: Array, predicted: Array, seconds: float) -> tuple[Array, Array]:
    """Rows (N, 2) of G for coordinate and velocity, of covariances (N, 3) xx, xv, vv before and after a prediction."""
    a, b, c = known.T
    p, q, r = predicted.T
    determinant = p * r - q * q
    # P F' = [[a + b s, b], [b + c s, c]]
    first, second = np.stack([a + b * seconds, b], 1), np.stack([b + c * seconds, c], 1)
    inverse = np.stack([r, -q, -q, p], 1).reshape(-1, 2, 2) / determinant[:, None, None]
    place, speed = (np.einsum("ni,nij->nj", row, inverse) for row in (first, second))
    return place, speed


def _placed(tracks: Tracks | None, moment: Moment, motion: Motion) -> Tracks | None:
    """The tracks of a frame at their smoothed places; those that ended in this very frame stay where they are."""
    if tracks is None or len(tracks.id) == 0:
        return tracks
    ids, boxes = tracks.id.cpu().numpy(), tracks.boxes
    _, rows, columns = np.intersect1d(ids, moment.id, return_indices=True)
    box = rows_of(boxes)
    velocity = array(boxes.velocity)
    box[rows] = to_sensor(motion.box[columns], moment.pose)
    velocity[rows] = (motion.velocity[columns] @ moment.pose[:3, :3])[:, :2]
    made = boxes_of(box, boxes.label.cpu().numpy(), array(boxes.score), boxes, velocity)
    return Tracks(made, tracks.id, tracks.moving)
