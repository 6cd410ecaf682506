"""Classes of pixels, and so of points."""

from __future__ import annotations

from dataclasses import dataclass

from lidarfw.errors import DataError
from lidarfw.interfaces import Head
from lidarfw.types import DataSpec, PointLabels, Points, RangeImage, Spec
from torch import Tensor, nn


@dataclass
class MovingSegOutput:
    """Raw output of the head."""

    logits: Tensor  # (B, K, H, W)
    image: RangeImage  # the features that they were made of; says which pixels hold a point
    points: Points  # the points of the range image, in the order of image.pixel


class MovingSegHead(Head):
    """A class for every pixel of a range image, by a 1 x 1 convolution; every point has the class of its pixel.

    The classes are those of the data: static and moving, or any others. A point outside the view has no class (all
    probabilities 0), unless a postprocessor finds one.
    """

    defaults = {"loss": ["edge_aware"], "postprocessor": ["knn"], "metric": ["mos_iou"]}

    def __init__(self, image: Spec, points: Spec, data: DataSpec) -> None:
        super().__init__()
        self.classify = nn.Conv2d(image.channels, len(data.classes), 1)
        self.provides = Spec(PointLabels, classes=data.classes)

    def forward(self, image: RangeImage, points: Points) -> MovingSegOutput:
        """Logits (B, K, H, W)."""
        if len(image.pixel) != len(points):
            raise DataError(
                f"head 'moving_seg': the range image was made of {len(image.pixel)} points, given are {len(points)}"
                "\n  fix: put the range projection last among the transforms that add or drop points"
            )
        return MovingSegOutput(self.classify(image.features), image, points)

    def decode(self, output: MovingSegOutput) -> PointLabels:
        """Probabilities (N, K) of every point."""
        pixels = output.logits.float().softmax(1).permute(0, 2, 3, 1).flatten(0, 2)
        pixel = output.image.pixel
        probability = pixels.index_select(0, pixel.clamp(min=0)) * (pixel >= 0)[:, None]
        return PointLabels(probability, output.points.batch, output.points.batch_size)


__all__ = ["MovingSegHead", "MovingSegOutput"]
