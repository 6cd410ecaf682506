"""What moves and what is parked: vehicles that follow lanes and each other, people on the pavements, and the route.

Source of the car-following model: Treiber, Hennecke, Helbing, "Congested traffic states in empirical observations and
microscopic simulations", Physical Review E 62 (2000), the intelligent driver model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarfw_town.bodies import KINDS, VEHICLES, make
from lidarfw_town.mesh import Array, Mesh
from lidarfw_town.streets import (
    CROSSING,
    LANE,
    PARKING_WIDTH,
    PAVEMENT_WIDTH,
    Street,
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
_ON_ROAD = ("car",) * 26 + ("van",) * 4 + ("truck",) * 2 + ("bus",) + ("cyclist",) * 8 + ("motorcyclist",) * 2
_PARKED = ("car",) * 12 + ("van",) * 2
_ACCELERATION, _BRAKING, _HEADWAY, _GAP = 1.4, 2.2, 1.8, 3.0  # of the driver model: m/s2, m/s2, seconds, metres
_SIDEWAYS = 2.2  # m/s2 that a driver takes in curves
_LOOK = np.arange(2, 46, 2.0)  # metres ahead on the own path at which others are looked for
_FORESEEN = np.arange(0.5, 3.1, 0.5)  # seconds ahead that drivers look at the ways of others
_PATIENCE = 5.0  # seconds after which a driver no longer gives way
_JAM, _DRAWS = 20.0, 8  # seconds of standing after which a drive is drawn anew, and how often at most


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
        walkers, vehicles = self._flowing(steps)
        self.ego = vehicles[0].track
        self.movers = [*vehicles[1:], *self._crossing(walkers), *self._strolling(steps)]

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

    def _flowing(self, steps: int) -> tuple[Walkers, list[Mover]]:
        """Walkers and vehicles, the ego vehicle first; drawn anew where it is caught in a jam for long."""
        for _ in range(_DRAWS):
            walkers = Walkers(*self._loops())
            vehicles = self._drive(steps, walkers)
            if _longest_stand(vehicles[0].track) < _JAM:
                break
        return walkers, vehicles

    def _drive(self, steps: int, walkers: Walkers, count: int = 20) -> list[Mover]:
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
        tracks = _Road(paths, limits, np.array(lengths), np.array(starts), walkers).run(steps)
        return [
            Mover(n, kind, self._seed(n), track)
            for n, (kind, track) in enumerate(zip(kinds, tracks))
            if track is not None
        ]

    def _seed(self, number: int) -> tuple[int, ...]:
        return (self._world.seed, 4, number, self._traversal)

    def _loops(self, count: int = 24) -> tuple[list[Array], Array, Array, Array]:
        """Walks about a street, over both of its crossings: paths, gates, speeds and first places of `Walkers`."""
        rng, paths, gates = self._rng, [], []
        for _ in range(count):
            street = self._built_up()
            line = trimmed(street.line, CROSSING, CROSSING)
            right, left = (
                LANE + PARKING_WIDTH * parking + PAVEMENT_WIDTH * float(rng.uniform(0.4, 0.85))
                for parking in street.parking
            )
            there, back = offset(line, right), offset(line[::-1], left)
            paths.append(resampled(np.concatenate([there, back, there[:1]]), Walkers.STEP))
            first, across, second = float(arc_length(there)[-1]), right + left, float(arc_length(back)[-1])
            kerb = LANE + 0.4
            starts = np.array([first + right, first + across + second + left]) - kerb
            gates.append(np.stack([starts, starts + 2 * kerb], 1))
        speeds = np.clip(rng.normal(1.35, 0.2, count), 0.7, 2)
        return paths, np.array(gates), speeds, rng.uniform(0, 1, count)

    def _built_up(self) -> Street:
        """A street with pavements; any, where the town has none."""
        streets = [s for s in self._world.network.streets if not s.highway]
        lined = [s for s in streets if s.setting != "open"] or streets
        return lined[int(self._rng.integers(len(lined)))]

    def _crossing(self, walkers: Walkers) -> list[Mover]:
        tracks = walkers.tracks()
        return [Mover(200 + n, "pedestrian", self._seed(200 + n), track) for n, track in enumerate(tracks)]

    def _strolling(self, steps: int, count: int = 24) -> list[Mover]:
        """People who walk up and down a pavement, some of them standing."""
        rng, movers = self._rng, []
        for number in range(300, 300 + count):
            street, side = self._built_up(), int(rng.integers(2))
            edge = LANE + PARKING_WIDTH * street.parking[side] + PAVEMENT_WIDTH * float(rng.uniform(0.4, 0.85))
            line = resampled(offset(trimmed(street.line[:: 1 - 2 * side], 16, 16), edge), 1.0)
            speed = 0.0 if rng.random() < 0.3 else float(np.clip(rng.normal(1.35, 0.2), 0.7, 2))
            track = _to_and_fro(line, float(rng.uniform(0, 1)), speed, steps)
            movers.append(Mover(number, "pedestrian", self._seed(number), track))
        return movers

    def height(self, kind: str, place: Array) -> float:
        """Metres of the ground under an object at a place (x, y, ...)."""
        # a wheel on the kerb lifts no vehicle
        lift = self._world.lift(place[:2], 0.0 if kind == "pedestrian" else 1.5)
        return float(self._world.hills.height(place[:2])) + lift


def _longest_stand(track: Array) -> float:
    """Seconds that the longest halt of a track (T, 4) lasts."""
    moves = np.flatnonzero(np.concatenate([[True], track[:, 3] >= 0.3, [True]]))
    return float(np.diff(moves).max() - 1) * PERIOD


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


class Walkers:
    """People who walk in loops and cross streets at crossings, when no vehicle is too near to stop.

    `paths`: closed polylines with a point every STEP metres. `gates` (N, 2, 2): where along its path each enters and
    leaves the carriageway at its two crossings, metres. `speeds` (N,) in m/s. `starts` (N,): first place, share of
    the loop. Who stands at the kerb waits; vehicles that can stop do.
    """

    STEP = 0.5

    def __init__(self, paths: list[Array], gates: Array, speeds: Array, starts: Array) -> None:
        self._paths, self._gates, self._speeds = paths, gates, speeds
        self._total = np.array([len(path) for path in paths]) * self.STEP
        self._along = starts * self._total
        self._states: list[Array] = []

    def crossing(self) -> list[tuple[int, Array, bool]]:
        """Who is on a carriageway (True) or stands at the kerb: number, the way still to go (P, 2), which."""
        found = []
        place = self._along % self._total
        on = (self._gates[..., 0] < place[:, None]) & (place[:, None] < self._gates[..., 1])
        soon = self._gates[..., 0] - place[:, None]
        at_kerb = (soon >= 0) & (soon <= self._speeds[:, None] * PERIOD)
        for number, gate in np.argwhere(on | at_kerb):
            way = np.arange(place[number], self._gates[number, gate, 1] + 0.5, 0.5)
            found.append((int(number), self._at(number, way), bool(on[number, gate])))
        return found

    def _at(self, number: int, along: Array) -> Array:
        path = self._paths[number]
        at = np.arange(len(path) + 1) * self.STEP
        closed = np.concatenate([path, path[:1]])
        along = along % self._total[number]
        return np.stack([np.interp(along, at, closed[:, axis]) for axis in (0, 1)], -1)

    def advance(self, waiting: set[int], *, record: bool) -> None:
        """Walk on for a period; those who wait stand."""
        speed = self._speeds.copy()
        speed[list(waiting)] = 0
        self._along = self._along + speed * PERIOD
        if record:
            self._states.append(np.stack([self._along, speed], 1))

    def tracks(self) -> list[Array]:
        """Tracks (T, 4) of what was recorded."""
        states = np.stack(self._states, 1)
        tracks = []
        for number, (along, speed) in enumerate(zip(states[..., 0], states[..., 1])):
            place = self._at(number, along)
            # a step ahead and a step behind: corners are rounded
            chord = self._at(number, along + 0.4) - self._at(number, along - 0.4)
            yaw = np.unwrap(np.arctan2(chord[:, 1], chord[:, 0]))
            tracks.append(np.concatenate([place, yaw[:, None], speed[:, None]], 1))
        return tracks


class _Road:
    """Vehicles on their paths. Each follows whatever is on its own path ahead, and gives way.

    To vehicles from the right whose way crosses the own, and to people at crossings, where there is room to brake.
    """

    def __init__(self, paths: list[Array], plans: list[Array], lengths: Array, starts: Array, walkers: Walkers) -> None:
        longest = max(len(path) for path in paths)
        self.path = np.stack([np.pad(p, ((0, longest - len(p)), (0, 0)), mode="edge") for p in paths])
        self.yaw = np.stack([np.pad(np.unwrap(headings(p)), (0, longest - len(p)), mode="edge") for p in paths])
        self.plan = np.stack([np.pad(p, (0, longest - len(p)), mode="edge") for p in plans])
        self.ends = np.array([len(path) for path in paths]) * 0.5 - 30
        self.length, self.along, self.walkers = lengths, starts, walkers
        self.speed = np.zeros(len(paths))
        self.waited = np.zeros(len(paths))

    def run(self, steps: int, warm_up: int = 80) -> list[Array | None]:
        """Tracks (T, 4) for `steps` + 2 moments; None for a vehicle that had no room to start."""
        there = self._room()
        self.speed = self._at(self.plan) * 0.8
        states = []
        for step in range(warm_up + steps + 2):
            self._advance(there, record=step >= warm_up)
            if step >= warm_up:
                states.append(np.stack([*self._places().T, self._at(self.yaw), self.speed], 1))
        tracks = np.stack(states, 1)
        return [track if alive else None for track, alive in zip(tracks, there)]

    def _at(self, table: Array) -> Array:
        where = np.clip(self.along / 0.5, 0, table.shape[1] - 2)
        first = where.astype(int)
        rows = np.arange(len(table))
        return np.asarray(table[rows, first] * (1 - (where - first)) + table[rows, first + 1] * (where - first))

    def _ahead(self, metres: Array) -> tuple[Array, Array]:
        """Places (V, L, 2) and headings (V, L) on the own paths, `metres` (V, L) or (L,) ahead."""
        index = np.clip(((self.along[:, None] + metres) / 0.5).astype(int), 0, self.path.shape[1] - 1)
        rows = np.arange(len(index))[:, None]
        return self.path[rows, index], self.yaw[rows, index]

    def _places(self) -> Array:
        return np.stack([self._at(self.path[..., axis]) for axis in (0, 1)], 1)

    def _bodies(self) -> Array:
        """Front, middle and rear (V, 3, 2): an outstretched vehicle counts by all of them."""
        reach, yaw = self.length[:, None] * np.array([-0.4, 0, 0.4]), self._at(self.yaw)
        ahead = np.stack([np.cos(yaw), np.sin(yaw)], 1)
        return np.asarray(self._places()[:, None] + reach[..., None] * ahead[:, None])

    def _room(self) -> np.ndarray:
        """Vehicles are let in one after another where 14 m are free."""
        places, there = self._places(), np.zeros(len(self.along), bool)
        for number in range(len(there)):
            apart = np.linalg.norm(places - places[number], axis=1)
            there[number] = not (there & (apart < 14)).any()
        return there

    def _advance(self, there: np.ndarray, *, record: bool) -> None:
        gap, theirs = self._vehicle_ahead(there)
        stop = np.minimum(self._gap_to_crossers(there, record=record), self._gap_to_right(there))
        theirs, gap = np.where(stop < gap, 0.0, theirs), np.minimum(gap, stop)
        wanted = np.maximum(self._at(self.plan), 0.5)
        closing = self.speed * (self.speed - theirs) / (2 * np.sqrt(_ACCELERATION * _BRAKING))
        room = _GAP + np.maximum(self.speed * _HEADWAY + closing, 0)
        push = _ACCELERATION * (1 - (self.speed / wanted) ** 4 - (room / np.maximum(gap, 0.3)) ** 2)
        self.speed = np.maximum(self.speed + np.clip(push, -7, 2) * PERIOD, 0)
        self.speed[self.along > self.ends] = 0
        self.along = self.along + self.speed * PERIOD
        self.waited = np.where(self.speed < 0.3, self.waited + PERIOD, 0)

    def _vehicle_ahead(self, there: np.ndarray) -> tuple[Array, Array]:
        """Gap in metres to the next vehicle on the own path, and its speed along that path."""
        rows, yaw = np.arange(len(self.along)), self._at(self.yaw)
        places, bodies = self._ahead(_LOOK)[0], self._bodies()
        others = (there & (rows[:, None] != rows))[:, None]
        # there is room beside a bicycle
        reach = np.where(self.length < 2, 1.3, 1.55)[:, None]
        across = np.abs(np.sin(yaw[:, None] - yaw)) > 0.5
        # of two that stand in each other's way, the lower number squeezes past after a while
        first = (rows[None] > rows[:, None]) & (self.waited[:, None] > 4 + rows[:, None] * 0.2)
        past = (across & first)[:, None] & ~_near(places, bodies, 1.0)
        hit = others & _near(places, bodies, reach) & ~past
        gap, nearest = self._first(hit.any(2))
        other = hit[rows, nearest].argmax(1)
        theirs = np.maximum(self.speed[other] * np.cos(yaw[other] - yaw), 0)
        return gap, np.where(gap < 1e3, theirs, self.speed)

    def _first(self, blocked: np.ndarray) -> tuple[Array, np.ndarray]:
        """Gap (V,) to the first blocked place (V, L) ahead, 1e3 for none, and which place it is."""
        nearest = np.where(blocked.any(1), blocked.argmax(1), 0)
        return np.where(blocked.any(1), _LOOK[nearest] - self.length / 2, 1e3), nearest

    def _can_stop(self, gap: Array) -> np.ndarray:
        """Whether a vehicle stops within a gap (V,) without haste."""
        return np.asarray(gap > self.speed**2 / (2 * _BRAKING) + self.speed * 0.5 + 1)

    def _gap_to_right(self, there: np.ndarray) -> Array:
        """Gap (V,) to where the way of a vehicle from the right crosses the own; 1e3 for none, or too late to stop."""
        places, yaw = self._ahead(_LOOK)
        theirs, headed = self._ahead(self.speed[:, None] * _FORESEEN)
        near = _near(places, theirs, 2.0, each=True)
        # it comes from the right if it goes to the left there
        from_right = np.sin(headed[None, None] - yaw[:, :, None, None]) > 0.5
        goes = there & (self.speed > 0.5) & ~np.eye(len(there), dtype=bool)
        crossed = np.asarray(((near & from_right).any(3) & goes[:, None]).any(2))
        gap, _ = self._first(crossed)
        return np.where(self._can_stop(gap) & (self.waited < _PATIENCE), gap, 1e3)

    def _gap_to_crossers(self, there: np.ndarray, *, record: bool) -> Array:
        """Gap (V,) to the nearest crossing that people are on, or wait at; they walk on, or wait, as well."""
        gap, waiting = np.full(len(there), 1e3), set()
        places, bodies = self._ahead(_LOOK)[0], self._bodies()
        for number, way, on_road in self.walkers.crossing():
            found, _ = self._first(_near(places, way[None], 1.6)[..., 0])
            able = self._can_stop(found)
            blocked = _near(bodies, way[None], 2.2).any((1, 2)) & there
            if not on_road and (blocked | (there & ~able & (self.speed > 0.5))).any():
                waiting.add(number)
            gap = np.where(able | on_road, np.minimum(gap, found), gap)
        self.walkers.advance(waiting, record=record)
        return gap


def _near(places: Array, others: Array, reach: float | Array, *, each: bool = False) -> np.ndarray:
    """Which places (V, L, 2) are within `reach` metres, one or (W, 1), of any point of others (W, P, 2): (V, L, W).

    With `each`, (V, L, W, P): of which point.
    """
    east, north = (places[:, :, None, None, axis] - others[..., axis] for axis in (0, 1))
    close = east * east + north * north < reach**2
    return np.asarray(close if each else close.any(-1))


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
