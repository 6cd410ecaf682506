"""The shared backbone of TACO: residual sparse convolutions between poolings by the mean over points.

Sources: TACO, section 4 ("the 3D backbone of LiSA"); Yang et al., "LiSA: LiDAR Localization with Semantic Awareness",
CVPR 2024, whose widths and layout it takes. LiSA's distillation of semantic features is not part of TACO.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from lidarfw.components.layers import BatchNorm1d, grid_from_options
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Backbone
from lidarfw.ops import (
    SparseConv3d,
    SparseModule,
    SparseSequential,
    SubmanifoldConv3d,
    assign_cells,
    scatter_mean,
    scatter_sum,
    to_dense,
)
from lidarfw.ops.cells import cell_columns, cell_index, cell_key
from lidarfw.types import BEV, Grid, Points, Spec, Voxels
from torch import Tensor, nn


@dataclass
class _Counted:
    """Voxels, and how many points lie in each."""

    voxels: Voxels
    points: Tensor  # (V, 1)

    def with_voxels(self, voxels: Voxels) -> _Counted:
        return _Counted(voxels, self.points)


def _voxelize(points: Points, features: Tensor, grid: Grid) -> _Counted:
    """The mean of the points' features in each cell."""
    cells = assign_cells(points.xyz, points.batch, points.batch_size, grid)
    mean = scatter_mean(features, cells.inverse, len(cells.index))
    voxels = Voxels(mean, cells.index, grid, grid.shape(), batch_size=points.batch_size)
    return _Counted(voxels, cells.counts[:, None].to(mean.dtype))


