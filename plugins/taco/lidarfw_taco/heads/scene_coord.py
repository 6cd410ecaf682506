"""Scene-coordinate regression: where in the map each part of the scan lies.

Sources: TACO, section 4; Li et al., "SGLoc: Scene Geometry Encoding for Outdoor LiDAR Localization", CVPR 2023; Yang
et al., "LiSA", CVPR 2024 (shift); Li et al., "LightLoc", CVPR 2025 (absolute).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from lidarfw.components.layers import BatchNorm1d
from lidarfw.errors import ConfigError
from lidarfw.interfaces import Head
from lidarfw.ops import find_voxels, scatter_mean, to_dense, transform
from lidarfw.types import BEV, Points, Poses, Record, SceneCoords, Spec, Targets, Voxels
from torch import Tensor, nn

from lidarfw_taco.heads.regions import EMBEDDING, Regions

TARGETS = ("absolute", "shift", "affine")
CALIBRATION = 100  # training batches that set origin and scale


@dataclass
class SceneCoordOutput(Record):
    """What the scene-coordinate heads return."""

    pairs: SceneCoords  # weight 1
    tap: BEV  # what the last layer reads, the maximum over z; 0 where there is no point
    region_logits: Tensor | None = None  # (B, K): which region of the map each scan was taken in
    region: Tensor | None = None  # (B,) in training: the true one; -1 where no pose is known


@dataclass
class Regressed:
    """What the regressor says of cells (N,) of B scans."""

    world: Tensor  # (N, 3) map coordinates in metres
    tap: Tensor  # (N, C), not negative
    region_logits: Tensor | None = None  # (B, K)
    region: Tensor | None = None  # (B,)


class CoordinateRegressor(nn.Module):
    """Features of cells -> map coordinates: a residual layer, the tap, and a linear layer that reads the tap.

    The last layer works in a normalised frame: `origin` and `scale` (metres) are the mean of what is to be predicted
    and its mean distance from it, over the first `CALIBRATION` training batches, and stand still from then on. So
    the map may lie anywhere, be of any size, and the loss stays in metres.

    With `regions` that frame is the pose of the region which the scan was taken in: the true one in training, else the
    likeliest; the residual layer also reads which one it is. Scale is then the size of a region.
    """

    origin: Tensor
    scale: Tensor
    batches: Tensor

    def __init__(
        self, in_channels: int, hidden: int, tap_channels: int, target: str, regions: int, region_size: float
    ) -> None:
        super().__init__()
        if target not in TARGETS:
            raise ConfigError(f"scene_coord: target is {target!r}.\n  fix: target: {' or '.join(TARGETS)}")
        self.target = target
        self.regions = Regions(in_channels, regions, region_size) if regions else None
        width = in_channels + (EMBEDDING if regions else 0)
        self.convs = nn.Sequential(
            nn.Linear(width, hidden, bias=False), BatchNorm1d(hidden), nn.LeakyReLU(),
            nn.Linear(hidden, hidden, bias=False), BatchNorm1d(hidden),
        )  # fmt: skip
        self.shortcut = nn.Sequential(nn.Linear(width, hidden, bias=False), BatchNorm1d(hidden))
        self.bottleneck = nn.Linear(hidden, tap_channels)
        self.last = nn.Linear(tap_channels, 12 if target == "affine" else 3)
        self.register_buffer("origin", torch.zeros(3))
        self.register_buffer("scale", torch.ones(()))
        self.register_buffer("batches", torch.zeros((), dtype=torch.long))

    def forward(self, features: Tensor, pairs: SceneCoords, poses: Poses | None = None) -> Regressed:
        """Places of cells with features (N, C), whose `pairs` hold source and batch; `poses` in training only."""
        if self.regions is None:
            tap = self._tap(features)
            return Regressed(self._places(tap, pairs.source), tap)
        logits = self.regions(features, pairs.batch, pairs.batch_size)
        region = None if poses is None else self.regions.of(poses)
        chosen = logits.argmax(1) if region is None else region.clamp(min=0)
        tap = self._tap(torch.cat([features, self.regions.embedding(chosen)[pairs.batch]], 1))
        around = self._places(tap, pairs.source)
        world = transform(self.regions.poses[chosen][pairs.batch], around[:, None])[:, 0]
        return Regressed(world, tap, logits, region)

    def _tap(self, features: Tensor) -> Tensor:
        hidden = nn.functional.leaky_relu(self.convs(features) + self.shortcut(features))
        return nn.functional.relu(self.bottleneck(hidden))

    def _places(self, tap: Tensor, source: Tensor) -> Tensor:
        """(N, 3) in the frame of the map, or of the region."""
        with torch.autocast(tap.device.type, enabled=False):  # metres in 16 bit are off by half a metre at 100 m
            values = self.last(tap.float())
            places: Tensor = self.origin + self.scale * values[:, :3]
            if self.target == "affine":
                places = places + (values[:, 3:].view(-1, 3, 3) @ source[:, :, None])[:, :, 0]
        around_sensor = self.target == "shift" or (self.target == "affine" and self.regions is not None)
        return torch.add(places, source) if around_sensor else places

    @torch.no_grad()
    def calibrate(self, source: Tensor, batch: Tensor, poses: Poses) -> None:
        """Count a training batch into origin and scale, or into the regions."""
        if int(self.batches) >= CALIBRATION:
            return
        known = poses.ok[batch]
        source, batch = source[known], batch[known]
        if not len(source):
            return
        self.batches += 1
        if self.regions is not None:
            self.regions.found(poses)
            self.scale.fill_(self.regions.size)
            return
        wanted = transform(poses.matrix.to(source.dtype)[batch], source[:, None])[:, 0]
        wanted = wanted - source if self.target == "shift" else wanted
        self.origin += (wanted.mean(0) - self.origin) / self.batches
        spread = (wanted - self.origin).abs().mean().clamp(min=1.0)
        self.scale += (spread - self.scale) / self.batches


class SceneCoordHead(Head):
    """Map coordinates of every voxel (TACO, section 4): the pairs from which `pose_ransac` finds the pose.

    A pair is the mean of the points in a voxel (sensor frame) and its predicted place in the map. `target` says what
    the last layer gives: absolute, the place itself; shift, the difference, as SGLoc and LiSA do, which is better where
    the heading hardly varies; affine (ours), a matrix A and a vector t with the place A x + t, so that all voxels of a
    scan can share one answer. The tap is the input of that layer, `tap_channels` wide and not negative, as a map with
    the maximum over z. Voxels without a point give no pair.

    With `regions` (ours, after HSCNet and LightLoc; 0: without) a scan is first given to one of so many regions, each
    `region_size` metres to every side and for one direction of travel, and the last layer's answer is relative to it.
    """

    defaults = {"loss": ["scene_coord"], "postprocessor": ["pose_ransac"], "metric": ["pose_error"]}

    def __init__(
        self,
        voxels: Spec,
        points: Spec,
        *,
        target: str = "absolute",
        hidden: int = 4096,
        tap_channels: int = 64,
        regions: int = 0,
        region_size: float = 8.0,
    ) -> None:
        super().__init__()
        self.regressor = CoordinateRegressor(voxels.channels, hidden, tap_channels, target, regions, region_size)
        self.tap = Spec(BEV, tap_channels, voxels.stride, voxels.geometry)
        self.provides = Spec(SceneCoords, stride=voxels.stride, geometry=voxels.geometry)

    def forward(self, voxels: Voxels, points: Points, targets: Targets | None = None) -> SceneCoordOutput:
        """One pair per voxel that holds a point."""
        source, kept = _means_in_voxels(points, voxels)
        cells = Voxels(
            voxels.features[kept], voxels.index[kept], voxels.grid, voxels.shape, voxels.strides, voxels.batch_size
        )
        pairs = _unplaced(source, cells.index[:, 0], voxels.batch_size)
        found = self.regressor(cells.features, pairs, _true_poses(self, pairs, targets))
        highest = to_dense(cells.with_features(found.tap)).amax(2)
        return _output(found, pairs, BEV(highest, voxels.grid, voxels.stride))

    def decode(self, output: SceneCoordOutput) -> SceneCoords:
        """The pairs."""
        return output.pairs


class SceneCoordBEVHead(Head):
    """Map coordinates of every column of a bird's-eye-view map that holds a point: `scene_coord` for 2D backbones.

    Options and tap are those of `scene_coord`; a pair is the mean of the points in the column.
    """

    defaults = {"loss": ["scene_coord"], "postprocessor": ["pose_ransac"], "metric": ["pose_error"]}

    def __init__(
        self,
        bev: Spec,
        points: Spec,
        *,
        target: str = "absolute",
        hidden: int = 4096,
        tap_channels: int = 64,
        regions: int = 0,
        region_size: float = 8.0,
    ) -> None:
        super().__init__()
        self.regressor = CoordinateRegressor(bev.channels, hidden, tap_channels, target, regions, region_size)
        self.tap = Spec(BEV, tap_channels, bev.stride, bev.geometry)
        self.provides = Spec(SceneCoords, stride=bev.stride, geometry=bev.geometry)

    def forward(self, bev: BEV, points: Points, targets: Targets | None = None) -> SceneCoordOutput:
        """One pair per column that holds a point."""
        source, column = _means_in_columns(points, bev)
        samples, _, height, width = bev.features.shape
        pairs = _unplaced(source, column // (height * width), samples)
        rows = bev.features.permute(0, 2, 3, 1).flatten(0, 2)
        found = self.regressor(rows[column], pairs, _true_poses(self, pairs, targets))
        flat = found.tap.new_zeros(samples * height * width, found.tap.shape[1]).index_copy(0, column, found.tap)
        spread = flat.view(samples, height, width, -1).permute(0, 3, 1, 2)
        return _output(found, pairs, BEV(spread, bev.grid, bev.stride))

    def decode(self, output: SceneCoordOutput) -> SceneCoords:
        """The pairs."""
        return output.pairs


def _unplaced(source: Tensor, batch: Tensor, samples: int) -> SceneCoords:
    """Pairs of weight 1 whose places in the map are still to come."""
    return SceneCoords(source, torch.zeros_like(source), torch.ones_like(source[:, 0]), batch, samples)


def _true_poses(head: SceneCoordHead | SceneCoordBEVHead, pairs: SceneCoords, targets: Targets | None) -> Poses | None:
    """In training the poses of the batch, after the regressor has counted them in; else None."""
    if targets is None or targets.poses is None or not head.training:
        return None
    head.regressor.calibrate(pairs.source, pairs.batch, targets.poses)
    return targets.poses


def _output(found: Regressed, pairs: SceneCoords, tap: BEV) -> SceneCoordOutput:
    return SceneCoordOutput(pairs.replace(world=found.world), tap, found.region_logits, found.region)


def _means_in_voxels(points: Points, voxels: Voxels) -> tuple[Tensor, Tensor]:
    """Mean (N, 3) of the points in each voxel that holds one, and the rows (N,) of those voxels."""
    cell, inside = voxels.grid.index(points.xyz)
    rows = find_voxels(voxels, points.batch, cell // cell.new_tensor(voxels.strides))
    return _means(points.xyz, torch.where(inside & (rows < len(voxels)), rows, -1), len(voxels))


def _means_in_columns(points: Points, bev: BEV) -> tuple[Tensor, Tensor]:
    """Mean (N, 3) of the points in each column that holds one, and the columns (N,): flat index b*H*W + row*W + x."""
    samples, _, height, width = bev.features.shape
    cell, inside = bev.grid.index(points.xyz)
    _, row, column = (cell // bev.stride).unbind(1)
    flat = (points.batch * height + row) * width + column
    return _means(points.xyz, torch.where(inside, flat, -1), samples * height * width)


def _means(xyz: Tensor, cell: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Means of the points (P, 3) by cell (P,), -1 for none, and the cells that have a point, ascending."""
    kept = torch.bincount(cell + 1, minlength=size + 1)[1:].nonzero()[:, 0]
    return scatter_mean(xyz, cell, size)[kept], kept
