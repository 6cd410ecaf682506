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
    CROSSING,
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
_SETBACKS = {"terrace": (0.3, 3.0, 5.0, 8.0), "suburb": (6.0, 9.0, 12.0, 16.0)}  # metres from pavement to house
_GAPS = {"terrace": (0.0, 0.0, 3.5, 6.0), "suburb": (4.0, 5.5, 11.0, 18.0)}  # metres from house to house


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
        self.houses: list[BaseGeometry] = []  # and the places beside them where vehicles stand
        self._driveways: list[tuple[Array, float]] = []
        plots = self._plots()
        self.slots = self._parking_slots()
        parts = [
            *self._ground(),
            *self._markings(),
            *plots,
            *self._roadside(),
            *self._fields(),
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
        """Carriageways and parking bays; prepared for many questions."""
        whole = self.road.union(self.bays).buffer(0.01)
        shapely.prepare(whole)
        return whole

    @cached_property
    def pavement(self) -> BaseGeometry:
        """Pavements along the built-up streets."""
        town = shapely.unary_union(
            [shapely.LineString(s.line).buffer(14.0) for s in self.network.streets if s.setting != "open"]
        )
        return self.paved.buffer(PAVEMENT_WIDTH).difference(self.paved).intersection(town)

    @cached_property
    def land(self) -> BaseGeometry:
        """The whole ground."""
        low, high = self.network.nodes.min(0) - MARGIN, self.network.nodes.max(0) + MARGIN
        return shapely.box(*low, *high)

    @cached_property
    def aprons(self) -> BaseGeometry:
        """Driveways from the street to the slots beside the houses."""
        areas = [_rectangle(place, 5.4, 2.8, yaw) for place, yaw in self._driveways]
        return shapely.unary_union(areas).difference(self.paved.union(self.pavement))

    def lift(self, place: Array, within: float = 0.0) -> float:
        """Metres by which the ground at (x, y) stands above the carriageway: 0 on it and `within` metres of it."""
        on_it = shapely.dwithin(self.paved, shapely.Point(place), within)
        return 0.0 if on_it else KERB_HEIGHT

    def on_ground(self, mesh: Mesh, place: Array, yaw: float, lift: float = KERB_HEIGHT) -> Mesh:
        """A mesh set on the ground at (x, y)."""
        return mesh.placed(float(place[0]), float(place[1]), float(self.hills.height(place)) + lift, yaw)

    def _ground(self) -> list[Mesh]:
        carriageway = self.paved.difference(self.bays)
        grass = self.land.difference(shapely.unary_union([self.paved, self.pavement, self.aprons]))
        areas = (
            (carriageway, ROAD, 0.0),
            (self.bays, PARKING, 0.0),
            (self.pavement, PAVEMENT, KERB_HEIGHT),
            (self.aprons, PARKING, KERB_HEIGHT),
            (grass, TERRAIN, KERB_HEIGHT),
        )
        spread = {ROAD: 0.25}  # asphalt differs from town to town more than grass does
        parts = [
            pave(area, self.hills, kind.varied(self._rng, spread.get(kind, 0.08)), self._rng, lift)
            for area, kind, lift in areas
        ]
        return [*parts, kerbs(self.paved, self.hills, KERB)]

    def _markings(self) -> list[Mesh]:
        """Dashed middle lines, lines along the lanes of the highway, stop lines and crossings."""
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
                for way in (street.line, street.line[::-1]):
                    areas += [_stop_line(trimmed(way, 0, CROSSING + 2.5)), *_zebra(trimmed(way, 0, CROSSING))]
        return [pave(shapely.unary_union(areas), self.hills, MARKING, self._rng, 0.006)]

    def _parking_slots(self) -> Slots:
        centers, yaws = [], []
        for street in self.network.streets:
            for side, line in ((0, street.line), (1, street.line[::-1])):
                if street.parking[side]:
                    lane = resampled(offset(trimmed(line, TRIM + 9, TRIM + 9), LANE + PARKING_WIDTH / 2), SLOT)
                    centers.append(lane[1:-1])
                    yaws.append(headings(lane)[1:-1])
        centers += [place[None] for place, _ in self._driveways]
        yaws += [np.array([yaw]) for _, yaw in self._driveways]
        return Slots(np.concatenate(centers), np.concatenate(yaws))

    def _plots(self) -> list[Mesh]:
        """Houses along both sides of every street, with gaps, and what stands between house and street."""
        parts = []
        for street in self.network.streets:
            for side, line in ((0, street.line), (1, street.line[::-1])):
                if street.setting == "open":
                    continue
                edge = LANE + PARKING_WIDTH * street.parking[side] + PAVEMENT_WIDTH
                parts += self._row_of_plots(line, edge, street.setting)
                parts += self._row_of_plots(line, edge + 30.0, street.setting)
        return parts

    def _row_of_plots(self, line: Array, edge: float, setting: str) -> list[Mesh]:
        parts, rng = [], self._rng
        at, end = 17.0, float(arc_length(line)[-1]) - 17.0
        while at < end:
            width = float(rng.uniform(8, 19))
            parts += self._plot(line, at, width, edge, float(rng.choice(_SETBACKS[setting])))
            gap = float(rng.choice(_GAPS[setting]))
            if 3.0 < gap < 6.0 and edge < 10 and rng.random() < 0.7:
                self._driveway(line, at + width + gap / 2, edge)
            at += width + gap
        return parts

    def _driveway(self, line: Array, at: float, edge: float) -> None:
        """Room for a vehicle between two houses, its nose or tail towards the street."""
        place, yaw = _line(line, at, at + 3.0)[0], float(headings(_line(line, at, at + 3.0))[0])
        right = np.array([np.sin(yaw), -np.cos(yaw)])
        center, turned = place + right * (edge + float(self._rng.uniform(3.0, 5.5))), yaw + np.pi / 2
        room = _rectangle(center, 5.4, 2.4, turned)
        if self._free(room):
            self._driveways.append((center, turned))
            self.houses.append(room)

    def _plot(self, line: Array, at: float, width: float, edge: float, setback: float) -> list[Mesh]:
        rng = self._rng
        whole, along = _line(line, at, at + width), float(rng.uniform(8, 13))
        if len(whole) < 2:
            return []
        middle, yaw = whole[len(whole) // 2], float(headings(whole)[len(whole) // 2])
        right = np.array([np.sin(yaw), -np.cos(yaw)])
        place = middle + right * (edge + setback + along / 2)
        footprint = _rectangle(place, width, along, yaw)
        if rng.random() < 0.3 or not self._free(footprint):
            return self._front(offset(whole, edge + 0.35), 0.8)
        self.houses.append(footprint)
        parts = [self.on_ground(house(width, along, rng), place, yaw + np.pi, 0.0)]
        return parts + (self._front(offset(whole, edge + 0.35), 0.9) if setback > 1 else [])

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
        kind = rng.random()
        if kind < 0.38:
            return [furniture.hedge(line, self.hills, height, KERB_HEIGHT, rng)]
        if kind < 0.93:
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
                if street.setting != "open":
                    parts += self._row(trimmed(line, 17, 17), edge + 0.45, side)
                parts += self._junction(trimmed(line, TRIM, TRIM), LANE + 0.7)
        return parts

    def _fields(self) -> list[Mesh]:
        """Along open streets and the highway: trees in rows, undergrowth, fences, and long views between them."""
        parts, rng = [], self._rng
        for street in self.network.streets:
            for line in (street.line, street.line[::-1]):
                if street.setting != "open":
                    continue
                lane = trimmed(line, 20, 20)
                for begin in np.arange(0, float(arc_length(lane)[-1]) - 25, 25):
                    for low, high in ((3.5, 9), (10, 18), (20, 34)):
                        reach = street.half_width + float(rng.uniform(low, high))
                        parts += self._hem(offset(_line(lane, begin, begin + 25), reach), float(rng.random()))
        return parts

    def _hem(self, line: Array, draw: float) -> list[Mesh]:
        rng = self._rng
        if self._near_road(line) or not self._free(shapely.LineString(line).buffer(1.5)):
            return []
        if draw < 0.5:
            return [furniture.thicket(line, self.hills, KERB_HEIGHT, rng)]
        if draw < 0.7:
            return [
                furniture.picket_fence(line, self.hills, float(rng.uniform(0.9, 1.4)), FENCE.varied(rng), KERB_HEIGHT)
            ]
        if draw < 0.85:
            places = resampled(line, 7.0)
            return [self.on_ground(furniture.tree(rng), place, float(rng.uniform(0, 6.28))) for place in places]
        return []

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
        """Trees, bushes and stones in gardens, and woods around the town."""
        rng = self._rng
        low, high = np.array(self.land.bounds[:2]), np.array(self.land.bounds[2:])
        built = [*(house.buffer(1.5) for house in self.houses), self.aprons.buffer(1.5)]
        taken = shapely.unary_union([self.paved.buffer(PAVEMENT_WIDTH + 1.6), *built])
        shapely.prepare(taken)
        parts = []
        for place in rng.uniform(low, high, (int((high - low).prod() / 45), 2)):
            if shapely.contains_xy(taken, *place):
                continue
            kind = rng.random()
            what = (
                furniture.tree if kind < 0.33
                else furniture.copse if kind < 0.36
                else furniture.bush if kind < 0.93
                else furniture.shed if kind < 0.97
                else furniture.boulder
            )  # fmt: skip
            parts.append(self.on_ground(what(rng), place, float(rng.uniform(0, 6.28))))
        rim = shapely.get_coordinates(shapely.segmentize(self.land.buffer(-12).exterior, 5.0))
        for place in rim + rng.normal(0, 4, rim.shape):
            if not shapely.contains_xy(taken, *place):
                parts.append(self.on_ground(furniture.copse(rng), place, float(rng.uniform(0, 6.28))))
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


def _zebra(line: Array) -> list[BaseGeometry]:
    """The bars of a crossing at the end of a polyline."""
    place, yaw = line[-1], float(headings(line)[-1])
    right = np.array([np.sin(yaw), -np.cos(yaw)])
    return [_rectangle(place + right * aside, 2.6, 0.5, yaw) for aside in np.arange(-LANE + 0.5, LANE, 1.0)]


def _stop_line(line: Array) -> BaseGeometry:
    lane = offset(line, LANE / 2)[-1]
    yaw = float(headings(line)[-1])
    return _rectangle(lane, 0.4, LANE - 0.4, yaw)
