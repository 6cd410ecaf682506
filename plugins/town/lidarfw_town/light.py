"""Light and weather: the sun or the lamps of a drive, the air, and what they do to pictures.

The unit of light is what a white surface sends back in full sun.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from lidarfw_town.beams import Body
from lidarfw_town.mesh import Array
from lidarfw_town.sensors import Scene, Weather

Colour = tuple[float, float, float]

WEATHER = {"clear": Weather(), "rain": Weather(0.003, wet=True), "fog": Weather(0.015), "night": Weather()}

_PER_BOX = 12  # triangles: every lamp is a box
_STREET_POWER, _HEADLIGHT_POWER = 30.0, 600.0
_LAMPS_FROM = 90.0  # metres from the camera within which lamps light the street
_OWN_HEADLIGHTS = ((1.8, 0.6), (1.8, -0.6))  # ahead and left of the LiDAR, metres
_OWN_HEIGHT = 0.68  # metres of the own headlights above the ground


@dataclass(frozen=True)
class Light:
    """The light of a drive.

    `sun` is the direction to it, `direct` its strength; `ambient` the light of the sky; `zenith` and `horizon` its
    colours; `air` the colour of the haze and `haze` its extinction per metre; `grain` the noise of the camera; `lamps`
    how strong lamps are, 0 where they are off; `wet` whether the road mirrors the sky; `rain`: streaks per megapixel.
    """

    sun: Colour
    exposure: float
    warmth: float
    direct: float = 1.0
    ambient: Colour = (0.92, 1.0, 1.12)
    zenith: Colour = (0.25, 0.45, 0.80)
    horizon: Colour = (0.78, 0.85, 0.92)
    air: Colour = (0.72, 0.78, 0.86)
    haze: float = 1 / 420
    grain: float = 0.008
    lamps: float = 0.0
    wet: bool = False
    rain: int = 0


def light_of(seed: int, traversal: int, weather: str = "clear") -> Light:
    """The light of a traversal: another hour, other clouds and another exposure each time."""
    rng = np.random.default_rng((seed, 6, traversal))
    height, azimuth = np.radians(rng.uniform(12, 60)), rng.uniform(0, 2 * np.pi)
    x, y, z = np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height)
    # the lower the sun, the warmer and the weaker it is
    low = float(np.clip((0.7 - z) / 0.5, 0, 1))
    light = Light((float(x), float(y), float(z)), float(rng.uniform(0.8, 1.3)), 0.03 + 0.22 * low, 1 - 0.25 * low)
    clouds = float(rng.uniform(0, 1)) ** 2
    return _IN[weather](_clouded(light, clouds))


def _clouded(light: Light, clouds: float) -> Light:
    """Less sun and a greyer, brighter sky, the more clouds (0..1) there are."""
    return replace(
        light,
        direct=light.direct * (1 - 0.9 * clouds),
        warmth=light.warmth * (1 - clouds),
        ambient=_mixed(light.ambient, (1.35, 1.4, 1.45), clouds),
        zenith=_mixed(light.zenith, (0.66, 0.70, 0.75), clouds),
        horizon=_mixed(light.horizon, (0.82, 0.84, 0.86), clouds),
    )


def _mixed(first: Colour, second: Colour, share: float) -> Colour:
    red, green, blue = (a * (1 - share) + b * share for a, b in zip(first, second))
    return red, green, blue


def _rainy(light: Light) -> Light:
    grey = replace(_clouded(light, 1.0), zenith=(0.50, 0.53, 0.57), horizon=(0.66, 0.68, 0.71), wet=True)
    return replace(grey, ambient=(1.15, 1.2, 1.27), air=(0.62, 0.65, 0.69), haze=0.009, lamps=0.25, rain=900)


def _foggy(light: Light) -> Light:
    grey, white = _clouded(light, 0.97), (0.76, 0.78, 0.80)
    return replace(
        grey, zenith=white, horizon=white, air=white, haze=0.028, exposure=light.exposure * 0.9, lamps=0.3, wet=True
    )


def _dark(light: Light) -> Light:
    """A moonless night: the camera exposes longer and still is noisy."""
    glow, black = (0.030, 0.026, 0.028), (0.006, 0.008, 0.016)
    dark = replace(light, direct=0.0, ambient=(0.055, 0.055, 0.065), zenith=black, horizon=glow, air=glow, lamps=1.0)
    return replace(dark, exposure=light.exposure * 1.6, grain=0.012)


_IN: dict[str, Callable[[Light], Light]] = {"clear": lambda light: light, "rain": _rainy, "fog": _foggy, "night": _dark}


@dataclass(frozen=True, eq=False)
class Lamps:
    """Lamps: places (L, 3) in the world, axes (L, 3), power (L, 3) RGB, narrowness of the beam (L,), near range (L,).

    At d metres, off the axis by an angle a, a lamp gives power * cos(a) ** narrow / max(d, near) ** 2; the lens of a
    headlight spreads what falls close by.
    """

    place: Array
    axis: Array
    power: Array
    narrow: Array
    near: Array

    def within(self, place: Array) -> Lamps:
        """The lamps that matter to a camera at a place."""
        near = np.linalg.norm(self.place - place, axis=1) < _LAMPS_FROM
        return Lamps(*(getattr(self, field.name)[near] for field in fields(self)))


def lamps_of(still: Scene, bodies: Iterable[Body], pose: Array, height: float) -> Lamps:
    """Street lamps, headlights of moving vehicles, and those of the own one.

    `pose` (4, 4) is that of the LiDAR, `height` its own above the ground.
    """
    own = np.array([(*place, _OWN_HEIGHT - height) for place in _OWN_HEADLIGHTS])
    groups = [_street_lamps(still), _headlights(own @ pose[:3, :3].T + pose[:3, 3], pose[:3, :3])]
    for body in bodies:
        glow = _white(body.mesh.glow, body.mesh.colour)
        if glow.any():
            groups.append(_headlights(_boxes(body.mesh.triangles[glow]) @ body.turn.T + body.place, body.turn))
    return Lamps(*(np.concatenate([getattr(g, field.name) for g in groups]) for field in fields(Lamps)))


@functools.lru_cache(maxsize=4)
def _street_lamps(still: Scene) -> Lamps:
    mesh = still.mesh
    chosen = (mesh.glow > 0) & (mesh.semantic == 80)
    place = _boxes(mesh.triangles[chosen]) - (0, 0, 0.1)
    return _alike(place, np.array([0.0, 0, -1]), _STREET_POWER * np.array([1.0, 0.80, 0.52]), 1.0, 0.7)


def _headlights(place: Array, turn: Array) -> Lamps:
    axis = turn @ np.array([0.997, 0.0, -0.075])
    return _alike(place + 0.1 * axis, axis, _HEADLIGHT_POWER * np.array([1.0, 0.97, 0.88]), 28.0, 14.0)


def _alike(place: Array, axis: Array, power: Array, narrow: float, near: float) -> Lamps:
    count = len(place)
    values = (np.tile(axis, (count, 1)), np.tile(power, (count, 1)), np.full(count, narrow), np.full(count, near))
    return Lamps(place, *values)


def _white(glow: npt.NDArray[np.float32], colour: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    return np.asarray((glow > 0) & (colour.min(1) > 0.5))


def _boxes(triangles: npt.NDArray[np.float32]) -> Array:
    """Middles (B, 3) of boxes, from all their triangles."""
    return np.asarray(triangles.reshape(-1, _PER_BOX, 3, 3).mean((1, 2)), np.float64)
