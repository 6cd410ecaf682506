"""Layers that several components share: normalisation in the settings of LiDAR networks, and convolution blocks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor, nn
from torch.nn import functional as F

from lidarfw.errors import ConfigError, GeometryError
from lidarfw.ops import SparseConv3d, SparseSequential, SubmanifoldConv3d
from lidarfw.types import Grid


class _BatchNorm(nn.modules.batchnorm._BatchNorm):
    """What both batch normalisations share.

    LiDAR networks average their running statistics over about 100 batches (momentum 0.01). From the first batch on
    that leaves the initial values in for hundreds of steps, and a network that has learned fails in evaluation. So
    the n-th batch weighs 10 / (n + 10) until that falls to 0.01: an average over the last tenth of the training, as
    Shamir and Zhang (ICML 2013) give it for weights.
    """

    def __init__(self, channels: int) -> None:
        super().__init__(channels, eps=1e-3, momentum=0.01)
        self._batches: int | None = None  # num_batches_tracked as a number: reading the tensor would wait for the GPU

    def forward(self, input: Tensor) -> Tensor:
        if input.numel() <= self.num_features:  # no variance: normalise by the running statistics, leave them alone
            return F.batch_norm(input, self.running_mean, self.running_var, self.weight, self.bias, eps=self.eps)
        if self.training:
            seen = int(self.num_batches_tracked or 0) if self._batches is None else self._batches
            self._batches, self.momentum = seen + 1, max(0.01, 10 / (seen + 10))
        return super().forward(input)

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        self._batches = None
        super()._load_from_state_dict(*args, **kwargs)


class BatchNorm1d(_BatchNorm, nn.BatchNorm1d):
    """Batch normalisation of rows (N, C), eps 1e-3 and a final momentum of 0.01 as LiDAR networks use it.

    In training, zero rows or one have no variance to normalise with (torch raises an error for one row): they are
    normalised by the running statistics, as in evaluation, and do not change them.
    """


class BatchNorm2d(_BatchNorm, nn.BatchNorm2d):
    """Batch normalisation of maps (B, C, H, W) in the same way; a single value is treated as one row is there."""


def conv_block(in_channels: int, channels: int, stride: int = 1) -> nn.Sequential:
    """3 x 3 convolution, batch normalisation, ReLU; a map of H x W becomes ceil(H / stride) x ceil(W / stride)."""
    conv = nn.Conv2d(in_channels, channels, 3, stride, padding=1, bias=False)
    return nn.Sequential(conv, BatchNorm2d(channels), nn.ReLU(inplace=True))


def submanifold_block(in_channels: int, channels: int) -> SparseSequential:
    """3 x 3 x 3 submanifold convolution of Voxels, batch normalisation, ReLU: the same cells."""
    conv = SubmanifoldConv3d(in_channels, channels, 3)
    return SparseSequential(conv, BatchNorm1d(channels), nn.ReLU(inplace=True))


def halving_block(in_channels: int, channels: int) -> SparseSequential:
    """3 x 3 x 3 sparse convolution of stride 2, batch normalisation, ReLU; n cells along an axis become ceil(n / 2)."""
    conv = SparseConv3d(in_channels, channels, (3, 3, 3), (2, 2, 2), (1, 1, 1))
    return SparseSequential(conv, BatchNorm1d(channels), nn.ReLU(inplace=True))


def folding_block(in_channels: int, channels: int) -> SparseSequential:
    """3 x 1 x 1 sparse convolution of stride 2 along z, batch normalisation, ReLU; see `folded_depth`."""
    conv = SparseConv3d(in_channels, channels, (3, 1, 1), (2, 1, 1), (0, 0, 0))
    return SparseSequential(conv, BatchNorm1d(channels), nn.ReLU(inplace=True))


def folded_depth(grid: Grid, backbone: str) -> int:
    """Cells along z of the level of stride 8 after `folding_block`. Raises ConfigError where none is left."""
    depth = (grid.shape(8)[0] - 3) // 2 + 1
    if depth < 1:
        height = grid.upper[2] - grid.lower[2]
        raise ConfigError(
            f"backbone '{backbone}' needs at least 17 cells along z, its grid has {grid.shape()[0]}\n"
            f"  given: z from {grid.lower[2]} to {grid.upper[2]} m in cells of {grid.cell[2]} m\n"
            f"  fix: cells of at most {height / 17:.3f} m along z, or a higher range"
        )
    return depth


def grid_from_options(lower: Sequence[float], upper: Sequence[float], cell: Sequence[float]) -> Grid:
    """The grid of options given as x, y, z in metres; `cell` may be x, y alone for cells of the full height.

    Raises ConfigError where they make no grid.
    """
    try:
        (x0, y0, z0), (x1, y1, z1) = lower, upper
        dx, dy, dz = cell if len(cell) == 3 else (*cell, z1 - z0)
        return Grid((x0, y0, z0), (x1, y1, z1), (dx, dy, dz))
    except (ValueError, GeometryError) as error:
        raise ConfigError(
            f"options lower, upper and cell make no grid: {error}\n"
            f"  given: lower {tuple(lower)}, upper {tuple(upper)}, cell {tuple(cell)}\n"
            "  fix: give metres along x, y, z, for example lower: [0, -40, -3], upper: [70.4, 40, 1]"
        ) from None
