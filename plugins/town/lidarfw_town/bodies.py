"""Shapes of what moves: cars, vans, trucks, buses, people, cyclists, motorcyclists.

Every body is centred in x and y, stands on z = 0, looks along +x and fills its length, width and height exactly.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidarfw_town.mesh import Array, Mesh, Surface, ball, box, join, of, quads, tube

_PAINTS = ((0.08, 0.08, 0.09), (0.75, 0.76, 0.78), (0.9, 0.9, 0.9), (0.45, 0.47, 0.5), (0.12, 0.18, 0.4),
           (0.55, 0.08, 0.08), (0.15, 0.3, 0.2), (0.65, 0.55, 0.35))  # fmt: skip
_CLOTHES = (
    (0.1, 0.1, 0.12),
    (0.6, 0.15, 0.15),
    (0.2, 0.3, 0.55),
    (0.75, 0.72, 0.65),
    (0.3, 0.4, 0.25),
    (0.85, 0.5, 0.1),
)
PANE = Surface(10, 0.03, (0.07, 0.09, 0.11))  # beams pass it
_DIRTY = 0.06  # reflectance of the panes that send beams back
TYRE = Surface(10, 0.08, (0.05, 0.05, 0.05))
PLATE = Surface(10, 1.7, (0.85, 0.85, 0.75))
HEADLAMP = Surface(10, 0.7, (0.9, 0.9, 0.85), 6.0)
TAIL_LAMP = Surface(10, 0.9, (0.6, 0.05, 0.05), 1.5)


_ROUNDING = 0.16  # share of the width that a body loses at its two ends


@dataclass(frozen=True)
class Kind:
    """A class of movable object: KITTI's name, SemanticKITTI's ids standing and moving, cruise speed in m/s."""

    name: str
    semantic: int
    moving: int
    speed: float


KINDS = {
    "car": Kind("Car", 10, 252, 12.5),
    "van": Kind("Van", 10, 252, 11.5),
    "truck": Kind("Truck", 18, 258, 10.5),
    "bus": Kind("Misc", 13, 257, 10.0),
    "pedestrian": Kind("Pedestrian", 30, 254, 1.35),
    "cyclist": Kind("Cyclist", 31, 253, 4.8),
    "motorcyclist": Kind("Misc", 32, 255, 11.5),
}


@dataclass(frozen=True)
class Outline:
    """The side view of a body as stations from tail to nose: (x, belt, top, half width at the top), in shares 0..1.

    `low` is the ground clearance as a share of the height. Between belt and top there is glass where `glazed` says so.
    """

    stations: tuple[tuple[float, float, float, float], ...]
    low: float
    glazed: tuple[bool, ...]  # by gap between two stations
    wheels: tuple[float, ...]  # places of the axles along x, shares
    wheel: float  # radius in metres

    def varied(self, rng: np.random.Generator) -> Outline:
        """The outline of another make: its roof, belt and bonnet a little elsewhere."""
        table = np.array(self.stations)
        table[1:-1, 0] += rng.normal(0, 0.012, len(table) - 2)
        table[:, 1:] += rng.normal(0, 0.012, 3) + rng.normal(0, 0.008, table[:, 1:].shape)
        table[:, 0] = np.maximum.accumulate(np.clip(table[:, 0], 0, 1))
        table[:, 2] = np.maximum(table[:, 2], table[:, 1] + 0.03)
        return replace(self, stations=tuple(tuple(row) for row in table.tolist()))


_SEDAN = Outline(
    ((0, 0.5, 0.56, 0.9), (0.04, 0.55, 0.66, 0.9), (0.18, 0.6, 0.69, 0.86), (0.3, 0.62, 0.98, 0.68),
     (0.48, 0.62, 1, 0.7), (0.6, 0.6, 0.94, 0.68), (0.73, 0.59, 0.64, 0.84), (0.94, 0.5, 0.55, 0.86),
     (1, 0.36, 0.42, 0.82)),
    0.13, (False, False, True, True, True, True, False, False), (0.2, 0.81), 0.31)  # fmt: skip
_HATCH = Outline(
    ((0, 0.5, 0.6, 0.86), (0.03, 0.58, 0.68, 0.82), (0.13, 0.62, 0.97, 0.7), (0.4, 0.62, 1, 0.72),
     (0.57, 0.6, 0.96, 0.7), (0.74, 0.58, 0.65, 0.82), (0.95, 0.48, 0.55, 0.85), (1, 0.34, 0.42, 0.8)),
    0.13, (False, True, True, True, True, False, False), (0.17, 0.81), 0.3)  # fmt: skip
_ESTATE = Outline(
    ((0, 0.48, 0.58, 0.88), (0.02, 0.58, 0.7, 0.84), (0.09, 0.61, 0.97, 0.7), (0.3, 0.62, 1, 0.72),
     (0.52, 0.61, 0.98, 0.7), (0.62, 0.6, 0.92, 0.7), (0.74, 0.58, 0.64, 0.84), (0.95, 0.48, 0.55, 0.85),
     (1, 0.34, 0.42, 0.82)),
    0.13, (False, True, True, True, True, True, False, False), (0.19, 0.82), 0.31)  # fmt: skip
_SUV = Outline(
    ((0, 0.5, 0.62, 0.88), (0.02, 0.6, 0.72, 0.86), (0.08, 0.64, 0.98, 0.74), (0.4, 0.64, 1, 0.76),
     (0.58, 0.63, 0.97, 0.74), (0.71, 0.61, 0.68, 0.86), (0.95, 0.54, 0.62, 0.88), (1, 0.36, 0.5, 0.84)),
    0.17, (False, True, True, True, True, False, False), (0.18, 0.81), 0.36)  # fmt: skip
_MINIVAN = Outline(
    ((0, 0.4, 0.5, 0.9), (0.02, 0.52, 0.96, 0.8), (0.35, 0.54, 1, 0.82), (0.62, 0.54, 0.98, 0.8),
     (0.83, 0.5, 0.6, 0.85), (0.97, 0.4, 0.46, 0.85), (1, 0.3, 0.36, 0.8)),
    0.12, (True, True, True, True, False, False), (0.18, 0.83), 0.32)  # fmt: skip
_PANEL_VAN = Outline(
    ((0, 0.4, 0.97, 0.9), (0.35, 0.5, 1, 0.92), (0.68, 0.5, 0.99, 0.9), (0.83, 0.48, 0.62, 0.88),
     (0.97, 0.36, 0.46, 0.88), (1, 0.26, 0.34, 0.84)),
    0.11, (False, False, True, False, False), (0.2, 0.83), 0.34)  # fmt: skip
_BUS = Outline(
    ((0, 0.38, 0.96, 0.94), (0.02, 0.36, 1, 0.95), (0.33, 0.36, 1, 0.95), (0.66, 0.36, 1, 0.95),
     (0.98, 0.34, 0.99, 0.95), (1, 0.3, 0.95, 0.93)),
    0.1, (True, True, True, True, True), (0.25, 0.79), 0.48)  # fmt: skip


def _panes(glass: list[tuple[Array, ...]], rng: np.random.Generator) -> Mesh:
    """The windows of a vehicle: beams pass some, and others send them back."""
    mesh = quads(glass, PANE)
    through = np.repeat(rng.random(len(glass)) < 0.55, 2)
    return replace(mesh, reflectance=np.where(through, mesh.reflectance, _DIRTY).astype(np.float32))


def _body(outline: Outline, size: Sequence[float], paint: Surface, rng: np.random.Generator) -> Mesh:
    """The hull of an outline with glass, wheels, lamps, plates and mirrors, at its size in metres."""
    length, width, height = size
    sections = np.array([_section(*station, outline.low) for station in outline.stations])
    sections *= (length, width / 2, height)
    sections[..., 0] -= length / 2
    hull: list[tuple[Array, ...]] = []
    glass: list[tuple[Array, ...]] = []
    for number, glazed in enumerate(outline.glazed):
        a, b = sections[number], sections[number + 1]
        for side in range(6):
            face = (a[side], b[side], b[(side + 1) % 6], a[(side + 1) % 6])
            steep = side == 2 and abs(a[2, 2] - b[2, 2]) > 0.12 * height
            (glass if glazed and (side in (1, 3) or steep) else hull).append(face)
    ends = [(s[0], s[k], s[k + 1]) for s in (sections[0], sections[-1]) for k in range(1, 5)]
    parts = [quads(hull, paint), _panes(glass, rng), of(ends, paint)]
    parts += _wheels(outline.wheels, outline.wheel, length, width)
    low, nose = outline.low * height, 0.45 * height
    parts += [
        box((x, 0, low + 0.22 * height * 0.5), (0.02, 0.5, 0.12), PLATE) for x in (-length / 2 - 0.01, length / 2)
    ]
    parts += [
        box((x, y, nose), (0.06, 0.32, 0.13), lamp)
        for x, lamp in ((-length / 2 + 0.02, TAIL_LAMP), (length * 0.485, HEADLAMP))
        for y in (-0.36 * width, 0.36 * width)
    ]
    parts += [box((0.16 * length, y, 0.64 * height), (0.12, 0.16, 0.12), paint) for y in (-width * 0.5, width * 0.5)]
    return join(parts)


def _section(x: float, belt: float, top: float, narrow: float, low: float) -> list[tuple[float, float, float]]:
    wide = 1 - _ROUNDING * abs(2 * x - 1) ** 6  # seen from above, the corners are round
    half = np.array([0.95, 1, narrow]) * wide
    return [
        (x, -half[0], low), (x, -half[1], belt), (x, -half[2], top),
        (x, half[2], top), (x, half[1], belt), (x, half[0], low),
    ]  # fmt: skip


def _wheels(axles: Sequence[float], radius: float, length: float, width: float) -> list[Mesh]:
    parts = []
    for share in axles:
        for y in (-1, 1):
            x, outer = (share - 0.5) * length, y * (width / 2 + 0.005)
            parts.append(tube((x, outer - y * 0.22, radius), (x, outer, radius), radius, TYRE, 1, 12))
            parts.append(
                tube(
                    (x, outer - y * 0.05, radius),
                    (x, outer + y * 0.01, radius),
                    radius * 0.6,
                    replace(TYRE, reflectance=0.35, colour=(0.5, 0.5, 0.52)),
                    1,
                    8,
                )
            )
    return parts


def _paint(rng: np.random.Generator) -> Surface:
    """Paint whose reflectance in the infrared says little about its colour."""
    colour = _PAINTS[int(rng.integers(len(_PAINTS)))]
    # about half of the beams on real paint come back too faint for a remission
    reflectance = float(rng.choice([0.05, 0.08, 0.12, 0.28, 0.36, 0.45])) * float(rng.uniform(0.8, 1.2))
    return Surface(10, max(reflectance, 0.05), colour).varied(rng, 0.08)


def _size(rng: np.random.Generator, mean: Sequence[float], spread: float = 0.06) -> tuple[float, float, float]:
    length, width, height = (np.array(mean) * np.clip(rng.normal(1, spread, 3), 0.85, 1.18)).tolist()
    return length, width, height


def car(rng: np.random.Generator) -> Mesh:
    """A saloon, hatchback, estate or off-roader; sizes as in KITTI's labels."""
    choices = (
        (_SEDAN, (4.2, 1.66, 1.46)),
        (_HATCH, (3.6, 1.58, 1.51)),
        (_ESTATE, (4.15, 1.65, 1.51)),
        (_SUV, (4.1, 1.72, 1.69)),
    )
    outline, mean = choices[int(rng.choice(4, p=[0.25, 0.42, 0.18, 0.15]))]
    size = _size(rng, mean)
    return _body(outline.varied(rng), size, _paint(rng), rng).fitted(*size)


