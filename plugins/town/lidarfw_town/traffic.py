"""What moves and what is parked: vehicles that follow lanes and each other, people on the pavements, and the route.

Source of the car-following model: Treiber, Hennecke, Helbing, "Congested traffic states in empirical observations and
microscopic simulations", Physical Review E 62 (2000), the intelligent driver model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarfw_town.bodies import KINDS, VEHICLES, make
from lidarfw_town.ground import KERB_HEIGHT
from lidarfw_town.mesh import Array, Mesh
from lidarfw_town.streets import (
    LANE,
    PARKING_WIDTH,
    PAVEMENT_WIDTH,
    arc_length,
    circuit,
    headings,
    lane_path,
    offset,
    random_route,
    resampled,
    trimmed,
)  # fmt: skip
from lidarfw_town.world import SLOT, World

PERIOD = 0.1  # seconds from frame to frame
_ON_ROAD = ("car",) * 20 + ("van",) * 4 + ("truck",) * 4 + ("bus",) * 2 + ("cyclist",) * 14 + ("motorcyclist",) * 2
_PARKED = ("car",) * 12 + ("van",) * 2
_ACCELERATION, _BRAKING, _HEADWAY, _GAP = 1.4, 2.2, 1.3, 2.5  # of the driver model: m/s2, m/s2, seconds, metres
_SIDEWAYS = 2.2  # m/s2 that a driver takes in curves
_LOOK = np.arange(2, 46, 2.0)  # metres ahead on the own path at which others are looked for


@dataclass(frozen=True, eq=False)
class Mover:
    """A movable object over time. `track` (T, 4): x, y, heading (continuous, radians), speed, every PERIOD seconds."""

    id: int
    kind: str
    seed: tuple[int, ...]
    track: Array

    def at(self, step: float) -> Array:
        """x, y, heading, speed at a moment, counted in periods."""
        first = int(np.clip(np.floor(step), 0, len(self.track) - 2))
        share = step - first
        return np.asarray(self.track[first] * (1 - share) + self.track[first + 1] * share)

    def body(self, step: float) -> Mesh:
        """The body at a moment; the legs of people swing with the way they have gone."""
        if self.kind in VEHICLES:
            return make(self.kind, self.seed)
        pace = {"pedestrian": 4.4, "cyclist": 1.5}.get(self.kind, 0.0)
        gone = float(np.interp(step, np.arange(len(self.track)), np.cumsum(self.track[:, 3]) * PERIOD))
        return make(self.kind, self.seed, pace * gone + self.id)


@dataclass(frozen=True, eq=False)
class Parked:
    """A vehicle that stands in a slot: x, y, heading."""

    id: int
    kind: str
    seed: tuple[int, ...]
    pose: Array


class Traffic:
    """One drive through a world: the ego vehicle, the other vehicles, people, and the parked ones.

    `ego` (T, 4) is x, y, heading, speed, every PERIOD seconds; `movers` and `parked` are the others. The traversal
    number draws the parked vehicles anew, of which about a third keep their place, and another route; with `circuit`
    the ego vehicle drives the same circuit every time, the other way round where the number is odd.
    """

    def __init__(self, world: World, traversal: int, steps: int, *, circuit: bool = False) -> None:
        self._world, self._traversal, self._circuit = world, traversal, circuit
        self._rng = np.random.default_rng((world.seed, 1, traversal))
        self.parked = self._park(traversal)
        vehicles = self._drive(steps)
        self.ego = vehicles[0].track
        people = self._walk(steps, len(vehicles))
        self.movers = [*vehicles[1:], *people]

    def _park(self, traversal: int) -> list[Parked]:
        """A kept third of the slots depends on the world alone; the rest is drawn for the traversal."""
        slots, lasting = self._world.slots, np.random.default_rng((self._world.seed, 2))
        count = len(slots.yaw)
        kept = lasting.random(count) < 0.16
        drawn = self._rng.random(count) < self._rng.uniform(0.3, 0.5)
        parked = []
        for slot in np.flatnonzero(kept | drawn):
            rng = lasting if kept[slot] else self._rng
            seed = (self._world.seed, 3, int(slot), 0 if kept[slot] else traversal + 1)
            kind = _PARKED[int(np.random.default_rng(seed).integers(len(_PARKED)))]
            yaw = slots.yaw[slot] + (np.pi if rng.random() < 0.15 else 0) + rng.normal(0, 0.02)
            ahead = np.array([np.cos(slots.yaw[slot]), np.sin(slots.yaw[slot])])
            place = slots.center[slot] + ahead * rng.uniform(-0.1, 0.1) * (SLOT - 5) + rng.normal(0, 0.06, 2)
            parked.append(Parked(10000 + int(slot), kind, seed, np.array([*place, yaw])))
        return parked

    def _drive(self, steps: int, count: int = 46) -> list[Mover]:
        rng, network = self._rng, self._world.network
        kinds = ["car", *(str(_ON_ROAD[int(i)]) for i in rng.integers(len(_ON_ROAD), size=count))]
        paths, limits, lengths, starts = [], [], [], []
        for number, kind in enumerate(kinds):
            street = network.streets[int(rng.integers(len(network.streets)))]
            need = steps * PERIOD * KINDS[kind].speed + 260
            route = random_route(network, street, bool(rng.random() < 0.5), need, rng)
            side = 1.45 if kind == "cyclist" else float(rng.normal(0, 0.08))
            if number == 0 and self._circuit:
                route, side = circuit(network, self._traversal % 2 == 1, need), float(rng.uniform(-0.4, 0.4))
            path, limit = lane_path(network, route, side)
            paths.append(path)
            limits.append(_speed_plan(path, np.minimum(limit * rng.uniform(0.8, 1.05), _fastest(kind, street.highway))))
            lengths.append(float(np.ptp(make(kind, self._seed(number)).triangles[..., 0])))
            starts.append(0.0 if number == 0 else float(rng.uniform(0, 60)))
        tracks = _Road(paths, limits, np.array(lengths), np.array(starts)).run(steps)
        return [
            Mover(n, kind, self._seed(n), track)
            for n, (kind, track) in enumerate(zip(kinds, tracks))
            if track is not None
        ]

    def _seed(self, number: int) -> tuple[int, ...]:
        return (self._world.seed, 4, number, self._traversal)

    def _walk(self, steps: int, first: int, count: int = 60) -> list[Mover]:
        """People who walk up and down a pavement, some of them in pairs, some standing."""
        rng, streets = self._rng, [s for s in self._world.network.streets if not s.highway]
        movers = []
        for number in range(count):
            street, side = streets[int(rng.integers(len(streets)))], int(rng.integers(2))
            edge = LANE + PARKING_WIDTH * street.parking[side] + PAVEMENT_WIDTH * float(rng.uniform(0.4, 0.85))
            line = resampled(offset(trimmed(street.line[:: 1 - 2 * side], 16, 16), edge), 1.0)
            speed = 0.0 if rng.random() < 0.2 else float(np.clip(rng.normal(1.35, 0.2), 0.7, 2))
            track = _to_and_fro(line, float(rng.uniform(0, 1)), speed, steps)
            movers.append(Mover(first + 100 + number, "pedestrian", self._seed(1000 + number), track))
        return movers

    def height(self, kind: str, place: Array) -> float:
        """Metres of the ground under an object."""
        lift = KERB_HEIGHT if kind == "pedestrian" else 0.0
        return float(self._world.hills.height(place[:2])) + lift


def _fastest(kind: str, highway: bool) -> float:
    return KINDS[kind].speed if kind == "cyclist" or not highway else KINDS[kind].speed * 1.8


def _speed_plan(path: Array, limit: Array) -> Array:
    """Speed (P,) along a path every 0.5 m: within the limit, slow in curves, with room to brake before them."""
    turn = np.abs(np.gradient(np.unwrap(headings(path)))) / 0.5
    bend = np.convolve(turn, np.ones(7) / 7, mode="same")
    speed = np.minimum(limit, np.sqrt(_SIDEWAYS / np.maximum(bend, 1e-4)))
    for number in range(len(speed) - 2, -1, -1):
        speed[number] = min(speed[number], np.sqrt(speed[number + 1] ** 2 + 2 * 1.5 * 0.5))
    return np.asarray(np.maximum(speed, 2.0))


class _Road:
    """Vehicles on their paths. Each follows, or waits for, whatever is on its own path ahead."""

    def __init__(self, paths: list[Array], plans: list[Array], lengths: Array, starts: Array) -> None:
        longest = max(len(path) for path in paths)
        self.path = np.stack([np.pad(p, ((0, longest - len(p)), (0, 0)), mode="edge") for p in paths])
        self.yaw = np.stack([np.pad(np.unwrap(headings(p)), (0, longest - len(p)), mode="edge") for p in paths])
        self.plan = np.stack([np.pad(p, (0, longest - len(p)), mode="edge") for p in plans])
        self.ends = np.array([len(path) for path in paths]) * 0.5 - 30
        self.length, self.along = lengths, starts
        self.speed = np.zeros(len(paths))
        self.waited = np.zeros(len(paths))

    def run(self, steps: int, warm_up: int = 80) -> list[Array | None]:
        """Tracks (T, 4) for `steps` + 2 moments; None for a vehicle that had no room to start."""
        there = self._room()
        self.speed = self._at(self.plan) * 0.8
        states = []
        for step in range(warm_up + steps + 2):
            self._advance(there)
            if step >= warm_up:
                states.append(np.stack([*self._places().T, self._at(self.yaw), self.speed], 1))
        tracks = np.stack(states, 1)
        return [track if alive else None for track, alive in zip(tracks, there)]

    def _at(self, table: Array) -> Array:
        where = np.clip(self.along / 0.5, 0, table.shape[1] - 2)
        first = where.astype(int)
        rows = np.arange(len(table))
        return np.asarray(table[rows, first] * (1 - (where - first)) + table[rows, first + 1] * (where - first))

    def _places(self) -> Array:
        return np.stack([self._at(self.path[..., axis]) for axis in (0, 1)], 1)

    def _room(self) -> np.ndarray:
        """Vehicles are let in one after another where 14 m are free."""
        places, there = self._places(), np.zeros(len(self.along), bool)
        for number in range(len(there)):
            apart = np.linalg.norm(places - places[number], axis=1)
            there[number] = not (there & (apart < 14)).any()
        return there

    def _advance(self, there: np.ndarray) -> None:
        gap, theirs = self._ahead(there)
        wanted = np.maximum(self._at(self.plan), 0.5)
        closing = self.speed * (self.speed - theirs) / (2 * np.sqrt(_ACCELERATION * _BRAKING))
        room = _GAP + np.maximum(self.speed * _HEADWAY + closing, 0)
        push = _ACCELERATION * (1 - (self.speed / wanted) ** 4 - (room / np.maximum(gap, 0.3)) ** 2)
        self.speed = np.maximum(self.speed + np.clip(push, -7, 2) * PERIOD, 0)
        self.speed[self.along > self.ends] = 0
        self.along = self.along + self.speed * PERIOD
        self.waited = np.where(self.speed < 0.3, self.waited + PERIOD, 0)

    def _ahead(self, there: np.ndarray) -> tuple[Array, Array]:
        """Gap in metres to the next vehicle on the own path, and its speed along that path."""
        rows, places, yaw = np.arange(len(self.along)), self._places(), self._at(self.yaw)
        index = np.clip(((self.along[:, None] + _LOOK) / 0.5).astype(int), 0, self.path.shape[1] - 1)
        ahead = self.path[rows[:, None], index]
        # an outstretched vehicle counts by its front, middle and rear
        reach = self.length[:, None] * np.array([-0.4, 0, 0.4])
        bodies = places[:, None] + reach[..., None] * np.stack([np.cos(yaw), np.sin(yaw)], 1)[:, None]
        flat, points = ahead.reshape(-1, 2), bodies.reshape(-1, 2)
        square = (flat**2).sum(1)[:, None] + (points**2).sum(1) - 2 * flat @ points.T
        hit = (
            (square.reshape(*ahead.shape[:2], len(rows), 3).min(-1) < 1.55**2)
            & there[None, None]
            & (rows[:, None] != rows)[:, None]
        )
        across = np.abs(np.sin(yaw[:, None] - yaw)) > 0.5
        # who crosses waits for the lower number; who has waited long goes first
        first = (rows[None] > rows[:, None]) & (self.waited[:, None] > 4 + rows[:, None] * 0.2)
        hit &= ~(across & first)[:, None]
        blocked = hit.any(2)
        nearest = np.where(blocked.any(1), blocked.argmax(1), 0)
        gap = np.where(blocked.any(1), _LOOK[nearest] - self.length / 2, 1e3)
        other = hit[rows, nearest].argmax(1)
        theirs = np.maximum(self.speed[other] * np.cos(yaw[other] - yaw), 0)
        return gap, np.where(blocked.any(1), theirs, self.speed)


def _to_and_fro(line: Array, start: float, speed: float, steps: int) -> Array:
    """A walk along a line and back (T, 4); the turn at its end takes a second."""
    total = float(arc_length(line)[-1])
    gone = start * 2 * total + speed * PERIOD * np.arange(steps + 2)
    fold = np.abs((gone + total) % (2 * total) - total)
    at = np.linspace(0, total, len(line))
    place = np.stack([np.interp(fold, at, line[:, axis]) for axis in (0, 1)], 1)
    back = np.where((gone % (2 * total)) > total, np.pi, 0.0)
    smooth = np.convolve(np.pad(back, 5, mode="edge"), np.ones(11) / 11, mode="valid")
    yaw = np.interp(fold, at, np.unwrap(headings(line))) + smooth
    return np.concatenate([place, yaw[:, None], np.full((len(yaw), 1), speed)], 1)
