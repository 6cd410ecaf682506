"""Features of a region: at the points of a grid in it, from voxels, points or a bird's-eye-view map.

Sources: the MSRM paper, section II-C (equation 3, decomposed PointNet); Deng et al., "Voxel R-CNN", AAAI 2021,
sections 3.2 and 3.3 (voxel query, accelerated aggregation); ranges and widths of CasA's configuration for KITTI.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
from lidarfw.components.layers import BatchNorm1d
from lidarfw.ops import knn, scatter_max
from lidarfw.types import BEV, Voxels
from torch import Tensor, nn

from lidarfw_msrm.heads.rois import to_sensor

SPREAD = 4  # candidates per neighbour that is taken


@dataclass
class Sites:
    """Places that hold features: the voxels of one level, or points."""

    xyz: Tensor  # (V, 3) metres
    features: Tensor  # (V, C)
    batch: Tensor  # (V,)

    @classmethod
    def of(cls, voxels: Voxels) -> Sites:
        """The centres of voxels."""
        return cls(voxels.centers(), voxels.features, voxels.index[:, 0])


def grid_points(rois: Tensor, size: int) -> Tensor:
    """Points (N, size^3, 3) in metres: the centres of size x size x size cells of each region (N, 7)."""
    steps = (torch.arange(size, device=rois.device) + 0.5) / size - 0.5
    unit = torch.cartesian_prod(steps, steps, steps).to(rois.dtype).view(size**3, 3)
    local = (unit * rois[:, None, 3:6]).reshape(-1, 3)
    upright = torch.cat([local, local.new_zeros(len(local), 4)], 1)
    return to_sensor(upright, rois.repeat_interleave(len(unit), 0))[:, :3].view(len(rois), size**3, 3)


def neighbors(sites: Sites, xyz: Tensor, batch: Tensor, radii: Sequence[float], count: int) -> list[Tensor]:
    """Pairs (P, 2) of query point and site for each radius, at most `count` a point, by query.

    Of more sites within a radius, `count` evenly spread over their order by distance are taken: the nearest ones alone
    would make a large radius see no more than a small one. At most four times `count` sites are considered.
    """
    index, distance = knn(xyz, batch, sites.xyz, sites.batch, SPREAD * count, max(radii))
    slot = torch.arange(count, device=xyz.device)
    pairs = []
    for radius in radii:
        found = (distance <= radius).sum(1, keepdim=True)
        place = torch.where(found > count, slot * found // count, slot)
        query, place_of = (slot < found).nonzero().unbind(1)
        pairs.append(torch.stack([query, index[query, place[query, place_of]]], 1))
    return pairs


def aggregation_cost(sites: int, places: int, neighbors: int, in_channels: int, channels: int) -> tuple[int, int]:
    """Products of the PointNet on [features, offset] of every pair, and of its decomposed form (section II-C).

    T K (C + 3) C' and N C C' + T K 3 C', of N sites with C channels, T places with K neighbours each, C' channels out.
    The paper writes M for T in the second; no other reading fits its text. Both leave out what is the same in both,
    the layer after the maximum.
    """
    pairs = places * neighbors
    return pairs * (in_channels + 3) * channels, sites * in_channels * channels + pairs * 3 * channels


class Aggregation(nn.Module):
    """Decomposed PointNet over the neighbours of a point (section II-C): the sites' features are transformed once per
    site, the offsets once per pair, and the maximum of their sum is taken.

    Equal to a PointNet on [features, offset] whose normalisation is folded; `aggregation_cost` has what is saved.
    """

    def __init__(self, in_channels: int, channels: int) -> None:
        super().__init__()
        self.feature = nn.Linear(in_channels, channels, bias=False)
        self.feature_norm = BatchNorm1d(channels)
        self.offset = nn.Linear(3, channels, bias=False)
        self.offset_norm = BatchNorm1d(channels)
        self.out = nn.Sequential(nn.Linear(channels, channels, bias=False), BatchNorm1d(channels), nn.ReLU())

    def transform(self, sites: Sites) -> Tensor:
        """(V, C') of all sites, the same for every stage; where the normalisation is fixed, with A x_v in it."""
        transformed: Tensor = self.feature_norm(self.feature(sites.features))
        return transformed if self.training else transformed + _product(sites.xyz, self._fixed()[0])

    def forward(self, transformed: Tensor, sites: Sites, xyz: Tensor, pairs: Tensor) -> Tensor:
        """(M, C') of the points xyz (M, 3) with their pairs (P, 2); 0 goes in where a point has no neighbour."""
        query, site = pairs.unbind(1)
        if self.training:
            pooled = self._pool_pairs(transformed, sites, xyz, query, site)
        else:
            pooled = self._pool_sites(transformed, xyz, query, site)
        out: Tensor = self.out(pooled)
        return out

    def _pool_pairs(self, transformed: Tensor, sites: Sites, xyz: Tensor, query: Tensor, site: Tensor) -> Tensor:
        """max over the neighbours v of point g of relu(t_v + norm(W (x_v - x_g))); norm looks at all pairs."""
        offset = self.offset_norm(self.offset(sites.xyz[site] - xyz[query]))
        return scatter_max(torch.relu(transformed[site] + offset), query, len(xyz))

    def _pool_sites(self, transformed: Tensor, xyz: Tensor, query: Tensor, site: Tensor) -> Tensor:
        """The same where the normalisation is fixed, A x + b: relu(max(t_v + A x_v) - A x_g + b), since A x_g and b are
        the same for all neighbours. Nothing is left to do for each pair but to take the maximum."""
        weight, bias = self._fixed()
        highest = scatter_max(transformed[site], query, len(xyz))
        pooled = torch.relu(highest - _product(xyz, weight) + bias)
        found = torch.zeros(len(xyz), 1, dtype=pooled.dtype, device=pooled.device).index_fill(0, query, 1)
        return pooled * found

    def _fixed(self) -> tuple[Tensor, Tensor]:
        """A (C', 3) and b (C',) of the offsets, their normalisation by its running statistics folded in."""
        norm = self.offset_norm
        gain = norm.weight / torch.sqrt(norm.running_var + norm.eps)  # type: ignore[operator, arg-type]
        return self.offset.weight * gain[:, None], norm.bias - norm.running_mean * gain  # type: ignore[operator]


def _product(xyz: Tensor, weight: Tensor) -> Tensor:
    """(N, C') of (N, 3) and (C', 3), not as a matrix product: at half precision, places would be off by decimetres."""
    x, y, z = xyz[:, :1], xyz[:, 1:2], xyz[:, 2:]
    return torch.addcmul(torch.addcmul(x * weight[:, 0], y, weight[:, 1]), z, weight[:, 2])


class SitePooling(nn.Module):
    """Grid features of regions from one or more kinds of sites, each with its radii in metres."""

    def __init__(
        self, in_channels: Sequence[int], radii: Sequence[Sequence[float]], channels: int, size: int, count: int
    ) -> None:
        super().__init__()
        self.radii, self.size, self.count = [list(r) for r in radii], size, count
        self.scales = nn.ModuleList(
            nn.ModuleList(Aggregation(c, channels) for _ in r) for c, r in zip(in_channels, radii, strict=True)
        )
        self.channels = size**3 * channels * sum(map(len, radii))

    def prepare(self, sources: list[Sites]) -> list[list[Tensor]]:
        """The transformed features of all sites, once for all stages."""
        return [[a.transform(s) for a in scale] for s, scale in zip(sources, self._scales(), strict=True)]

    def forward(self, sources: list[Sites], prepared: list[list[Tensor]], rois: Tensor, batch: Tensor) -> Tensor:
        """(N, channels) of regions (N, 7) of samples (N,)."""
        xyz = grid_points(rois, self.size)
        owner = batch.repeat_interleave(xyz.shape[1])
        flat, found = xyz.reshape(-1, 3), list[Tensor]()
        for sites, scale, transformed, radii in zip(sources, self._scales(), prepared, self.radii, strict=True):
            pairs = neighbors(sites, flat, owner, radii, self.count)
            found += [a(t, sites, flat, p) for a, t, p in zip(scale, transformed, pairs, strict=True)]
        return torch.cat(found, 1).view(len(rois), self.channels)

    def _scales(self) -> list[list[Aggregation]]:
        return [[cast(Aggregation, a) for a in cast(nn.ModuleList, scale)] for scale in self.scales]


class BEVPooling(nn.Module):
    """Grid features of regions from a map, for backbones without 3D features: size x size bilinear samples in the
    footprint, and the height and vertical extent of the region, which no sample tells apart."""

    def __init__(self, in_channels: int, channels: int, size: int) -> None:
        super().__init__()
        self.size = size
        self.reduce = nn.Sequential(nn.Linear(in_channels, channels, bias=False), BatchNorm1d(channels), nn.ReLU())
        self.channels = size**2 * channels + 2

    def forward(self, bev: BEV, rois: Tensor, batch: Tensor) -> Tensor:
        """(N, channels) of regions (N, 7) of samples (N,)."""
        flat = torch.cat([rois[:, :2], rois[:, 2:3] * 0, rois[:, 3:5], rois[:, 5:6] * 0, rois[:, 6:]], 1)
        xy = grid_points(flat, self.size)[:, :: self.size, :2].reshape(-1, 2)
        samples = bilinear(bev, xy, batch.repeat_interleave(self.size**2))
        return torch.cat([self.reduce(samples).view(len(rois), self.channels - 2), rois[:, 2:3], rois[:, 5:6]], 1)


def bilinear(bev: BEV, xy: Tensor, batch: Tensor, channel: Tensor | None = None) -> Tensor:
    """The map at places xy (M, 2) in metres of samples (M,), 0 outside: (M, C), or (M,) of one channel (M,) each.

    The centre of cell i lies at i + 0.5 strides, as in grid_sample with align_corners=False.
    """
    _, _, height, width = bev.features.shape
    pixel = bev.grid.pixel(xy, bev.stride) - 0.5
    low, total = pixel.floor(), torch.zeros((), device=xy.device)
    for dx, dy in ((0, 0), (0, 1), (1, 0), (1, 1)):
        corner = low + low.new_tensor([dx, dy])
        weight = (1 - (pixel - corner).abs()).prod(1)
        inside = ((corner >= 0) & (corner < corner.new_tensor([width, height]))).all(1)
        column, row = torch.where(inside[:, None], corner, 0.0).long().unbind(1)
        value = bev.features[batch, slice(None) if channel is None else channel, row, column]
        share = (weight * inside).to(value.dtype)
        total = total + value * (share[:, None] if channel is None else share)
    return total
