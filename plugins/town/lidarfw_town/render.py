"""Pictures of the town by ray casting: colour shaded by sun and sky, depth, semantics, instances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from lidarfw.types import Camera

from lidarfw_town.camera import rays_of
from lidarfw_town.light import Light, light_of
from lidarfw_town.mesh import Array
from lidarfw_town.sensors import Floats, Hits, Scene, first_hits

if TYPE_CHECKING:
    from lidarfw_town.drive import Drive, TownFrame

_BLOCK = 1 << 16  # rays that are shaded together, so that they stay in the caches of the processor


@dataclass(frozen=True, eq=False)
class Rendering:
    """A picture: image (H, W, 3) uint8 RGB, depth (H, W) metres, 0 where no surface is, class and track id (H, W).

    The depth is that of `Camera.project`: z in the camera frame for a pinhole, the distance for other models.
    """

    image: npt.NDArray[np.uint8]
    depth: Floats
    semantic: npt.NDArray[np.uint16]
    instance: npt.NDArray[np.int32]


def photograph(drive: Drive, frame: TownFrame, camera: Camera) -> Rendering:
    """The picture of a camera of the vehicle at the moment of a frame.

    Moving objects are where the LiDAR saw them, so that they fit its points and boxes. The noise depends on the frame
    and on where the camera stands: the same call gives the same bytes.
    """
    spot = [round(1000 * value) for value in rays_of(camera)[0].tolist()]
    rng = np.random.default_rng((drive.seed, 7, drive.traversal, frame.number, *(abs(2 * s) + (s < 0) for s in spot)))
    light = light_of(drive.seed, drive.traversal, drive.weather)
    return render([drive.still, frame.movers], camera, frame.pose, light, rng)


def render(scenes: Sequence[Scene], camera: Camera, pose: Array, light: Light, rng: np.random.Generator) -> Rendering:
    """A picture of scenes. `pose` (4, 4) is that of the LiDAR, in whose frame the camera is given, in the world."""
    place, rays, scale = rays_of(camera)
    origin = (pose[:3, :3] @ place + pose[:3, 3]).astype(np.float32)
    count = len(rays)
    image, depth = np.zeros((count, 3), np.uint8), np.zeros(count, np.float32)
    semantic, instance = np.zeros(count, np.uint16), np.zeros(count, np.int32)
    for start in range(0, count, _BLOCK):
        rows = start + np.flatnonzero(rays[start : start + _BLOCK].any(1))
        directions = np.ascontiguousarray(rays[rows] @ pose[:3, :3].T.astype(np.float32))
        hits = first_hits(scenes, np.tile(origin, (len(rows), 1)), directions)
        image[rows] = _exposed(_colour(hits, origin, directions, scenes, light), light, rng)
        depth[rows] = np.where(hits.semantic > 0, hits.distance * scale[rows], 0)
        semantic[rows], instance[rows] = hits.semantic, hits.instance
    size = (camera.height, camera.width)
    return Rendering(image.reshape(*size, 3), depth.reshape(size), semantic.reshape(size), instance.reshape(size))


def _exposed(colour: Array, light: Light, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """What the sensor of the camera makes of light (N, 3): exposure, noise, and the curve of a picture."""
    grain = rng.normal(0, light.grain, colour.shape)
    tone = np.clip(colour * light.exposure + grain, 0, 1) ** (1 / 1.9)
    return np.asarray(np.round(tone * 255), np.uint8)


def _colour(hits: Hits, origin: Floats, directions: Floats, scenes: Sequence[Scene], light: Light) -> Array:
    """Light (N, 3) that comes along rays: of the surface or the sky, through haze."""
    seen = np.flatnonzero(hits.semantic > 0)
    colour = _sky(directions, light)
    colour[seen] = _surface(hits, origin, directions, seen, scenes, light)
    haze = 1 - np.exp(-np.minimum(hits.distance, 1e3) * light.haze)[seen, None]
    colour[seen] = colour[seen] * (1 - haze) + np.array(light.air) * haze
    return colour


def _surface(
    hits: Hits, origin: Floats, directions: Floats, seen: npt.NDArray[np.int64], scenes: Sequence[Scene], light: Light
) -> Array:
    """Lambertian light of sun and sky on what was hit, with cast shadows and a little gloss on glass and paint."""
    sun = np.array(light.sun, np.float32)
    normal, along = hits.normal[seen], directions[seen]
    normal = np.where((normal * along).sum(1, keepdims=True) > 0, -normal, normal)
    place = origin + along * hits.distance[seen, None] + normal * 0.01
    facing = np.maximum(normal @ sun, 0)
    shadow = _hidden(scenes, place, sun, facing > 0)
    leafy = hits.semantic[seen] == 70  # leaves let some of the light through
    direct = np.where(shadow, 0.0, np.where(leafy, 0.35 + 0.5 * facing, facing))[:, None] * light.direct
    ambient = (0.30 + 0.14 * normal[:, 2:]) * np.array(light.ambient)
    sunlight = 0.85 * np.array([1 + light.warmth, 1.0, 1 - light.warmth])
    albedo = hits.colour[seen] ** 1.6 * _texture(place, hits.semantic[seen])[:, None]
    mirror = along - 2 * (along * normal).sum(1, keepdims=True) * normal
    glossy = (hits.reflectance[seen] < 0.08)[:, None] * np.clip(mirror[:, 2:] + 0.25, 0, 1) * 0.4
    return np.asarray(albedo * (ambient + sunlight * direct) + glossy * np.array([0.6, 0.72, 0.9]))


def _hidden(
    scenes: Sequence[Scene], place: Floats, direction: Floats, chosen: npt.NDArray[np.bool_]
) -> npt.NDArray[np.bool_]:
    """Whether something stands between places (N, 3) and a far light, for the chosen ones."""
    rows = np.flatnonzero(chosen)
    origins, towards = np.ascontiguousarray(place[rows]), np.tile(direction, (len(rows), 1))
    hidden = np.zeros(len(place), bool)
    for scene in scenes:
        hidden[rows] |= scene.cast(origins, towards)[1] >= 0
    return hidden


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
    """Blue above, pale at the horizon, a glow around the sun; grey under clouds."""
    up = np.clip(directions[:, 2:], 0, 1) ** 0.5
    colour = np.array(light.horizon) * (1 - up) + np.array(light.zenith) * up
    glow = np.clip(directions @ np.array(light.sun, np.float32), 0, 1)[:, None] ** 24
    return np.asarray(colour + 0.3 * light.direct * glow * np.array([1.0, 0.95, 0.85]))
