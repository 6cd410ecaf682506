"""A pinhole camera: pictures of the town in colour, shaded by sun and sky."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lidarfw_town.mesh import Array
from lidarfw_town.sensors import Floats, Hits, Scene, first_hits

KITTI_SIZE = (1242, 375)
_KITTI_LENS = (721.5377, 721.5377, 609.5593, 172.854)  # fx, fy, cx, cy of the left colour camera
# camera 0 stands 0.27 m ahead of the LiDAR and 0.08 m below it; camera 2 is 6 cm to the left of camera 0
LIDAR_TO_CAMERA = np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27]])
BASELINE = 0.06


@dataclass(frozen=True)
class Pinhole:
    """A camera without distortion: size in pixels, and fx, fy, cx, cy."""

    width: int
    height: int
    lens: tuple[float, float, float, float]

    @property
    def projection(self) -> Array:
        """(3, 4): rectified camera 0 -> pixels, KITTI's P2."""
        fx, fy, cx, cy = self.lens
        return np.array([[fx, 0, cx, fx * BASELINE], [0, fy, cy, 0], [0, 0, 1, 0]])

    def rays(self) -> Floats:
        """Directions (height, width, 3) of the pixel centres in the LiDAR's axes, unit length."""
        fx, fy, cx, cy = self.lens
        u, v = np.meshgrid((np.arange(self.width) - cx) / fx, (np.arange(self.height) - cy) / fy)
        direction = np.stack([np.ones_like(u), -u, -v], -1)
        return np.asarray(direction / np.linalg.norm(direction, axis=-1, keepdims=True), np.float32)

    @property
    def place(self) -> Array:
        """Where the camera stands in the frame of the LiDAR, metres."""
        return np.array([0.27, BASELINE, -0.08])


def kitti_camera(width: int = KITTI_SIZE[0]) -> Pinhole:
    """KITTI's left colour camera, its picture scaled to a width in pixels."""
    scale = width / KITTI_SIZE[0]
    fx, fy, cx, cy = _KITTI_LENS
    # whole numbers are pixel centres: the corner of the picture is at -0.5
    lens = (fx * scale, fy * scale, (cx + 0.5) * scale - 0.5, (cy + 0.5) * scale - 0.5)
    return Pinhole(width, round(KITTI_SIZE[1] * scale), lens)


@dataclass(frozen=True)
class Light:
    """Sun and camera of a drive: direction to the sun, exposure, warmth of the light."""

    sun: tuple[float, float, float]
    exposure: float
    warmth: float


def light_of(seed: int, traversal: int) -> Light:
    """The light of a traversal: another hour and another exposure each time."""
    rng = np.random.default_rng((seed, 6, traversal))
    height, azimuth = np.radians(rng.uniform(22, 60)), rng.uniform(0, 2 * np.pi)
    sun = (np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height))
    return Light(
        (float(sun[0]), float(sun[1]), float(sun[2])), float(rng.uniform(0.85, 1.2)), float(rng.uniform(0, 0.12))
    )


def render(
    camera: Pinhole, scenes: list[Scene], pose: Array, light: Light, rng: np.random.Generator
) -> npt.NDArray[np.uint8]:
    """A picture (height, width, 3) RGB. `pose` (4, 4) is that of the LiDAR in the world."""
    directions = np.ascontiguousarray(camera.rays().reshape(-1, 3) @ pose[:3, :3].T.astype(np.float32))
    place = (pose[:3, :3] @ camera.place + pose[:3, 3]).astype(np.float32)
    origins = np.ascontiguousarray(np.broadcast_to(place, directions.shape))
    hits = first_hits(scenes, origins, directions)
    seen = hits.semantic > 0
    colour = _sky(directions, light)
    colour[seen] = _surface(hits, origins, directions, seen, scenes, light, rng)
    haze = 1 - np.exp(-np.minimum(hits.distance, 1e3) / 420)[:, None]
    colour = np.where(seen[:, None], colour * (1 - haze) + np.array([0.72, 0.78, 0.86]) * haze, colour)
    grain = rng.normal(0, 0.008, colour.shape)
    tone = np.clip(colour * light.exposure + grain, 0, 1) ** (1 / 1.9)
    return np.asarray(np.round(tone * 255), np.uint8).reshape(camera.height, camera.width, 3)


def _surface(
    hits: Hits, origins: Floats, directions: Floats, seen: npt.NDArray[np.bool_], scenes: list[Scene], light: Light,
    rng: np.random.Generator,
) -> Array:  # fmt: skip
    """Lambertian light of sun and sky on what was hit, with cast shadows and a little gloss on glass and paint."""
    sun = np.array(light.sun, np.float32)
    normal = hits.normal[seen]
    normal = np.where((normal * directions[seen]).sum(1, keepdims=True) > 0, -normal, normal)
    place = origins[seen] + directions[seen] * hits.distance[seen, None] + normal * 0.01
    towards = np.ascontiguousarray(np.broadcast_to(sun, place.shape))
    facing = np.maximum(normal @ sun, 0)
    lit = np.flatnonzero(facing > 0)
    shadow = np.zeros(len(place), bool)
    for scene in scenes:
        shadow[lit] |= scene.cast(np.ascontiguousarray(place[lit]), towards[lit])[1] >= 0
    leafy = hits.semantic[seen] == 70  # leaves let some of the light through
    direct = np.where(shadow, 0.0, np.where(leafy, 0.35 + 0.5 * facing, facing))[:, None]
    ambient = (0.30 + 0.14 * normal[:, 2:]) * np.array([0.92, 1.0, 1.12])
    sunlight = 0.85 * np.array([1 + light.warmth, 1.0, 1 - light.warmth])
    albedo = hits.colour[seen] ** 1.6 * _texture(place, hits.semantic[seen])[:, None]
    mirror = directions[seen] - 2 * (directions[seen] * normal).sum(1, keepdims=True) * normal
    glossy = (hits.reflectance[seen] < 0.08)[:, None] * np.clip(mirror[:, 2:] + 0.25, 0, 1) * 0.4
    return np.asarray(albedo * (ambient + sunlight * direct) + glossy * np.array([0.6, 0.72, 0.9]))


def _texture(place: Floats, semantic: npt.NDArray[np.uint16]) -> Array:
    """Mottling of surfaces that depends on the place alone: coarse on grass, fine on asphalt."""
    scale = np.where(np.isin(semantic, (70, 72)), 2.3, 6.0)
    phase = place * scale[:, None]
    waves = np.sin(phase[:, 0] * 1.7 + np.sin(phase[:, 1] * 2.3)) * np.sin(
        phase[:, 1] * 1.3 + np.sin(phase[:, 2] * 2.9)
    )
    cell = np.floor(place.astype(np.float64) / 0.06) @ np.array([12.9898, 78.233, 37.719])
    speckle = np.modf(np.abs(np.sin(cell)) * 43758.5453)[0] - 0.5
    return np.asarray(1 + 0.07 * waves + 0.14 * speckle)


def _sky(directions: Floats, light: Light) -> Array:
    """Blue above, pale at the horizon, a glow around the sun."""
    up = np.clip(directions[:, 2:], 0, 1) ** 0.5
    blue = np.array([0.78, 0.85, 0.92]) * (1 - up) + np.array([0.25, 0.45, 0.80]) * up
    glow = np.clip(directions @ np.array(light.sun, np.float32), 0, 1)[:, None] ** 24
    return np.asarray(blue + 0.3 * glow * np.array([1.0, 0.95, 0.85]))
