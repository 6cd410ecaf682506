"""Sensor data and feature maps: the five representations that components exchange.

Raw data and features share a type on purpose: a scan and a point feature are both `Points`.
Coordinates are metres in the sensor frame: x forward, y left, z up.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from lidarfw._lazy import LazyModule
from lidarfw.types.geometry import Camera, Grid, RangeView
from lidarfw.types.record import Record, Rows

if TYPE_CHECKING:
    import torch
    from torch import Tensor
else:
    torch = LazyModule("torch")


@dataclass
class Points(Rows):
    """A raw scan, several merged scans, or features on points."""

    xyz: Tensor  # (N, 3) float32, metres
    features: Tensor  # (N, C) float32; of a raw scan: remission 0..1 and whatever else the sensor gives
    batch: Tensor  # (N,) int64, sample of each point
    batch_size: int = 1
    time: Tensor | None = None  # (N,) float32 seconds relative to the frame, past scans negative

    @classmethod
    def from_scan(cls, xyz: Tensor, features: Tensor, time: Tensor | None = None) -> Points:
        """The points of one frame, as a batch of one."""
        return cls(xyz, features, torch.zeros(len(xyz), dtype=torch.long, device=xyz.device), 1, time)


@dataclass
class Voxels(Record):
    """Sparse features on a 3D grid, in canonical order: rows sorted by (b, z, y, x), each cell once."""

    features: Tensor  # (N, C)
    index: Tensor  # (N, 4) int64: batch, z, y, x at this stride
    grid: Grid
    shape: tuple[int, int, int]  # cells (D, H, W) at this stride
    strides: tuple[int, int, int] = (1, 1, 1)  # grid cells per voxel along z, y, x
    batch_size: int = 1
    cache: dict[Any, Any] = field(default_factory=dict, repr=False, compare=False)  # rulebooks of these cells

    def __len__(self) -> int:
        return int(self.index.shape[0])

    @property
    def stride(self) -> int:
        """Horizontal stride."""
        return self.strides[2]

    def with_features(self, features: Tensor) -> Voxels:
        """The same cells with other features (N, C'); the rulebooks stay valid."""
        return Voxels(features, self.index, self.grid, self.shape, self.strides, self.batch_size, self.cache)

    def centers(self) -> Tensor:
        """Centre of each voxel (N, 3) x, y, z in metres."""
        return self.grid.center(self.index[:, 1:], self.strides)


@dataclass
class BEV(Record):
    """A bird's-eye-view map: row = y, column = x, cell (0, 0) at the grid's lower corner."""

    features: Tensor  # (B, C, H, W)
    grid: Grid
    stride: int = 1

    @property
    def batch_size(self) -> int:
        return int(self.features.shape[0])


@dataclass
class RangeImage(Record):
    """A spherical projection of scans; pixels without a point have xyz = 0 and mask False."""

    features: Tensor  # (B, C, H, W)
    xyz: Tensor  # (B, 3, H, W) metres
    mask: Tensor  # (B, H, W) bool, pixel holds a point
    pixel: Tensor  # (N,) int64, flat index b*H*W + row*W + column of every point of the batch, -1 outside the view
    view: RangeView

    @property
    def batch_size(self) -> int:
        return int(self.features.shape[0])


@dataclass
class Image(Record):
    """Pictures (C = 3, RGB 0..1, stride 1) or feature maps of one camera, one `Camera` per sample."""

    features: Tensor  # (B, C, H, W)
    cameras: tuple[Camera, ...]  # of the full picture (stride 1), length B
    stride: int = 1

    @property
    def batch_size(self) -> int:
        return int(self.features.shape[0])
