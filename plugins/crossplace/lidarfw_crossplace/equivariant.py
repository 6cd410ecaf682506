"""Convolutions that turn with their input: what a network of them finds in a bird's-eye view turns as the view does.

Source: Cohen and Welling, "Group Equivariant Convolutional Networks", ICML 2016: every filter is applied in all its
orientations, and filters of later layers turn together with the orientations of their inputs. Luo et al., "BEVPlace",
ICCV 2023, take the maximum over the orientations at the end. Quarter turns of a 3 x 3 filter are exact; for eighths its
rim moves on by one cell, which is nearly a turn.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import torch
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Backbone
from lidarfw.types import BEV, Spec
from torch import Tensor, nn
from torch.nn import functional as F

_RIM = (0, 1, 2, 5, 8, 7, 6, 3)  # cells of a 3 x 3 filter round its middle, clockwise


def turned_cells(turns: int) -> Tensor:
    """(turns, 9): for each of the orientations, which cell of a flat 3 x 3 filter each cell takes its weight from."""
    cells = torch.arange(9).repeat(turns, 1)
    for turn in range(turns):
        for place, cell in enumerate(_RIM):
            cells[turn, _RIM[(place + turn * len(_RIM) // turns) % len(_RIM)]] = cell
    return cells


class GroupConv2d(nn.Module):
    """Convolution of size 3 (padded by 1) or 1 with every filter in `turns` orientations, 4 or 8.

    Channels of the input are C filters by T orientations, (B, C * T, H, W); a plain picture, which has none, by
    `lifting`. Input and output turn together: turning the picture by 1 / T moves all orientations on by one.
    """

    cells: Tensor
    order: Tensor

    def __init__(
        self, in_channels: int, out_channels: int, turns: int, *, size: int = 3, stride: int = 1, lifting: bool = False
    ) -> None:
        super().__init__()
        self.turns, self.size, self.stride, self.lifting = turns, size, stride, lifting
        seen = 1 if lifting else turns
        self.weight = nn.Parameter(torch.empty(out_channels, in_channels, seen, size**2))
        nn.init.normal_(self.weight, std=math.sqrt(2 / (in_channels * seen * size**2)))
        cells = turned_cells(turns) if size == 3 else torch.zeros(turns, 1, dtype=torch.long)
        self.register_buffer("cells", cells, persistent=False)
        steps = torch.arange(turns)
        self.register_buffer("order", (steps - steps[:, None]) % turns, persistent=False)

    def filters(self) -> Tensor:
        """(out * T, in * T, size, size): every filter in every orientation."""
        turned = [self.weight if self.lifting else self.weight[:, :, order] for order in self.order]
        kernel = torch.stack([part[..., cells] for part, cells in zip(turned, self.cells, strict=True)], 1)
        return kernel.reshape(kernel.shape[0] * self.turns, -1, self.size, self.size)

    def forward(self, features: Tensor) -> Tensor:
        """(B, C * T, H, W), or (B, C, H, W) for `lifting` -> (B, out * T, H', W')."""
        return F.conv2d(features, self.filters(), stride=self.stride, padding=self.size // 2)


class GroupNorm3d(nn.BatchNorm3d):
    """Batch normalisation with one mean and scale for all orientations of a filter."""

    def forward(self, features: Tensor) -> Tensor:
        """(B, C * T, H, W), as it is."""
        parts = features.reshape(len(features), self.num_features, -1, *features.shape[2:])
        return super().forward(parts).flatten(1, 2)


class GroupBlock(nn.Module):
    """Two group convolutions whose result is added to the input (He et al., 2016)."""

    def __init__(self, in_channels: int, channels: int, turns: int) -> None:
        super().__init__()
        self.branch = nn.Sequential(
            GroupConv2d(in_channels, channels, turns), GroupNorm3d(channels), nn.ReLU(inplace=True),
            GroupConv2d(channels, channels, turns), GroupNorm3d(channels),
        )  # fmt: skip
        self.shortcut: nn.Module = nn.Identity()
        if in_channels != channels:
            self.shortcut = nn.Sequential(GroupConv2d(in_channels, channels, turns, size=1), GroupNorm3d(channels))

    def forward(self, features: Tensor) -> Tensor:
        """(B, C * T, H, W) -> (B, channels * T, H, W)."""
        return torch.relu(self.branch(features) + self.shortcut(features))


class EquivariantBEVBackbone(Backbone):
    """A residual network of group convolutions on a bird's-eye view: features that say what is there, from any side.

    At each place the strongest of all orientations of a filter is taken at the end, so turning the view only moves the
    features. Means of 2 x 2 cells halve the map, since strided convolutions look at other cells when it is turned, and
    a fixed 3 x 3 mean comes first, since sparse views change much under interpolation. Stride 2 for the first
    convolution and 2 for each stage of `halve`.
    """

    example: ClassVar[dict[str, Any]] = {"channels": (2, 4), "halve": (True, False), "turns": 4}

    def __init__(
        self,
        bev: Spec,
        *,
        turns: int = 8,
        channels: tuple[int, ...] = (4, 8, 16),
        halve: tuple[bool, ...] = (True, True, False),
    ) -> None:
        """Options: turns, orientations of each filter, 4 or 8. channels: filters of each stage; halve: before it."""
        super().__init__()
        if turns not in (4, 8) or not channels or len(channels) != len(halve) or min(channels) < 1:
            raise ConfigError(
                "equivariant_bev: turns are 4 or 8, and channels and halve need a value for each stage\n"
                f"  given: turns: {turns}, channels: {list(channels)}, halve: {list(halve)}\n"
                "  fix: for example turns: 8, channels: [4, 8, 16], halve: [true, true, false]"
            )
        self.turns = turns
        first = GroupConv2d(bev.channels, channels[0], turns, stride=2, lifting=True)
        layers: list[nn.Module] = [first, GroupNorm3d(channels[0]), nn.ReLU(inplace=True)]
        for before, width, half in zip((channels[0], *channels), channels, halve, strict=False):
            layers += [nn.AvgPool2d(2, ceil_mode=True)] if half else []
            layers.append(GroupBlock(before, width, turns))
        self.layers = nn.Sequential(*layers)
        self.stride = bev.stride * 2 ** (1 + sum(halve))
        self.provides = Spec(BEV, channels[-1], self.stride, bev.grid)

    def forward(self, bev: BEV) -> BEV:
        """(B, C, H, W) -> (B, F, ceil(H / stride), ceil(W / stride)), at least 0."""
        found: Tensor = self.layers(F.avg_pool2d(bev.features, 3, 1, 1))
        return BEV(found.reshape(len(found), -1, self.turns, *found.shape[2:]).amax(2), bev.grid, self.stride)
