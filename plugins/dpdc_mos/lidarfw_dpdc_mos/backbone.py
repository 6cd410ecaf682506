"""The two-branch range-image network: what the scan looks like, and what changed since the past ones.

Source: Tang, Zhu and Sun, Remote Sensing 2025, 17(2), 195, section 3.2 and figure 3, with the blocks of SalsaNext.
"""

from __future__ import annotations

from functools import partial

import torch
from lidarfw.errors import AssemblyError, ConfigError
from lidarfw.interfaces import Backbone
from lidarfw.types import DataSpec, Points, RangeImage, RangeView, Spec
from torch import Tensor, nn

from lidarfw_dpdc_mos.blocks import (
    AddMotion,
    ContextBlock,
    JoinMotion,
    MakeConv,
    MetaKernel,
    MotionGuidedAttention,
    ResidualBlock,
    SoftPool2d,
    UpBlock,
)
from lidarfw_dpdc_mos.convolution import DPDC2d, RangeConv2d

CONTEXTS = 3  # context blocks of the appearance branch
FUSIONS = ("attention", "add", "concat", "stack")


class DPDCBackbone(Backbone):
    """Range image with residuals -> features at full resolution (Remote Sensing 2025, 17(2), 195, section 3.2).

    The appearance branch sees range, x, y, z and the features of the points: three context blocks, a MetaKernel after
    the first, then residual blocks with SoftPool between them. The motion branch sees the residual images: one
    context block and the same residual blocks. Where their maps have the same size, motion-guided attention joins
    them. Up blocks lead back to full resolution; the last one gives the map, widths[0] / 2 channels.

    Of the input's features, the first is the range, then come as many as the points of the data have, and any after
    those are residual images. Without residual images there is one branch.
    """

    example = {"stem": 8, "widths": (16, 16, 16)}

    def __init__(
        self,
        image: Spec,
        data: DataSpec,
        *,
        stem: int = 32,
        widths: tuple[int, ...] = (64, 128, 256, 256, 256),
        placement: tuple[str, ...] = ("context",),
        branches: tuple[str, ...] = ("cdc", "rdc", "sdc", "ddc", "dilated"),
        dilation: int = 2,
        meta_kernel: bool = True,
        fusion: str = "attention",
        circular: bool = True,
        dropout: float = 0.2,
        mean: tuple[float, ...] = (12.12, 10.88, 0.23, -1.04, 0.21),
        std: tuple[float, ...] = (12.32, 11.47, 6.91, 0.86, 0.16),
    ) -> None:
        """Options.

        stem: width of the context blocks. widths: of the residual blocks, multiples of 8, each after the first at
        half the resolution of the one before. placement: where DPDC stands for the dilated convolution of the
        appearance branch and the decoder: context, res1, res2, ..., up1, up2, ... (1 is the finest); none: nowhere.
        branches, dilation: of DPDC; [dense] is an ordinary 5 x 5 convolution. fusion: attention, add, concat, or
        stack (residuals as further inputs of a single branch). circular: columns go round the full turn. mean, std:
        of range, x, y, z (metres) and the features of the points, for normalisation; 0 and 1 beyond their length.
        """
        super().__init__()
        _check(image, widths, placement, fusion)
        known = next((spec.channels for spec in data.inputs.values() if spec.kind is Points), 0)
        self.residuals = max(0, image.channels - 1 - known)
        self.meta_kernel, self.placement, self.circular = meta_kernel, placement, circular
        self._dpdc = partial(DPDC2d, branches=branches, dilation=dilation, circular=circular)
        stacked = self.residuals if fusion == "stack" else 0
        appearance = 3 + image.channels - self.residuals
        self._normalise(mean, std, appearance)
        self.contexts = nn.ModuleList(
            ContextBlock(appearance + stacked if i == 0 else stem, stem, self._wide("context"), circular)
            for i in range(CONTEXTS)
        )
        self.meta = MetaKernel(stem, appearance, circular) if meta_kernel else None
        self.stages = self._stages(stem, widths, placed=True)
        self._make_motion(stem, widths, "stack" if self.residuals == 0 else fusion)
        self.ups = self._ups(widths, dropout)
        self.pool, self.dropout = SoftPool2d(), nn.Dropout2d(dropout)
        self.provides = Spec(RangeImage, widths[0] // 2, 1, image.geometry)

    mean: Tensor
    std: Tensor

    def _normalise(self, mean: tuple[float, ...], std: tuple[float, ...], channels: int) -> None:
        padded = [*mean, *[0.0] * channels][:channels], [*std, *[1.0] * channels][:channels]
        for name, values in zip(("mean", "std"), padded, strict=True):
            self.register_buffer(name, torch.tensor(values).view(1, -1, 1, 1), persistent=False)

    def _wide(self, place: str) -> MakeConv:
        """The wide convolution of a block: DPDC where it is placed, else 3 x 3 with dilation 2."""
        if place in self.placement:
            return self._dpdc
        return partial(RangeConv2d, size=3, dilation=2, circular=self.circular)

    def _stages(self, stem: int, widths: tuple[int, ...], placed: bool) -> nn.ModuleList:
        pairs = zip([stem, *widths], widths, strict=False)
        return nn.ModuleList(
            ResidualBlock(before, width, self._wide(f"res{number}" if placed else ""), self.circular)
            for number, (before, width) in enumerate(pairs, 1)
        )

    def _make_motion(self, stem: int, widths: tuple[int, ...], fusion: str) -> None:
        """The motion branch and what joins it, from the finest map to the coarsest."""
        self.motion_context: nn.Module | None = None
        self.motion_stages, self.joins = nn.ModuleList(), nn.ModuleList()
        if fusion == "stack":
            return
        self.motion_context = ContextBlock(self.residuals, stem, self._wide(""), self.circular)
        self.motion_stages = self._stages(stem, widths, placed=False)
        makers = {"attention": MotionGuidedAttention, "concat": JoinMotion}
        self.joins.extend(makers[fusion](width) if fusion in makers else AddMotion() for width in widths)

    def _ups(self, widths: tuple[int, ...], dropout: float) -> nn.ModuleList:
        """From the finest to the coarsest; used the other way round."""
        halves = [*(width // 2 for width in widths[:-1]), widths[-1]]
        return nn.ModuleList(
            UpBlock(halves[i + 1], widths[i], halves[i], self._wide(f"up{i + 1}"), self.circular, dropout)
            for i in range(len(widths) - 1)
        )

    def forward(self, image: RangeImage) -> RangeImage:
        """The same pixels with features (B, widths[0] / 2, H, W)."""
        appearance, residual = self._inputs(image)
        features = self._appearance(appearance, residual if self.motion_context is None else None)
        motion = self.motion_context(residual) if self.motion_context is not None else None
        maps = self._encode(features, motion)
        features = maps.pop()
        for up, skip in zip(reversed(self.ups), reversed(maps), strict=True):
            features = up(features, skip)
        return RangeImage(features, image.xyz, image.mask, image.pixel, image.view)

    def _inputs(self, image: RangeImage) -> tuple[Tensor, Tensor]:
        """Normalised range, x, y, z and point features, 0 where no point is; the residual images as they are."""
        own = image.features.shape[1] - self.residuals
        parts = [image.features[:, :1], image.xyz, image.features[:, 1:own]]
        appearance = (torch.cat(parts, 1) - self.mean) / self.std * image.mask[:, None]
        return appearance, image.features[:, own:]

    def _appearance(self, appearance: Tensor, stacked: Tensor | None) -> Tensor:
        features = appearance if stacked is None else torch.cat([appearance, stacked], 1)
        for number, context in enumerate(self.contexts):
            features = context(features)
            if number == 0 and self.meta is not None:
                features = self.meta(features, appearance)
        return features

    def _encode(self, features: Tensor, motion: Tensor | None) -> list[Tensor]:
        """The map of each stage, finest first, motion joined in."""
        maps: list[Tensor] = []
        for number, stage in enumerate(self.stages):
            if number:
                features = self.dropout(self.pool(features))
                motion = None if motion is None else self.dropout(self.pool(motion))
            features = stage(features)
            if motion is not None:
                motion = self.motion_stages[number](motion)
                features = self.joins[number](features, motion)
            maps.append(features)
        return maps


def _check(image: Spec, widths: tuple[int, ...], placement: tuple[str, ...], fusion: str) -> None:
    """ConfigError for options that make no network, AssemblyError for a range image that it cannot halve."""
    if len(widths) < 2 or any(width < 8 or width % 8 for width in widths):
        raise ConfigError(
            f"backbone.dpdc.widths: expected two or more multiples of 8, found {list(widths)}\n"
            "  fix: for example widths: [64, 128, 256, 256, 256]"
        )
    numbers = range(1, len(widths) + 1)
    places = ["context", *(f"res{i}" for i in numbers), *(f"up{i}" for i in numbers[:-1])]
    unknown = [place for place in placement if place not in places]
    if unknown:
        raise ConfigError(f"backbone.dpdc.placement: there is no {unknown[0]!r}.\n  places: {', '.join(places)}")
    if fusion not in FUSIONS:
        raise ConfigError(f"backbone.dpdc.fusion is {fusion!r}.\n  there are: {', '.join(FUSIONS)}")
    if not isinstance(image.geometry, RangeView):
        raise AssemblyError(f"backbone.dpdc needs the range view of its input, got {image}")
    stride = 2 ** (len(widths) - 1)
    view = image.geometry
    if view.height % stride or view.width % stride:
        raise AssemblyError(
            f"backbone.dpdc halves the range image {len(widths) - 1} times, but it has {view.height} x {view.width} "
            f"pixels\n  fix: height and width that {stride} divides, or fewer backbone.dpdc.widths"
        )