def van(rng: np.random.Generator) -> Mesh:
    """A panel van or a people carrier."""
    outline, mean = ((_PANEL_VAN, (5.3, 1.95, 2.35)), (_MINIVAN, (4.7, 1.83, 1.9)))[int(rng.integers(2))]
    size = _size(rng, mean)
    return _body(outline, size, _paint(rng), rng).fitted(*size)


def truck(rng: np.random.Generator) -> Mesh:
    """A cab with a box body, a flatbed with load, or a tank."""
    length, width, height = _size(rng, (8.6, 2.5, 3.3), 0.1)
    paint, cargo = _paint(rng), _paint(rng)
    nose, cab = length / 2, 2.1
    front = box((nose - cab / 2, 0, 0.45 + height * 0.37), (cab, width, height * 0.74), paint)
    pane = box((nose - 0.02, 0, height * 0.62), (0.06, width * 0.85, height * 0.24), PANE)
    sides = box((nose - 0.7, 0, height * 0.6), (0.8, width + 0.02, height * 0.2), PANE)
    frame = box((-cab / 2, 0, 0.75), (length - cab, width * 0.4, 0.3), TYRE)
    bed, middle = length - cab - 0.3, -cab / 2 - 0.15
    kind = int(rng.integers(3))
    if kind == 0:
        load = box((middle, 0, (1.0 + height) / 2), (bed, width, height - 1.0), cargo)
    elif kind == 1:
        piles = [
            box((middle + x, 0, 1.5), (bed * 0.28, width * 0.8, float(rng.uniform(0.5, 1.2))), cargo)
            for x in (-bed * 0.3, 0, bed * 0.3)
        ]
        load = join([box((middle, 0, 1.05), (bed, width, 0.15), paint), *piles])
    else:
        load = tube((middle - bed / 2, 0, 1.95), (middle + bed / 2, 0, 1.95), 1.0, cargo, 1, 14)
    plates = [box((x, 0, 0.7), (0.03, 0.55, 0.14), PLATE) for x in (-length / 2, length / 2)]
    wheels = _wheels((0.14, 0.27, 0.87), 0.5, length, width - 0.1)
    return join([front, pane, sides, frame, load, *plates, *wheels]).fitted(length, width, height)


