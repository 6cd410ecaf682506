"""The static town: everything that does not move, made from a seed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
import shapely.ops
from shapely.geometry.base import BaseGeometry

from lidarfw_town import furniture
from lidarfw_town.buildings import house
from lidarfw_town.ground import KERB_HEIGHT, Hills, kerbs, pave
from lidarfw_town.mesh import (
    FENCE,
    KERB,
    MARKING,
    PARKING,
    PAVEMENT,
    ROAD,
    STRUCTURE,
    TERRAIN,
    Array,
    Mesh,
    join,
)  # fmt: skip
from lidarfw_town.streets import (
    LANE,
    PARKING_WIDTH,
    PAVEMENT_WIDTH,
    TRIM,
    Street,
    arc_length,
    build_network,
    headings,
    offset,
    resampled,
    trimmed,
)  # fmt: skip

MARGIN = 70.0  # metres of land around the outermost streets
SLOT = 5.6  # metres of a parking slot along the street


@dataclass(frozen=True, eq=False)
class Slots:
    """Parking slots: centre (S, 2) in metres and heading (S,) in radians."""

    center: Array
    yaw: Array


class World:
    """The streets, the land and all that stands still. The same seed gives the same town to the bit.

    Attributes: `network`, `hills`, `slots`, and `mesh`, whose frame is x east, y north, z up, in metres.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self._rng = np.random.default_rng((seed, 0))
        self.hills = Hills(self._rng)
        self.network = build_network(self._rng)
        self.slots = self._parking_slots()
        self.houses: list[BaseGeometry] = []
        parts = [
            *self._ground(),
            *self._markings(),
            *self._plots(),
            *self._roadside(),
            *self._highway(),
            *self._trees(),
        ]
        self.mesh: Mesh = join(parts)

    @cached_property
    def bays(self) -> BaseGeometry:
        """Parking bays along the streets."""
        strips = [_strip(s, side) for s in self.network.streets for side in (0, 1) if s.parking[side]]
        return shapely.unary_union(strips)

    @cached_property
    def road(self) -> BaseGeometry:
        """Carriageways with junctions."""
        lines = [shapely.LineString(s.line).buffer(s.half_width) for s in self.network.streets]
        rounded = shapely.unary_union(lines).buffer(5.0).buffer(-5.0)
        return rounded.union(shapely.unary_union(lines))

    @cached_property
    def paved(self) -> BaseGeometry:
        """Carriageways and parking bays."""
        return self.road.union(self.bays).buffer(0.01)

    @cached_property
    def pavement(self) -> BaseGeometry:
        """Pavements along the streets of the town, not along the highway."""
        town = shapely.unary_union(
            [shapely.LineString(s.line).buffer(14.0) for s in self.network.streets if not s.highway]
        )
        return self.paved.buffer(PAVEMENT_WIDTH).difference(self.paved).intersection(town)

    @cached_property
    def land(self) -> BaseGeometry:
        """The whole ground."""
        low, high = self.network.nodes.min(0) - MARGIN, self.network.nodes.max(0) + MARGIN
        return shapely.box(*low, *high)

    def on_ground(self, mesh: Mesh, place: Array, yaw: float, lift: float = KERB_HEIGHT) -> Mesh:
        """A mesh set on the ground at (x, y)."""
        return mesh.placed(float(place[0]), float(place[1]), float(self.hills.height(place)) + lift, yaw)

    def _ground(self) -> list[Mesh]:
        carriageway = self.paved.difference(self.bays)
        grass = self.land.difference(self.paved.union(self.pavement))
        areas = ((carriageway, ROAD, 0.0), (self.bays, PARKING, 0.0), (self.pavement, PAVEMENT, KERB_HEIGHT))
        parts = [pave(area, self.hills, surface, self._rng, lift) for area, surface, lift in areas]
        return [*parts, pave(grass, self.hills, TERRAIN, self._rng, KERB_HEIGHT), kerbs(self.paved, self.hills, KERB)]

    def _markings(self) -> list[Mesh]:
        """Dashed middle lines, lines along the lanes of the highway, and stop lines."""
        areas = []
        for street in self.network.streets:
            line = trimmed(street.line, TRIM, TRIM)
            edges = (-LANE - 1, LANE + 1, 2 * LANE + 1, -2 * LANE - 1) if street.highway else (0.0,)
            for right in edges:
                solid = abs(right) > LANE + 1
                areas += [
                    d.buffer(0.075, cap_style="flat") for d in _dashes(offset(line, right), 1.0 if solid else 0.4)
                ]
            if not street.highway:
                areas += [_stop_line(line), _stop_line(line[::-1])]
        return [pave(shapely.unary_union(areas), self.hills, MARKING, self._rng, 0.006)]

    def _parking_slots(self) -> Slots:
        centers, yaws = [], []
        for street in self.network.streets:
            for side, line in ((0, street.line), (1, street.line[::-1])):
                if street.parking[side]:
                    lane = resampled(offset(trimmed(line, TRIM + 6, TRIM + 6), LANE + PARKING_WIDTH / 2), SLOT)
                    centers.append(lane[1:-1])
                    yaws.append(headings(lane)[1:-1])
        return Slots(np.concatenate(centers), np.concatenate(yaws))

    def _plots(self) -> list[Mesh]:
        """Houses along both sides of every street, with gaps, and what stands between house and street."""
        parts = []
        for street in self.network.streets:
            for side, line in ((0, street.line), (1, street.line[::-1])):
                if street.highway:
                    continue
                edge = LANE + PARKING_WIDTH * street.parking[side] + PAVEMENT_WIDTH
                parts += self._row_of_plots(line, edge) + self._row_of_plots(line, edge + 27.0)
        return parts

    def _row_of_plots(self, line: Array, edge: float) -> list[Mesh]:
        parts = []
        at, end = 13.0, float(arc_length(line)[-1]) - 13.0
        while at < end:
            width = float(self._rng.uniform(8, 19))
            parts += self._plot(line, at, width, edge)
            at += width + float(self._rng.choice([0.0, 2.5, 4.0, 9.0], p=[0.25, 0.3, 0.3, 0.15]))
        return parts

    def _plot(self, line: Array, at: float, width: float, edge: float) -> list[Mesh]:
        rng = self._rng
        whole, along = _line(line, at, at + width), float(rng.uniform(8, 13))
        if len(whole) < 2:
            return []
        setback = float(rng.choice([0.3, 3.0, 6.0, 9.0], p=[0.2, 0.25, 0.3, 0.25]))
        middle, yaw = whole[len(whole) // 2], float(headings(whole)[len(whole) // 2])
        right = np.array([np.sin(yaw), -np.cos(yaw)])
        place = middle + right * (edge + setback + along / 2)
        footprint = _rectangle(place, width, along, yaw)
        if rng.random() < 0.12 or not self._free(footprint):
            return self._front(offset(whole, edge + 0.35), 0.8)
        self.houses.append(footprint)
        parts = [self.on_ground(house(width, along, rng), place, yaw + np.pi, 0.0)]
        return parts + (self._front(offset(whole, edge + 0.35), 0.65) if setback > 1 else [])

    def _free(self, footprint: BaseGeometry) -> bool:
        if footprint.distance(self.paved) < PAVEMENT_WIDTH + 0.2:
            return False
        return not any(footprint.intersects(other) for other in self.houses)

    def _front(self, line: Array, chance: float) -> list[Mesh]:
        """A fence, a hedge or a low wall along a garden, or nothing."""
        rng, height = self._rng, float(self._rng.uniform(0.8, 1.7))
        line = resampled(line, 3.0)
        if len(line) < 2 or rng.random() > chance or self._near_road(line):
            return []
        kind = int(rng.integers(4))
        if kind <= 1:
            return [furniture.hedge(line, self.hills, height, KERB_HEIGHT, rng)]
        if kind == 2:
            return [furniture.picket_fence(line, self.hills, height, FENCE.varied(rng, 0.3), KERB_HEIGHT)]
        return [furniture.wall(line, self.hills, height * 0.7, 0.25, STRUCTURE.varied(rng), KERB_HEIGHT)]

    def _near_road(self, line: Array) -> bool:
        return bool(shapely.LineString(line).distance(self.paved) < PAVEMENT_WIDTH - 0.3)

    def _roadside(self) -> list[Mesh]:
        """Lamps, signs, traffic lights, street trees and oddments on the pavements."""
        parts = []
        for street in self.network.streets:
            if street.highway:
                continue
            for side, line in ((0, street.line), (1, street.line[::-1])):
                edge = LANE + PARKING_WIDTH * street.parking[side]
                parts += self._row(trimmed(line, 14, 14), edge + 0.45, side)
                parts += self._junction(trimmed(line, TRIM, TRIM), LANE + 0.7)
        return parts

    def _row(self, line: Array, right: float, side: int) -> list[Mesh]:
        rng, parts = self._rng, []
        lane = resampled(offset(line, right), 7.0)
        yaws, trees = headings(lane), rng.random() < 0.6
        for number, (place, yaw) in enumerate(zip(lane, yaws)):
            draw = rng.random()
            if number % 4 == 2 * side:
                parts.append(self.on_ground(furniture.lamp(rng), place, yaw + np.pi / 2))
            elif trees and draw < 0.5:
                parts.append(self.on_ground(furniture.tree(rng), place, draw * 50))
            elif draw > 0.9:
                parts.append(self.on_ground(furniture.sign(rng), place, yaw + np.pi))
            elif draw > 0.82:
                parts.append(self.on_ground(furniture.oddment(rng), place, yaw + np.pi))
            elif draw > 0.81:
                aside = place + 1.4 * np.array([np.sin(yaw), -np.cos(yaw)])
                parts.append(self.on_ground(furniture.shelter(rng), aside, yaw + np.pi))
        return parts

    def _junction(self, line: Array, right: float) -> list[Mesh]:
        """A traffic light or a sign where a lane ends at a junction."""
        place, yaw = offset(line, right)[-1], float(headings(line)[-1])
        if shapely.Point(place).distance(self.road) < 0.2 or self._rng.random() < 0.3:
            return []
        what = furniture.traffic_light if self._rng.random() < 0.5 else furniture.sign
        return [self.on_ground(what(self._rng), place, yaw + np.pi)]

    def _highway(self) -> list[Mesh]:
        """Guard rails, sparse sign bridges and a noise barrier."""
        parts = []
        for street in self.network.streets:
            if street.highway:
                line = resampled(trimmed(street.line, 22, 22), 8.0)
                parts += [
                    furniture.guard_rail(offset(line, right), self.hills)
                    for right in (-street.half_width - 0.6, 0, street.half_width + 0.6)
                ]
                barrier = offset(line, street.half_width + 3.5)
                parts.append(furniture.wall(barrier, self.hills, 3.0, 0.2, STRUCTURE, KERB_HEIGHT))
                for number in range(8, len(line), 16):
                    yaw = float(headings(line)[number])
                    parts.append(
                        self.on_ground(furniture.gantry(2 * street.half_width + 4, self._rng), line[number], yaw, 0.0)
                    )
        return parts

    def _trees(self) -> list[Mesh]:
        """Trees, bushes and stones in gardens, denser at the rim of the town."""
        rng = self._rng
        low, high = np.array(self.land.bounds[:2]), np.array(self.land.bounds[2:])
        taken = shapely.unary_union([self.paved.buffer(PAVEMENT_WIDTH + 1.6), *(h.buffer(1.5) for h in self.houses)])
        shapely.prepare(taken)
        parts = []
        for place in rng.uniform(low, high, (int((high - low).prod() / 75), 2)):
            if shapely.contains_xy(taken, *place):
                continue
            kind = rng.random()
            what = furniture.tree if kind < 0.6 else furniture.bush if kind < 0.95 else furniture.boulder
            parts.append(self.on_ground(what(rng), place, float(rng.uniform(0, 6.28))))
        return parts


def _strip(street: Street, side: int) -> BaseGeometry:
    line = trimmed(street.line if side == 0 else street.line[::-1], TRIM + 4, TRIM + 4)
    inner, outer = offset(line, LANE - 0.02), offset(line, LANE + PARKING_WIDTH)
    return shapely.Polygon(np.concatenate([inner, outer[::-1]])).buffer(0)


def _line(line: Array, begin: float, end: float) -> Array:
    return trimmed(line, begin, max(float(arc_length(line)[-1]) - end, 0.0))


def _rectangle(center: Array, length: float, width: float, yaw: float) -> BaseGeometry:
    cosine, sine = np.cos(yaw), np.sin(yaw)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (length / 2, width / 2)
    return shapely.Polygon(corners @ np.array([[cosine, sine], [-sine, cosine]]) + center)


def _dashes(line: Array, share: float) -> list[BaseGeometry]:
    """Pieces of a line: `share` of every 7.5 m is painted."""
    whole, total = shapely.LineString(line), float(arc_length(line)[-1])
    starts = np.arange(0, total - 3, 7.5)
    return [shapely.ops.substring(whole, s, s + 7.5 * share) for s in starts]


def _stop_line(line: Array) -> BaseGeometry:
    lane = offset(line, LANE / 2)[-1]
    yaw = float(headings(line)[-1])
    return _rectangle(lane, 0.4, LANE - 0.4, yaw)
