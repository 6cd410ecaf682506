"""Inputs of the measurements: a simulated street, a scan of the simulated town, random boxes."""

from __future__ import annotations

import importlib
import math
from importlib.util import find_spec

import torch
from torch import Tensor

from lidarfw.errors import ConfigError
from lidarfw.types import Points

_SENSOR_HEIGHT = 1.73  # metres


def street_scan(sweeps: int = 1, half_view: float = math.radians(41), seed: int = 0) -> Points:
    """Points of a simulated 64-beam scanner in a street with facades, cars, poles and bushes.

    Args:
        sweeps: scans taken a metre apart, all in the frame of the first.
        half_view: radians kept to either side of straight ahead; pi keeps the whole turn.
    """
    random = torch.Generator().manual_seed(seed)
    boxes, depth = _street(random)
    scans = [_scan(boxes, depth, torch.tensor([float(k), 0.0, 0.0]), half_view, random) for k in range(sweeps)]
    xyz = torch.cat(scans)
    remission = torch.rand(len(xyz), 1, generator=random)
    return Points.from_scan(xyz, remission)


def _street(random: torch.Generator) -> tuple[Tensor, Tensor]:
    """Axis-aligned boxes (K, 6) lower and upper corner, and how deep a ray gets into each (K,) metres."""

    def row(count: int, low: list[float], high: list[float], size: list[float], vary: list[float]) -> Tensor:
        center = torch.tensor(low) + torch.rand(count, 3, generator=random) * (torch.tensor(high) - torch.tensor(low))
        half = (torch.tensor(size) + torch.rand(count, 3, generator=random) * torch.tensor(vary)) / 2
        base = torch.cat([center[:, :2] - half[:, :2], torch.full((count, 1), -_SENSOR_HEIGHT)], 1)
        return torch.cat([base, base + 2 * half], 1)

    sides = (-1, 1)
    facades = [row(12, [-70, side * 16.0, 0], [90, side * 24.0, 0], [9, 6, 5], [8, 3, 7]) for side in sides]
    cars = [row(12, [-60, side * 4.5, 0], [80, side * 6.0, 0], [3.8, 1.6, 1.4], [1, 0.3, 0.5]) for side in sides]
    poles = row(20, [-60, -9, 0], [80, 9, 0], [0.15, 0.15, 4], [0.2, 0.2, 3])
    bushes = [row(20, [-60, side * 8.0, 0], [80, side * 13.0, 0], [1.5, 1.5, 0.8], [4, 3, 2]) for side in sides]
    crowns = [row(12, [-60, side * 7.0, 0], [80, side * 12.0, 0], [3, 3, 4], [4, 3, 4]) for side in sides]
    crowns = [c + torch.tensor([0, 0, 2.5, 0, 0, 0]) for c in crowns]
    solid, soft = torch.cat([*facades, *cars, poles]), torch.cat([*bushes, *crowns])
    return torch.cat([solid, soft]), torch.cat([torch.zeros(len(solid)), torch.full((len(soft),), 2.5)])


def _scan(boxes: Tensor, depth: Tensor, origin: Tensor, half_view: float, random: torch.Generator) -> Tensor:
    """(N, 3) returns of one turn, in the frame of the street."""
    elevation = torch.cat([torch.linspace(2, -8.3, 32), torch.linspace(-8.8, -24.8, 32)]).deg2rad()
    azimuth = torch.arange(2083) / 2083 * 2 * math.pi - math.pi
    azimuth = azimuth[azimuth.abs() < half_view]
    flat, angle = elevation.cos()[:, None], azimuth[None]
    rays = [flat * angle.cos(), flat * angle.sin(), elevation.sin()[:, None] * torch.ones_like(angle)]
    direction = torch.stack(rays, -1).view(-1, 3)
    distance = torch.where(direction[:, 2] < 0, -_SENSOR_HEIGHT / direction[:, 2], torch.inf)
    for box, soft in zip(boxes, depth, strict=True):
        first, second = (box[:3] - origin) / direction, (box[3:] - origin) / direction
        near, far = torch.minimum(first, second).amax(1), torch.maximum(first, second).amin(1)
        inside = near + soft * torch.rand(len(near), generator=random)
        hit = (near > 0) & (near < far) & (inside < far)
        distance = torch.where(hit, torch.minimum(distance, inside), distance)
    distance = distance + torch.randn(len(distance), generator=random) * 0.015
    rough = (origin + direction * distance[:, None])[:, 1].abs() > 5.5  # grass beside the road
    distance = distance - rough * torch.rand(len(distance), generator=random) * 0.04 * distance.clamp(max=25)
    seen = (distance < 100) & (torch.rand(len(distance), generator=random) > 0.08)
    return direction[seen] * distance[seen, None] + origin


def random_boxes(count: int, kind: str, seed: int = 0) -> Tensor:
    """(count, 7) boxes: `cluster` round 50 objects, `spread` over 70 x 80 m, or `dense`, all over each other."""
    random = torch.Generator().manual_seed(seed)
    extent = torch.tensor([70, 80, 2, 3, 1, 1, 2 * math.pi]) if kind != "dense" else torch.tensor([1, 1, 1, 3, 1, 1, 6])
    objects = 50 if kind == "cluster" else count
    boxes = torch.rand(objects, 7, generator=random) * extent + torch.tensor([0, -40, -2, 3, 1.5, 1.4, 0])
    if kind != "cluster":
        return boxes
    noise = torch.randn(count, 7, generator=random) * torch.tensor([0.4, 0.4, 0.2, 0.2, 0.1, 0.1, 0.2])
    return boxes[torch.randint(50, (count,), generator=random)] + noise


def town_scan(half_view: float = math.radians(41)) -> Points:
    """A scan of the town that the plugin lidarfw-town simulates, as KITTI's scanner sees it ahead.

    Args:
        half_view: radians kept to either side of straight ahead.

    Raises:
        ConfigError: the plugin is not installed.
    """
    if find_spec("lidarfw_town") is None:
        raise ConfigError("--town: lidarfw-town is not installed here\n  fix: pip install lidarfw-town")
    drive, sensors = (importlib.import_module(f"lidarfw_town.{name}") for name in ("drive", "sensors"))
    points = torch.from_numpy(drive.Drive(0, 1, sensors.LIDARS["hdl64"]).frame(0).points)
    ahead = points[torch.atan2(points[:, 1], points[:, 0]).abs() < half_view]
    return Points.from_scan(ahead[:, :3].contiguous(), ahead[:, 3:].contiguous())
