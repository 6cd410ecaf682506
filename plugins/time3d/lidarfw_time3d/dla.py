"""Deep layer aggregation: a network for pictures whose map at stride 4 knows all strides up to 32.

Source: Yu, Wang, Shelhamer and Darrell, "Deep Layer Aggregation", CVPR 2018; sections and figures below are its own.
The decoder is the one of CenterNet (Zhou et al., "Objects as Points", 2019), with plain convolutions.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from lidarfw.components.layers import BatchNorm2d, conv_block
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Backbone
from lidarfw.types import Image, Spec
from torch import Tensor, nn


class Block(nn.Module):
    """Two 3 x 3 convolutions whose result is added to `residual` (the basic block of section 4.1)."""

    def __init__(self, channels: int, out_channels: int, stride: int = 1) -> None:
        super().__init__()
        second = nn.Conv2d(out_channels, out_channels, 3, padding=1, bias=False)
        self.branch = nn.Sequential(conv_block(channels, out_channels, stride), second, BatchNorm2d(out_channels))

    def forward(self, features: Tensor, residual: Tensor) -> Tensor:
        return torch.relu(self.branch(features) + residual)


class Root(nn.Module):
    """Aggregation node: 1 x 1 convolution of all children side by side (equation 3, no residual connection)."""

    def __init__(self, channels: int, out_channels: int) -> None:
        super().__init__()
        self.join = nn.Sequential(nn.Conv2d(channels, out_channels, 1, bias=False), BatchNorm2d(out_channels))

    def forward(self, *children: Tensor) -> Tensor:
        return torch.relu(self.join(torch.cat(children, 1)))


class Tree(nn.Module):
    """Hierarchical deep aggregation of 2^depth blocks (section 3.2, figure 2f, equation 2).

    Two subtrees follow each other; the root of the last one joins its two blocks and the result of every subtree
    before it. With `keep_input` the map at the head of the stage takes part too.
    """

    def __init__(
        self, depth: int, channels: int, out_channels: int, stride: int, joined: int = 0, keep_input: bool = False
    ) -> None:
        super().__init__()
        joined = (joined or 2 * out_channels) + (channels if keep_input else 0)
        self.keep_input, self.depth = keep_input, depth
        self.shrink: nn.Module = nn.MaxPool2d(stride, ceil_mode=True) if stride > 1 else nn.Identity()
        self.first: nn.Module
        self.second: nn.Module
        if depth == 1:
            self.first, self.second = Block(channels, out_channels, stride), Block(out_channels, out_channels)
            self.root = Root(joined, out_channels)
            self.project: nn.Module = nn.Identity()
            if channels != out_channels:
                resize = nn.Conv2d(channels, out_channels, 1, bias=False)
                self.project = nn.Sequential(resize, BatchNorm2d(out_channels))
        else:
            self.first = Tree(depth - 1, channels, out_channels, stride)
            self.second = Tree(depth - 1, out_channels, out_channels, 1, joined + out_channels)

    def forward(self, features: Tensor, children: tuple[Tensor, ...] = ()) -> Tensor:
        """Map (B, C, H, W) -> (B, out_channels, ceil(H / stride), ceil(W / stride)); children join at the root."""
        if self.keep_input:
            children = (*children, self.shrink(features))
        if self.depth > 1:
            first = self.first(features)
            result: Tensor = self.second(first, (*children, first))
            return result
        first = self.first(features, self.project(self.shrink(features)))
        second = self.second(first, first)
        joined: Tensor = self.root(second, first, *children)
        return joined


class Merge(nn.Module):
    """One step of iterative deep aggregation (section 3.1, equation 1): a coarse map is brought up to a finer one.

    The coarse map is projected, enlarged by a learned convolution that starts as bilinear, and added; a last
    convolution smooths the sum.
    """

    def __init__(self, channels: int, out_channels: int, factor: int) -> None:
        super().__init__()
        self.project, self.smooth = conv_block(channels, out_channels), conv_block(out_channels, out_channels)
        self.enlarge = nn.ConvTranspose2d(
            out_channels, out_channels, 2 * factor, factor, factor // 2, groups=out_channels, bias=False
        )
        with torch.no_grad():
            self.enlarge.weight.copy_(_bilinear(factor).expand_as(self.enlarge.weight))

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        height, width = fine.shape[2:]
        result: Tensor = self.smooth(self.enlarge(self.project(coarse))[..., :height, :width] + fine)
        return result


def _bilinear(factor: int) -> Tensor:
    """Kernel (2 factor, 2 factor) of bilinear enlargement."""
    place = (torch.arange(2 * factor) + 0.5) / factor - 1
    line = 1 - place.abs()
    return line[:, None] * line


class DLA(Backbone):
    """DLA-34 (Yu et al., CVPR 2018, table 1): picture -> one map at stride 4, trained from scratch.

    Two convolutions at full size, four stages of hierarchical aggregation at strides 4, 8, 16, 32, and iterative
    aggregation of those (figure 3): first every stage takes in the coarser ones, then strides 4, 8 and 16 are joined.
    CenterNet's deformable convolutions in the decoder are plain 3 x 3 ones here. Pictures of any size will do.
    """

    example: ClassVar = {"channels": (4, 8, 8, 12, 16, 16), "depths": (1, 2, 1, 1)}

    def __init__(
        self,
        image: Spec,
        *,
        channels: tuple[int, int, int, int, int, int] = (16, 32, 64, 128, 256, 512),
        depths: tuple[int, int, int, int] = (1, 2, 2, 1),
    ) -> None:
        """Options: width of the two levels and four stages, depth of the tree of each stage."""
        super().__init__()
        if len(channels) != 6 or len(depths) != 4 or min(*channels, *depths) < 1:
            raise ConfigError(
                "backbone 'dla' needs six widths and four depths, all positive\n"
                f"  given: channels: {list(channels)}, depths: {list(depths)}\n"
                "  fix: for example channels: [16, 32, 64, 128, 256, 512], depths: [1, 2, 2, 1]"
            )
        base = nn.Conv2d(image.channels, channels[0], 7, padding=3, bias=False)
        self.base = nn.Sequential(
            base, BatchNorm2d(channels[0]), nn.ReLU(inplace=True),
            conv_block(channels[0], channels[0]), conv_block(channels[0], channels[1], 2),
        )  # fmt: skip
        self.stages = nn.ModuleList(
            Tree(depth, channels[i + 1], channels[i + 2], 2, keep_input=i > 0) for i, depth in enumerate(depths)
        )
        widths = channels[2:]
        # aggregation k brings stages k.. up to the stride of stage k - 1, each into the one before it
        self.up = nn.ModuleList(
            nn.ModuleList(Merge(widths[k], widths[k - 1], 2) for _ in range(k, 4)) for k in (3, 2, 1)
        )
        self.last = nn.ModuleList(Merge(widths[k], widths[0], 2**k) for k in (1, 2))
        self.stride = 4 * image.stride
        self.provides = Spec(Image, widths[0], self.stride, image.geometry)

    def forward(self, image: Image) -> Image:
        """The map at stride 4: a picture of H x W has ceil(ceil(H / 2) / 2) rows and likewise columns."""
        features, maps = self.base(image.features), []
        for stage in self.stages:
            features = stage(features)
            maps.append(features)
        finest = [maps[3]]
        for merges, start in zip(self.up, (2, 1, 0), strict=True):
            assert isinstance(merges, nn.ModuleList)
            for place, merge in enumerate(merges, start + 1):
                maps[place] = merge(maps[place], maps[place - 1])
            finest.append(maps[3])
        joined = finest[3]
        for merge, coarse in zip(self.last, (finest[2], finest[1]), strict=True):
            joined = merge(coarse, joined)
        return Image(joined, image.cameras, self.stride)