def bus(rng: np.random.Generator) -> Mesh:
    """A city bus."""
    size = _size(rng, (11.5, 2.55, 3.1), 0.05)
    return _body(_BUS, size, _paint(rng), rng).fitted(*size)


def _person(rng: np.random.Generator, swing: float, hip: float, lean: float = 0.0, *, seated: bool = False) -> Mesh:
    """A person of 1.75 m whose legs and arms swing by `swing` radians, leaning forward by `lean`."""
    top, trousers = (
        Surface(30, float(rng.uniform(0.15, 0.55)), _CLOTHES[int(i)]) for i in rng.integers(len(_CLOTHES), size=2)
    )
    skin = Surface(30, 0.45, (0.75, 0.55, 0.43))
    shoulder = np.array([np.sin(lean) * 0.52, 0, hip + np.cos(lean) * 0.52])
    parts = [tube((0, 0, hip - 0.05), shoulder, 0.15, top, 1.25, 8)]
    parts.append(tube(shoulder + (0, -0.17, 0), shoulder + (0, 0.17, 0), 0.09, top))
    parts.append(ball(shoulder + (np.sin(lean) * 0.2 + 0.02, 0, 0.24), (0.1, 0.085, 0.125), skin))
    for side in (-1, 1):
        thigh = swing * side if not seated else 0.9 + swing * side * 0.5
        knee = np.array([np.sin(thigh) * 0.43, side * 0.1, hip - np.cos(thigh) * 0.43])
        shin = min(thigh, 0.0) * 1.3 - max(-swing * side, 0) * 0.3 if not seated else -0.5
        foot = knee + (np.sin(shin) * 0.43, 0, -np.cos(shin) * 0.43)
        parts += [tube((0, side * 0.09, hip), knee, 0.085, trousers, 0.8), tube(knee, foot, 0.065, trousers, 0.7)]
        parts.append(box(foot + (0.06, 0, 0.02), (0.25, 0.09, 0.09), TYRE))
        arm = -swing * side * 0.9 if not seated else 0.9
        elbow = shoulder + (np.sin(arm) * 0.28, side * 0.22, -np.cos(arm) * 0.28)
        hand = elbow + (np.sin(arm + 0.3) * 0.26, 0, -np.cos(arm + 0.3) * 0.26)
        parts += [tube(shoulder + (0, side * 0.2, 0), elbow, 0.055, top, 0.85), tube(elbow, hand, 0.045, skin, 0.8)]
    return join(parts)


