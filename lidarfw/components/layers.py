"""Layers that several components share: normalisation in the settings of LiDAR networks, and convolution blocks."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn
from torch.nn import functional as F

from lidarfw.errors import ConfigError, GeometryError
from lidarfw.types import Grid


def _normalize(norm: nn.BatchNorm1d | nn.BatchNorm2d, values: Tensor) -> Tensor:
    """Normalise with the running statistics, which stay as they are."""
    return F.batch_norm(values, norm.running_mean, norm.running_var, norm.weight, norm.bias, eps=norm.eps)


class BatchNorm1d(nn.BatchNorm1d):
    """Batch normalisation of rows (N, C), eps 1e-3 and momentum 0.01 as LiDAR networks use it.

    In training, zero rows or one have no variance to normalise with (torch raises an error for one row): they are
    normalised by the running statistics, as in evaluation, and do not change them.
    """

    def __init__(self, channels: int) -> None:
        super().__init__(channels, eps=1e-3, momentum=0.01)

    def forward(self, input: Tensor) -> Tensor:
        """(N, C) -> (N, C)."""
        return _normalize(self, input) if input.numel() <= self.num_features else super().forward(input)


class BatchNorm2d(nn.BatchNorm2d):
    """Batch normalisation of maps (B, C, H, W), eps 1e-3 and momentum 0.01; a single value is treated as above."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels, eps=1e-3, momentum=0.01)

    def forward(self, input: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, C, H, W)."""
        return _normalize(self, input) if input.numel() <= self.num_features else super().forward(input)


def conv_block(in_channels: int, channels: int, stride: int = 1) -> nn.Sequential:
    """3 x 3 convolution, batch normalisation, ReLU; a map of H x W becomes ceil(H / stride) x ceil(W / stride)."""
    conv = nn.Conv2d(in_channels, channels, 3, stride, padding=1, bias=False)
    return nn.Sequential(conv, BatchNorm2d(channels), nn.ReLU(inplace=True))


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
