"""Houses: facades with recessed windows, ledges, doors, and flat or gabled roofs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarfw_town.mesh import BUILDING, GLASS, ROOF, Array, Mesh, Surface, box, join, of, quads

_FACADES = ((0.78, 0.70, 0.58), (0.66, 0.36, 0.28), (0.82, 0.81, 0.77), (0.60, 0.60, 0.62), (0.72, 0.62, 0.42))
_DEPTH = 0.18  # metres that windows stand back


def house(width: float, depth: float, rng: np.random.Generator) -> Mesh:
    """A house about the origin, `width` along x and `depth` along y, its front towards -y."""
    storeys = int(rng.choice([1, 2, 2, 3, 3, 4, 5], p=[0.1, 0.2, 0.2, 0.2, 0.1, 0.1, 0.1]))
    height = storeys * float(rng.uniform(2.7, 3.3)) + 0.6
    wall = replace(BUILDING, colour=_FACADES[int(rng.integers(len(_FACADES)))]).varied(rng)
    corners = np.array([[-width, -depth], [width, -depth], [width, depth], [-width, depth]]) / 2
    parts = []
    for number in range(4):
        a, b = corners[number], corners[(number + 1) % 4]
        plain = number in (1, 3) and rng.random() < 0.5
        parts.append(_facade(a, b, height, 0 if plain else storeys, wall, rng))
    parts.append(_roof(width, depth, height, rng))
    parts += _extras(width, depth, height, storeys, wall, rng)
    return join(parts)


def _facade(a: Array, b: Array, height: float, storeys: int, wall: Surface, rng: np.random.Generator) -> Mesh:
    """A wall from a to b (outside at its right) with a grid of windows set back."""
    length = float(np.linalg.norm(b - a))
    bays = max(int(length / rng.uniform(2.4, 3.6)), 1) if storeys else 0
    across = _edges(length, bays, float(rng.uniform(0.35, 0.5)))
    upward = 0.3 + _edges(height - 0.6, storeys, float(rng.uniform(0.4, 0.55)))
    upward[[0, -1]] = -1.0, height
    s0, z0 = (grid.ravel() for grid in np.meshgrid(across[:-1], upward[:-1], indexing="ij"))
    s1, z1 = (grid.ravel() for grid in np.meshgrid(across[1:], upward[1:], indexing="ij"))
    column, row = np.meshgrid(np.arange(len(across) - 1), np.arange(len(upward) - 1), indexing="ij")
    window = ((column % 2 == 1) & (row % 2 == 1)).ravel()
    ahead = (b - a) / length
    inward = np.array([-ahead[1], ahead[0]])

    def corner(s: Array, z: Array, back: float) -> Array:
        flat = a + s[:, None] * ahead + back * inward
        return np.concatenate([flat, z[:, None]], 1)

    front, rear = (
        np.stack([corner(s0, z0, d), corner(s1, z0, d), corner(s1, z1, d), corner(s0, z1, d)], 1) for d in (0.0, _DEPTH)
    )
    outer, inner = front[window], rear[window]
    reveals = [
        np.stack([outer[:, i], outer[:, j], inner[:, j], inner[:, i]], 1) for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))
    ]
    return join([quads(front[~window], wall), quads(np.concatenate(reveals), wall), _windows(inner, rng)])


def _windows(corners: Array, rng: np.random.Generator) -> Mesh:
    """Panes; behind most of them something stands or hangs that beams come back from."""
    mesh = quads(corners, GLASS)
    behind = np.repeat(
        np.where(rng.random(len(corners)) < 0.85, rng.uniform(0.2, 0.5, len(corners)), GLASS.reflectance), 2
    )
    return replace(mesh, reflectance=behind.astype(np.float32))


def _edges(length: float, count: int, share: float) -> Array:
    """Borders of `count` openings, each `share` of its bay, from 0 to `length`."""
    if not count:
        return np.array([0.0, length])
    bay = length / count
    starts = (np.arange(count) + (1 - share) / 2) * bay
    return np.concatenate([[0.0], np.stack([starts, starts + share * bay], 1).ravel(), [length]])


def _roof(width: float, depth: float, height: float, rng: np.random.Generator) -> Mesh:
    surface = ROOF.varied(rng, 0.25)
    if rng.random() < 0.35:
        return box((0, 0, height + 0.15), (width + 0.3, depth + 0.3, 0.3), surface)
    x, y, top = width / 2 + 0.3, depth / 2 + 0.5, height + depth * float(rng.uniform(0.25, 0.5))
    low = np.array([[-x, -y, height], [x, -y, height], [x, y, height], [-x, y, height]])
    ridge = np.array([[-x, 0, top], [x, 0, top]])
    slopes = quads([[low[0], low[1], ridge[1], ridge[0]], [low[2], low[3], ridge[0], ridge[1]]], surface)
    return join([slopes, of([[low[1], low[2], ridge[1]], [low[3], low[0], ridge[0]]], BUILDING)])


def _extras(
    width: float, depth: float, height: float, storeys: int, wall: Surface, rng: np.random.Generator
) -> list[Mesh]:
    """A plinth, a step before the door, and on some houses ledges, balconies, a bay, a chimney."""
    front = -depth / 2
    door = float(rng.uniform(-0.3, 0.3)) * width
    parts = [box((0, front, 0.1), (width + 0.08, 0.1, 0.8), wall), box((door, front - 0.4, 0.0), (1.4, 0.8, 0.3), wall)]
    parts.append(box((door, front - 0.02, 1.05), (1.0, 0.1, 2.1), replace(ROOF, reflectance=0.2)))
    if rng.random() < 0.5:
        parts += [box((0, front, z), (width, 0.16, 0.14), wall) for z in np.arange(1, storeys) * height / storeys]
    if storeys > 1 and rng.random() < 0.4:
        places = rng.uniform(-0.35, 0.35, 2) * width
        parts += [box((x, front - 0.5, height / storeys + 0.5), (2.2, 1.0, 1.0), wall) for x in places]
    if rng.random() < 0.3:
        parts.append(box((-width * 0.3, front - 0.45, height * 0.35), (2.6, 0.9, height * 0.7), wall))
    if rng.random() < 0.5:
        parts.append(box((width * 0.25, 0, height + depth * 0.35), (0.7, 0.7, depth * 0.35), wall))
    return parts
