"""The map in regions: first which part of the map a scan was taken in, then where in it.

Sources: Li et al., "Hierarchical Scene Coordinate Classification and Regression for Visual Localization" (HSCNet),
CVPR 2020: regions are classified, places regressed within them, and the true region is given in training; Li et al.,
"LightLoc", CVPR 2025, section 3.2: one class for the whole scan. Not part of TACO.
"""

from __future__ import annotations

import torch
from lidarfw.errors import ConfigError
from lidarfw.ops import scatter_mean
from lidarfw.types import Poses
from torch import Tensor, nn

EMBEDDING = 32  # channels that tell the regressor which region it works in
TURN = 0.5**0.5  # cosine of the 45 degrees up to which poses may be of one region


class Regions(nn.Module):
    """Poses of the vehicle, spread over the map, from which places are measured; which of them a scan was taken near.

    A training pose that lies more than `size` metres or 45 degrees from all others founds a region, until there are
    `count` (the leader algorithm: Hartigan, "Clustering Algorithms", 1975, chapter 3). They are kept with the weights.
    """

    poses: Tensor  # (K, 4, 4), region -> map
    founded: Tensor  # (), how many of them there are

    def __init__(self, in_channels: int, count: int, size: float) -> None:
        super().__init__()
        if count < 1 or size <= 0:
            raise ConfigError(
                f"scene_coord: regions and region_size must be above 0, got {count} and {size} m.\n"
                "  fix: region_size: 8, and as many regions as the roads are long in tens of metres, for each direction"
            )
        self.size = size
        self.classify = nn.Linear(in_channels, count)
        self.embedding = nn.Embedding(count, EMBEDDING)
        self.register_buffer("poses", torch.eye(4).repeat(count, 1, 1))
        self.register_buffer("founded", torch.zeros((), dtype=torch.long))

    def forward(self, features: Tensor, batch: Tensor, samples: int) -> Tensor:
        """Logits (B, K) of every scan from the features (N, C) of its cells; -inf for regions that are not founded."""
        scan = scatter_mean(features, batch, samples)
        there = torch.arange(len(self.poses), device=scan.device) < self.founded.clamp(min=1)
        logits: Tensor = self.classify(scan).float().masked_fill(~there, -torch.inf)
        return logits

    @torch.no_grad()
    def of(self, poses: Poses) -> Tensor:
        """The nearest region (B,) of the poses; -1 where no pose is known."""
        nearest = self._apart(poses.matrix).argmin(1)
        return torch.where(poses.ok, nearest, -1)

    @torch.no_grad()
    def found(self, poses: Poses) -> None:
        """Take the poses of a training batch in."""
        for matrix in poses.matrix[poses.ok].to(self.poses.dtype):
            number = int(self.founded)
            if number < len(self.poses) and (not number or self._apart(matrix[None]).min() > self.size):
                self.poses[number] = matrix
                self.founded += 1

    def _apart(self, matrix: Tensor) -> Tensor:
        """Metres (B, K) from poses (B, 4, 4) to the regions, with 1e6 more to those that look another way."""
        regions = self.poses[: max(int(self.founded), 1)]
        matrix = matrix.to(regions.dtype)
        apart = (matrix[:, None, :3, 3] - regions[None, :, :3, 3]).norm(dim=2)
        cosine = (torch.einsum("bij,kij->bk", matrix[:, :3, :3], regions[:, :3, :3]) - 1) / 2
        return torch.where(cosine >= TURN, apart, apart + 1e6)
