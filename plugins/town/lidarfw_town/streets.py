"""The street network: a graph of curved streets with loops and a highway, and the lanes that vehicles drive on."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lidarfw_town.mesh import Array

LANE = 3.75  # metres
PARKING_WIDTH = 2.3
PAVEMENT_WIDTH = 2.4
TRIM = 11.0  # metres from a node at which its junction begins
CROSSING = 14.0  # metres from a node at which people cross a street
# how streets are built up, how often, and how often a side has parking bays
_SETTINGS = {"terrace": (0.15, 0.8), "suburb": (0.42, 0.6), "open": (0.43, 0.25)}
CIRCUIT = 620.0  # metres of the way that is driven again and again


@dataclass(frozen=True, eq=False)
class Street:
    """An edge of the network. `line` (P, 2) runs from node `start` to node `end`, about 3 m from point to point."""

    start: int
    end: int
    line: Array
    highway: bool
    parking: tuple[bool, bool]  # parking bays at the right, at the left
    setting: str = "open"  # terrace: house by house; suburb: houses in gardens; open: fields and trees

    @property
    def half_width(self) -> float:
        """Metres from the middle to the edge of the carriageway, without parking bays."""
        return 2 * LANE + 1.2 if self.highway else LANE

    @property
    def limit(self) -> float:
        """Speed limit, metres a second."""
        return 25.0 if self.highway else 13.0


@dataclass(frozen=True, eq=False)
class Network:
    """Nodes (N, 2) in metres and the streets between them."""

    nodes: Array
    streets: tuple[Street, ...]

    def at(self, node: int) -> list[Street]:
        """The streets that meet at a node."""
        return [street for street in self.streets if node in (street.start, street.end)]


def build_network(rng: np.random.Generator, columns: int = 4, rows: int = 3, spacing: float = 105.0) -> Network:
    """A grid with moved nodes, bent streets and some streets left out, and a highway along one side."""
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij"), -1).reshape(-1, 2) * spacing
    nodes = grid + rng.uniform(-14, 14, grid.shape)
    pairs = [(i * rows + j, (i + 1) * rows + j) for i in range(columns - 1) for j in range(rows)]
    pairs += [(i * rows + j, i * rows + j + 1) for i in range(columns) for j in range(rows - 1)]
    pairs = _thinned(pairs, len(nodes), rng)
    west, east = len(nodes), len(nodes) + 1
    ends = np.array([nodes[0] + (-20, -95), nodes[(columns - 1) * rows] + (20, -95)])
    nodes = np.concatenate([nodes, ends])
    streets = [_street(nodes, pair, rng) for pair in [*pairs, (0, west), ((columns - 1) * rows, east)]]
    streets.append(Street(west, east, _bent(nodes[west], nodes[east], -25.0), True, (False, False)))
    return Network(nodes, tuple(streets))


def _thinned(pairs: list[tuple[int, int]], count: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Leave some pairs out while every node keeps two streets at least and all hang together."""
    kept = list(pairs)
    for number in rng.permutation(len(pairs))[: len(pairs) // 3]:
        rest = [pair for pair in kept if pair != pairs[number]]
        degree = np.bincount(np.array(rest).ravel(), minlength=count)
        if degree.min() >= 2 and _connected(rest, count) and len(kept) > len(pairs) * 0.8:
            kept = rest
    return kept


def _connected(pairs: list[tuple[int, int]], count: int) -> bool:
    reached = {0}
    for _ in range(count):
        reached |= {b for pair in pairs for a, b in (pair, pair[::-1]) if a in reached}
    return len(reached) == count


def _street(nodes: Array, pair: tuple[int, int], rng: np.random.Generator) -> Street:
    line = _bent(nodes[pair[0]], nodes[pair[1]], float(rng.normal(0, 7)))
    shares = [share for share, _ in _SETTINGS.values()]
    setting = list(_SETTINGS)[int(rng.choice(len(shares), p=shares))]
    right, left = rng.random(2) < _SETTINGS[setting][1]
    return Street(*pair, line, False, (bool(right), bool(left)), setting)


def _bent(a: Array, b: Array, bend: float) -> Array:
    """A parabola from a to b that leaves the straight line by `bend` metres."""
    ahead = b - a
    length = float(np.linalg.norm(ahead))
    share = np.linspace(0, 1, max(int(length / 3), 2))[:, None]
    normal = np.array([-ahead[1], ahead[0]]) / length
    return np.asarray(a + ahead * share + normal * bend * 4 * share * (1 - share))


def headings(line: Array) -> Array:
    """Direction (P,) of a polyline at its points, radians."""
    slope = np.gradient(line, axis=0)
    return np.asarray(np.arctan2(slope[:, 1], slope[:, 0]))


def offset(line: Array, right: float) -> Array:
    """The polyline moved to its right by some metres."""
    angle = headings(line)
    return np.asarray(line + right * np.stack([np.sin(angle), -np.cos(angle)], 1))


def arc_length(line: Array) -> Array:
    """Metres (P,) along a polyline from its begin."""
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def resampled(line: Array, step: float) -> Array:
    """The polyline with points every `step` metres."""
    along = arc_length(line)
    at = np.arange(0, along[-1], step)
    return np.stack([np.interp(at, along, line[:, 0]), np.interp(at, along, line[:, 1])], 1)


def trimmed(line: Array, begin: float, end: float) -> Array:
    """The polyline without its first and last metres."""
    along = arc_length(line)
    at = np.concatenate([[begin], along[(along > begin) & (along < along[-1] - end)], [along[-1] - end]])
    return np.stack([np.interp(at, along, line[:, 0]), np.interp(at, along, line[:, 1])], 1)


def random_route(network: Network, first: Street, forward: bool, length: float, rng: np.random.Generator) -> list[int]:
    """Node numbers of a drive of at least `length` metres that never turns back, and prefers streets not seen yet."""
    route = [first.start, first.end] if forward else [first.end, first.start]
    seen, done = {frozenset(route)}, float(arc_length(first.line)[-1])
    while done < length:
        choices = [s for s in network.at(route[-1]) if route[-2] not in (s.start, s.end)]
        weights = np.array([0.1 if frozenset((s.start, s.end)) in seen else 1.0 for s in choices])
        street = choices[int(rng.choice(len(choices), p=weights / weights.sum()))]
        route.append(street.end if street.start == route[-1] else street.start)
        seen.add(frozenset((street.start, street.end)))
        done += float(arc_length(street.line)[-1])
    return route


def circuit(network: Network, reverse: bool, length: float) -> list[int]:
    """Node numbers of at least `length` metres round and round the loop of streets that is nearest to CIRCUIT long."""
    metres = {}
    for street in network.streets:
        if not street.highway:
            metres[street.start, street.end] = metres[street.end, street.start] = float(arc_length(street.line)[-1])
    loops = [loop for node in range(len(network.nodes)) for loop in _loops([node], metres)]
    total = [sum(metres[pair] for pair in itertools.pairwise([*loop, loop[0]])) for loop in loops]
    best = min(range(len(loops)), key=lambda n: (abs(total[n] - CIRCUIT), loops[n]))
    loop = loops[best] if not reverse else [loops[best][1], loops[best][0], *loops[best][:1:-1]]
    rounds = int(length / total[best]) + 2
    return [*loop * rounds, loop[0]]


def _loops(path: list[int], metres: Mapping[tuple[int, int], float]) -> Iterator[list[int]]:
    """Every loop without crossings that starts with `path`, from its lowest node on, in both directions."""
    for a, b in metres:
        if a != path[-1] or b < path[0] or len(path) > 12:
            continue
        if b == path[0] and len(path) > 2:
            yield path
        elif b not in path:
            yield from _loops([*path, b], metres)


def lane_path(network: Network, route: Sequence[int], side: float = 0.0, step: float = 0.5) -> tuple[Array, Array]:
    """The lane of a route: points (P, 2) every `step` metres, and the speed limit (P,) at each, in metres a second.

    Vehicles keep to the right; `side` moves the path further to the right. Junctions are crossed on Bezier curves.
    """
    parts: list[Array] = []
    limits: list[Array] = []
    by_ends = {frozenset((s.start, s.end)): s for s in network.streets}
    for a, b in itertools.pairwise(route):
        street = by_ends[frozenset((a, b))]
        line = street.line if street.start == a else street.line[::-1]
        right = (LANE * 1.5 + 1.0 if street.highway else LANE / 2) + side
        lane = offset(trimmed(line, TRIM, TRIM), right)
        if parts:
            before, lane = _with_room(parts[-1], lane)
            limits[-1], parts[-1] = limits[-1][: len(before)], before
            curve = _turn(before, lane)
            parts.append(curve)
            limits.append(np.full(len(curve), 8.0))
        parts.append(lane)
        limits.append(np.full(len(lane), street.limit))
    whole, limit = np.concatenate(parts), np.concatenate(limits)
    along = arc_length(whole)
    path = resampled(whole, step)
    return path, np.interp(np.arange(len(path)) * step, along, limit)


def _with_room(before: Array, after: Array) -> tuple[Array, Array]:
    """Two lanes with their ends shortened until the way from one to the other leads ahead, as at sharp corners."""
    for _ in range(6):
        way = after[0] - before[-1]
        leave, enter = before[-1] - before[-2], after[1] - after[0]
        if min(way @ leave / np.linalg.norm(leave), way @ enter / np.linalg.norm(enter)) > 4 or len(before) < 8:
            break
        before, after = before[:-1], after[1:]
    return before, after


def _turn(before: Array, after: Array) -> Array:
    """A cubic Bezier curve from the end of one lane to the begin of the next, without the two ends."""
    start, end = before[-1], after[0]
    reach = np.linalg.norm(end - start) * 0.45
    leave, enter = before[-1] - before[-2], after[1] - after[0]
    a = start + leave / np.linalg.norm(leave) * reach
    b = end - enter / np.linalg.norm(enter) * reach
    t = np.linspace(0, 1, 14)[1:-1, None]
    return np.asarray((1 - t) ** 3 * start + 3 * (1 - t) ** 2 * t * a + 3 * (1 - t) * t**2 * b + t**3 * end)
