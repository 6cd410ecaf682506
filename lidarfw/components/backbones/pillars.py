"""PointPillars: a learned bird's-eye-view map of a point cloud.

Source: Lang et al., "PointPillars: Fast Encoders for Object Detection from Point Clouds", CVPR 2019, section 2.1.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lidarfw.components.layers import BatchNorm1d, grid_from_options
from lidarfw.interfaces import Backbone
from lidarfw.ops import assign_cells, scatter_max, scatter_mean
from lidarfw.types import BEV, Grid, Points, Spec


class PillarEncoder(nn.Module):
    """Pillar feature net and scatter: points -> map (B, C, H, W) of the grid, zero where no point is.

    A point is described by x, y, z, its features, its offset to the mean of its pillar's points (x, y, z) and to
    the pillar's centre (x, y); linear layer, batch normalisation, ReLU; the maximum over a pillar's points.
    All points count (dynamic pillars: Zhou et al., "End-to-End Multi-View Fusion", CoRL 2019), where the
    PointPillars paper draws 100 points of 12000 pillars.
    """

    def __init__(self, in_channels: int, grid: Grid, channels: int) -> None:
        super().__init__()
        self.grid = grid
        self.linear = nn.Linear(3 + in_channels + 3 + 2, channels, bias=False)
        self.norm = BatchNorm1d(channels)

    def forward(self, points: Points) -> Tensor:
        """Map (B, C, H, W); points outside the grid are left out."""
        cells = assign_cells(points.xyz, points.batch, points.batch_size, self.grid, pillars=True)
        inside = cells.inverse >= 0
        pillar = cells.inverse[inside]
        described = self.describe(points.xyz[inside], points.features[inside], pillar, cells.index)
        encoded = torch.relu(self.norm(self.linear(described)))
        return self.scatter(scatter_max(encoded, pillar, len(cells.index)), cells.index, points.batch_size)

    def describe(self, xyz: Tensor, features: Tensor, pillar: Tensor, index: Tensor) -> Tensor:
        """Input (N, 3 + C + 3 + 2) of the linear layer; `pillar` (N,) is each point's row of `index` (V, 4)."""
        mean = scatter_mean(xyz, pillar, len(index))
        center = self.grid.center(index[:, 1:])[:, :2]
        return torch.cat([xyz, features, xyz - mean[pillar], xyz[:, :2] - center[pillar]], 1)

    def scatter(self, pillars: Tensor, index: Tensor, batch_size: int) -> Tensor:
        """Pillar features (V, C) at their cells, zeros elsewhere; channels lie innermost in memory."""
        _, height, width = self.grid.shape()
        cell = (index[:, 0] * height + index[:, 2]) * width + index[:, 3]
        canvas = pillars.new_zeros(batch_size * height * width, pillars.shape[1])
        canvas = canvas.index_copy(0, cell, pillars)
        return canvas.view(batch_size, height, width, -1).permute(0, 3, 1, 2)


class PillarsBackbone(Backbone):
    """PointPillars' encoder (CVPR 2019): points -> bird's-eye-view map at the pitch of its pillars.

    The paper's 2D network is the neck `bev_fpn`.
    """

    example = {"lower": (0.0, -16.0, -3.0), "upper": (32.0, 16.0, 1.0)}

    def __init__(
        self,
        points: Spec,
        *,
        lower: tuple[float, float, float] = (0.0, -40.0, -3.0),
        upper: tuple[float, float, float] = (70.4, 40.0, 1.0),
        cell: tuple[float, float] = (0.16, 0.16),
        channels: int = 64,
    ) -> None:
        """Options: range and pillar size x, y in metres (the paper's for KITTI cars), width of the map."""
        super().__init__()
        grid = grid_from_options(lower, upper, cell)
        self.encoder = PillarEncoder(points.channels, grid, channels)
        self.provides = Spec(BEV, channels, 1, grid)

    def forward(self, points: Points) -> BEV:
        """The map at stride 1 of the grid."""
        return BEV(self.encoder(points), self.encoder.grid, 1)
