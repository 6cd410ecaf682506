"""A small street scene in numpy: road users that move, clutter that does not, and rays cast through it.

World frame: x, y, z in metres, z = 0 at the height of the sensor; the ground is flat.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

PERIOD = 0.1  # seconds between frames
GROUND = -1.73  # metres, height of the ground in the sensor frame
REACH = 80.0  # metres, longest horizontal distance of a return


@dataclass(frozen=True)
class Shape:
    """A kind of road user: its box and the blocks that fill it, as shares of the box along l, w, h."""

    size: tuple[float, float, float]  # length, width, height in metres
    speed: float  # metres per second, of those that move
    blocks: tuple[tuple[tuple[float, float], tuple[float, float], tuple[float, float]], ...]
    remission: float
    colour: tuple[float, float, float]


SHAPES = {
    "Car": Shape(
        (3.9, 1.65, 1.55),
        5.0,
        (((0, 1), (0, 1), (0, 0.6)), ((0.1, 0.65), (0.05, 0.95), (0.6, 1))),
        0.6,
        (0.8, 0.2, 0.2),
    ),
    "Pedestrian": Shape((0.7, 0.65, 1.75), 1.2, (((0, 1), (0, 1), (0, 1)),), 0.3, (0.2, 0.3, 0.9)),
    "Cyclist": Shape(
        (1.8, 0.65, 1.75), 3.0, (((0, 1), (0.3, 0.7), (0, 0.6)), ((0.25, 0.65), (0, 1), (0.5, 1))), 0.4, (0.9, 0.7, 0.1)
    ),
}
CLUTTER = Shape((1, 1, 1), 0.0, (((0, 1), (0, 1), (0, 1)),), 0.2, (0.45, 0.5, 0.45))
_HEADINGS, _SHARES = np.array([0.0, np.pi, np.pi / 2, -np.pi / 2]), (0.7, 0.2, 0.05, 0.05)  # most go our way
_GROUND_REMISSION, _GROUND_COLOUR, _SKY_COLOUR = 0.1, (0.35, 0.35, 0.35), (0.6, 0.75, 0.95)


@dataclass(frozen=True)
class Scene:
    """The objects of one sequence in the world frame at time 0, and the path of the sensor."""

    kinds: list[Shape]
    label: Array  # (M,) class number, -1 for clutter
    center: Array  # (M, 3)
    size: Array  # (M, 3) l, w, h
    yaw: Array  # (M,)
    velocity: Array  # (M, 2) m/s
    path: Array  # (T, 3) x, y, yaw of the sensor

    def pose(self, step: int) -> Array:
        """(4, 4) sensor -> world at a step."""
        x, y, yaw = self.path[step]
        pose = np.eye(4)
        pose[:2, :2] = rotation(yaw)
        pose[:2, 3] = x, y
        return pose

    def boxes(self, step: int) -> Array:
        """(M, 7) x, y, z, l, w, h, yaw in the sensor frame at a step."""
        x, y, yaw = self.path[step]
        place = self.center[:, :2] + self.velocity * step * PERIOD - (x, y)
        heading = np.mod(self.yaw - yaw + np.pi, 2 * np.pi) - np.pi
        return np.column_stack([place @ rotation(yaw), self.center[:, 2], self.size, heading])

    def seen_velocity(self, step: int) -> Array:
        """(M, 2) velocity over ground along the sensor's x and y axes."""
        return np.asarray(self.velocity @ rotation(self.path[step, 2]))


def rotation(yaw: float) -> Array:
    """(2, 2) matrix that turns counter-clockwise."""
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])


def draw_scene(shapes: list[Shape], steps: int, rng: np.random.Generator) -> Scene:
    """Two to five objects of each shape and some clutter that never touch each other, ahead of a moving sensor."""
    path = _path(steps, rng)
    wanted = [(label, shape) for label, shape in enumerate(shapes) for _ in range(rng.integers(2, 6))]
    found: list[tuple[int, Shape, Array, Array]] = []  # label, shape, box, velocity
    taken = np.zeros((0, steps, 2)), np.zeros(0)
    for label, shape in [*wanted, *[(-1, CLUTTER)] * 8]:
        for _ in range(20):
            box, velocity = _draw_object(label, shape, rng)
            places = box[:2] + velocity * np.arange(steps)[:, None] * PERIOD
            radius = float(np.hypot(box[3], box[4]) / 2)
            gaps = np.linalg.norm(taken[0] - places, axis=2).min(1) if len(found) else np.zeros(0)
            if (gaps > taken[1] + radius).all() and np.linalg.norm(places - path[:, :2], axis=1).min() > radius + 3:
                found.append((label, shape, box, velocity))
                taken = np.concatenate([taken[0], places[None]]), np.append(taken[1], radius)
                break
    labels, kinds, boxes, velocities = zip(*found, strict=True)
    box = np.stack(boxes)
    return Scene(list(kinds), np.array(labels), box[:, :3], box[:, 3:6], box[:, 6], np.stack(velocities), path)


