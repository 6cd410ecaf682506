"""What stands in streets and gardens: trees, hedges, fences, lamps, signs, traffic lights, guard rails."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from lidarfw_town.ground import Hills
from lidarfw_town.mesh import (
    FENCE,
    FOLIAGE,
    OTHER,
    POLE,
    RAIL,
    SIGN,
    STRUCTURE,
    TRUNK,
    Array,
    Mesh,
    Surface,
    ball,
    box,
    join,
    leaves,
    quads,
    tube,
)  # fmt: skip
from lidarfw_town.streets import arc_length, resampled

_SIGN_COLOURS = ((0.85, 0.2, 0.18), (0.15, 0.3, 0.75), (0.9, 0.85, 0.2), (0.9, 0.9, 0.9))


_LANTERN = replace(POLE, colour=(0.95, 0.80, 0.55), glow=5.0)


def tree(rng: np.random.Generator) -> Mesh:
    """A tree: trunk, a few boughs, a porous crown."""
    height, crown = float(rng.uniform(4.5, 11)), float(rng.uniform(1.3, 2.8))
    fork = height * float(rng.uniform(0.12, 0.42))
    thick = 0.025 * height * float(rng.uniform(0.7, 1.2))
    green = FOLIAGE.varied(rng, 0.2)
    lean = rng.normal(0, 0.15, 2)
    parts = [tube((0, 0, -0.2), (*lean, height * 0.75), thick, TRUNK, 0.5)]
    for _ in range(4):
        side = rng.normal(0, crown * 0.4, 2)
        parts.append(tube((*lean * 0.5, fork), (*(lean + side), height * 0.8), thick * 0.4, TRUNK, 0.4, 4))
    middle = (fork + height) / 2
    count = int(150 * crown * (height - fork) / 4)
    parts.append(leaves((*lean, middle + 0.3), (crown, crown, (height - fork) / 2), count, 0.38, green, rng))
    return join(parts)


def copse(rng: np.random.Generator) -> Mesh:
    """Some trees that have grown together, with leaves down to the ground; coarse, to be seen from afar."""
    wide, height = float(rng.uniform(2.5, 4.5)), float(rng.uniform(5, 12))
    green = FOLIAGE.varied(rng, 0.2)
    return leaves((0, 0, height * 0.48), (wide, wide, height / 2), int(14 * wide * height), 0.8, green, rng)


def bush(rng: np.random.Generator) -> Mesh:
    """A bush without a trunk."""
    radius, height = float(rng.uniform(0.5, 1.3)), float(rng.uniform(0.5, 1.1))
    count = int(210 * radius)
    return leaves((0, 0, height * 0.8), (radius, radius, height), count, 0.3, FOLIAGE.varied(rng, 0.2), rng)


def thicket(line: Array, hills: Hills, lift: float, rng: np.random.Generator) -> Mesh:
    """Undergrowth along a polyline: bushes of many sizes, some of them grown into each other."""
    parts = []
    for place in resampled(line, 1.8) + rng.normal(0, 0.6, (len(resampled(line, 1.8)), 2)):
        if rng.random() < 0.8:
            height = float(hills.height(place)) + lift
            parts.append(_scrub(rng).placed(float(place[0]), float(place[1]), height, float(rng.uniform(0, 6.28))))
    return join(parts)


def _scrub(rng: np.random.Generator) -> Mesh:
    wide, deep, height = rng.uniform(0.7, 1.6), rng.uniform(0.6, 1.3), rng.uniform(0.6, 1.9)
    count = int(95 * (wide + deep) * height**0.5)
    return leaves((0, 0, height * 0.75), (wide, deep, height), count, 0.4, FOLIAGE.varied(rng, 0.2), rng)


def shed(rng: np.random.Generator) -> Mesh:
    """A garden shed, a garage, a container or a stack of goods: boxes of the sizes of vehicles, and others."""
    length, width, height = rng.uniform(1.0, 6.0), rng.uniform(0.8, 3.0), rng.uniform(0.9, 2.6)
    surface = replace(STRUCTURE, semantic=50, reflectance=float(rng.uniform(0.1, 0.5))).varied(rng, 0.25)
    roof = box((0, 0, height), (length + 0.2, width + 0.2, 0.08), surface.varied(rng))
    return join([box((0, 0, height / 2 - 0.1), (length, width, height + 0.2), surface), roof])


def lamp(rng: np.random.Generator) -> Mesh:
    """A street lamp; its arm points to +x."""
    height = float(rng.uniform(5, 8))
    parts = [
        tube((0, 0, -0.2), (0, 0, height), 0.09, POLE, 0.6),
        tube((0, 0, height), (1.5, 0, height + 0.2), 0.05, POLE),
    ]
    return join([*parts, box((1.7, 0, height + 0.2), (0.6, 0.25, 0.12), _LANTERN)])


def sign(rng: np.random.Generator) -> Mesh:
    """A road sign that faces +x."""
    face = replace(SIGN, colour=_SIGN_COLOURS[int(rng.integers(len(_SIGN_COLOURS)))])
    height = float(rng.uniform(2.2, 2.9))
    size = float(rng.uniform(0.5, 0.8))
    return join(
        [tube((0, 0, -0.2), (0, 0, height + size), 0.035, POLE), box((0.05, 0, height), (0.02, size, size), face)]
    )


def traffic_light(rng: np.random.Generator) -> Mesh:
    """A traffic light that faces +x; its arm points to +y."""
    reach = float(rng.uniform(2.0, 3.5))
    head = Surface(99, 0.15, (0.08, 0.1, 0.09))
    parts = [tube((0, 0, -0.2), (0, 0, 5.4), 0.1, POLE), tube((0, 0, 5.3), (0, reach, 5.3), 0.06, POLE)]
    for place in ((0.05, 0, 2.6), (0.05, reach, 4.9)):
        parts.append(box(place, (0.25, 0.3, 0.9), head))
        lights = ((0.9, 0.15, 0.1), (0.9, 0.6, 0.1), (0.1, 0.7, 0.3))
        for step, colour in zip((0.28, 0, -0.28), lights):
            pane = Surface(99, 0.3, colour, 3.0 if step > 0 else 0.0)  # the upper lamp is on
            parts.append(box((place[0] + 0.14, place[1], place[2] + step), (0.03, 0.2, 0.2), pane))
    return join(parts)


def oddment(rng: np.random.Generator) -> Mesh:
    """A bin, a bench, a cabinet or a bollard."""
    kind = int(rng.integers(4))
    if kind == 0:
        return tube((0, 0, 0), (0, 0, 0.95), 0.28, OTHER.varied(rng), 1.1, 10)
    if kind == 1:
        seat = [box((0, 0, 0.45), (1.5, 0.45, 0.06), FENCE), box((0, 0.22, 0.75), (1.5, 0.05, 0.35), FENCE)]
        return join([*seat, *(box((x, 0, 0.22), (0.06, 0.4, 0.44), OTHER) for x in (-0.6, 0.6))]).with_semantic(99)
    if kind == 2:
        return box((0, 0, 0.6), (1.0, 0.4, 1.2), OTHER.varied(rng))
    return tube((0, 0, 0), (0, 0, 0.9), 0.09, OTHER.varied(rng), 1.0, 8)


def shelter(rng: np.random.Generator) -> Mesh:
    """A bus stop shelter, open towards -y."""
    pane = replace(STRUCTURE, reflectance=0.12, colour=(0.5, 0.58, 0.62))
    posts = [tube((x, y, 0), (x, y, 2.4), 0.05, STRUCTURE) for x in (-2, 2) for y in (-0.6, 0.7)]
    return join([*posts, box((0, 0.7, 1.3), (4, 0.04, 1.9), pane), box((0, 0, 2.45), (4.4, 1.7, 0.1), STRUCTURE)])


def along(line: Array, hills: Hills, lift: float) -> Array:
    """A polyline on the ground (P, 3)."""
    return np.concatenate([line, hills.height(line)[:, None] + lift], 1)


def wall(line: Array, hills: Hills, height: float, thickness: float, surface: Surface, lift: float) -> Mesh:
    """A wall along a polyline (P, 2)."""
    places = along(line, hills, lift)
    parts = []
    for a, b in itertools.pairwise(places):
        step = b - a
        middle = (a + b) / 2 + (0, 0, height / 2 - 0.1)
        yaw = float(np.arctan2(step[1], step[0]))
        parts.append(box(middle, (float(np.hypot(step[0], step[1])) + 0.02, thickness, height + 0.2), surface, yaw))
    return join(parts)


def picket_fence(line: Array, hills: Hills, height: float, surface: Surface, lift: float) -> Mesh:
    """Upright slats with gaps between them, a rail, and posts; beams pass through."""
    total = float(arc_length(line)[-1])
    at = np.arange(0.08, total, 0.2)
    foot = along(_places(line, at), hills, lift)
    ahead = (_places(line, at + 0.05) - _places(line, at - 0.05)) / 0.1
    step = np.concatenate([ahead * 0.05, np.zeros((len(at), 1))], 1)
    up = np.array([0, 0, height])
    slats = quads(np.stack([foot - step, foot + step, foot + step + up, foot - step + up], 1), surface)
    spans = along(line, hills, lift)
    rails = [
        tube(a + (0, 0, z), b + (0, 0, z), 0.04, surface, 1, 4)
        for a, b in itertools.pairwise(spans)
        for z in (0.25 * height, 0.8 * height)
    ]
    return join([slats, *rails])


def hedge(line: Array, hills: Hills, height: float, lift: float, rng: np.random.Generator) -> Mesh:
    """A hedge: leaf cards in a long block around an opaque heart."""
    green = FOLIAGE.varied(rng, 0.2)
    places = along(line, hills, lift)
    parts = []
    for a, b in itertools.pairwise(places):
        length = float(np.linalg.norm(b - a))
        yaw = float(np.arctan2(b[1] - a[1], b[0] - a[0]))
        cards = leaves(
            (0, 0, height / 2), (length / 2, 0.32, height / 2), int(34 * length * height), 0.27, green, rng, block=True
        )
        heart = box((0, 0, height * 0.42), (length, 0.25, height * 0.8), green)
        parts.append(join([cards, heart]).moved(_turned(yaw), (a + b) / 2))
    return join(parts)


def _turned(yaw: float) -> Array:
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def guard_rail(line: Array, hills: Hills) -> Mesh:
    """A steel rail on posts every 4 m."""
    places = along(line, hills, 0.0)
    rails = [wall(line, hills, 0.32, 0.06, RAIL, 0.5)]
    at = np.arange(0, float(arc_length(line)[-1]), 4.0)
    rails += [box(p + (0, 0, 0.35), (0.1, 0.1, 0.8), RAIL) for p in along(_places(line, at), hills, 0.0)]
    return join(rails) if len(places) else join([])


def gantry(span: float, rng: np.random.Generator) -> Mesh:
    """A sign bridge of that span along y, its panels facing -x."""
    panel = Surface(81, 1.3, (0.1, 0.25, 0.65))
    posts = [tube((0, y, -0.3), (0, y, 7), 0.2, POLE, 1, 8) for y in (-span / 2, span / 2)]
    panels = [box((-0.2, y, 6.4), (0.05, 3.5, 2.0), panel) for y in rng.uniform(-0.3, 0.3, 2) * span]
    return join([*posts, box((0, 0, 6.2), (0.3, span, 0.5), POLE), *panels])


def boulder(rng: np.random.Generator) -> Mesh:
    """A stone in the grass."""
    radii = rng.uniform(0.2, 0.6, 3)
    return ball((0, 0, 0.1), radii, replace(STRUCTURE, semantic=99).varied(rng))


def _places(line: Array, at: Array) -> Array:
    length = arc_length(line)
    return np.stack([np.interp(at, length, line[:, 0]), np.interp(at, length, line[:, 1])], 1)
