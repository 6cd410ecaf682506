"""The only owners of metric <-> index: `Grid` (voxels, BEV), `RangeView` (range images), `Camera` (pictures)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from lidarfw._lazy import LazyModule

if TYPE_CHECKING:
    import torch
    from torch import Tensor
else:
    torch = LazyModule("torch")

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Grid:
    """A box of space cut into cells. Metric values are x, y, z in metres; index values are z, y, x.

    A point belongs to cell floor((point - lower) / cell); `lower` is inside, `upper` is not.
    At a stride s, cell i covers the grid cells [i*s, (i+1)*s).
    """

    lower: Triple
    upper: Triple
    cell: Triple

    def __post_init__(self) -> None:
        for axis, low, high, size in zip("xyz", self.lower, self.upper, self.cell, strict=True):
            if not size > 0:
                raise ValueError(f"grid: cell size along {axis} must be positive, got {size}")
            if not high - low >= size / 2:
                raise ValueError(f"grid: range along {axis} is empty: lower {low}, upper {high}, cell {size}")

    def shape(self, strides: int | tuple[int, int, int] = 1) -> tuple[int, int, int]:
        """Cells (D, H, W) at `strides` (z, y, x, or one number): rounded at stride 1, then rounded up."""
        each = (strides,) * 3 if isinstance(strides, int) else strides
        cells = [round((h - l) / c) for l, h, c in zip(self.lower, self.upper, self.cell, strict=True)]
        depth, height, width = (-(-n // s) for n, s in zip(reversed(cells), each, strict=True))
        return depth, height, width

    def index(self, xyz: Tensor) -> tuple[Tensor, Tensor]:
        """Cell (N, 3) int64 z, y, x of points (N, 3) at stride 1, and whether each lies inside (N,) bool.

        Divides by the cell size: multiplying by its reciprocal moves points across edges.
        """
        cell = torch.floor((xyz - xyz.new_tensor(self.lower)) / xyz.new_tensor(self.cell))
        size = cell.new_tensor(self.shape()[::-1])
        inside = ((cell >= 0) & (cell < size)).all(1)  # False for NaN
        return torch.where(inside[:, None], cell, 0).long().flip(1), inside

    def center(self, index: Tensor, strides: int | tuple[int, int, int] = 1) -> Tensor:
        """Centre (N, 3) x, y, z in metres of cells (N, 3) z, y, x at `strides`."""
        each = (strides,) * 3 if isinstance(strides, int) else strides
        lower = torch.tensor(self.lower, device=index.device)
        cell = torch.tensor([c * s for c, s in zip(self.cell, reversed(each), strict=True)], device=index.device)
        return (index.flip(1) + 0.5) * cell + lower

    def pixel(self, xy: Tensor, stride: int = 1) -> Tensor:
        """Continuous BEV coordinates (..., 2) column, row of metric x, y (..., 2): cell i spans [i, i + 1)."""
        cell = xy.new_tensor(self.cell[:2]) * stride
        return (xy - xy.new_tensor(self.lower[:2])) / cell

    def bev_centers(self, stride: int = 1, device: torch.device | str = "cpu") -> Tensor:
        """Metric centres (H, W, 2) x, y of the BEV cells at a stride."""
        _, height, width = self.shape(stride)
        rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        flat = torch.stack([torch.zeros_like(rows), rows, columns], -1).reshape(-1, 3)
        return self.center(flat.to(device), stride)[:, :2].view(height, width, 2)


@dataclass(frozen=True)
class RangeView:
    """A spherical image of a spinning LiDAR.

    Column 0 looks backward (azimuth +pi) and columns run clockwise: column = (1 - azimuth/pi) * W / 2.
    Row 0 is the highest elevation. Angles in radians.
    """

    height: int
    width: int
    up: float  # elevation of the upper edge of row 0
    down: float  # elevation of the lower edge of the last row


@dataclass(frozen=True)
class Camera:
    """A calibrated camera: one of the models pinhole, mei, fisheye (equidistant), equirectangular.

    Plain numbers only, so that a camera can stand in a config and a checkpoint.
    """

    model: str
    width: int  # pixels
    height: int
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy in pixels
    distortion: tuple[float, ...] = ()
    from_sensor: tuple[tuple[float, float, float, float], ...] = ()  # 4 x 4, sensor -> camera (x right, y down, z ahead)
