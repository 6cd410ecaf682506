"""Necks that change the representation: between points, voxels, bird's-eye view and range image."""

from __future__ import annotations

from itertools import product

import torch
from torch import Tensor
from torch.nn import functional as F

from lidarfw.components.backbones.pillars import PillarEncoder
from lidarfw.components.layers import grid_from_options
from lidarfw.errors import DataError
from lidarfw.interfaces import Neck
from lidarfw.ops import find_voxels, from_dense, voxelize_mean
from lidarfw.types import BEV, Points, RangeImage, Spec, Voxels


class BEVToVoxels(Neck):
    """Each cell of a bird's-eye view with a feature other than 0 becomes one voxel of the grid's full height."""

    def __init__(self, bev: Spec) -> None:
        super().__init__()
        self.strides = (bev.grid.shape()[0], bev.stride, bev.stride)
        self.provides = Spec(Voxels, bev.channels, bev.stride, bev.grid, depth=1)

    def forward(self, bev: BEV) -> Voxels:
        """Voxels of depth 1, so that `height_compression` gives the map back."""
        return from_dense(bev.features[:, :, None], bev.grid, self.strides)


class PointsToVoxels(Neck):
    """The mean of the points in each cell, x, y, z in front of their features (SECOND, Sensors 2018)."""

    def __init__(
        self,
        points: Spec,
        *,
        lower: tuple[float, float, float] = (0.0, -40.0, -3.0),
        upper: tuple[float, float, float] = (70.4, 40.0, 1.0),
        cell: tuple[float, float, float] = (0.05, 0.05, 0.1),
    ) -> None:
        """Options: range and cell size x, y, z in metres (SECOND's for KITTI)."""
        super().__init__()
        self.grid = grid_from_options(lower, upper, cell)
        self.provides = Spec(Voxels, 3 + points.channels, 1, self.grid, depth=self.grid.shape()[0])

    def forward(self, points: Points) -> Voxels:
        """Voxels at stride 1; points outside the grid are left out."""
        return voxelize_mean(points, self.grid)


class PointsToBEV(Neck):
    """A pillar feature net (PointPillars, CVPR 2019) on points that already carry features."""

    example = {"lower": (0.0, -16.0, -3.0), "upper": (32.0, 16.0, 1.0)}

    def __init__(
        self,
        points: Spec,
        *,
        lower: tuple[float, float, float] = (0.0, -40.0, -3.0),
        upper: tuple[float, float, float] = (70.4, 40.0, 1.0),
        cell: tuple[float, float] = (0.16, 0.16),
        channels: int = 64,
    ) -> None:
        """Options: range and pillar size x, y in metres, width of the map."""
        super().__init__()
        grid = grid_from_options(lower, upper, cell)
        self.encoder = PillarEncoder(points.channels, grid, channels)
        self.provides = Spec(BEV, channels, 1, grid)

    def forward(self, points: Points) -> BEV:
        """The map at stride 1; points outside the grid are left out."""
        return BEV(self.encoder(points), self.encoder.grid, 1)


class VoxelsToPoints(Neck):
    """Voxel features at the points, by trilinear interpolation between the voxel centres.

    Source: Tang et al., "Searching Efficient 3D Architectures with Sparse Point-Voxel Convolution", ECCV 2020,
    section 3.1. Empty cells do not count: the weights of the others are scaled to a sum of 1.
    """

    def __init__(self, voxels: Spec, points: Spec) -> None:
        super().__init__()
        self.provides = Spec(Points, voxels.channels)

    def forward(self, voxels: Voxels, points: Points) -> Points:
        """The same points with features (N, C) of the voxels; 0 outside the grid and where no voxel is near."""
        rows, weights = _surrounding_voxels(voxels, points)
        total = weights.sum(1, keepdim=True)
        weights = torch.where(total > 0, weights / total, 0).to(voxels.features.dtype)
        table = torch.cat([voxels.features, voxels.features.new_zeros(1, voxels.features.shape[1])])
        return points.replace(features=F.embedding_bag(rows, table, mode="sum", per_sample_weights=weights))


class RangeToPoints(Neck):
    """Each point takes the features of its pixel; points outside the view get 0."""

    def __init__(self, image: Spec, points: Spec) -> None:
        super().__init__()
        self.provides = Spec(Points, image.channels)

    def forward(self, image: RangeImage, points: Points) -> Points:
        """The points that the range image was made of, with features (N, C)."""
        if len(image.pixel) != len(points):
            raise DataError(
                f"neck 'range_to_points': the range image was made of {len(image.pixel)} points, "
                f"given are {len(points)}"
                "\n  fix: put the range projection last among the transforms that add or drop points"
            )
        pixels = image.features.permute(0, 2, 3, 1).flatten(0, 2)
        features = pixels.index_select(0, image.pixel.clamp(min=0))
        return points.replace(features=torch.where((image.pixel >= 0)[:, None], features, 0))


def _surrounding_voxels(voxels: Voxels, points: Points) -> tuple[Tensor, Tensor]:
    """Rows (N, 8) of the voxels whose centres surround each point, len(voxels) for none, and weights (N, 8)."""
    inside = voxels.grid.index(points.xyz)[1]
    pitch = points.xyz.new_tensor(voxels.grid.cell) * points.xyz.new_tensor(voxels.strides[::-1])
    place = ((points.xyz - points.xyz.new_tensor(voxels.grid.lower)) / pitch - 0.5).flip(1)
    place = torch.where(inside[:, None], place, 0).clamp(min=0)
    place = torch.minimum(place, place.new_tensor(voxels.shape) - 1)  # z, y, x; whole numbers are centres
    corners = torch.tensor(list(product((0, 1), repeat=3)), device=place.device)
    cell = torch.floor(place)[:, None].long() + corners  # (N, 8, 3)
    weights = (1 - (place[:, None] - cell).abs()).prod(2)
    rows = find_voxels(voxels, points.batch[:, None].expand(-1, 8), cell)
    return rows, weights * ((rows < len(voxels)) & inside[:, None])
