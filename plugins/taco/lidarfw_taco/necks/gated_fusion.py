"""The localization branch: voxels of several strides, fused at the coarsest.

Source: Yang et al., "LiSA: LiDAR Localization with Semantic Awareness", CVPR 2024, whose backbone TACO takes.
"""

from __future__ import annotations

import torch
from lidarfw.components.layers import BatchNorm1d
from lidarfw.interfaces import Neck
from lidarfw.ops import find_voxels, scatter_mean
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


class GatedFusion(Neck):
    """Voxels of several strides -> voxels of the coarsest one, with the finer levels added through gates (LiSA).

    Each finer level is averaged over the coarse cells, brought to `channels` and weighted by a gate 0..1; the
    deepest level and all of these stand side by side. Every level has a gate of its own.

    With `context`, so many channels that say what the whole scan looks like (a layer on the deepest level, averaged
    over the scan) stand beside the features of every voxel: a place is known sooner from the scan than from a voxel.
    LightLoc (CVPR 2025, section 3.2) guides scene coordinates by the class of the scan in the same spirit.
    """

    def __init__(self, voxels: list[Spec], *, channels: int = 128, context: int = 0) -> None:
        super().__init__()
        *fine, deepest = sorted(voxels, key=lambda spec: spec.stride)
        self.gates = nn.ModuleList(_Gate(spec.channels, deepest.channels, channels) for spec in fine)
        self.context = _context(deepest.channels, context) if context else None
        width = deepest.channels + channels * len(fine) + context
        self.provides = Spec(Voxels, width, deepest.stride, deepest.geometry, depth=deepest.depth)

    def forward(self, voxels: list[Voxels]) -> Voxels:
        """The cells of the coarsest level."""
        *fine, deepest = sorted(voxels, key=lambda level: level.stride)
        parts = [deepest.features]
        for gate, level in zip(self.gates, fine, strict=True):
            parts.append(gate(averaged(level, deepest), deepest.features))
        if self.context is not None:
            batch = deepest.index[:, 0]
            parts.append(scatter_mean(self.context(deepest.features), batch, deepest.batch_size)[batch])
        return deepest.with_features(torch.cat(parts, 1))


def _context(in_channels: int, channels: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(in_channels, channels, bias=False), BatchNorm1d(channels), nn.ReLU())


def averaged(fine: Voxels, coarse: Voxels) -> Tensor:
    """(V, C) mean of the fine voxels in each coarse one, 0 where there is none."""
    ratio = fine.index.new_tensor([c // f for c, f in zip(coarse.strides, fine.strides, strict=True)])
    rows = find_voxels(coarse, fine.index[:, 0], fine.index[:, 1:] // ratio)
    return scatter_mean(fine.features, torch.where(rows < len(coarse), rows, -1), len(coarse))