def pedestrian(rng: np.random.Generator, phase: float = 0.0) -> Mesh:
    """A person on foot at a phase of the gait, radians."""
    tall = float(np.clip(rng.normal(1.74, 0.1), 1.2, 1.98))
    mesh = _person(rng, 0.5 * float(np.sin(phase)), 0.9)
    if rng.random() < 0.3:
        mesh = join([mesh, box((-0.2, 0, 1.25), (0.18, 0.3, 0.45), _paint(rng))])
    return _scaled(mesh, tall)


def _scaled(mesh: Mesh, height: float) -> Mesh:
    """A mesh of another height, its proportions kept."""
    length, width, old = (mesh.triangles.max((0, 1)) - mesh.triangles.min((0, 1))).tolist()
    return mesh.fitted(length * height / old, width * height / old, height)


def _rim(x: float, radius: float, surface: Surface, thickness: float) -> list[Mesh]:
    """A wheel of tyre, spokes and hub: beams pass through it."""
    angle = np.linspace(0, 2 * np.pi, 13)
    ring = np.stack([x + radius * np.cos(angle), 0 * angle, radius + radius * np.sin(angle)], 1)
    parts = [tube(a, b, thickness, surface, 1, 4) for a, b in itertools.pairwise(ring)]
    return parts + [tube(ring[k], ring[k + 6], 0.006, surface, 1, 3) for k in range(0, 6, 2)]


