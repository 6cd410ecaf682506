"""The lie of the land, and surfaces that follow it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import shapely
from shapely.geometry.base import BaseGeometry

from lidarfw_town.mesh import Array, Mesh, Surface, join, of, quads

KERB_HEIGHT = 0.12  # metres
_TILE = 9.0  # metres: how far a triangle may stray from the curved ground


class Hills:
    """A smooth height field: long waves, slopes up to about 3 %."""

    def __init__(self, rng: np.random.Generator) -> None:
        angle = rng.uniform(0, 2 * np.pi, 3)
        length = rng.uniform(180, 420, 3)
        self._waves = np.stack([np.cos(angle), np.sin(angle)], 1) * (2 * np.pi / length)[:, None]
        self._phase = rng.uniform(0, 2 * np.pi, 3)
        self._height = rng.uniform(0.002, 0.009, 3) * length / (2 * np.pi)

    def height(self, xy: npt.ArrayLike) -> Array:
        """Metres above zero (...,) at places (..., 2)."""
        return np.asarray(np.sin(np.asarray(xy) @ self._waves.T + self._phase) @ self._height)

    def slope(self, xy: npt.ArrayLike) -> Array:
        """Rise per metre (..., 2) along x and y."""
        return np.asarray((np.cos(np.asarray(xy) @ self._waves.T + self._phase) * self._height) @ self._waves)


def pave(area: BaseGeometry, hills: Hills, surface: Surface, rng: np.random.Generator, lift: float = 0.0) -> Mesh:
    """An area as triangles on the ground, raised by `lift`; shades vary from tile to tile."""
    if area.is_empty:
        return join([])
    pieces = [
        fine for coarse in _cut(area, 8 * _TILE) for fine in _cut(coarse, _TILE)
    ]  # twice: large areas are slow to cut
    triangles = []
    for piece in shapely.get_parts(pieces):
        if piece.geom_type == "Polygon" and piece.area > 1e-3:
            triangles += list(shapely.get_parts(shapely.constrained_delaunay_triangles(piece)))
    if not triangles:
        return join([])
    corners = shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3]
    clockwise = np.cross(_third(corners[:, 1] - corners[:, 0]), _third(corners[:, 2] - corners[:, 0]))[:, 2] < 0
    corners[clockwise] = corners[clockwise][:, ::-1]
    flat = np.concatenate([corners, hills.height(corners)[..., None] + lift], -1)
    mesh = of(flat, surface)
    shade = rng.normal(1, 0.04, (len(mesh), 1)).astype(np.float32)
    return replace(mesh, colour=np.clip(mesh.colour * shade, 0, 1))


def _third(flat: Array) -> Array:
    return np.concatenate([flat, np.zeros((len(flat), 1))], 1)


def _cut(area: BaseGeometry, size: float) -> list[BaseGeometry]:
    """The parts of an area in square tiles of that size."""
    x0, y0, x1, y1 = np.floor(np.array(area.bounds) / size)
    x, y = (grid.ravel() * size for grid in np.meshgrid(np.arange(x0, x1 + 1), np.arange(y0, y1 + 1), indexing="ij"))
    pieces = shapely.intersection(area, shapely.box(x, y, x + size, y + size))
    return list(pieces[~shapely.is_empty(pieces)])


def kerbs(area: BaseGeometry, hills: Hills, surface: Surface, height: float = KERB_HEIGHT) -> Mesh:
    """Upright faces along the border of an area, from the ground up."""
    walls = []
    for ring in shapely.get_parts(shapely.boundary(shapely.segmentize(area, 4.0))):
        line = shapely.get_coordinates(ring)
        low = np.concatenate([line, hills.height(line)[:, None]], 1)
        high = low + (0, 0, height)
        walls.append(quads(np.stack([low[:-1], low[1:], high[1:], high[:-1]], 1), surface))
    return join(walls)
