"""Residual networks on panoramas and on bird's-eye views: the trunk of CosPlace.

Sources: Berton, Masone and Caputo, "Rethinking Visual Geo-localization for Large-Scale Applications" (CosPlace), CVPR
2022: a ResNet without its pooling and classifier. He et al., "Deep Residual Learning for Image Recognition", CVPR 2016,
table 1. The weights know nothing of the sensor: camera and LiDAR go through the same network (paper 3.4).
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from lidarfw.components.backbones.resnet import BasicBlock
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Backbone
from lidarfw.types import BEV, Image, Spec
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

BLOCKS = {  # residual blocks of each stage
    "small": (1, 1, 1, 1), "resnet18": (2, 2, 2, 2), "resnet34": (3, 4, 6, 3), "resnet50": (3, 4, 6, 3),
    "resnet101": (3, 4, 23, 3), "resnet152": (3, 8, 36, 3),
}  # fmt: skip
_BOTTLENECK = ("resnet50", "resnet101", "resnet152")
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet


class Bottleneck(nn.Module):
    """1 x 1, 3 x 3 and 1 x 1 convolutions whose result is added to the input (He et al., figure 5 right)."""

    def __init__(self, in_channels: int, channels: int, stride: int = 1) -> None:
        super().__init__()
        width = channels // 4
        self.branch = nn.Sequential(
            nn.Conv2d(in_channels, width, 1, bias=False), nn.BatchNorm2d(width), nn.ReLU(inplace=True),
            nn.Conv2d(width, width, 3, stride, padding=1, bias=False), nn.BatchNorm2d(width), nn.ReLU(inplace=True),
            nn.Conv2d(width, channels, 1, bias=False), nn.BatchNorm2d(channels),
        )  # fmt: skip
        self.shortcut: nn.Module = nn.Identity()
        if stride != 1 or in_channels != channels:
            resize = nn.Conv2d(in_channels, channels, 1, stride, bias=False)
            self.shortcut = nn.Sequential(resize, nn.BatchNorm2d(channels))

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, channels, ceil(H / stride), ceil(W / stride))."""
        return torch.relu(self.branch(features) + self.shortcut(features))


