"""A random shift of the whole scene, with the pose that follows it."""

from __future__ import annotations

import numpy as np
from lidarfw.components.transforms.augmentation import move_frame
from lidarfw.errors import ConfigError
from lidarfw.interfaces.data import Transform
from lidarfw.types import Frame


class RandomShift(Transform):
    """Shift the scene along x and y by up to `distance` metres, with `probability` (LightLoc, CVPR 2025).

    Points, boxes and the pose change together: every point keeps its place in the map, as `random_rotation` does it.
    Mirroring and scaling have no such pose and must not be used where localization is learned.
    """

    train_only = True

    def __init__(self, *, distance: float = 1.0, probability: float = 0.5) -> None:
        if distance < 0 or not 0 <= probability <= 1:
            raise ConfigError(
                f"random_shift: expected distance >= 0 m and probability 0..1, got {distance} and {probability}"
            )
        self.distance, self.probability = distance, probability

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame, perhaps shifted."""
        shift = rng.uniform(-self.distance, self.distance, 2)
        if rng.random() >= self.probability:
            return frame
        matrix = np.eye(4)
        matrix[:2, 3] = shift
        return move_frame(frame, matrix)
