"""SECOND: sparse 3D convolutions over the mean of the points in each voxel.

Sources: Yan et al., "SECOND: Sparsely Embedded Convolutional Detection", Sensors 2018, sections 3.1.1 and 3.1.2;
Zhou and Tuzel, "VoxelNet", CVPR 2018 (voxel mean instead of a learned encoder is the usual choice since). The widths
are those that the field calls VoxelBackBone8x.
"""

from __future__ import annotations

from torch import nn

from lidarfw.components.layers import (
    folded_depth,
    folding_block,
    grid_from_options,
    halving_block,
    submanifold_block,
)
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Backbone
from lidarfw.ops import SparseSequential, voxelize_mean
from lidarfw.types import Points, Spec, Voxels


class SecondBackbone(Backbone):
    """SECOND (Sensors 2018): points -> voxels at horizontal strides 1, 2, 4, 8.

    Every stage but the first begins with a sparse convolution of stride 2 and goes on with submanifold ones, all
    3 x 3 x 3 with batch normalisation and ReLU, padded by 1 on every side: level k has ceil(n / 2^k) cells along
    each axis, as `Grid.shape` says. A last convolution, (3, 1, 1) with stride (2, 1, 1) and no padding, folds the z
    axis of the coarsest level, which it replaces: 40 z cells give 40, 20, 10 and, instead of 5, 2.
    """

    def __init__(
        self,
        points: Spec,
        *,
        lower: tuple[float, float, float] = (0.0, -40.0, -3.0),
        upper: tuple[float, float, float] = (70.4, 40.0, 1.0),
        cell: tuple[float, float, float] = (0.05, 0.05, 0.1),
        channels: tuple[int, int, int, int] = (16, 32, 64, 64),
        out_channels: int = 128,
        layers: int = 2,
    ) -> None:
        """Options: range and voxel size x, y, z in metres, width of the four stages and of the last convolution,
        submanifold convolutions in each stage."""
        super().__init__()
        self.grid = grid_from_options(lower, upper, cell)
        _check(channels, layers)
        depths = [*(self.grid.shape(stride)[0] for stride in (1, 2, 4)), folded_depth(self.grid, "second")]
        first = [submanifold_block(3 + points.channels, channels[0]), *_submanifolds(channels[0], layers - 1)]
        stages = [SparseSequential(*first)]
        for i in range(1, 4):
            down = halving_block(channels[i - 1], channels[i])
            stages.append(SparseSequential(down, *_submanifolds(channels[i], layers)))
        stages[3].append(folding_block(channels[3], out_channels))
        self.stages = nn.ModuleList(stages)
        widths = [*channels[:3], out_channels]
        self.provides = [Spec(Voxels, widths[i], 2**i, self.grid, depth=depths[i]) for i in range(4)]

    def forward(self, points: Points) -> list[Voxels]:
        """The result of each stage, finest first."""
        voxels, levels = voxelize_mean(points, self.grid), list[Voxels]()
        for stage in self.stages:
            voxels = stage(voxels)
            levels.append(voxels)
        return levels


def _check(channels: tuple[int, ...], layers: int) -> None:
    if len(channels) != 4 or min(*channels, layers) < 1:
        raise ConfigError(
            "backbone 'second' has four stages and needs a positive width for each, and at least one layer\n"
            f"  given: channels: {list(channels)}, layers: {layers}\n"
            "  fix: for example channels: [16, 32, 64, 64], layers: 2"
        )


def _submanifolds(channels: int, number: int) -> list[SparseSequential]:
    return [submanifold_block(channels, channels) for _ in range(number)]
