"""The 2D network of SECOND and PointPillars: blocks of convolutions, brought to one stride and concatenated.

Sources: Lang et al., "PointPillars", CVPR 2019, section 2.2 (the defaults are its values for cars, section 3.1);
Yan et al., "SECOND: Sparsely Embedded Convolutional Detection", Sensors 2018, section 3.1.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

import torch
from torch import Tensor, nn

from lidarfw.components.layers import BatchNorm2d, conv_block
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Neck
from lidarfw.types import BEV, Spec


class BEVFPN(Neck):
    """Feature pyramid on the bird's-eye view (PointPillars CVPR 2019, SECOND Sensors 2018): BEV -> BEV.

    Block i is `layers[i]` 3 x 3 convolutions of width `channels[i]`, the first with stride `strides[i]`. A
    transposed convolution of width `upsampled[i]` brings its result to the stride of the first block; the
    concatenation of all comes out.
    """

    def __init__(
        self,
        bev: Spec,
        *,
        strides: tuple[int, ...] = (2, 2, 2),
        layers: tuple[int, ...] = (4, 6, 6),
        channels: tuple[int, ...] = (64, 128, 256),
        upsampled: tuple[int, ...] = (128, 128, 128),
    ) -> None:
        """Options: one number per block each."""
        super().__init__()
        _check_lengths(strides=strides, layers=layers, channels=channels, upsampled=upsampled)
        widths = [bev.channels, *channels]
        self.blocks = nn.ModuleList(_block(widths[i], channels[i], strides[i], layers[i]) for i in range(len(channels)))
        self.ups = nn.ModuleList(
            _upsample(channels[i], upsampled[i], prod(strides[1 : i + 1])) for i in range(len(channels))
        )
        self.stride = bev.stride * strides[0]
        self.provides = Spec(BEV, sum(upsampled), self.stride, bev.geometry)

    def forward(self, bev: BEV) -> BEV:
        """Map (B, C, H, W) -> (B, sum(upsampled), ceil(H / strides[0]), ceil(W / strides[0]))."""
        features, results = bev.features, list[Tensor]()
        for block, up in zip(self.blocks, self.ups, strict=True):
            features = block(features)
            results.append(up(features))
        height, width = results[0].shape[2:]  # sizes that a stride does not divide come back larger
        merged = torch.cat([result[:, :, :height, :width] for result in results], 1)
        return BEV(merged, bev.grid, self.stride)


def _block(in_channels: int, channels: int, stride: int, layers: int) -> nn.Sequential:
    rest = [conv_block(channels, channels) for _ in range(layers - 1)]
    return nn.Sequential(conv_block(in_channels, channels, stride), *rest)


def _upsample(in_channels: int, channels: int, factor: int) -> nn.Sequential:
    conv = nn.ConvTranspose2d(in_channels, channels, factor, factor, bias=False)
    return nn.Sequential(conv, BatchNorm2d(channels), nn.ReLU(inplace=True))


def _check_lengths(**options: Sequence[int]) -> None:
    lengths = {name: len(values) for name, values in options.items()}
    if len(set(lengths.values())) > 1 or min(lengths.values()) < 1 or min(map(min, options.values())) < 1:
        given = ", ".join(f"{name}: {list(values)}" for name, values in options.items())
        raise ConfigError(
            "neck 'bev_fpn' needs one positive number per block in each of its options\n"
            f"  given: {given}\n"
            f"  fix: give {max(lengths.values())} numbers for each of {', '.join(options)}"
        )