def cyclist(rng: np.random.Generator, phase: float = 0.0) -> Mesh:
    """A person on a bicycle."""
    metal = replace(_paint(rng), semantic=31)
    parts = [*_rim(-0.52, 0.34, TYRE, 0.025), *_rim(0.52, 0.34, TYRE, 0.025)]
    joints = {
        "rear": (-0.52, 0, 0.34),
        "front": (0.52, 0, 0.34),
        "crank": (-0.05, 0, 0.3),
        "seat": (-0.2, 0, 0.9),
        "head": (0.38, 0, 0.92),
    }
    for a, b in (
        ("rear", "crank"),
        ("rear", "seat"),
        ("crank", "seat"),
        ("crank", "head"),
        ("seat", "head"),
        ("front", "head"),
    ):
        parts.append(tube(joints[a], joints[b], 0.022, metal))
    parts += [
        tube((0.36, -0.28, 1.02), (0.36, 0.28, 1.02), 0.018, metal),
        box((-0.22, 0, 0.94), (0.26, 0.16, 0.06), TYRE),
    ]
    rider = _person(rng, 0.5 * float(np.sin(phase)), 1.0, 0.55, seated=True).placed(-0.2, 0, -0.02, 0)
    mesh = join([*parts, rider])
    return _scaled(mesh, float(np.clip(rng.normal(1.73, 0.08), 1.5, 1.95)))


def motorcyclist(rng: np.random.Generator, phase: float = 0.0) -> Mesh:
    """A person on a motorcycle or scooter; the phase is not used, nothing of it moves."""
    metal = _paint(rng)
    parts = [tube((x, -0.07, 0.3), (x, 0.07, 0.3), 0.3, TYRE, 1, 12) for x in (-0.68, 0.68)]
    parts += [box((0, 0, 0.5), (0.8, 0.3, 0.4), metal), ball((0.15, 0, 0.82), (0.32, 0.2, 0.16), metal)]
    parts += [box((-0.4, 0, 0.82), (0.7, 0.26, 0.12), TYRE), tube((0.68, 0, 0.3), (0.48, 0, 1.0), 0.06, metal)]
    parts += [
        tube((0.45, -0.36, 1.05), (0.45, 0.36, 1.05), 0.02, metal),
        box((0.62, 0, 0.9), (0.1, 0.22, 0.2), HEADLAMP),
    ]
    parts.append(box((-0.85, 0, 0.55), (0.02, 0.2, 0.15), PLATE))
    rider = _person(rng, 0.1, 0.92, 0.4, seated=True).placed(-0.3, 0, 0, 0)
    helmet = ball((0.02, 0, 1.72), (0.15, 0.14, 0.15), metal)
    return _scaled(join([*parts, rider, helmet]), float(np.clip(rng.normal(1.72, 0.07), 1.5, 1.9)))


Maker = Callable[[np.random.Generator], Mesh]
VEHICLES: dict[str, Maker] = {"car": car, "van": van, "truck": truck, "bus": bus}
RIDERS = {"pedestrian": pedestrian, "cyclist": cyclist, "motorcyclist": motorcyclist}


def make(kind: str, seed: tuple[int, ...], phase: float = 0.0) -> Mesh:
    """The body of an object: the same for the same seed, apart from the phase of the gait, radians.

    Gaits have 24 phases, so that bodies need not be made anew in every frame.
    """
    return _made(kind, seed, round(phase / (2 * np.pi) * 24) % 24)


@functools.lru_cache(maxsize=4096)
def _made(kind: str, seed: tuple[int, ...], step: int) -> Mesh:
    phase = step * 2 * np.pi / 24
    rng = np.random.default_rng(seed)
    mesh = VEHICLES[kind](rng) if kind in VEHICLES else RIDERS[kind](rng, phase)
    return mesh.with_semantic(KINDS[kind].semantic)
