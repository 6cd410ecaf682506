"""Spinning LiDARs: where their beams point, and what comes back."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore import EmbreeDevice
from embreex.rtcore_scene import EmbreeScene

from lidarfw_town.mesh import Mesh

Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Lidar:
    """A spinning LiDAR.

    Elevations from the highest beam to the lowest, degrees; columns per turn; noise of the range, metres; farthest
    range, metres; `weakest`: signal (reflectance, on smooth surfaces times the cosine, relative to 30 m) at which half
    of the pulses are lost; `mixed`: share of the points at edges that lie between two surfaces.
    """

    name: str
    elevations: tuple[float, ...]
    columns: int
    noise: float
    farthest: float
    weakest: float
    mixed: float = 0.08
    height: float = 1.73  # metres above the ground
    turn: float = 0.1  # seconds

    def rays(self) -> tuple[Floats, Floats]:
        """Unit directions (beams, columns, 3) in the sensor frame, and the time of a column in turns, -0.5..0.5.

        Columns run clockwise from behind, so that the beams look ahead in the middle of the turn.
        """
        elevation = np.radians(np.array(self.elevations))[:, None]
        share = (np.arange(self.columns) + 0.5) / self.columns
        azimuth = (np.pi * (1 - 2 * share))[None]
        flat = np.cos(elevation)
        parts = (flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation) + 0 * azimuth)
        return np.stack(parts, -1).astype(np.float32), (share - 0.5).astype(np.float32)


def _even(up: float, down: float, count: int) -> tuple[float, ...]:
    return tuple(float(angle) for angle in np.linspace(up, down, count))


LIDARS = {
    # its elevations are those that KITTI's scans show about their origin
    "hdl64": Lidar("hdl64", _even(2.4, -7.8, 32) + _even(-8.4, -23.7, 32), 2048, 0.02, 80.0, 0.03),
    "hdl32": Lidar("hdl32", _even(10.67, -30.67, 32), 2048, 0.02, 100.0, 0.04, height=1.84),
    "ouster32": Lidar("ouster32", _even(22.5, -22.5, 32), 1024, 0.015, 120.0, 0.04, height=1.8),
    "small": Lidar("small", _even(2.0, -24.33, 32), 512, 0.02, 80.0, 0.03),
}


_ROADS = (40, 44, 60)
_SMOOTH = (10, 13, 18)  # vehicles: paint and glass send little back at an angle
_ROUGH = (70, 71, 72)  # vegetation, trunks, terrain: matt at every incidence, and not quite where their triangles are


@functools.cache
def _device() -> EmbreeDevice:
    # one for all scenes: Embree fails where a process has about a thousand
    return EmbreeDevice()


class Scene:
    """Triangles made ready for rays."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._scene = EmbreeScene(_device())
        if len(mesh):
            TriangleMesh(self._scene, mesh.triangles)

    def cast(self, origins: Floats, directions: Floats) -> tuple[Floats, npt.NDArray[np.int32], Floats]:
        """First hits of unit rays: distance (N,), 1e37 for none; triangle (N,), -1 for none; a normal (N, 3)."""
        if not len(self.mesh):
            count = len(origins)
            return np.full(count, 1e37, np.float32), np.full(count, -1, np.int32), np.zeros((count, 3), np.float32)
        found = self._scene.run(origins, directions, query="INTERSECT", output=1)
        return found["tfar"], found["primID"], found["Ng"]


@dataclass(frozen=True, eq=False)
class Hits:
    """What rays hit first, row by row: distance (1e37: nothing), class, instance, reflectance, normal (N, 3)."""

    distance: Floats
    semantic: npt.NDArray[np.uint16]
    instance: npt.NDArray[np.int32]
    reflectance: Floats
    normal: Floats


