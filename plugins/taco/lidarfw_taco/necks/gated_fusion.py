"""The localization branch: voxels of several strides, fused at the coarsest.

Source: Yang et al., "LiSA: LiDAR Localization with Semantic Awareness", CVPR 2024, whose backbone TACO takes.
"""

from __future__ import annotations

import torch
from lidarfw.components.layers import BatchNorm1d
from lidarfw.interfaces import Neck
from lidarfw.ops import find_voxels, scatter_mean, to_dense
from lidarfw.types import Spec, Voxels
from torch import Tensor, nn


class _Gate(nn.Module):
    """A finer level on the coarse cells, weighted by what it and the deepest level say of its worth there."""

    def __init__(self, in_channels: int, deepest: int, channels: int) -> None:
        super().__init__()
        self.project = nn.Sequential(nn.Linear(in_channels, channels, bias=False), BatchNorm1d(channels))
        self.own, self.deep = nn.Linear(channels, 1), nn.Linear(deepest, 1)

    def forward(self, fine: Tensor, deepest: Tensor) -> Tensor:
        projected = nn.functional.leaky_relu(self.project(fine))
        gated: Tensor = projected * torch.sigmoid(self.own(projected) + self.deep(deepest))
        return gated


class _Layout(nn.Module):
    """A vector (B, `channels`) for each scan: what stands where around the sensor."""

    CELLS, WIDTH = 16, 8  # of the map that is read, to each side, and its channels at each height

    def __init__(self, voxels: Spec, channels: int) -> None:
        super().__init__()
        self.squeeze = nn.Sequential(nn.Linear(voxels.channels, self.WIDTH), BatchNorm1d(self.WIDTH), nn.ReLU())
        width = self.WIDTH * voxels.depth * self.CELLS**2
        self.read = nn.Sequential(nn.Linear(width, channels), nn.LayerNorm(channels), nn.ReLU())

    def forward(self, voxels: Voxels) -> Tensor:
        seen = to_dense(voxels.with_features(self.squeeze(voxels.features))).flatten(1, 2)  # every height is there
        vector: Tensor = self.read(nn.functional.adaptive_max_pool2d(seen, self.CELLS).flatten(1))
        return vector


class GatedFusion(Neck):
    """Voxels of several strides -> voxels of the coarsest one, with the finer levels added through gates (LiSA).

    Each finer level is averaged over the coarse cells, brought to `channels` and weighted by a gate 0..1; the
    deepest level and all of these stand side by side. Every level has a gate of its own.

    With `context`, so many channels that say what stands where around the sensor stand beside the features of every
    voxel (ours): a place is known from the whole scan sooner than from a voxel, and from its layout sooner than from
    an average over the scan, which cannot tell where in it something is. They are read by one linear layer from the
    level before the deepest, pooled to 16 x 16 columns with all heights. LightLoc (CVPR 2025, section 3.2) guides
    scene coordinates by the whole scan as well.
    """

    def __init__(self, voxels: list[Spec], *, channels: int = 128, context: int = 0) -> None:
        super().__init__()
        *fine, deepest = sorted(voxels, key=lambda spec: spec.stride)
        self.gates = nn.ModuleList(_Gate(spec.channels, deepest.channels, channels) for spec in fine)
        self.context = _Layout([*fine, deepest][-2:][0], context) if context else None
        width = deepest.channels + channels * len(fine) + context
        self.provides = Spec(Voxels, width, deepest.stride, deepest.geometry, depth=deepest.depth)

    def forward(self, voxels: list[Voxels]) -> Voxels:
        """The cells of the coarsest level."""
        *fine, deepest = sorted(voxels, key=lambda level: level.stride)
        parts = [deepest.features]
        for gate, level in zip(self.gates, fine, strict=True):
            parts.append(gate(averaged(level, deepest), deepest.features))
        if self.context is not None:
            parts.append(self.context([*fine, deepest][-2:][0])[deepest.index[:, 0]])
        return deepest.with_features(torch.cat(parts, 1))


def averaged(fine: Voxels, coarse: Voxels) -> Tensor:
    """(V, C) mean of the fine voxels in each coarse one, 0 where there is none."""
    ratio = fine.index.new_tensor([c // f for c, f in zip(coarse.strides, fine.strides, strict=True)])
    rows = find_voxels(coarse, fine.index[:, 0], fine.index[:, 1:] // ratio)
    return scatter_mean(fine.features, torch.where(rows < len(coarse), rows, -1), len(coarse))