def _halved(fine: _Counted) -> _Counted:
    """The level of twice the stride: a cell has the mean of the features at all the points in it."""
    voxels = fine.voxels
    z, y, x = (2 * stride for stride in voxels.strides)
    shape = voxels.grid.shape((z, y, x))
    b, *cell = voxels.index.unbind(1)
    key = cell_key((b, cell[0] // 2, cell[1] // 2, cell[2] // 2), shape)
    keys, inverse = torch.unique(key, return_inverse=True)
    points = scatter_sum(fine.points, inverse, len(keys))
    mean = scatter_sum(voxels.features * fine.points, inverse, len(keys)) / points
    index = cell_index(cell_columns(keys, shape))
    return _Counted(Voxels(mean, index, voxels.grid, shape, (z, y, x), voxels.batch_size), points)


class ResidualBlock(SparseModule):
    """Two submanifold 3 x 3 x 3 convolutions, and a 1 x 1 x 1 shortcut where the width changes; leaky ReLU."""

    def __init__(self, in_channels: int, channels: int) -> None:
        super().__init__()
        self.convs = SparseSequential(
            SubmanifoldConv3d(in_channels, channels, 3),
            BatchNorm1d(channels),
            nn.LeakyReLU(inplace=True),
            SubmanifoldConv3d(channels, channels, 3),
            BatchNorm1d(channels),
        )
        same = in_channels == channels
        self.shortcut = nn.Identity() if same else _linear(in_channels, channels)

    def forward(self, voxels: Voxels) -> Voxels:
        """The same cells with `channels` features."""
        features = self.convs(voxels).features + self.shortcut(voxels.features)
        return voxels.with_features(nn.functional.leaky_relu(features))


def _linear(in_channels: int, channels: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(in_channels, channels, bias=False), BatchNorm1d(channels))


class TacoBackbone(Backbone):
    """Task-agnostic features of TACO (section 4): points -> voxels at strides 2, 4, 8 and a bird's-eye-view map.

    A submanifold convolution of width `stem` on the mean of the points in each voxel; then, for each group of
    `blocks`, a pooling by 2 that takes the mean over the points of a cell (not over its voxels), and residual
    blocks of the widths in the group. The map is the level of stride `bev_stride` with its z cells laid side by side
    and a 1 x 1 convolution to `bev_channels`, done sparsely: the map of a level 10 cells high is never formed.
    """

    def __init__(
        self,
        points: Spec,
        *,
        lower: tuple[float, float, float] = (-60.0, -60.0, -2.0),
        upper: tuple[float, float, float] = (60.0, 60.0, 6.0),
        cell: tuple[float, float, float] = (0.2, 0.2, 0.2),
        stem: int = 64,
        blocks: tuple[tuple[int, ...], ...] = ((128,), (128, 256), (256, 512, 512, 512)),
        bev_stride: int = 4,
        bev_channels: int = 256,
        intensity: bool = False,
    ) -> None:
        """Options: range and voxel size x, y, z in metres; widths; whether the points' own features are used beside
        x, y, z, which are all that the paper's backbone sees."""
        super().__init__()
        self.grid, self.intensity = grid_from_options(lower, upper, cell), intensity
        strides = [2 ** (number + 1) for number in range(len(blocks))]
        _check(stem, blocks, bev_stride, strides)
        self.stem = SparseSequential(
            SubmanifoldConv3d(3 + points.channels * intensity, stem, 3), BatchNorm1d(stem), nn.LeakyReLU(inplace=True)
        )
        widths = [stem, *(group[-1] for group in blocks)]
        self.levels = nn.ModuleList(_residual(widths[i], group) for i, group in enumerate(blocks))
        self.bev_level = strides.index(bev_stride)
        height = self.grid.shape(bev_stride)[0]
        flat = SparseConv3d(widths[self.bev_level + 1], bev_channels, (height, 1, 1), (height, 1, 1))
        self.flatten = SparseSequential(flat, BatchNorm1d(bev_channels), nn.ReLU(inplace=True))
        levels = [
            Spec(Voxels, width, stride, self.grid, depth=self.grid.shape(stride)[0])
            for width, stride in zip(widths[1:], strides, strict=True)
        ]
        self.provides = (levels, Spec(BEV, bev_channels, bev_stride, self.grid))

    def forward(self, points: Points) -> tuple[list[Voxels], BEV]:
        """The levels, finest first, and the map; points outside the range are left out."""
        level = _voxelize(points, self._features(points), self.grid)
        level = level.with_voxels(self.stem(level.voxels))
        levels = list[Voxels]()
        for residual in self.levels:
            level = _halved(level)
            level = level.with_voxels(residual(level.voxels))
            levels.append(level.voxels)
        return levels, self._bev(levels[self.bev_level])

    def _features(self, points: Points) -> Tensor:
        """x, y, z as shares of the half range, -1..1, so that all weights are of one size."""
        lower, upper = points.xyz.new_tensor(self.grid.lower), points.xyz.new_tensor(self.grid.upper)
        xyz = (points.xyz - (lower + upper) / 2) / ((upper - lower) / 2)
        return torch.cat([xyz, points.features.to(xyz.dtype)], 1) if self.intensity else xyz

    def _bev(self, voxels: Voxels) -> BEV:
        return BEV(to_dense(self.flatten(voxels))[:, :, 0], self.grid, voxels.stride)


def _residual(in_channels: int, widths: tuple[int, ...]) -> SparseSequential:
    before = [in_channels, *widths]
    return SparseSequential(*(ResidualBlock(a, b) for a, b in zip(before, widths, strict=False)))


def _check(stem: int, blocks: tuple[tuple[int, ...], ...], bev_stride: int, strides: list[int]) -> None:
    if not blocks or stem < 1 or any(not group or min(group) < 1 for group in blocks):
        raise ConfigError(
            "backbone 'taco' needs a positive stem and, for each pooling, the widths of its residual blocks\n"
            f"  given: stem: {stem}, blocks: {[list(group) for group in blocks]}\n"
            "  fix: for example stem: 32, blocks: [[32], [64], [64, 128]]"
        )
    if bev_stride not in strides:
        raise ConfigError(
            f"backbone 'taco' has no level of stride {bev_stride} for its map\n"
            f"  levels: {', '.join(map(str, strides))}\n  fix: bev_stride: {strides[0]}"
        )
