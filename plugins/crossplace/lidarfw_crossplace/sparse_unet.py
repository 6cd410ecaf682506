"""Classes of points by a sparse U-Net: the network that names what a scan sees.

Sources: Choy, Gwak and Savarese, "4D Spatio-Temporal ConvNets: Minkowski Convolutional Neural Networks", CVPR 2019
(MinkUNet); the widths and depths are those of the 34C of its authors, which the paper uses (3.3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from lidarfw.components.layers import BatchNorm1d, grid_from_options, halving_block, submanifold_block
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Backbone, Head, Loss
from lidarfw.ops import SparseInverseConv3d, SparseSequential, SubmanifoldConv3d, find_voxels, voxelize_mean
from lidarfw.types import DataSpec, PointLabels, Points, Spec, Targets, Voxels
from torch import Tensor, nn
from torch.nn import functional as F

_LEVELS = 4


class SparseBasicBlock(nn.Module):
    """Two 3 x 3 x 3 submanifold convolutions whose result is added to the input (He et al., 2016)."""

    def __init__(self, in_channels: int, channels: int) -> None:
        super().__init__()
        second = SubmanifoldConv3d(channels, channels, 3)
        self.branch = SparseSequential(submanifold_block(in_channels, channels), second, BatchNorm1d(channels))
        self.shortcut: nn.Module = nn.Identity()
        if in_channels != channels:
            resize = nn.Linear(in_channels, channels, bias=False)
            self.shortcut = nn.Sequential(resize, BatchNorm1d(channels))

    def forward(self, voxels: Voxels) -> Voxels:
        """The same cells."""
        return voxels.with_features(torch.relu(self.branch(voxels).features + self.shortcut(voxels.features)))


class _Up(nn.Module):
    """Back to the cells of a finer level, whose features are put beside; then residual blocks."""

    def __init__(self, in_channels: int, beside: int, channels: int, blocks: int) -> None:
        super().__init__()
        self.up = SparseInverseConv3d(in_channels, channels, (3, 3, 3), (2, 2, 2), (1, 1, 1))
        self.norm = nn.Sequential(BatchNorm1d(channels), nn.ReLU(inplace=True))
        self.blocks = _blocks(channels + beside, channels, blocks)

    def forward(self, voxels: Voxels, fine: Voxels) -> Voxels:
        raised = self.norm(self.up(voxels, fine).features)
        whole: Voxels = self.blocks(fine.with_features(torch.cat([raised, fine.features], 1)))
        return whole


def _blocks(in_channels: int, channels: int, count: int) -> nn.Sequential:
    widths = [in_channels, *[channels] * count]
    return nn.Sequential(*(SparseBasicBlock(widths[i], channels) for i in range(count)))


class MinkUNetBackbone(Backbone):
    """Points -> features of every occupied voxel, that have seen up to four levels of coarser ones.

    Down four times by sparse convolutions of stride 2 with residual blocks, and up again by their transposes, each time
    with the features of the finer level beside (MinkUNet34C by its usual values; 38 M parameters).
    """

    example: ClassVar[dict[str, Any]] = {"channels": (4, 4, 6, 8, 8), "up_channels": (8, 6, 4, 4), "blocks": (1,) * 8}

    def __init__(
        self,
        points: Spec,
        *,
        lower: tuple[float, float, float] = (-60.0, -60.0, -4.0),
        upper: tuple[float, float, float] = (60.0, 60.0, 4.0),
        cell: tuple[float, float, float] = (0.1, 0.1, 0.1),
        channels: tuple[int, ...] = (32, 32, 64, 128, 256),
        up_channels: tuple[int, ...] = (256, 128, 96, 96),
        blocks: tuple[int, ...] = (2, 3, 4, 6, 2, 2, 2, 2),
    ) -> None:
        """Options: range and voxel size in metres; channels, of the finest level and after each way down; up_channels,
        after each way up; blocks, residual blocks of the four levels down and the four up."""
        super().__init__()
        _check(channels, up_channels, blocks)
        self.grid = grid_from_options(lower, upper, cell)
        first = submanifold_block(3 + points.channels, channels[0])
        self.stem = SparseSequential(first, submanifold_block(channels[0], channels[0]))
        self.down = nn.ModuleList(
            nn.Sequential(halving_block(channels[i], channels[i]), _blocks(channels[i], channels[i + 1], blocks[i]))
            for i in range(_LEVELS)
        )
        widths = [channels[-1], *up_channels]
        self.up = nn.ModuleList(
            _Up(widths[i], channels[_LEVELS - 1 - i], widths[i + 1], blocks[_LEVELS + i]) for i in range(_LEVELS)
        )
        self.provides = Spec(Voxels, up_channels[-1], 1, self.grid, depth=self.grid.shape()[0])

    def forward(self, points: Points) -> Voxels:
        """Voxels of stride 1."""
        levels: list[Voxels] = [self.stem(voxelize_mean(points, self.grid))]
        for stage in self.down:
            levels.append(stage(levels[-1]))
        voxels = levels.pop()
        for stage in self.up:
            voxels = stage(voxels, levels.pop())
        return voxels


def _check(channels: Sequence[int], up_channels: Sequence[int], blocks: Sequence[int]) -> None:
    if (len(channels), len(up_channels), len(blocks)) != (5, 4, 8) or min(*channels, *up_channels, *blocks) < 1:
        raise ConfigError(
            "backbone 'mink_unet' needs 5 channels, 4 up_channels and 8 blocks, all positive\n"
            f"  given: channels: {list(channels)}, up_channels: {list(up_channels)}, blocks: {list(blocks)}"
        )


@dataclass
class VoxelLabelsOutput:
    """Raw output of the head."""

    logits: Tensor  # (V + 1, K) of the voxels; the last row, 0, is for points outside of all
    row: Tensor  # (N,) voxel of each point
    points: Points


class VoxelLabelsHead(Head):
    """A class for every voxel by a linear layer; every point has the class of its voxel.

    A point outside the grid has no class: all its probabilities are 0.
    """

    defaults = {"loss": ["point_cross_entropy"], "metric": ["mean_iou"]}

    def __init__(self, voxels: Spec, points: Spec, data: DataSpec) -> None:
        super().__init__()
        self.classify = nn.Linear(voxels.channels, len(data.classes))
        self.provides = Spec(PointLabels, classes=data.classes)

    def forward(self, voxels: Voxels, points: Points) -> VoxelLabelsOutput:
        """Logits of the voxels (V + 1, K)."""
        cell, inside = voxels.grid.index(points.xyz)
        row = find_voxels(voxels, points.batch, cell // cell.new_tensor(voxels.strides))
        row = torch.where(inside, row, len(voxels.features))
        logits = self.classify(voxels.features)
        return VoxelLabelsOutput(F.pad(logits, (0, 0, 0, 1)), row, points)

    def decode(self, output: VoxelLabelsOutput) -> PointLabels:
        """Probabilities (N, K)."""
        inside = (output.row < len(output.logits) - 1)[:, None]
        probability = output.logits.float().softmax(1).index_select(0, output.row) * inside
        return PointLabels(probability, output.points.batch, output.points.batch_size)


class PointCrossEntropyLoss(Loss):
    """Cross entropy of the classes of points; those without a label or outside the grid do not count."""

    def forward(self, output: VoxelLabelsOutput, targets: Targets) -> dict[str, Tensor]:
        """The term `cross_entropy`, 0 where no point is labelled."""
        if targets.points is None:
            return {"cross_entropy": output.logits.float().sum() * 0}
        label = targets.points.label
        known = (label >= 0) & (output.row < len(output.logits) - 1)
        logits = output.logits.float()[output.row[known]]
        lost = F.cross_entropy(logits, label[known], reduction="sum")
        return {"cross_entropy": lost / known.sum().clamp(min=1)}
