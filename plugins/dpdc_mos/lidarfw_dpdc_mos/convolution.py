"""Depth pixel difference convolution: five branches in training, one ordinary convolution for inference.

Source: Tang, Zhu and Sun, Remote Sensing 2025, 17(2), 195, section 3.3. The difference branches are those of Su et
al., "Pixel Difference Networks for Efficient Edge Detection", ICCV 2021 (central, radial, angular), and of Chen et
al., "DEA-Net", TIP 2024 (straight lines).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from lidarfw.errors import ConfigError
from torch import Tensor, nn
from torch.nn import functional as F

Offset = tuple[int, int]  # rows down, columns to the right of the centre
Tap = dict[Offset, float]  # what one weight is multiplied with

FIVE = ("cdc", "rdc", "sdc", "ddc", "dilated")


def _pairs(side: int, plus: Sequence[int], minus: Sequence[int]) -> list[Tap]:
    """Differences of the pixels of a `side` x `side` window, numbered row by row: x[plus] - x[minus]."""
    middle = side // 2

    def place(number: int) -> Offset:
        return number // side - middle, number % side - middle

    return [{place(p): 1.0, place(m): -1.0} for p, m in zip(plus, minus, strict=True)]


_TURNED = (3, 0, 1, 6, 4, 2, 7, 8, 5)  # the 3 x 3 window, its border turned by one pixel
_DIFFERENCES: dict[str, list[Tap]] = {
    "cdc": _pairs(3, (0, 1, 2, 3, 5, 6, 7, 8), (4,) * 8),  # to the centre
    "rdc": _pairs(5, (0, 2, 4, 10, 14, 20, 22, 24), (6, 7, 8, 11, 13, 16, 17, 18)),  # outer ring to inner ring
    "sdc": _pairs(3, (0, 3, 6, 0, 1, 2), (2, 5, 8, 6, 7, 8)),  # along rows, then columns
    "sdc_adjacent": _pairs(3, (0, 1, 3, 4, 6, 7, 0, 3, 1, 4, 2, 5), (1, 2, 4, 5, 7, 8, 3, 6, 4, 7, 5, 8)),
    "ddc": _pairs(3, (0, 1, 3, 2, 1, 5), (8, 5, 7, 6, 3, 7)),  # along both diagonals
    "ddc_minimal": _pairs(3, (0, 2), (8, 6)),
    "adc": _pairs(3, (0, 1, 2, 3, 5, 6, 7, 8), [_TURNED.index(i) for i in (0, 1, 2, 3, 5, 6, 7, 8)]),  # round the ring
}
BRANCHES = (*_DIFFERENCES, "dilated", "dense")


def branch_taps(branch: str, dilation: int = 2, difference_dilation: int = 1) -> list[Tap]:
    """What each weight of a branch is multiplied with, in the order of its weights.

    `dilated` is an ordinary 3 x 3 convolution of that dilation, `dense` an ordinary 5 x 5 one; the others are
    differences of two pixels. ConfigError for an unknown branch.
    """
    if branch == "dilated":
        return [{(dilation * row, dilation * column): 1.0} for row in (-1, 0, 1) for column in (-1, 0, 1)]
    if branch == "dense":
        return [{(row, column): 1.0} for row in range(-2, 3) for column in range(-2, 3)]
    if branch not in _DIFFERENCES:
        raise ConfigError(f"DPDC has no branch {branch!r}.\n  branches: {', '.join(BRANCHES)}")
    far = difference_dilation
    return [{(far * row, far * column): sign for (row, column), sign in tap.items()} for tap in _DIFFERENCES[branch]]


def tap_basis(taps: Sequence[Tap], size: int) -> Tensor:
    """(len(taps), size, size) kernel of each weight by itself, centred."""
    basis = torch.zeros(len(taps), size, size)
    for number, tap in enumerate(taps):
        for (row, column), value in tap.items():
            basis[number, row + size // 2, column + size // 2] += value
    return basis


def go_round(features: Tensor, columns: int) -> Tensor:
    """(B, C, H, W + 2 columns): the left border continued by the right one, and the other way round."""
    if columns == 0:
        return features
    width = features.shape[-1]
    turns = -(-columns // width)  # more than once round only where the map is narrower than the kernel
    if turns > 1:
        index = torch.arange(-columns, width + columns, device=features.device) % width
        return features[..., index]
    return torch.cat([features[..., width - columns :], features, features[..., :columns]], -1)


class RangeConv2d(nn.Conv2d):
    """A convolution that keeps the size (at stride 1); with `circular` its columns go round the full turn.

    Rows beyond the image are zeros. An even kernel must have an even dilation.
    """

    def __init__(
        self,
        in_channels: int,
        channels: int,
        size: int,
        *,
        stride: int = 1,
        dilation: int = 1,
        groups: int = 1,
        bias: bool = True,
        circular: bool = False,
    ) -> None:
        reach = dilation * (size - 1)
        if reach % 2:
            raise ValueError(f"a kernel of size {size} and dilation {dilation} has no centre")
        super().__init__(in_channels, channels, size, stride, reach // 2, dilation, groups, bias)
        self.circular = circular

    def forward(self, input: Tensor) -> Tensor:
        """(B, in_channels, H, W) -> (B, channels, ceil(H / stride), ceil(W / stride))."""
        return convolve(input, self.weight, self.bias, self.stride[0], self.dilation[0], self.groups, self.circular)


def convolve(
    features: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    stride: int = 1,
    dilation: int = 1,
    groups: int = 1,
    circular: bool = False,
) -> Tensor:
    """conv2d that keeps the size at stride 1, with columns that go round where `circular`."""
    rows, columns = (dilation * (size - 1) // 2 for size in weight.shape[2:])
    if circular:
        features, columns = go_round(features, columns), 0
    return F.conv2d(features, weight, bias, stride, (rows, columns), dilation, groups)


class DPDC2d(nn.Module):
    """Depth pixel difference convolution (section 3.3, figure 4), in place of a convolution that keeps the size.

    y = b + sum over branches of their convolution of x. All branches are linear, so their sum is one convolution with
    the kernel sum_i w_i (equation 4), every w_i laid into the support that holds them all: 5 x 5 for the paper's
    five branches with dilation 2. That kernel is put together in every pass, in training too: the gradients are the
    same, and one convolution is faster than five. `merged` gives it as an ordinary convolution.

    branches: of BRANCHES. dilation: of the branch `dilated`; difference_dilation: of the difference branches.
    circular: columns go round the full turn; rows beyond the image are zeros.
    """

    basis: Tensor

    def __init__(
        self,
        in_channels: int,
        channels: int,
        *,
        branches: Sequence[str] = FIVE,
        dilation: int = 2,
        difference_dilation: int = 1,
        stride: int = 1,
        groups: int = 1,
        bias: bool = True,
        circular: bool = False,
    ) -> None:
        super().__init__()
        if not branches or len(set(branches)) < len(branches):
            raise ConfigError(f"DPDC needs branches that differ from each other, got {list(branches)}")
        taps = {name: branch_taps(name, dilation, difference_dilation) for name in branches}
        reach = max(abs(step) for group in taps.values() for tap in group for offset in tap for step in offset)
        self.size, self.stride, self.groups, self.circular = 2 * reach + 1, stride, groups, circular
        self.in_channels, self.channels = in_channels, channels
        self.register_buffer("basis", tap_basis([t for group in taps.values() for t in group], self.size), False)
        self.counts = {name: len(group) for name, group in taps.items()}
        self.weights = nn.ParameterDict(
            {name: nn.Parameter(torch.empty(channels, in_channels // groups, n)) for name, n in self.counts.items()}
        )
        self.bias = nn.Parameter(torch.zeros(channels)) if bias else None
        self._initialise()

    def _initialise(self) -> None:
        """Uniform, scaled so that the sum has the variance of one ordinary convolution as torch initialises it."""
        parts = self.basis.square().sum((1, 2)).split(list(self.counts.values()))  # type: ignore[no-untyped-call]
        scale = float(sum(float(part.mean()) for part in parts)) ** -0.5
        for weight in self.weights.values():
            fan_in = weight.shape[1] * weight.shape[2]
            nn.init.uniform_(weight, -scale * fan_in**-0.5, scale * fan_in**-0.5)

    def kernels(self) -> dict[str, Tensor]:
        """Kernel (channels, in_channels / groups, size, size) of each branch, in the common support."""
        parts = self.basis.split(list(self.counts.values()))  # type: ignore[no-untyped-call]
        return {
            name: torch.einsum("ocm,mhw->ochw", self.weights[name], part)
            for name, part in zip(self.counts, parts, strict=True)
        }

    def kernel(self) -> Tensor:
        """Sum of the kernels of all branches (equation 4)."""
        weight = torch.cat([self.weights[name] for name in self.counts], 2)
        return (weight @ self.basis.flatten(1)).view(*weight.shape[:2], self.size, self.size)

    def forward(self, features: Tensor) -> Tensor:
        """(B, in_channels, H, W) -> (B, channels, ceil(H / stride), ceil(W / stride))."""
        return convolve(features, self.kernel(), self.bias, self.stride, groups=self.groups, circular=self.circular)

    def merged(self) -> RangeConv2d:
        """The same map as an ordinary convolution, in eval mode."""
        conv = RangeConv2d(
            self.in_channels,
            self.channels,
            self.size,
            stride=self.stride,
            groups=self.groups,
            bias=self.bias is not None,
            circular=self.circular,
        ).to(self.basis)
        with torch.no_grad():
            conv.weight.copy_(self.kernel())
            if self.bias is not None and conv.bias is not None:
                conv.bias.copy_(self.bias)
        return conv.eval()

    def extra_repr(self) -> str:
        """As torch prints a module."""
        return f"{self.in_channels}, {self.channels}, branches={list(self.counts)}, size={self.size}"
