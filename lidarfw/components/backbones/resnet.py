"""A residual network for pictures.

Source: He et al., "Deep Residual Learning for Image Recognition", CVPR 2016 (table 1, the 18-layer network).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lidarfw.components.layers import BatchNorm2d, conv_block
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Backbone
from lidarfw.types import Image, Spec


class BasicBlock(nn.Module):
    """Two 3 x 3 convolutions whose result is added to the input (figure 5 left).

    Where the shape changes, the shortcut is a 1 x 1 convolution with batch normalisation (option B).
    """

    def __init__(self, in_channels: int, channels: int, stride: int = 1) -> None:
        super().__init__()
        second = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.branch = nn.Sequential(conv_block(in_channels, channels, stride), second, BatchNorm2d(channels))
        self.shortcut: nn.Module = nn.Identity()
        if stride != 1 or in_channels != channels:
            resize = nn.Conv2d(in_channels, channels, 1, stride, bias=False)
            self.shortcut = nn.Sequential(resize, BatchNorm2d(channels))

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, channels, ceil(H / stride), ceil(W / stride))."""
        return torch.relu(self.branch(features) + self.shortcut(features))


class ResNetBackbone(Backbone):
    """ResNet-18 (CVPR 2016): picture -> feature maps at strides 4, 8, 16, 32, trained from scratch."""

    def __init__(
        self,
        image: Spec,
        *,
        channels: tuple[int, int, int, int] = (64, 128, 256, 512),
        blocks: tuple[int, int, int, int] = (2, 2, 2, 2),
    ) -> None:
        """Options: width and number of residual blocks of each of the four stages."""
        super().__init__()
        if not len(channels) == len(blocks) == 4 or min(*channels, *blocks) < 1:
            raise ConfigError(
                "backbone 'resnet' has four stages and needs a positive number for each\n"
                f"  given: channels: {list(channels)}, blocks: {list(blocks)}\n"
                "  fix: for example channels: [64, 128, 256, 512], blocks: [2, 2, 2, 2]"
            )
        stem = nn.Conv2d(image.channels, channels[0], 7, stride=2, padding=3, bias=False)
        self.stem = nn.Sequential(
            stem, BatchNorm2d(channels[0]), nn.ReLU(inplace=True), nn.MaxPool2d(3, stride=2, padding=1)
        )
        widths = [channels[0], *channels]
        self.stages = nn.ModuleList(_stage(widths[i], channels[i], 1 if i == 0 else 2, blocks[i]) for i in range(4))
        self.strides = [image.stride * 2 ** (2 + i) for i in range(4)]
        self.provides = [Spec(Image, c, s, image.geometry) for c, s in zip(channels, self.strides, strict=True)]

    def forward(self, image: Image) -> list[Image]:
        """The map of each stage, finest first; a picture of H x W has ceil(H / stride) x ceil(W / stride) cells."""
        features, maps = self.stem(image.features), list[Image]()
        for stage, stride in zip(self.stages, self.strides, strict=True):
            features = stage(features)
            maps.append(Image(features, image.cameras, stride))
        return maps


def _stage(in_channels: int, channels: int, stride: int, blocks: int) -> nn.Sequential:
    rest = [BasicBlock(channels, channels) for _ in range(blocks - 1)]
    return nn.Sequential(BasicBlock(in_channels, channels, stride), *rest)
