"""Random changes of the whole scene: mirrored, turned and scaled about the sensor.

Source: Zhou and Tuzel, "VoxelNet", CVPR 2018, section 3.2; Yan et al., "SECOND", Sensors 2018, section 3.2.5.
Points, labels, poses and calibration change together: pictures stay as they are, the cameras of the frame take the
change up, so that points still fall on their pixels; poses do too, so that points keep their place in the map.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lidarfw._lazy import LazyModule
from lidarfw.errors import ConfigError
from lidarfw.interfaces.data import Transform
from lidarfw.types import BEV, Boxes, Frame, Image, Points, Poses, RangeImage, Targets, Tracks

if TYPE_CHECKING:
    import torch
    from torch import Tensor
else:
    torch = LazyModule("torch")

Matrix = npt.NDArray[np.float64]


def move_frame(frame: Frame, matrix: Matrix) -> Frame:
    """The frame with its scene moved: points p become matrix @ p.

    `matrix` (3, 3) is a turn about z, a mirror that keeps z, a scale, or a product of these, about the sensor;
    (4, 4) may shift too. Boxes keep their shape under it; an observation angle belongs to the picture and stays.
    """
    whole = np.eye(4)
    whole[: len(matrix), : len(matrix)] = matrix
    inputs = {name: _move_input(name, value, whole) for name, value in frame.inputs.items()}
    cameras = {name: camera.transformed(whole) for name, camera in frame.meta.cameras.items()}
    targets = Targets(
        boxes=_move_boxes(frame.targets.boxes, whole),
        ignored=_move_boxes(frame.targets.ignored, whole),
        points=frame.targets.points,
        poses=None if frame.targets.poses is None else _move_poses(frame.targets.poses, whole),
        tracks=_move_tracks(frame.targets.tracks, whole),
    )
    return Frame(inputs, targets, dataclasses.replace(frame.meta, cameras=cameras))


def _move_input(name: str, value: Any, matrix: Matrix) -> Any:
    if isinstance(value, Points):
        return value.replace(xyz=_affine(value.xyz, matrix))
    if isinstance(value, Image):
        return value.replace(cameras=tuple(camera.transformed(matrix) for camera in value.cameras))
    if isinstance(value, Poses):
        return _move_poses(value, matrix)
    if isinstance(value, (RangeImage, BEV)):
        raise ConfigError(
            f"the input '{name}' is a {type(value).__name__}, which cannot be turned or mirrored any more.\n"
            f"  fix: list augmentations before the transform that makes it"
        )
    return value


def _linear(vectors: Tensor, matrix: Matrix) -> Tensor:
    """Vectors (N, 2 or 3) times the linear part."""
    size = vectors.shape[1]
    return vectors @ torch.tensor(matrix[:size, :size].T, dtype=vectors.dtype)


def _affine(places: Tensor, matrix: Matrix) -> Tensor:
    """Places (N, 3) moved by the whole (4, 4)."""
    return _linear(places, matrix) + torch.tensor(matrix[:3, 3], dtype=places.dtype)


def _move_boxes(boxes: Boxes | None, matrix: Matrix) -> Boxes | None:
    if boxes is None:
        return None
    heading = _linear(torch.stack([boxes.yaw.cos(), boxes.yaw.sin()], 1), matrix)
    return boxes.replace(
        center=_affine(boxes.center, matrix),
        size=boxes.size * float(np.cbrt(abs(np.linalg.det(matrix[:3, :3])))),
        yaw=torch.atan2(heading[:, 1], heading[:, 0]),
        velocity=None if boxes.velocity is None else _linear(boxes.velocity, matrix),
    )


def _move_tracks(tracks: Tracks | None, matrix: Matrix) -> Tracks | None:
    boxes = None if tracks is None else _move_boxes(tracks.boxes, matrix)
    return None if tracks is None or boxes is None else tracks.replace(boxes=boxes)


def _move_poses(poses: Poses, matrix: Matrix) -> Poses:
    """Poses T become T @ inverse(matrix): points keep their place in the map."""
    inverse = torch.tensor(np.linalg.inv(matrix), dtype=poses.matrix.dtype)
    return poses.replace(matrix=poses.matrix @ inverse)


class RandomFlip(Transform):
    """Mirror the scene, about each of `axes` with `probability`.

    Axis x exchanges left and right (y changes sign), axis y ahead and behind.
    """

    train_only = True

    def __init__(self, *, axes: tuple[str, ...] = ("x",), probability: float = 0.5) -> None:
        if not set(axes) <= {"x", "y"}:
            raise ConfigError(f"random_flip.axes: expected x, y or both, found {list(axes)}")
        if not 0 <= probability <= 1:
            raise ConfigError(f"random_flip.probability: expected 0..1, found {probability}")
        self.axes, self.probability = tuple(axes), probability

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame, perhaps mirrored."""
        signs = np.ones(3)
        for axis in self.axes:
            if rng.random() < self.probability:
                signs["yx".index(axis)] *= -1
        return frame if (signs == 1).all() else move_frame(frame, np.diag(signs))


class RandomRotation(Transform):
    """Turn the scene about the vertical axis by an angle drawn evenly from [-angle, angle] radians."""

    train_only = True

    def __init__(self, *, angle: float = 0.7853981633974483) -> None:
        if not 0 <= angle <= math.pi:
            raise ConfigError(f"random_rotation.angle: expected radians in 0..pi, found {angle}")
        self.angle = angle

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame, turned."""
        angle = rng.uniform(-self.angle, self.angle)
        cosine, sine = math.cos(angle), math.sin(angle)
        return move_frame(frame, np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]))


class RandomScaling(Transform):
    """Scale the scene, sizes and velocities included, by a factor drawn evenly from [low, high]."""

    train_only = True

    def __init__(self, *, low: float = 0.95, high: float = 1.05) -> None:
        if not 0 < low <= high:
            raise ConfigError(f"random_scaling: expected 0 < low <= high, found low {low}, high {high}")
        self.low, self.high = low, high

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame, scaled."""
        return move_frame(frame, np.eye(3) * rng.uniform(self.low, self.high))
