"""Blocks of the two-branch network: SalsaNext's, MetaKernel, SoftPool and motion-guided attention.

Sources: Cortinhal et al., "SalsaNext", ISVC 2020 (context block, residual block, up block); Fan et al., "RangeDet",
ICCV 2021, section 3.1 (MetaKernel); Stergiou et al., "Refining activation downsampling with SoftPool", ICCV 2021; Li
et al., "Motion guided attention for video salient object detection", ICCV 2019 (attention).

Every block keeps a map of H x W; `conv` arguments make a convolution from (in, out) channels, so that any
convolution that keeps the size can stand in for the dilated one.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from lidarfw.components.layers import BatchNorm2d
from torch import Tensor, nn
from torch.nn import functional as F

from lidarfw_dpdc_mos.convolution import RangeConv2d, go_round

MakeConv = Callable[[int, int], nn.Module]


def unit(conv: nn.Module, channels: int) -> nn.Sequential:
    """Convolution, batch normalisation, leaky ReLU: in this order, so that the norm can become part of the conv."""
    return nn.Sequential(conv, BatchNorm2d(channels), nn.LeakyReLU(0.01))


class SoftPool2d(nn.Module):
    """2 x 2 pooling with weights exp(x) / sum exp(x): between the mean and the maximum (SoftPool, equation 2)."""

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, C, H / 2, W / 2)."""
        batch, channels, height, width = features.shape
        cells = F.pixel_unshuffle(features, 2).view(batch, channels, 4, height // 2, width // 2)
        return (cells.softmax(2) * cells).sum(2)


class ContextBlock(nn.Module):
    """Context at full resolution: 3 x 3 and a wide convolution, added to a 1 x 1 shortcut (SalsaNext, figure 1 b)."""

    def __init__(self, in_channels: int, channels: int, wide: MakeConv, circular: bool) -> None:
        super().__init__()
        self.shortcut = nn.Sequential(nn.Conv2d(in_channels, channels, 1), nn.LeakyReLU(0.01))
        self.narrow = unit(RangeConv2d(channels, channels, 3, circular=circular), channels)
        self.wide = unit(wide(channels, channels), channels)

    def forward(self, features: Tensor) -> Tensor:
        """(B, in_channels, H, W) -> (B, channels, H, W)."""
        shortcut = self.shortcut(features)
        return shortcut + self.wide(self.narrow(shortcut))  # type: ignore[no-any-return]


class Pyramid(nn.Module):
    """A chain of three convolutions of growing reach, all three joined by a 1 x 1 convolution (SalsaNext, figure 1).

    3 x 3, then `wide`, then 2 x 2 with dilation 2.
    """

    def __init__(self, in_channels: int, channels: int, wide: MakeConv, circular: bool) -> None:
        super().__init__()
        conv = partial(RangeConv2d, circular=circular)
        self.first = unit(conv(in_channels, channels, 3), channels)
        self.second = unit(wide(channels, channels), channels)
        self.third = unit(conv(channels, channels, 2, dilation=2), channels)
        self.join = unit(nn.Conv2d(3 * channels, channels, 1), channels)

    def forward(self, features: Tensor) -> Tensor:
        """(B, in_channels, H, W) -> (B, channels, H, W)."""
        first = self.first(features)
        second = self.second(first)
        return self.join(torch.cat([first, second, self.third(second)], 1))  # type: ignore[no-any-return]


class ResidualBlock(nn.Module):
    """A pyramid beside a 1 x 1 shortcut (SalsaNext, figure 1 c); its caller pools."""

    def __init__(self, in_channels: int, channels: int, wide: MakeConv, circular: bool) -> None:
        super().__init__()
        self.shortcut = nn.Sequential(nn.Conv2d(in_channels, channels, 1), nn.LeakyReLU(0.01))
        self.pyramid = Pyramid(in_channels, channels, wide, circular)

    def forward(self, features: Tensor) -> Tensor:
        """(B, in_channels, H, W) -> (B, channels, H, W)."""
        return self.shortcut(features) + self.pyramid(features)  # type: ignore[no-any-return]


class UpBlock(nn.Module):
    """Twice the resolution by pixel shuffle, joined with the encoder's map of that size (SalsaNext, figure 1 e)."""

    def __init__(
        self, in_channels: int, skip: int, channels: int, wide: MakeConv, circular: bool, dropout: float
    ) -> None:
        super().__init__()
        self.pyramid = Pyramid(in_channels // 4 + skip, channels, wide, circular)
        self.dropout = nn.Dropout2d(dropout)

    def forward(self, features: Tensor, skip: Tensor) -> Tensor:
        """(B, in_channels, H / 2, W / 2) and (B, skip, H, W) -> (B, channels, H, W)."""
        joined = torch.cat([F.pixel_shuffle(features, 2), skip], 1)
        return self.dropout(self.pyramid(self.dropout(joined)))  # type: ignore[no-any-return]


class MetaKernel(nn.Module):
    """A 3 x 3 convolution whose weights follow from where the neighbours lie in space (RangeDet, section 3.1).

    A small network turns the coordinates of each neighbour relative to the centre into weights of its features; the
    weighted features of all nine are joined by a 1 x 1 convolution, here as a sum of nine, without unfolding.
    """

    def __init__(self, channels: int, coordinates: int, circular: bool, hidden: int = 16) -> None:
        super().__init__()
        self.circular = circular
        self.place = nn.Conv2d(coordinates, hidden, 1, bias=False)
        self.shift = nn.Parameter(torch.zeros(hidden, 1, 1))
        self.weigh = nn.Conv2d(hidden, channels, 1)
        self.join = nn.Parameter(torch.empty(9, channels, channels, 1, 1))
        nn.init.uniform_(self.join, -((9 * channels) ** -0.5), (9 * channels) ** -0.5)
        self.finish = nn.Sequential(BatchNorm2d(channels), nn.LeakyReLU(0.01))

    def forward(self, features: Tensor, coordinates: Tensor) -> Tensor:
        """(B, channels, H, W) and the coordinates (B, coordinates, H, W) of its pixels -> (B, channels, H, W)."""
        place = self.place(coordinates)  # linear: the difference of places is the place of the difference
        height, width = place.shape[2:]
        far, around = self._surround(place), self._surround(features)
        total = torch.zeros_like(features)
        for number, join in enumerate(self.join.unbind()):
            rows, columns = slice(number // 3, number // 3 + height), slice(number % 3, number % 3 + width)
            relative = far[..., rows, columns] - place + self.shift
            weight = self.weigh(F.leaky_relu(relative, 0.01))
            total = total + F.conv2d(weight * around[..., rows, columns], join)
        return self.finish(total)  # type: ignore[no-any-return]

    def _surround(self, features: Tensor) -> Tensor:
        if self.circular:
            return F.pad(go_round(features, 1), (0, 0, 1, 1))
        return F.pad(features, (1, 1, 1, 1))


class MotionGuidedAttention(nn.Module):
    """What moves says where to look, then which channels: s = sigmoid(conv(motion)), a = s * appearance,
    c = C softmax(conv(mean of a)), result a * c + appearance (Li et al., ICCV 2019, section 3.3)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.where = nn.Conv2d(channels, 1, 1)
        self.which = nn.Conv2d(channels, channels, 1)

    def forward(self, appearance: Tensor, motion: Tensor) -> Tensor:
        """Two maps (B, channels, H, W) -> one."""
        attended = self.where(motion).sigmoid() * appearance
        gain = self.which(attended.mean((2, 3), keepdim=True)).softmax(1) * appearance.shape[1]
        joined: Tensor = attended * gain + appearance
        return joined


class AddMotion(nn.Module):
    """The plain alternative to attention: the sum of both maps."""

    def forward(self, appearance: Tensor, motion: Tensor) -> Tensor:
        """Two maps (B, C, H, W) -> their sum."""
        return appearance + motion


class JoinMotion(nn.Module):
    """The other alternative: both maps side by side, brought to the width of one by a 1 x 1 convolution."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.join = unit(nn.Conv2d(2 * channels, channels, 1), channels)

    def forward(self, appearance: Tensor, motion: Tensor) -> Tensor:
        """Two maps (B, channels, H, W) -> one."""
        return self.join(torch.cat([appearance, motion], 1))  # type: ignore[no-any-return]