def _path(steps: int, rng: np.random.Generator) -> Array:
    yaw = rng.uniform(-0.1, 0.1) * PERIOD * np.arange(steps)
    stride = rng.uniform(0, 4) * PERIOD * np.column_stack([np.cos(yaw), np.sin(yaw)])
    return np.column_stack([np.cumsum(stride, 0) - stride[0], yaw])


def _draw_object(label: int, shape: Shape, rng: np.random.Generator) -> tuple[Array, Array]:
    x = rng.uniform(7, 45)
    y = rng.uniform(-1, 1) * min(0.8 * x, 20)
    yaw = rng.choice(_HEADINGS, p=_SHARES) + rng.normal(0, 0.1)
    size = np.array(shape.size) * rng.normal(1, 0.02, 3)
    if label < 0:
        size = np.array([rng.uniform(0.2, 4), rng.uniform(0.2, 0.6), rng.uniform(0.5, 3)])
    moving = rng.random() < 0.5
    velocity = moving * shape.speed * rng.uniform(0.5, 1) * np.array([np.cos(yaw), np.sin(yaw)])
    return np.array([x, y, GROUND + size[2] / 2, *size, yaw]), velocity


@dataclass(frozen=True)
class Hits:
    """What rays (C columns, R rows) hit: metres along the horizontal, and which object (-1 ground, -2 nothing)."""

    distance: Array  # (C, R), inf for nothing
    object: Array  # (C, R)


def cast(azimuth: Array, slope: Array, boxes: Array, kinds: list[Shape], height: float = 0.0) -> Hits:
    """Follow rays from (0, 0, height) to the nearest surface.

    azimuth (C,) radians, the same for all rays of a column; slope (C, R) metres up per metre along the
    horizontal; boxes (M, 7) with their shapes.
    """
    owner, blocks = _blocks(boxes, kinds)
    enter, leave = _horizontal_interval(azimuth, blocks)
    block, column = np.nonzero((enter < leave) & (enter > 0))
    low, high = (blocks[block, 2] + sign * blocks[block, 5] / 2 - height for sign in (-1, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        crossings = np.stack([low[:, None], high[:, None]]) / slope[column]
        ground = np.where(slope < 0, (GROUND - height) / slope, np.inf)
    near = np.maximum(enter[block, column][:, None], crossings.min(0))
    far = np.minimum(leave[block, column][:, None], crossings.max(0))
    distance = np.full((len(blocks) + 1, *slope.shape), np.inf)
    distance[0] = ground
    distance[block + 1, column] = np.where(near < far, near, np.inf)
    first = distance.argmin(0)
    nearest = np.take_along_axis(distance, first[None], 0)[0]
    hit = np.concatenate([[-1], owner])[first]
    return Hits(np.where(nearest > REACH, np.inf, nearest), np.where(nearest > REACH, -2, hit))


def _blocks(boxes: Array, kinds: list[Shape]) -> tuple[Array, Array]:
    """Object number (P,) and box (P, 7) of every block of every object."""
    owner = np.array([number for number, kind in enumerate(kinds) for _ in kind.blocks], dtype=np.int64)
    shares = np.array([block for kind in kinds for block in kind.blocks], dtype=np.float64).reshape(-1, 3, 2)
    whole = boxes[owner]
    offset = (shares.mean(2) - 0.5) * whole[:, 3:6]
    cos, sin = np.cos(whole[:, 6]), np.sin(whole[:, 6])
    turned = np.column_stack([cos * offset[:, 0] - sin * offset[:, 1], sin * offset[:, 0] + cos * offset[:, 1]])
    center = whole[:, :3] + np.column_stack([turned, offset[:, 2]])
    return owner, np.column_stack([center, (shares[:, :, 1] - shares[:, :, 0]) * whole[:, 3:6], whole[:, 6]])


def _horizontal_interval(azimuth: Array, blocks: Array) -> tuple[Array, Array]:
    """Distances (P, C) at which each column of rays enters and leaves each block's footprint."""
    angle = azimuth[None] - blocks[:, 6:7]
    cos, sin = np.cos(blocks[:, 6]), np.sin(blocks[:, 6])
    x, y = blocks[:, 0], blocks[:, 1]
    origin = np.stack([-(cos * x + sin * y), sin * x - cos * y])  # the sensor in the block's frame
    with np.errstate(divide="ignore"):
        steps = 1 / np.stack([np.cos(angle), np.sin(angle)])
    half = blocks[:, 3:5].T / 2
    sides = np.stack([(side * half - origin)[:, :, None] * steps for side in (-1, 1)])
    return sides.min(0).max(0), sides.max(0).min(0)


def remission(hits: Hits, kinds: list[Shape]) -> Array:
    """Remission (C, R) 0..1 of the surfaces that were hit, 0 for nothing."""
    return np.array([kind.remission for kind in kinds] + [0.0, _GROUND_REMISSION])[hits.object]


def colours(hits: Hits, kinds: list[Shape]) -> Array:
    """Colour (C, R, 3) 0..1 of what was hit, darker with distance."""
    table = np.array([kind.colour for kind in kinds] + [_SKY_COLOUR, _GROUND_COLOUR])
    shade = np.exp(-np.where(np.isfinite(hits.distance), hits.distance, 0) / 60)
    return np.asarray(table[hits.object] * shade[..., None])
