"""A Kalman filter over many boxes at once: the constant velocity model of AB3DMOT.

Source: Weng et al., "3D multi-object tracking: a baseline and new evaluation metrics", IROS 2020, section III-B. The
state of a box is x, y, z, yaw, l, w, h and the velocity of its centre. All its covariance matrices are diagonal, and
the model couples only a coordinate of the centre with its own velocity, so the filter falls apart into small ones
that share their covariance: three of (coordinate, velocity) and four of one number. None of it needs a matrix
inverse, and one call serves all tracks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt
from typing_extensions import Self

Array = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]


@dataclass
class Noise:
    """Variances of the model; a number for all tracks, or (T,) for each."""

    measured: float | Array = 1.0  # of every measured number (m^2, rad^2)
    place: float | Array = 1.0  # that a frame adds to the place (m^2)
    shape: float | Array = 1.0  # that a frame adds to yaw and size
    velocity: float | Array = 1.0  # that a frame adds to the velocity (m^2/s^2)
    first: float | Array = 10.0  # of place, yaw and size of a new track
    first_velocity: float | Array = 1e6  # of the velocity of a new track (m^2/s^2)


class Table:
    """Base of dataclasses whose fields are arrays with a row per track."""

    def take(self, rows: Int | npt.NDArray[np.bool_]) -> Self:
        """These rows."""
        return type(self)(*(getattr(self, f.name)[rows] for f in fields(self)))  # type: ignore[arg-type]

    def join(self, other: Self) -> Self:
        """These rows, then the others."""
        pairs = ((getattr(self, f.name), getattr(other, f.name)) for f in fields(self))  # type: ignore[arg-type]
        return type(self)(*(np.concatenate(pair) for pair in pairs))


@dataclass
class Motion(Table):
    """T boxes in motion, in the tracking frame."""

    box: Array  # (T, 7) x, y, z, yaw, l, w, h
    velocity: Array  # (T, 3) m/s
    place: Array  # (T, 3) variance of a coordinate, covariance with its velocity, variance of the velocity
    shape: Array  # (T,) variance of yaw and of each size

    @classmethod
    def start(cls, box: Array, noise: Noise, velocity: Array | None = None) -> Motion:
        """New tracks at the boxes (N, 7), at rest or with a velocity (N, 3) in m/s."""
        count = len(box)
        place = np.zeros((count, 3))
        place[:, 0], place[:, 2] = noise.first, noise.first_velocity
        speed = np.zeros((count, 3)) if velocity is None else velocity.copy()
        return cls(box.copy(), speed, place, np.broadcast_to(np.asarray(noise.first, dtype=float), count).copy())

    def predict(self, seconds: float, frames: float, noise: Noise) -> None:
        """Move all tracks on by a time that is worth so many frames of process noise."""
        self.box[:, :3] += self.velocity * seconds
        variance, covariance, speed = self.place.T
        self.place[:, 0] = variance + seconds * (2 * covariance + seconds * speed) + frames * noise.place
        self.place[:, 1] = covariance + seconds * speed
        self.place[:, 2] = speed + frames * noise.velocity
        self.shape += frames * noise.shape

    def update(self, rows: Int, measured: Array, noise: Noise) -> None:
        """Correct the tracks `rows` (N,) by the boxes (N, 7) that were found for them.

        A heading more than a right angle off turns the track, one is not averaged with its opposite (AB3DMOT,
        "orientation correction").
        """
        place, off = self.place[rows], measured - self.box[rows]
        turn = wrap(off[:, 3])
        reverse = np.abs(turn) > math.pi / 2
        off[:, 3] = np.where(reverse, wrap(turn + math.pi), turn)
        self.box[rows[reverse], 3] += math.pi
        gain = place[:, 0] / (place[:, 0] + noise.measured)
        speed_gain = place[:, 1] / (place[:, 0] + noise.measured)
        self.box[rows, :3] += gain[:, None] * off[:, :3]
        self.velocity[rows] += speed_gain[:, None] * off[:, :3]
        self.place[rows, 2] = place[:, 2] - speed_gain * place[:, 1]
        self.place[rows, 0], self.place[rows, 1] = (1 - gain) * place[:, 0], (1 - gain) * place[:, 1]
        shape_gain = self.shape[rows] / (self.shape[rows] + noise.measured)
        self.box[rows, 3:] += shape_gain[:, None] * off[:, 3:]
        self.shape[rows] *= 1 - shape_gain
        self.box[rows, 3] = wrap(self.box[rows, 3])


def wrap(angle: Array) -> Array:
    """Angles in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi
