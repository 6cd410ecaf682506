"""Leaving out what lies outside a range."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lidarfw.errors import ConfigError
from lidarfw.interfaces.data import Transform
from lidarfw.types import Boxes, Frame, Points, Targets, Tracks

if TYPE_CHECKING:
    from torch import Tensor


class Crop(Transform):
    """Drop points outside a range, and labelled boxes whose centre lies outside; `lower` is inside, `upper` is not.

    With `boxes` it applies in training only: in evaluation every labelled object must be asked for. `boxes: false`
    crops points alone, in evaluation too.
    """

    example = {"lower": (0.0, -40.0, -3.0), "upper": (70.4, 40.0, 1.0)}

    def __init__(
        self,
        *,
        lower: tuple[float, float, float],
        upper: tuple[float, float, float],
        boxes: bool = True,
    ) -> None:
        """Options: corners x, y, z of the range in metres, sensor frame."""
        if not all(low < high for low, high in zip(lower, upper, strict=True)):
            raise ConfigError(f"crop: expected lower < upper along every axis, found lower {lower}, upper {upper}")
        self.lower, self.upper, self.boxes = lower, upper, boxes
        self.train_only = boxes

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame without what lies outside."""
        kept = {n: self._inside(value.xyz) for n, value in frame.inputs.items() if isinstance(value, Points)}
        inputs = {n: value[kept[n]] if n in kept else value for n, value in frame.inputs.items()}
        targets = frame.targets
        if targets.points is not None and "points" in kept:
            targets = targets.replace(points=targets.points[kept["points"]])
        return frame.replace(inputs=inputs, targets=self._crop_targets(targets) if self.boxes else targets)

    def _crop_targets(self, targets: Targets) -> Targets:
        boxes, ignored, tracks = targets.boxes, targets.ignored, targets.tracks
        return targets.replace(
            boxes=None if boxes is None else boxes[self._holds(boxes)],
            ignored=None if ignored is None else ignored[self._holds(ignored)],
            tracks=None if tracks is None else self._crop_tracks(tracks),
        )

    def _crop_tracks(self, tracks: Tracks) -> Tracks:
        kept = self._holds(tracks.boxes)
        moving = None if tracks.moving is None else tracks.moving[kept]
        return Tracks(tracks.boxes[kept], tracks.id[kept], moving)

    def _inside(self, xyz: Tensor) -> Tensor:
        return ((xyz >= xyz.new_tensor(self.lower)) & (xyz < xyz.new_tensor(self.upper))).all(1)

    def _holds(self, boxes: Boxes) -> Tensor:
        """Boxes (M,) to keep. Objects known in the picture only (label -1) have no centre to go by and stay."""
        return self._inside(boxes.center) | (boxes.label < 0)
