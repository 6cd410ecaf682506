"""Image features to a bird's-eye view without depth: every cell looks up what the camera sees of it.

Sources: Harley et al., "Simple-BEV: What Really Matters for Multi-Sensor BEV Perception?", ICRA 2023, section 3
(lifting by bilinear sampling, without parameters); Lin et al., "Feature Pyramid Networks", CVPR 2017 (lateral 1 x 1
convolutions, levels added from coarse to fine).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarfw.components.layers import grid_from_options
from lidarfw.interfaces import Neck
from lidarfw.types import BEV, Camera, Image, Spec


class Lift(Neck):
    """Image features -> bird's-eye view (Simple-BEV, ICRA 2023), averaged over the height.

    The levels are brought to one width by 1 x 1 convolutions and added at the stride of the finest. The centre of
    each grid cell is projected into the picture; a map cell is the mean over those of its z cells that the camera
    sees, 0 where it sees none.
    """

    example = {"lower": (0.0, -16.0, -3.0), "upper": (32.0, 16.0, 1.0)}

    def __init__(
        self,
        images: list[Spec],
        *,
        lower: tuple[float, float, float] = (0.0, -40.0, -3.0),
        upper: tuple[float, float, float] = (70.4, 40.0, 1.0),
        cell: tuple[float, float, float] = (0.4, 0.4, 0.5),
        channels: int = 64,
    ) -> None:
        """Options: range and cell size x, y, z in metres (the z cells are the heights that are looked up), width."""
        super().__init__()
        self.grid = grid_from_options(lower, upper, cell)
        self.laterals = nn.ModuleList(nn.Conv2d(spec.channels, channels, 1) for spec in images)
        self.provides = Spec(BEV, channels, 1, self.grid)

    def forward(self, images: list[Image]) -> BEV:
        """The map at stride 1 of the grid."""
        finest = min(images, key=lambda image: image.stride)
        merged = self.merge(images, finest)
        depth, height, width = self.grid.shape()
        cells = torch.cartesian_prod(*(torch.arange(n, device=merged.device) for n in (depth, height, width)))
        centers = self.grid.center(cells).view(depth, height * width, 3)
        maps = [_look_up(f, c, finest.stride, centers) for f, c in zip(merged, finest.cameras, strict=True)]
        return BEV(torch.stack(maps).view(len(maps), -1, height, width), self.grid, 1)

    def merge(self, images: list[Image], finest: Image) -> Tensor:
        """Sum (B, channels, H, W) of the levels, each cell repeated to the finest stride."""
        height, width = finest.features.shape[2:]
        levels = []
        for lateral, image in zip(self.laterals, images, strict=True):
            level = F.interpolate(lateral(image.features), scale_factor=float(image.stride // finest.stride))
            levels.append(level[:, :, :height, :width])
        return torch.stack(levels).sum(0)


def _look_up(features: Tensor, camera: Camera, stride: int, centers: Tensor) -> Tensor:
    """Mean (C, M) over the D centres (D, M, 3) that the camera sees of the features (C, h, w) at their pixels."""
    uv, _, seen = camera.project(centers.flatten(0, 1))
    extent = uv.new_tensor(features.shape[:0:-1]) * stride  # width, height in pixels of the whole feature map
    place = torch.where(seen[:, None], (uv + 0.5) / extent * 2 - 1, 0).view(1, *centers.shape[:2], 2)
    sampled = F.grid_sample(features[None], place.to(features.dtype), padding_mode="border", align_corners=False)
    weight = seen.view(centers.shape[:2]).to(features.dtype)
    return (sampled[0] * weight).sum(1) / weight.sum(0).clamp(min=1)