def cast(scenes: Sequence[Scene], origins: Floats, directions: Floats) -> tuple[Floats, npt.NDArray[np.int64], Floats]:
    """First hits in several scenes: distance, triangle, counted through all scenes, and a normal of any length."""
    distance, triangle, normal = scenes[0].cast(origins, directions)
    start, index = len(scenes[0].mesh), triangle.astype(np.int64)
    for scene in scenes[1:]:
        other, triangle, across = scene.cast(origins, directions)
        rows = np.flatnonzero((triangle >= 0) & (other < distance))
        distance[rows], index[rows], normal[rows] = other[rows], triangle[rows] + start, across[rows]
        start += len(scene.mesh)
    return distance, index, normal


def unit(vectors: Floats) -> Floats:
    """Vectors (N, 3) at length 1; those of length 0 stay."""
    square = np.einsum("ij,ij->i", vectors, vectors)
    return np.asarray(vectors / np.sqrt(np.maximum(square, 1e-20))[:, None], np.float32)


def first_hits(scenes: Sequence[Scene], origins: Floats, directions: Floats) -> Hits:
    """The nearest hits of rays (N, 3) in several scenes."""
    distance, index, normal = cast(scenes, origins, directions)
    semantic, instance, reflectance = (surfaces(scenes, index, n) for n in ("semantic", "instance", "reflectance"))
    return Hits(distance, semantic, instance, reflectance, unit(normal))


def surfaces(scenes: Sequence[Scene], index: npt.NDArray[np.int64], name: str) -> npt.NDArray[Any]:
    """An attribute of the meshes at triangles (N,) as `cast` counts them; 0 where there is none."""
    table = getattr(scenes[0].mesh, name)
    values, start = np.zeros((len(index), *table.shape[1:]), table.dtype), 0
    for scene in scenes:
        rows = np.flatnonzero((index >= start) & (index < start + len(scene.mesh)))
        values[rows] = getattr(scene.mesh, name)[index[rows] - start]
        start += len(scene.mesh)
    return values


@dataclass(frozen=True, eq=False)
class Scan:
    """A turn of a LiDAR: range (R, C) in metres (0: nothing came back), remission (R, C) 0..1, class, instance."""

    range: Floats
    remission: Floats
    semantic: npt.NDArray[np.uint16]
    instance: npt.NDArray[np.int32]


@dataclass(frozen=True)
class Weather:
    """What the air does to beams: extinction per metre by rain or fog; whether roads are wet."""

    extinction: float = 0.0
    wet: bool = False


def receive(lidar: Lidar, hits: Hits, directions: Floats, rng: np.random.Generator, weather: Weather) -> Scan:
    """What the LiDAR measures of the hits of its rays, beam by beam.

    The signal falls with the square of the range, on vehicles also with the cosine of incidence; weak pulses are lost,
    and the rest is given with noise, of three deviations at most. At edges a beam meets two surfaces and may measure a
    place between them; drops of rain and fog may send back more than what stands behind them. Such points have the
    class 1 (outlier) and belong to no object.
    """
    shape = (len(lidar.elevations), lidar.columns)
    rough = np.isin(hits.semantic, _ROUGH)
    cosine = np.abs(np.einsum("ij,ij->i", hits.normal, directions))
    signal = _signal(hits, cosine, weather)
    roof = _own_roof(lidar)
    drops = np.where(roof, 0, _drops(signal, hits.distance, weather.extinction, rng))
    lost = rng.random(len(signal), np.float32) > 1 / (1 + (lidar.weakest / np.maximum(signal, 1e-9)) ** 4)
    glassy = hits.reflectance < 0.045  # the beam goes on into the room or the car
    gone = lost | glassy | roof | (hits.distance > lidar.farthest)
    noise = np.clip(rng.standard_normal(len(signal), np.float32), -3, 3) * (lidar.noise * np.where(rough, 2.0, 1.0))
    distance = np.where(gone, 0, hits.distance + noise).astype(np.float32).reshape(shape)
    mixed = _mix(distance, lidar.mixed, rng).ravel() | (drops > 0)
    return Scan(
        np.where(drops > 0, drops, distance.ravel()).astype(np.float32).reshape(shape),
        np.where(drops > 0, 0.02, _remission(hits, cosine, rough, rng)).astype(np.float32).reshape(shape),
        np.where(mixed, 1, hits.semantic).astype(np.uint16).reshape(shape),
        np.where(mixed, 0, hits.instance).reshape(shape),
    )


