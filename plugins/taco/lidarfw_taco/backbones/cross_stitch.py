"""Cross-stitch: two networks, one for each task, that mix their features after every level.

Source: Misra et al., "Cross-stitch Networks for Multi-task Learning", CVPR 2016, section 3; a baseline in
table 6 of TACO.
"""

from __future__ import annotations

import torch
from lidarfw.interfaces import Backbone
from lidarfw.ops import SparseSequential
from lidarfw.types import BEV, Points, Spec, Voxels
from torch import Tensor, nn

from lidarfw_taco.backbones.taco import TacoBackbone, _halved, _voxelize


class CrossStitch(nn.Module):
    """Features of both tasks as weighted sums of both, channel by channel (equation 1).

    At the start, a task keeps `own` of its features and takes 1 - `own` of the other's. Without `both` only the first
    task has weights, where nothing reads the second one any more.
    """

    def __init__(self, channels: int, own: float, both: bool) -> None:
        super().__init__()
        weight = torch.tensor([[own, 1 - own], [1 - own, own]])[: 1 + both]
        self.weight = nn.Parameter(weight[:, :, None].repeat(1, 1, channels))

    def forward(self, one: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
        """Mixed features (V, C) of the first and of the second task."""
        mixed = [row[0] * one + row[1] * other for row in self.weight]
        return mixed[0], mixed[-1]


class CrossStitchBackbone(Backbone):
    """Two backbones of TACO with cross-stitch units: the voxels are those of localization, the map of detection.

    Takes the place of `taco` with the same necks and heads: those of localization read the voxels, those of detection
    the map. `own` is the share of its own features that a task starts with (0.9 was best in the paper); the other
    options are those of `taco`, for each of the two networks.
    """

    def __init__(
        self,
        points: Spec,
        *,
        lower: tuple[float, float, float] = (-60.0, -60.0, -2.0),
        upper: tuple[float, float, float] = (60.0, 60.0, 6.0),
        cell: tuple[float, float, float] = (0.2, 0.2, 0.2),
        stem: int = 64,
        blocks: tuple[tuple[int, ...], ...] = ((128,), (128, 256), (256, 512, 512, 512)),
        bev_stride: int = 4,
        bev_channels: int = 256,
        intensity: bool = False,
        own: float = 0.9,
    ) -> None:
        super().__init__()
        options = {"lower": lower, "upper": upper, "cell": cell, "stem": stem, "blocks": blocks}
        options |= {"bev_stride": bev_stride, "bev_channels": bev_channels, "intensity": intensity}
        self.localization, self.detection = (TacoBackbone(points, **options) for _ in range(2))  # type: ignore[arg-type]
        self.localization.flatten = SparseSequential()  # its map is nobody's
        last = len(blocks) - 1
        self.stitches = nn.ModuleList(
            CrossStitch(group[-1], own, both=number < last or self.detection.bev_level == last)
            for number, group in enumerate(blocks)
        )
        self.provides = self.detection.provides

    def forward(self, points: Points) -> tuple[list[Voxels], BEV]:
        """Levels of localization, finest first, and the map of detection."""
        level = _voxelize(points, self.detection._features(points), self.detection.grid)
        features = [tower.stem(level.voxels).features for tower in (self.localization, self.detection)]
        localization, detection = list[Voxels](), list[Voxels]()
        for stitch, one, other in zip(self.stitches, self.localization.levels, self.detection.levels, strict=True):
            # the mean over points is taken channel by channel: both tasks side by side
            level = _halved(level.with_voxels(level.voxels.with_features(torch.cat(features, 1))))
            halves = level.voxels.features.chunk(2, 1)
            own = [net(level.voxels.with_features(h)).features for net, h in zip((one, other), halves, strict=True)]
            features = list(stitch(*own))
            localization.append(level.voxels.with_features(features[0]))
            detection.append(level.voxels.with_features(features[1]))
        return localization, self.detection._bev(detection[self.detection.bev_level])
