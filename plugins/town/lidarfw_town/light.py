"""Weather and light: what they do to the beams of the LiDAR and to pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Colour = tuple[float, float, float]

WEATHER = {"clear": 0.0, "rain": 0.003, "fog": 0.015, "night": 0.0}  # extinction of a LiDAR's beams per metre


@dataclass(frozen=True)
class Light:
    """The light of a drive, relative to a white surface in the sun.

    `sun` is the direction to it, `direct` its strength; `ambient` the light of the sky; `zenith` and `horizon` its
    colours; `air` the colour of the haze and `haze` its extinction per metre; `grain` the noise of the camera.
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


def light_of(seed: int, traversal: int, weather: str = "clear") -> Light:
    """The light of a traversal: another hour and another exposure each time."""
    rng = np.random.default_rng((seed, 6, traversal))
    height, azimuth = np.radians(rng.uniform(22, 60)), rng.uniform(0, 2 * np.pi)
    x, y, z = np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height)
    sun = (float(x), float(y), float(z))
    return Light(sun, float(rng.uniform(0.85, 1.2)), float(rng.uniform(0, 0.12)))
