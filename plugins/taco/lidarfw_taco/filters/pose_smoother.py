"""Poses of a stream smoothed by a motion of constant velocity."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from lidarfw.interfaces import Filter
from lidarfw.types import FrameResult, Poses, Spec
from torch import Tensor


@dataclass
class SmootherState:
    """The motion so far, in float64; the covariances are those of one axis, (value, rate), the same for all three."""

    matrix: Tensor  # (4, 4)
    velocity: Tensor  # (3,) m/s in the map
    turn: Tensor  # (3,) rad/s about the axes of the map
    place_covariance: Tensor  # (2, 2)
    angle_covariance: Tensor  # (2, 2)
    time: float = 0.0  # seconds, of the last frame
    running: bool = False  # a pose was believed, at most `max_missed` frames ago
    missed: int = 0  # frames since a pose was last believed


class PoseSmoother(Filter):
    """A Kalman filter over the poses of a stream: constant speed and turn rate (Bar-Shalom et al., 2001, 6.3.2, 11.7).

    A pose that is not ok, or lies more than `gate` standard deviations from where the motion leads, is not believed:
    the predicted pose takes its place and stays ok for `max_missed` frames, then the filter starts anew with the next
    pose that is ok. The deviations `place_error` (m) and `angle_error` (rad) are those of a pose whose confidence
    (share of inliers) is 1; they grow as 1 / sqrt(confidence). `acceleration` (m/s^2) and `angular_acceleration`
    (rad/s^2) say how much the vehicle may change its motion. Nothing is held back: the result is causal.
    """

    def __init__(
        self,
        poses: Spec,
        *,
        place_error: float = 0.3,
        angle_error: float = 0.01,
        acceleration: float = 3.0,
        angular_acceleration: float = 0.5,
        gate: float = 5.0,
        max_missed: int = 10,
        frame_time: float = 0.1,
    ) -> None:
        super().__init__()
        self.place_error, self.angle_error = place_error, angle_error
        self.acceleration, self.angular_acceleration = acceleration, angular_acceleration
        self.gate, self.max_missed, self.frame_time = gate, max_missed, frame_time
        self.provides = poses

    def start(self) -> SmootherState:
        """No motion known."""
        matrix, nothing = torch.eye(4, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
        return SmootherState(matrix, nothing, nothing, matrix[:2, :2], matrix[:2, :2])

    def step(self, state: SmootherState, frame: FrameResult, poses: Poses) -> list[FrameResult]:
        """The frame with the smoothed pose."""
        passed = frame.meta.time - state.time
        state.time = frame.meta.time
        matrix, ok = poses.matrix[0].double().cpu(), bool(poses.ok[0])
        if not state.running:
            if ok:
                self._begin(state, matrix)
            return [frame]
        self._predict(state, passed if passed > 0 else self.frame_time)
        believed = ok and self._correct(state, matrix, float(poses.confidence[0]))
        state.missed = 0 if believed else state.missed + 1
        state.running = state.missed <= self.max_missed
        smoothed = poses.replace(
            matrix=state.matrix[None].to(poses.matrix), ok=torch.full_like(poses.ok, state.running)
        )
        return [frame.with_prediction(poses, smoothed)]

    def _begin(self, state: SmootherState, matrix: Tensor) -> None:
        state.matrix, state.running, state.missed = matrix, True, 0
        state.velocity, state.turn = torch.zeros_like(matrix[0, :3]), torch.zeros_like(matrix[0, :3])
        # a vehicle may start at 20 m/s and 0.5 rad/s
        state.place_covariance = torch.diag(matrix.new_tensor([self.place_error**2, 20.0**2]))
        state.angle_covariance = torch.diag(matrix.new_tensor([self.angle_error**2, 0.5**2]))

    def _predict(self, state: SmootherState, seconds: float) -> None:
        matrix, velocity, turn = state.matrix, state.velocity, state.turn
        turned, moved = _rotation(turn * seconds), matrix.clone()
        moved[:3, :3] = turned @ matrix[:3, :3]
        moved[:3, 3] += velocity * seconds
        state.matrix, state.velocity = moved, turned @ velocity  # a vehicle turns where it drives
        state.place_covariance = _grown(state.place_covariance, seconds, self.acceleration)
        state.angle_covariance = _grown(state.angle_covariance, seconds, self.angular_acceleration)

    def _correct(self, state: SmootherState, matrix: Tensor, confidence: float) -> bool:
        """Take a measured pose in; False, and nothing happens, where it lies outside the gate."""
        share = max(confidence, 1e-3)
        apart = matrix[:3, 3] - state.matrix[:3, 3]
        turned = _turn(matrix[:3, :3] @ state.matrix[:3, :3].T)
        place, place_gate = _gain(state.place_covariance, self.place_error**2 / share)
        angle, angle_gate = _gain(state.angle_covariance, self.angle_error**2 / share)
        if float(apart.norm()) > self.gate * place_gate or float(turned.norm()) > self.gate * angle_gate:
            return False
        state.velocity = state.velocity + place[1] * apart
        state.turn = state.turn + angle[1] * turned
        corrected = state.matrix.clone()
        corrected[:3, :3] = _rotation(angle[0] * turned) @ state.matrix[:3, :3]
        corrected[:3, 3] += place[0] * apart
        state.matrix = corrected
        state.place_covariance = _shrunk(state.place_covariance, place)
        state.angle_covariance = _shrunk(state.angle_covariance, angle)
        return True


def _grown(covariance: Tensor, seconds: float, acceleration: float) -> Tensor:
    """Covariance (2, 2) of value and rate after so much time with white accelerations."""
    motion = covariance.new_tensor([[1.0, seconds], [0.0, 1.0]])
    gain = covariance.new_tensor([seconds**2 / 2, seconds])
    return motion @ covariance @ motion.T + torch.outer(gain, gain) * acceleration**2


def _gain(covariance: Tensor, noise: float) -> tuple[Tensor, float]:
    """Kalman gain (2,) of a measured value, and the standard deviation of its difference to the expected one."""
    variance = covariance[0, 0] + noise
    return covariance[:, 0] / variance, float(variance.sqrt())


def _shrunk(covariance: Tensor, gain: Tensor) -> Tensor:
    updated = covariance - torch.outer(gain, covariance[0])
    symmetric: Tensor = (updated + updated.T) / 2
    return symmetric


def _rotation(vector: Tensor) -> Tensor:
    """Rotation (3, 3) about a vector (3,) by its length in radians."""
    x, y, z = vector.tolist()
    rotation: Tensor = torch.linalg.matrix_exp(vector.new_tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]))
    return rotation


def _turn(rotation: Tensor) -> Tensor:
    """The vector (3,) of a rotation (3, 3), below half a turn."""
    skew = torch.stack([
        rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]
    ]) / 2  # fmt: skip
    sine = skew.norm()
    angle = torch.atan2(sine, (rotation.diagonal().sum() - 1) / 2)
    scale = 1.0 if float(sine) < 1e-12 else float(angle / sine)
    scaled: Tensor = skew * scale
    return scaled