def _signal(hits: Hits, cosine: Floats, weather: Weather) -> Floats:
    """Strength of the pulses (N,), 1 for a white surface 30 m away. Water on roads mirrors them away.

    Rough ground sends light back where it came from at any incidence, as the moon does; paint and glass do not.
    """
    reach = np.minimum(hits.distance, np.float32(1e3))
    spread = np.maximum(reach / 30, 0.15) ** 2  # devices turn down what is closer than 4.5 m
    turned = np.where(np.isin(hits.semantic, _SMOOTH), np.maximum(cosine, 0.01), 1.0)
    signal = hits.reflectance * turned / spread * np.exp(-2 * weather.extinction * reach)
    return np.asarray(np.where(np.isin(hits.semantic, _ROADS), 0.4, 1.0) * signal if weather.wet else signal)


def _drops(signal: Floats, distance: Floats, extinction: float, rng: np.random.Generator) -> Floats:
    """Ranges (N,) at which drops send more back than the surface behind them, 0 where they do not.

    The stronger of two echoes counts, as with dual-return devices set to strongest (cf. Hahner et al., "Fog simulation
    on real LiDAR point clouds for 3D object detection in adverse weather", ICCV 2021). How often a beam meets a clump
    of drops and how much that sends back grow with the extinction.
    """
    count = len(signal)
    if not extinction:
        return np.zeros(count, np.float32)
    met = rng.random(count, np.float32) < 1 - np.exp(-10 * extinction)
    near = 1 + 4 * rng.standard_exponential(count, np.float32)
    echo = 4 * extinction * rng.standard_exponential(count, np.float32)
    echo *= np.exp(-2 * extinction * near) / np.maximum(near / 30, 0.15) ** 2
    return np.asarray(np.where(met & (near < distance) & (echo > signal), near, 0), np.float32)


def _remission(hits: Hits, cosine: Floats, rough: npt.NDArray[np.bool_], rng: np.random.Generator) -> Floats:
    """Calibrated remission as KITTI's scans have it; 0 where the pulse was faint.

    The device makes up for the range as far as 25 m. Smooth surfaces are weaker at grazing incidence. Dark paint and
    far roads give 0.
    """
    grazing = np.where(rough, 1.0, np.minimum(cosine / 0.085, 1.0))
    far = np.minimum(1.0, 25.0 / np.maximum(hits.distance, 1.0)) ** 1.2
    value = hits.reflectance * grazing * far * (1 + np.float32(0.18) * rng.standard_normal(len(cosine), np.float32))
    faint = value < 0.1 + np.float32(0.03) * rng.standard_normal(len(cosine), np.float32)
    faint |= (rng.random(len(cosine), np.float32) < 0.04) & ~rough  # seen at all ranges
    # levels of a hundredth, as the devices give them
    return np.where(faint, 0, np.round(np.clip(value, 0, 0.99), 2)).astype(np.float32)


def _mix(distance: Floats, share: float, rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    """Move some points at edges to between their surface and the one behind; which ones."""
    behind = np.maximum(np.roll(distance, 1, 1), np.roll(distance, -1, 1))
    jump = behind - distance
    mixed = (distance > 0) & (jump > 0.4) & (jump < 6) & (rng.random(distance.shape) < share)
    distance[mixed] += (jump * rng.uniform(0.15, 0.85, jump.shape))[mixed]
    return np.asarray(mixed)


@functools.lru_cache(maxsize=8)
def _own_roof(lidar: Lidar) -> npt.NDArray[np.bool_]:
    """Rays (beams * columns,) that the own roof stops: 0.45 m below, 0.55 m to each side."""
    directions = lidar.rays()[0].reshape(-1, 3)
    down = np.minimum(directions[:, 2], -1e-6)
    ahead, aside = -0.45 * directions[:, 0] / down, -0.45 * directions[:, 1] / down
    return np.asarray((ahead < 1.1) & (ahead > -1.4) & (np.abs(aside) < 0.55))
