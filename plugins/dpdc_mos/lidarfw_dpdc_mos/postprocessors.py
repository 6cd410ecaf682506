"""From pixels back to points: neighbours of similar range decide."""

from __future__ import annotations

import torch
from lidarfw.errors import ConfigError, DataError
from lidarfw.interfaces import PostProcessor
from lidarfw.ops import range_knn, range_knn_mean
from lidarfw.types import PointLabels, Points, RangeImage, Spec
from torch.nn import functional as F

from lidarfw_dpdc_mos.distance import on_pixels


class KnnLabels(PostProcessor):
    """Class of each point by the pixels around its own whose range is nearest to that of the point.

    Milioto et al., "RangeNet++", IROS 2019, section III-D. A pixel has the class of the point that it shows; points
    hidden behind it, and those at the border of an object, get the class of what lies at their distance. `soft`
    takes the mean of the probabilities of the neighbours, which a filter can go on with; otherwise their classes vote
    and the result is certain (as in the paper). Points outside the view keep what they had.
    """

    def __init__(
        self,
        labels: Spec,
        image: Spec,
        points: Spec,
        *,
        window: int = 5,
        neighbors: int = 5,
        sigma: float = 1.0,
        cutoff: float = 1.0,
        soft: bool = True,
    ) -> None:
        """Options: side of the window in pixels, how many neighbours count, width of the weight that distance in the
        picture has (pixels), range difference up to which one counts (metres), mean or vote."""
        super().__init__()
        if window % 2 == 0 or not 1 <= window <= 15:
            raise ConfigError(f"postprocessor.knn.window must be odd and at most 15, got {window}")
        self.window, self.neighbors, self.sigma, self.cutoff, self.soft = window, neighbors, sigma, cutoff, soft
        self.provides = labels

    def forward(self, labels: PointLabels, image: RangeImage, points: Points) -> PointLabels:
        """The points with other probabilities (N, K)."""
        if not len(labels) == len(points) == len(image.pixel):
            raise DataError(
                f"postprocessor 'knn': {len(labels)} points are labelled, the scan has {len(points)}, the range image "
                f"was made of {len(image.pixel)}\n  fix: project the scan after the transforms that change its points"
            )
        size = {"window": self.window, "neighbors": self.neighbors, "sigma": self.sigma, "cutoff": self.cutoff}
        distance = points.xyz.norm(dim=1)
        pixels = on_pixels(labels.probability, image, points).permute(0, 3, 1, 2)
        inside = (image.pixel >= 0)[:, None]
        if self.soft:
            found = range_knn_mean(image, pixels, distance, **size)  # type: ignore[arg-type]
        else:
            voted = range_knn(image, pixels.argmax(1), distance, **size)  # type: ignore[arg-type]
            found = F.one_hot(voted.clamp(min=0), labels.probability.shape[1]).to(labels.probability)
        return labels.replace(probability=torch.where(inside, found, labels.probability))
