"""Triangle soup with what the sensors need of every surface: class, LiDAR reflectance, colour."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import trimesh

Array = npt.NDArray[np.float64]
Vector = Sequence[float] | npt.NDArray[np.floating]


@dataclass(frozen=True)
class Surface:
    """A SemanticKITTI class id, the LiDAR reflectance (1 and above: retro-reflective), and the albedo, RGB 0..1.

    `glow` is the light that a lamp sends out where lamps are on, relative to a white surface in the sun.
    """

    semantic: int
    reflectance: float
    colour: tuple[float, float, float]
    glow: float = 0.0

    def varied(self, rng: np.random.Generator, amount: float = 0.12) -> Surface:
        """The same surface with another shade, and independently of that another reflectance."""
        shade = rng.normal(1, amount) + rng.normal(0, amount / 3, 3)
        red, green, blue = np.clip(np.array(self.colour) * shade, 0.01, 1).tolist()
        reflectance = float(np.clip(self.reflectance * rng.normal(1, amount), 0.01, 2))
        return replace(self, reflectance=reflectance, colour=(red, green, blue))


ROAD = Surface(40, 0.28, (0.30, 0.30, 0.31))
PARKING = Surface(44, 0.33, (0.38, 0.37, 0.36))
PAVEMENT = Surface(48, 0.33, (0.52, 0.50, 0.47))
KERB = Surface(48, 0.36, (0.60, 0.59, 0.57))
BUILDING = Surface(50, 0.45, (0.70, 0.62, 0.52))
ROOF = Surface(50, 0.30, (0.42, 0.22, 0.17))
GLASS = Surface(50, 0.04, (0.20, 0.26, 0.32))
FENCE = Surface(51, 0.36, (0.42, 0.33, 0.24))
RAIL = Surface(51, 0.45, (0.62, 0.64, 0.66))
STRUCTURE = Surface(52, 0.40, (0.55, 0.54, 0.52))
MARKING = Surface(60, 0.55, (0.90, 0.90, 0.88))
FOLIAGE = Surface(70, 0.36, (0.22, 0.38, 0.14))
TRUNK = Surface(71, 0.34, (0.33, 0.26, 0.20))
TERRAIN = Surface(72, 0.37, (0.34, 0.44, 0.20))
POLE = Surface(80, 0.22, (0.45, 0.47, 0.48))
SIGN = Surface(81, 0.6, (0.85, 0.20, 0.18))
OTHER = Surface(99, 0.38, (0.25, 0.33, 0.30))


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles (T, 3, 3) in metres, and class, reflectance, colour (T, 3), instance and glow of each.

    The instance is the track id of a movable object, 0 for all else.
    """

    triangles: npt.NDArray[np.float32]
    semantic: npt.NDArray[np.uint16]
    reflectance: npt.NDArray[np.float32]
    colour: npt.NDArray[np.float32]
    instance: npt.NDArray[np.int32]
    glow: npt.NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.triangles)

    @functools.cached_property
    def corners(self) -> Array:
        """Corners (8, 3) of the upright box around the mesh, the lowest first, the highest last."""
        places = self.triangles.reshape(-1, 3).astype(np.float64)
        return np.stack(np.meshgrid(*zip(places.min(0), places.max(0)), indexing="ij"), -1).reshape(8, 3)

    @functools.cached_property
    def panes(self) -> npt.NDArray[np.int64]:
        """Numbers (T,) of the windows of houses, each of two triangles that follow each other; -1 for all else."""
        glass = (self.semantic == GLASS.semantic) & is_glass(self.colour)
        at = np.arange(len(self))
        begins = glass & ~np.concatenate([[False], glass[:-1]])
        first = np.maximum.accumulate(np.where(begins, at, 0))
        return np.where(glass, first + (at - first) // 2, -1)

    def placed(self, x: float, y: float, z: float, yaw: float) -> Mesh:
        """The mesh turned by `yaw` about z and moved."""
        cosine, sine = np.cos(yaw), np.sin(yaw)
        turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
        return replace(self, triangles=(self.triangles @ turn.T + (x, y, z)).astype(np.float32))

    def moved(self, rotation: Array, place: Array) -> Mesh:
        """The mesh turned by a matrix (3, 3) and moved."""
        return replace(self, triangles=(self.triangles @ rotation.T + place).astype(np.float32))

    def with_instance(self, instance: int) -> Mesh:
        """The mesh as the object of that number."""
        return replace(self, instance=np.full(len(self), instance, np.int32))

    def without_glow(self) -> Mesh:
        """The mesh with its lamps off."""
        return replace(self, glow=np.zeros(len(self), np.float32))

    def with_semantic(self, semantic: int) -> Mesh:
        """The mesh with one class for all of it."""
        return replace(self, semantic=np.full(len(self), semantic, np.uint16))

    def fitted(self, length: float, width: float, height: float) -> Mesh:
        """The mesh stretched to that size, centred in x and y, standing on z = 0."""
        low, high = self.triangles.min((0, 1)), self.triangles.max((0, 1))
        scale = np.array([length, width, height]) / (high - low)
        origin = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
        return replace(self, triangles=((self.triangles - origin) * scale).astype(np.float32))


def is_glass(colour: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """Whether colours (N, 3) are those of the panes of houses, which are never varied."""
    return np.asarray((colour == np.array(GLASS.colour, np.float32)).all(1))


def join(meshes: Sequence[Mesh]) -> Mesh:
    """All triangles of the meshes, in their order."""
    if not meshes:
        return of(np.zeros((0, 3, 3)), ROAD)
    names = ("triangles", "semantic", "reflectance", "colour", "instance", "glow")
    return Mesh(*(np.concatenate([getattr(mesh, name) for mesh in meshes]) for name in names))


def of(triangles: npt.ArrayLike, surface: Surface) -> Mesh:
    """Triangles (T, 3, 3) of one surface."""
    table = np.asarray(triangles, np.float32).reshape(-1, 3, 3)
    count = len(table)
    return Mesh(
        table,
        np.full(count, surface.semantic, np.uint16),
        np.full(count, surface.reflectance, np.float32),
        np.full((count, 3), surface.colour, np.float32),
        np.zeros(count, np.int32),
        np.full(count, surface.glow, np.float32),
    )


def quads(corners: npt.ArrayLike, surface: Surface) -> Mesh:
    """Quadrilaterals (Q, 4, 3), each two triangles."""
    table = np.asarray(corners, np.float64).reshape(-1, 4, 3)
    return of(table[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3), surface)


def box(center: Vector, size: Vector, surface: Surface, yaw: float = 0.0) -> Mesh:
    """A box of full extents `size` about `center`."""
    return of(_unit_box() * np.array(size), surface).placed(center[0], center[1], center[2], yaw)


@functools.cache
def _unit_box() -> Array:
    return np.array(trimesh.creation.box().triangles)


@functools.cache
def _unit_tube(sections: int) -> Array:
    """Open cylinder of radius 1 from z = 0 to 1, with its upper lid."""
    solid = trimesh.creation.cylinder(radius=1, segment=[[0, 0, 0], [0, 0, 1]], sections=sections)
    triangles = np.array(solid.triangles)
    return np.asarray(triangles[(triangles[..., 2] > 1e-6).any(1)])


@functools.cache
def _unit_ball() -> Array:
    return np.array(trimesh.creation.icosphere(subdivisions=1).triangles)


def ball(center: Vector, radii: Vector, surface: Surface) -> Mesh:
    """An ellipsoid."""
    return of(_unit_ball() * np.array(radii) + np.array(center), surface)


def tube(start: Vector, end: Vector, radius: float, surface: Surface, taper: float = 1.0, sections: int = 6) -> Mesh:
    """A round bar between two places, `taper` times as thick at its end."""
    a, along = np.asarray(start, float), np.asarray(end, float) - start
    x, y, z = (along / max(math.hypot(*along), 1e-9)).tolist()
    # at a right angle to the axis: its cross product with y, or with x where it is near to y
    side = np.array((-z, 0.0, x) if abs(y) < 0.9 else (0.0, z, -y)) / (
        math.hypot(x, z) if abs(y) < 0.9 else math.hypot(y, z)
    )
    other = (y * side[2] - z * side[1], z * side[0] - x * side[2], x * side[1] - y * side[0])
    unit = _unit_tube(sections).copy()
    unit[..., :2] *= radius * (1 + (taper - 1) * unit[..., 2:])
    return of(unit @ np.array([side, other, along]) + a, surface)


def leaves(
    center: Vector, radii: Vector, count: int, size: float, surface: Surface,
    rng: np.random.Generator, *, block: bool = False,
) -> Mesh:  # fmt: skip
    """Porous foliage: `count` leaf cards of about `size` metres at random in an ellipsoid, or in a box with `block`.

    Cards are denser near the surface, as real crowns are; beams pass between them.
    """
    if block:
        places = rng.uniform(-1, 1, (count, 3))
    else:
        direction = rng.normal(size=(count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        places = direction * rng.uniform(0.1, 1, (count, 1)) ** 0.5
    a, b = rng.normal(size=(2, count, 3)) * size * 0.55
    middle = places * np.array(radii) + np.array(center)
    corners = np.stack([middle - a, middle + b, middle + a], 1)
    shade = rng.uniform(0.75, 1.25, (count, 1)).astype(np.float32)
    mesh = of(corners, surface)
    gloss = rng.uniform(0.7, 1.3, count).astype(np.float32)
    return replace(mesh, colour=np.clip(mesh.colour * shade, 0, 1), reflectance=mesh.reflectance * gloss)