class Trunk(nn.Module):
    """A ResNet without pooling and classifier: (B, C, H, W) -> (B, `channels`, ceil(H / stride), ceil(W / stride)).

    `small` has stages of 16, 32, 64 and 128 channels and stride 16, the others those of the paper and stride 32.
    A map of one channel is taken as a grey picture. In training, `chunk` > 0 runs so many samples at a time and keeps
    nothing but their results: they are run once more when the gradient comes (multistage backpropagation, as in
    MinkLoc3Dv2), so a batch of any size fits in memory. Batch normalisation then uses its running statistics.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, in_channels: int, network: str, chunk: int) -> None:
        super().__init__()
        self.chunk, self._settled = chunk, False
        small, wide = network == "small", 4 if network in _BOTTLENECK else 1
        widths = (16, 32, 64, 128) if small else tuple(wide * width for width in (64, 128, 256, 512))
        first = 16 if small else 64
        inputs = 3 if in_channels == 1 else in_channels
        self.stem = _stem(inputs, first, small)
        block = Bottleneck if network in _BOTTLENECK else BasicBlock
        starts = (first, *widths)
        self.stages = nn.Sequential(
            *(_stage(block, starts[i], widths[i], 1 if i == 0 else 2, BLOCKS[network][i]) for i in range(4))
        )
        for module in () if small else self.modules():
            if isinstance(module, nn.modules.batchnorm._BatchNorm):
                module.eps = 1e-5  # what published weights were trained with
        self.channels, self.stride = widths[3], 16 if small else 32
        mean, std = (_MEAN, _STD) if inputs == 3 else ((0.45,) * inputs, (0.225,) * inputs)
        self.register_buffer("mean", torch.tensor(mean)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(std)[:, None, None], persistent=False)

    def train(self, mode: bool = True) -> Trunk:
        """Batch normalisation stays in evaluation where a sample goes through twice."""
        super().train(mode)
        for module in self.modules() if self.chunk else ():
            if isinstance(module, nn.modules.batchnorm._BatchNorm):
                module.eval()
        return self

    def forward(self, features: Tensor) -> Tensor:
        """Values 0..1 -> features, at least 0."""
        if self.chunk and self.training and not self._settled:
            self._look_at_norms()
        if not self.chunk or not torch.is_grad_enabled() or len(features) <= self.chunk:
            return self._run(features)
        parts = features.split(self.chunk)  # type: ignore[no-untyped-call]
        return torch.cat([checkpoint(self._run, part, use_reentrant=False) for part in parts])

    def _look_at_norms(self) -> None:
        """Warn where statistics that nothing will ever change are still those of the start: no normalisation at all."""
        self._settled = True
        norm = self.stem[1]
        assert isinstance(norm, nn.BatchNorm2d)
        assert norm.running_mean is not None
        if not bool(norm.running_mean.any()):
            warnings.warn(
                "chunk keeps the statistics of batch normalisation as they are, and these are of no training: it does "
                "nothing\n  fix: pretrained=microsoft/resnet-152 (or the network's own), init={from: CKPT}, or chunk=0",
                stacklevel=2,
            )

    def _run(self, features: Tensor) -> Tensor:
        features = features.expand(-1, len(self.mean), -1, -1)
        result: Tensor = self.stages(self.stem((features - self.mean) / self.std))
        return result


def _stem(in_channels: int, channels: int, small: bool) -> nn.Sequential:
    size = 3 if small else 7
    conv = nn.Conv2d(in_channels, channels, size, stride=2, padding=size // 2, bias=False)
    layers: list[nn.Module] = [conv, nn.BatchNorm2d(channels), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers, *([] if small else [nn.MaxPool2d(3, stride=2, padding=1)]))


def _stage(block: type[nn.Module], in_channels: int, channels: int, stride: int, count: int) -> nn.Sequential:
    rest = [block(channels, channels) for _ in range(count - 1)]
    return nn.Sequential(block(in_channels, channels, stride), *rest)


def _trunk(in_channels: int, network: str, pretrained: str, chunk: int) -> Trunk:
    if network not in BLOCKS:
        raise ConfigError(f"there is no network {network!r}.\n  networks: {', '.join(BLOCKS)}")
    if chunk < 0:
        raise ConfigError(f"chunk must be at least 0 (0: the whole batch at once), got {chunk}")
    trunk = Trunk(in_channels, network, chunk)
    if pretrained:
        load_pretrained(trunk, _weights(pretrained), pretrained)
    return trunk


def _weights(name: str) -> Mapping[str, Tensor]:
    """The weights of a ResNet of the `transformers` library, by name or folder."""
    try:
        import transformers
    except ImportError as error:
        raise ConfigError(
            f"pretrained={name} needs the library transformers, which is not installed\n"
            "  fix: pip install 'lidarfw-crossplace[pretrained]', or pretrained='' to train from scratch"
        ) from error
    try:
        weights: Mapping[str, Tensor] = transformers.ResNetModel.from_pretrained(name).state_dict()
    except (OSError, ValueError) as error:
        raise ConfigError(f"pretrained={name}: {str(error).splitlines()[0]}") from error
    return weights


def load_pretrained(trunk: Trunk, weights: Mapping[str, Tensor], name: str = "weights") -> None:
    """Copy the weights of a `transformers.ResNetModel` into a trunk of the same network.

    The first convolution of a map of other than three channels takes the mean of the RGB filters. ConfigError where
    shapes differ.
    """
    own = trunk.state_dict()
    for key in own:
        theirs = _their_key(key, trunk)
        value = weights.get(theirs)
        if value is not None and key == "stem.0.weight" and value.shape[1] != own[key].shape[1]:
            value = value.mean(1, keepdim=True).expand(-1, own[key].shape[1], -1, -1)
        if value is None or value.shape != own[key].shape:
            found = "nothing" if value is None else tuple(value.shape)
            raise ConfigError(f"pretrained={name} is of another network: {theirs} has {found}, not {own[key].shape}")
        own[key] = value
    trunk.load_state_dict(own)


def _their_key(key: str, trunk: Trunk) -> str:
    """stages.1.0.branch.3.weight -> encoder.stages.1.layers.0.layer.1.convolution.weight."""
    parts = key.split(".")
    kinds = {0: "convolution", 1: "normalization"}
    if parts[0] == "stem":
        return f"embedder.embedder.{kinds[int(parts[1])]}.{parts[2]}"
    place = f"encoder.stages.{parts[1]}.layers.{parts[2]}"
    numbers, what = [int(part) for part in parts[4:-1]], parts[-1]
    if parts[3] == "shortcut":
        return f"{place}.shortcut.{kinds[numbers[0]]}.{what}"
    if isinstance(trunk.stages[0][0], Bottleneck):  # type: ignore[index]
        return f"{place}.layer.{numbers[0] // 3}.{kinds[numbers[0] % 3]}.{what}"
    layer, kind = (0, numbers[1]) if len(numbers) == 2 else (1, numbers[0] - 1)
    return f"{place}.layer.{layer}.{kinds[kind]}.{what}"


class CosPlaceBackbone(Backbone):
    """ResNet trunk on a picture or panorama: one feature map, of stride 32 (16 for `small`)."""

    example: ClassVar[dict[str, Any]] = {"network": "small"}

    def __init__(self, image: Spec, *, network: str = "resnet152", pretrained: str = "", chunk: int = 0) -> None:
        """Options.

        network: small, resnet18, resnet34, resnet50, resnet101 or resnet152. pretrained: name or folder of a ResNet of
        the library transformers to start from; empty for a random start. chunk: samples at a time in training, for
        batches that do not fit in memory; 0 for all at once.
        """
        super().__init__()
        self.trunk = _trunk(image.channels, network, pretrained, chunk)
        self.stride = image.stride * self.trunk.stride
        self.provides = Spec(Image, self.trunk.channels, self.stride, image.geometry)

    def forward(self, image: Image) -> Image:
        """(B, C, H, W) of values 0..1 -> (B, F, ceil(H / stride), ceil(W / stride))."""
        return Image(self.trunk(image.features), image.cameras, self.stride)


class CosPlaceBEVBackbone(Backbone):
    """The same trunk on a bird's-eye view of values 0..1, say the density of points.

    A fixed 3 x 3 mean comes first: sparse pictures change much when they are turned by interpolation, blurred ones
    little.
    """

    example: ClassVar[dict[str, Any]] = {"network": "small"}

    def __init__(
        self, bev: Spec, *, network: str = "small", blur: bool = True, pretrained: str = "", chunk: int = 0
    ) -> None:
        """Options: as of `cosplace`; blur: the 3 x 3 mean."""
        super().__init__()
        self.blur = blur
        self.trunk = _trunk(bev.channels, network, pretrained, chunk)
        self.stride = bev.stride * self.trunk.stride
        self.provides = Spec(BEV, self.trunk.channels, self.stride, bev.grid)

    def forward(self, bev: BEV) -> BEV:
        """(B, C, H, W) -> (B, F, ceil(H / stride), ceil(W / stride))."""
        features = F.avg_pool2d(bev.features, 3, 1, 1) if self.blur else bev.features
        return BEV(self.trunk(features), bev.grid, self.stride)
