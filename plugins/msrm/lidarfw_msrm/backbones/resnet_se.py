"""3D ResNet-SE: a residual sparse network with squeeze and excitation.

Sources: the MSRM paper, section II-A; its details follow the residual variant of SECOND's backbone that the field
calls VoxelResBackBone8x; He et al., "Deep Residual Learning", CVPR 2016; Hu et al., "Squeeze-and-Excitation Networks",
CVPR 2018 (equations 2 and 3).
"""

from __future__ import annotations

from typing import ClassVar

import torch
from lidarfw.components.layers import (
    BatchNorm1d,
    folded_depth,
    folding_block,
    grid_from_options,
    halving_block,
    submanifold_block,
)
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Backbone
from lidarfw.ops import SparseModule, SparseSequential, SubmanifoldConv3d, scatter_mean, to_dense, voxelize_mean
from lidarfw.types import BEV, Points, Spec, Voxels
from torch import nn

PLACES = ("none", "input", "all", "conv")  # of squeeze and excitation
REDUCTION, NARROWEST = 16, 8  # the hidden layer has channels / 16 units, at least 8


class SqueezeExcitation(SparseModule):
    """Scale the channels of each sample by what its voxels hold in the mean (SENet, equations 2 to 4).

    The mean is over the occupied voxels of one sample, never across the batch.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        hidden = max(channels // REDUCTION, NARROWEST)
        self.excite = nn.Sequential(nn.Linear(channels, hidden), nn.ReLU(), nn.Linear(hidden, channels), nn.Sigmoid())

    def forward(self, voxels: Voxels) -> Voxels:
        sample = voxels.index[:, 0]
        squeezed = scatter_mean(voxels.features, sample, voxels.batch_size)
        return voxels.with_features(voxels.features * self.excite(squeezed)[sample])


class ResidualBlock(SparseModule):
    """Two submanifold convolutions whose result is added to the input; `excite` scales it before."""

    def __init__(self, channels: int, excite: bool) -> None:
        super().__init__()
        second: list[nn.Module] = [SubmanifoldConv3d(channels, channels, 3), BatchNorm1d(channels)]
        second += [SqueezeExcitation(channels)] if excite else []
        self.branch = SparseSequential(submanifold_block(channels, channels), *second)

    def forward(self, voxels: Voxels) -> Voxels:
        return voxels.with_features(torch.relu(self.branch(voxels).features + voxels.features))


class ResNetSE(Backbone):
    """Residual sparse backbone with squeeze and excitation (MSRM, section II-A): points -> Voxels and BEV.

    A submanifold convolution, then stages at strides 1, 2, 4, 8 (from the second on they begin with a sparse
    convolution of stride 2), each with `blocks` residual blocks. The coarsest level, folded along z by a (3, 1, 1)
    convolution of stride 2, becomes the map: `out_channels` times its depth. The Voxels keep all of z.

    `se`: where squeeze and excitation stands, the three variants of section III-B and one more. none; input: after the
    first convolution; all: after that and after every stage; conv: in every residual block, before the addition.
    """

    example: ClassVar[dict[str, object]] = {"cell": (0.4, 0.4, 0.2), "blocks": 1}

    def __init__(
        self,
        points: Spec,
        *,
        lower: tuple[float, float, float] = (0.0, -40.0, -3.0),
        upper: tuple[float, float, float] = (70.4, 40.0, 1.0),
        cell: tuple[float, float, float] = (0.05, 0.05, 0.05),
        channels: tuple[int, int, int, int] = (16, 32, 64, 128),
        out_channels: int = 64,
        blocks: int = 2,
        se: str = "all",
    ) -> None:
        """Options: range and voxel size x, y, z in metres (KITTI's of section III-A), width of the four stages and of
        the map's convolution, residual blocks of each stage, place of squeeze and excitation."""
        super().__init__()
        self.grid = grid_from_options(lower, upper, cell)
        depth = folded_depth(self.grid, "resnet_se")
        if se not in PLACES:
            raise ConfigError(f"backbone 'resnet_se': se is one of {', '.join(PLACES)}, not {se!r}")
        excited = se == "all"
        self.stem = SparseSequential(
            submanifold_block(3 + points.channels, channels[0]), *_excitation(channels[0], excited or se == "input")
        )
        self.stages = nn.ModuleList()
        for number, width in enumerate(channels):
            down = [] if number == 0 else [halving_block(channels[number - 1], width)]
            residual = [ResidualBlock(width, se == "conv") for _ in range(blocks)]
            self.stages.append(SparseSequential(*down, *residual, *_excitation(width, excited)))
        self.fold = folding_block(channels[3], out_channels)
        depths = [self.grid.shape(2**number)[0] for number in range(4)]
        levels = [Spec(Voxels, c, 2**i, self.grid, depth=depths[i]) for i, c in enumerate(channels)]
        self.provides = (levels, Spec(BEV, out_channels * depth, 8, self.grid))

    def forward(self, points: Points) -> tuple[list[Voxels], BEV]:
        """The result of each stage, finest first, and the map (B, out_channels * depth, H, W) at stride 8."""
        voxels, levels = self.stem(voxelize_mean(points, self.grid)), list[Voxels]()
        for stage in self.stages:
            voxels = stage(voxels)
            levels.append(voxels)
        return levels, BEV(to_dense(self.fold(voxels)).flatten(1, 2), self.grid, 8)


def _excitation(channels: int, wanted: bool) -> list[nn.Module]:
    return [SqueezeExcitation(channels)] if wanted else []
