"""Pictures of the town by ray casting: colour shaded by sun, sky and lamps, depth, semantics, instances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from lidarfw.types import Camera
from scipy import ndimage

from lidarfw_town.bodies import make
from lidarfw_town.camera import rays_of
from lidarfw_town.light import Lamps, Light, lamps_of, light_of
from lidarfw_town.mesh import Array, is_glass
from lidarfw_town.sensors import Floats, Scene, cast, surfaces, unit

if TYPE_CHECKING:
    from lidarfw_town.drive import Drive, TownFrame

_BLOCK = 1 << 16  # rays that are shaded together, so that they stay in the caches of the processor
_WET = (40, 44, 48, 60)  # classes that rain makes glossy
_OWN_SEED = (0, 8)
_OWN_ROOF = 1.28  # metres above the ground, as the LiDAR's own roof
_OWN_BEHIND = 0.35  # metres of the middle of the own vehicle behind the LiDAR
_FAINT = 0.004  # light of a lamp below which its shadow is not looked for


@dataclass(frozen=True, eq=False)
class Rendering:
    """A picture: image (H, W, 3) uint8 RGB, depth (H, W) metres, 0 where no surface is, class and track id (H, W).

    The depth is that of `Camera.project`: z in the camera frame for a pinhole, the distance for other models. The own
    vehicle has class 0, as the sky.
    """

    image: npt.NDArray[np.uint8]
    depth: Floats
    semantic: npt.NDArray[np.uint16]
    instance: npt.NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class _Seen:
    """Surfaces that rays meet: place, normal towards the eye, direction of the ray (N, 3), and what they are."""

    place: Floats
    normal: Floats
    along: Floats
    distance: Floats
    semantic: npt.NDArray[np.uint16]
    reflectance: Floats
    colour: Floats
    glow: Floats


def photograph(drive: Drive, frame: TownFrame, camera: Camera) -> Rendering:
    """The picture of a camera of the vehicle at the moment of a frame.

    Moving objects are where the LiDAR saw them, so that they fit its points and boxes. The noise depends on the frame
    and on where the camera stands: the same call gives the same bytes.
    """
    spot = [round(1000 * value) for value in rays_of(camera)[0].tolist()]
    rng = np.random.default_rng((drive.seed, 7, drive.traversal, frame.number, *(abs(2 * s) + (s < 0) for s in spot)))
    light = light_of(drive.seed, drive.traversal, drive.weather)
    # by day, lamps can be seen, but they light nothing
    dark = light.direct == 0
    lamps = lamps_of(drive.still, frame.bodies, frame.pose, drive.lidar.height) if dark else None
    scenes = [drive.still, frame.movers, _own(frame, drive.lidar.height)]
    return render(scenes, camera, frame.pose, light, rng, lamps)


def _own(frame: TownFrame, height: float) -> Scene:
    """The own vehicle, of no class."""
    body = make("car", _OWN_SEED).fitted(4.6, 1.8, _OWN_ROOF).with_semantic(0)
    body = replace(body, colour=body.colour * np.float32(0.2))
    return Scene(body.moved(frame.pose[:3, :3], frame.pose[:3, :3] @ (-_OWN_BEHIND, 0, -height) + frame.pose[:3, 3]))


def render(
    scenes: Sequence[Scene], camera: Camera, pose: Array, light: Light, rng: np.random.Generator,
    lamps: Lamps | None = None,
) -> Rendering:  # fmt: skip
    """A picture of scenes. `pose` (4, 4) is that of the LiDAR, in whose frame the camera is given, in the world."""
    place, rays, scale = rays_of(camera)
    origin = (pose[:3, :3] @ place + pose[:3, 3]).astype(np.float32)
    near = lamps.within(origin.astype(np.float64)) if lamps else None
    size, count = (camera.height, camera.width), len(rays)
    colour, depth = np.zeros((count, 3), np.float32), np.zeros(count, np.float32)
    semantic, instance = np.zeros(count, np.uint16), np.zeros(count, np.int32)
    for start in range(0, count, _BLOCK):
        rows = start + np.flatnonzero(rays[start : start + _BLOCK].any(1))
        directions = np.ascontiguousarray(rays[rows] @ pose[:3, :3].T.astype(np.float32))
        distance, index, normal = cast(scenes, np.tile(origin, (len(rows), 1)), directions)
        colour[rows] = _sky(directions, light)
        met = np.flatnonzero(index >= 0)
        seen = _seen(scenes, origin, directions[met], distance[met], index[met], unit(normal[met]), light)
        colour[rows[met]] = _through_air(_shade(seen, scenes, light, near), seen.distance, light)
        depth[rows[met]] = seen.distance * scale[rows[met]]
        semantic[rows[met]], instance[rows[met]] = seen.semantic, surfaces(scenes, index[met], "instance")
    image = _exposed(colour.reshape(*size, 3), light, rng)
    image[~rays.any(1).reshape(size)] = 0
    return Rendering(image, depth.reshape(size), semantic.reshape(size), instance.reshape(size))


def _seen(
    scenes: Sequence[Scene], origin: Floats, along: Floats, distance: Floats, index: npt.NDArray[np.int64],
    normal: Floats, light: Light,
) -> _Seen:  # fmt: skip
    normal = np.where((normal * along).sum(1, keepdims=True) > 0, -normal, normal)
    place = origin + along * distance[:, None] + normal * 0.01
    semantic, reflectance, colour, glow = (
        surfaces(scenes, index, name) for name in ("semantic", "reflectance", "colour", "glow")
    )
    if light.lamps:
        glow = (glow + _lit_windows(surfaces(scenes, index, "panes"))) * np.float32(light.lamps)
    return _Seen(place, normal, along, distance, semantic, reflectance, colour, glow)


def _lit_windows(panes: npt.NDArray[np.int64]) -> Floats:
    """Light behind a quarter of the windows."""
    draw = np.modf(np.abs(np.sin(panes * 12.9898)) * 43758.5453)[0]
    return np.asarray(np.where((panes > 0) & (draw < 0.25), 0.45, 0.0), np.float32)


def _through_air(colour: Array, distance: Floats, light: Light) -> Array:
    """Light (N, 3) after its way through haze."""
    haze = 1 - np.exp(-distance * np.float32(light.haze))[:, None]
    return np.asarray(colour * (1 - haze) + np.array(light.air) * haze)


def _shade(seen: _Seen, scenes: Sequence[Scene], light: Light, lamps: Lamps | None) -> Array:
    """Lambertian light (N, 3) of sun, sky and lamps, what glows, and the gloss of glass, paint and wet roads."""
    wet = np.isin(seen.semantic, _WET)[:, None] & light.wet
    albedo = seen.colour**1.6 * _texture(seen.place, seen.semantic)[:, None] * np.where(wet, 0.55, 1.0)
    lit = _sunlight(seen, scenes, light) + (0.30 + 0.14 * seen.normal[:, 2:]) * np.array(light.ambient)
    if lamps:
        lit = lit + _lamplight(seen, scenes, lamps)
    # what a surface glows in is its own colour, a window's the yellow of a room
    room = np.where((seen.semantic == 50)[:, None], np.array([1.0, 0.78, 0.45]), seen.colour)
    glow = seen.glow[:, None] * room if light.lamps else 0.0
    return np.asarray(albedo * lit + glow + _gloss(seen, wet, light))


def _gloss(seen: _Seen, wet: npt.NDArray[np.bool_], light: Light) -> Array:
    """The sky in glass, and in wet roads at grazing angles (Schlick's form of Fresnel's reflection)."""
    cosine = np.abs((seen.along * seen.normal).sum(1, keepdims=True))
    mirror = seen.along + 2 * cosine * seen.normal
    grazing = (1 - cosine) ** 5
    pane = (seen.reflectance < 0.08) | is_glass(seen.colour)
    glass = pane[:, None] * np.clip(mirror[:, 2:] + 0.3, 0, 1) * (0.16 + 0.7 * grazing)
    film = wet * (0.04 + 0.5 * grazing)
    return np.asarray((glass + film) * np.array(light.horizon))


def _sunlight(seen: _Seen, scenes: Sequence[Scene], light: Light) -> Array:
    if light.direct < 0.01:
        return np.zeros((len(seen.place), 3))
    sun = np.array(light.sun, np.float32)
    facing = np.maximum(seen.normal @ sun, 0)
    rows = np.flatnonzero(facing > 0)
    shadow = np.zeros(len(facing), bool)
    shadow[rows] = _blocked(scenes, seen.place[rows], np.tile(sun, (len(rows), 1)))
    # leaves let some of the light through
    strength = np.where(shadow, 0.0, np.where(seen.semantic == 70, 0.35 + 0.5 * facing, facing))[:, None]
    return np.asarray(strength * light.direct * 0.85 * np.array([1 + light.warmth, 1.0, 1 - light.warmth]))


def _lamplight(seen: _Seen, scenes: Sequence[Scene], lamps: Lamps) -> Array:
    """Light of the lamps, each with shadows; signs send that of headlights back to where it came from."""
    total = np.zeros((len(seen.place), 3))
    for place, axis, power, narrow, near in zip(lamps.place, lamps.axis, lamps.power, lamps.narrow, lamps.near):
        way = (seen.place - place.astype(np.float32)).astype(np.float32)
        distance = np.linalg.norm(way, axis=1)
        way /= np.maximum(distance, 1e-3)[:, None]
        facing = np.maximum(-(way * seen.normal).sum(1), 0)
        facing = np.where(seen.semantic == 81, facing * (1 + 0.15 * narrow), facing)
        strength = np.maximum(way @ axis.astype(np.float32), 0) ** narrow * facing / np.maximum(distance, near) ** 2
        rows = np.flatnonzero(strength * power[0] > _FAINT)
        shadow = _blocked(scenes, seen.place[rows], -way[rows], distance[rows] - 0.4)
        total[rows[~shadow]] += strength[rows[~shadow], None] * power
    return total


def _blocked(
    scenes: Sequence[Scene], origins: Floats, directions: Floats, reach: Floats | None = None
) -> npt.NDArray[np.bool_]:
    """Whether something stands in the way of rays (N, 3), within a reach (N,) in metres or at all."""
    distance, index, _ = cast(scenes, np.ascontiguousarray(origins, np.float32), np.ascontiguousarray(directions))
    return np.asarray(index >= 0) if reach is None else np.asarray(distance < reach)


def _exposed(colour: Floats, light: Light, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """The picture that a camera makes of light (H, W, 3): glare around lamps, rain, exposure, noise, tone curve."""
    if light.lamps:
        colour = colour + _glare(colour)
    if light.rain:
        colour = _streaked(colour, light, rng)
    grain = rng.standard_normal(colour.shape, np.float32) * np.float32(light.grain)
    tone = np.clip(colour * np.float32(light.exposure) + grain, 0, 1) ** np.float32(1 / 1.9)
    return np.asarray(np.round(tone * 255), np.uint8)


def _glare(colour: Floats) -> Floats:
    """Light that the lens scatters around what is brighter than white."""
    bright = np.clip(colour - 1, 0, 6)
    wide = colour.shape[1] / 130
    return np.asarray(0.5 * ndimage.gaussian_filter(bright, (wide, wide, 0)), np.float32)


def _streaked(colour: Floats, light: Light, rng: np.random.Generator) -> Floats:
    """Falling drops, as short bright streaks."""
    height, width = colour.shape[:2]
    count, length = max(int(light.rain * height * width / 1e6), 1), max(height // 18, 2)
    top, left = rng.integers(-length, height, count), rng.integers(0, width, count)
    lean = rng.normal(0.06, 0.03, count)
    steps = np.arange(length)
    rows = top[:, None] + steps
    columns = np.round(left[:, None] + lean[:, None] * steps).astype(int)
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    alpha = np.zeros((height, width, 1), np.float32)
    alpha[rows[inside], columns[inside], 0] = 0.16
    return np.asarray(colour * (1 - alpha) + np.array(light.air, np.float32) * alpha)


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
