"""A drive through a town: what the sensors of the ego vehicle measure at every moment, and the truth about it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lidarfw_town.beams import Body, merge
from lidarfw_town.bodies import KINDS, make
from lidarfw_town.light import WEATHER
from lidarfw_town.mesh import Array, Mesh, join
from lidarfw_town.sensors import Floats, Hits, Lidar, Scene, first_hits, receive
from lidarfw_town.traffic import Mover, Parked, Traffic
from lidarfw_town.world import World

NEAREST = 0.5  # metres: what is nearer is left out
SEEN_FROM = 120.0  # metres: objects farther away are not simulated
_MOVES = 0.3  # m/s from which on an object counts as moving


@dataclass(frozen=True)
class Object:
    """A movable object in a scan. The box is in the frame of the scan's points: x, y, z, l, w, h, yaw."""

    id: int
    kind: str  # key of lidarfw_town.bodies.KINDS
    box: tuple[float, ...]
    velocity: tuple[float, float]  # over ground, in the axes of the scan, m/s
    moving: bool
    points: int  # of the scan that lie on it
    visible: float  # share of the beams towards it that reach it, 0..1
    moment: float  # when the beams pass it, in periods of the drive: then it is in its box


@dataclass(frozen=True, eq=False)
class TownFrame:
    """A scan with its truth. Points (N, 4) x, y, z, remission; `label` (N,) SemanticKITTI's uint32, class and instance.

    `pose` (4, 4) maps the frame of the points to the world; `bodies` are the moving objects as the scan saw them.
    """

    number: int
    time: float
    points: Floats
    label: np.ndarray
    objects: list[Object]
    pose: Array
    bodies: list[Body]
    grid: Floats  # (beams, columns) ranges in metres, 0 where nothing came back

    @property
    def columns(self) -> np.ndarray:
        """The column (N,) of the turn in which every point was measured."""
        return np.asarray(np.nonzero(self.grid > NEAREST)[1])

    @cached_property
    def movers(self) -> Scene:
        """The moving objects, for rays of a camera."""
        return Scene(join([body.placed for body in self.bodies]))


Passed = tuple[Mover | Parked, Body, float, Array]  # an object; its body, the moment, the LiDAR's pose when passed


class Drive:
    """A traversal of the town of a seed by a vehicle with a LiDAR: frame after frame, PERIOD seconds apart.

    With `compensated`, the points of a scan are where they were at its middle moment, as if the vehicle had stood
    still (as in KITTI odometry); without, they are where the turning sensor saw them. Boxes fit the points either way:
    an object is scanned at the moment when the beams pass it, and its box is that of this moment. `circuit`: every
    traversal goes round the same loop. `world` is that of the seed, where it stands already.
    """

    def __init__(
        self,
        seed: int,
        steps: int,
        lidar: Lidar,
        *,
        traversal: int = 0,
        compensated: bool = False,
        weather: str = "clear",
        circuit: bool = False,
        world: World | None = None,
    ) -> None:
        self.seed, self.traversal, self.lidar, self.compensated = seed, traversal, lidar, compensated
        self.weather = weather
        self.world = world or World(seed)
        self.traffic = Traffic(self.world, traversal, steps, circuit=circuit)
        self._directions, self._shares = lidar.rays()

    @cached_property
    def still(self) -> Scene:
        """The town with its parked vehicles."""
        return Scene(join([self.world.mesh, *(body.placed for body in self._parked.values())]))

    @cached_property
    def _parked(self) -> dict[int, Body]:
        return {p.id: self._body(p, p.pose, make(p.kind, p.seed).without_glow()) for p in self.traffic.parked}

    def _body(self, thing: Mover | Parked, state: Array, mesh: Mesh) -> Body:
        height = self.traffic.height(thing.kind, state)
        return Body(thing.id, mesh, (float(state[0]), float(state[1]), height), float(state[2]))

    def poses(self, steps: Array) -> Array:
        """Poses (S, 4, 4) of the LiDAR in the world at moments counted in periods."""
        track, at = self.traffic.ego, np.arange(len(self.traffic.ego))
        x, y, yaw = (np.interp(steps, at, track[:, axis]) for axis in range(3))
        place = np.stack([x, y], -1)
        slope = self.world.hills.slope(place)
        up = np.concatenate([-slope, np.ones((len(x), 1))], 1)
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        ahead = np.stack([np.cos(yaw), np.sin(yaw), slope[:, 0] * np.cos(yaw) + slope[:, 1] * np.sin(yaw)], 1)
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        pose = np.tile(np.eye(4), (len(x), 1, 1))
        pose[:, :3, 0], pose[:, :3, 1], pose[:, :3, 2] = ahead, np.cross(up, ahead), up
        pose[:, :3, 3] = np.concatenate([place, self.world.hills.height(place)[:, None]], 1) + up * self.lidar.height
        return pose

    def frame(self, step: int) -> TownFrame:
        """The scan whose middle is at a step of the drive; the same for the same arguments, in any order of calls."""
        rng = np.random.default_rng((self.seed, 5, self.traversal, step))
        pose = self.poses(np.array([float(step)]))[0]
        origins, directions = self._rays(step)
        bodies = self._bodies(step, pose)
        hits, beams = self._hits(bodies, origins, directions)
        scan = receive(self.lidar, hits, directions, rng, WEATHER[self.weather])
        back = np.flatnonzero(scan.range.ravel() > NEAREST)
        local = self._directions.reshape(-1, 3)[back] * scan.range.ravel()[back, None]
        if self.compensated:
            world = origins[back] + directions[back] * scan.range.ravel()[back, None]
            local = (world - pose[:3, 3]) @ pose[:3, :3]
        points = np.concatenate([local, scan.remission.ravel()[back, None]], 1).astype(np.float32)
        instance = scan.instance.ravel()[back]
        objects = self._objects(bodies, pose, beams, _counts(hits.instance), _counts(instance))
        label = _labels(scan.semantic.ravel()[back], instance, objects)
        moving = [body for thing, body, _, _ in bodies if isinstance(thing, Mover)]
        return TownFrame(step, step * self.lidar.turn, points, label, objects, pose, moving, scan.range)

    def in_world(self, frame: TownFrame) -> Array:
        """Where the points of a frame were in the world (N, 3), each by the LiDAR's pose when it was measured."""
        moments = frame.number + self._shares.astype(float)[frame.columns]
        poses = frame.pose[None] if self.compensated else self.poses(moments)
        return np.asarray((poses[:, :3, :3] @ frame.points[:, :3, None].astype(float))[..., 0] + poses[:, :3, 3])

    def in_box(self, thing: Object, frame: TownFrame, world: Array) -> Array:
        """Places (N, 3) of the world in the axes of an object's box, from its centre, when the beams pass it."""
        pose = frame.pose if self.compensated else self.poses(np.array([thing.moment]))[0]
        cosine, sine = np.cos(thing.box[6]), np.sin(thing.box[6])
        turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
        return np.asarray(((world - pose[:3, 3]) @ pose[:3, :3] - thing.box[:3]) @ turn)

    def _rays(self, step: int) -> tuple[Floats, Floats]:
        """Origins and directions (beams * columns, 3) in the world; every column from where the vehicle then is."""
        poses = self.poses(step + self._shares.astype(float))
        turns, places = (np.ascontiguousarray(part, np.float32) for part in (poses[:, :3, :3], poses[:, :3, 3]))
        ahead, left, up = (np.ascontiguousarray(self._directions[..., axis]) for axis in range(3))
        turned = [ahead * turn[:, 0] + left * turn[:, 1] + up * turn[:, 2] for turn in turns.swapaxes(0, 1)]
        return np.tile(places, (len(ahead), 1)), np.stack(turned, -1).reshape(-1, 3)

    def _bodies(self, step: int, pose: Array) -> list[Passed]:
        """Everything movable near by, where it is when the beams pass it."""
        things: list[Mover | Parked] = [*self.traffic.movers, *self.traffic.parked]
        states = [thing.at(step) if isinstance(thing, Mover) else thing.pose for thing in things]
        near = [np.hypot(*(state[:2] - pose[:2, 3])) <= SEEN_FROM for state in states]
        moments = [step + self._passed(state, pose) for state in states]
        bodies: list[Passed] = []
        for thing, moment, frame, close in zip(things, moments, self.poses(np.array(moments)), near):
            if close and isinstance(thing, Parked):
                bodies.append((thing, self._parked[thing.id], moment, frame))
            elif close and isinstance(thing, Mover):
                bodies.append((thing, self._body(thing, thing.at(moment), thing.body(moment)), moment, frame))
        return bodies

    def _hits(self, bodies: list[Passed], origins: Floats, directions: Floats) -> tuple[Hits, dict[int, int]]:
        """What the beams meet first; and how many would reach an object that stood alone, of those that some reach."""
        hits = first_hits([self.still], origins, directions)
        travel = float(np.linalg.norm(origins[0] - origins[-1]))
        standing, beams = set(_counts(hits.instance)), {}
        for thing, body, _, frame in bodies:
            moves = isinstance(thing, Mover)
            if moves or body.id in standing:
                rows = body.window(self.lidar, frame, travel)
                distance, triangle, normal = body.meet(origins[rows], directions[rows])
                beams[body.id] = int((triangle >= 0).sum())
                if moves:
                    merge(hits, body, rows, distance, triangle, normal)
        return hits, beams

    def _passed(self, state: Array, pose: Array) -> float:
        """When in a turn, -0.5..0.5, the beams pass a place."""
        local = pose[:2, :2].T @ (state[:2] - pose[:2, 3])
        return float(-np.arctan2(local[1], local[0]) / (2 * np.pi))

    def _objects(
        self, bodies: list[Passed], pose: Array, beams: dict[int, int], reached: dict[int, int], points: dict[int, int]
    ) -> list[Object]:
        """The truth about all objects that some beam reaches; `beams`, `reached`, `points` are numbers by object."""
        objects = []
        for thing, body, moment, frame in bodies:
            if thing.id not in reached:
                continue
            axes_of = pose if self.compensated else frame
            state = thing.at(moment) if isinstance(thing, Mover) else np.append(thing.pose, 0.0)
            speed, axes = float(state[3]), axes_of[:3, :3].T @ (np.cos(state[2]), np.sin(state[2]), 0.0)
            velocity = (float(axes[0] * speed), float(axes[1] * speed))
            box = _box_of(body.placed, axes_of, float(np.arctan2(axes[1], axes[0])))
            visible = reached[thing.id] / max(beams[thing.id], reached[thing.id])
            objects.append(
                Object(thing.id, thing.kind, box, velocity, speed > _MOVES, points.get(thing.id, 0), visible, moment)
            )
        return objects


def _counts(instance: np.ndarray) -> dict[int, int]:
    """How often every number but 0 occurs."""
    numbers, counts = np.unique(instance[instance > 0], return_counts=True)
    return dict(zip(numbers.tolist(), counts.tolist()))


def _box_of(body: Mesh, frame: Array, yaw: float) -> tuple[float, ...]:
    """The upright box of a heading that holds a body exactly, in a frame."""
    local = (body.triangles.reshape(-1, 3).astype(np.float64) - frame[:3, 3]) @ frame[:3, :3]
    cosine, sine = np.cos(yaw), np.sin(yaw)
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    local = local @ turn
    low, high = local.min(0), local.max(0)
    center = turn @ ((low + high) / 2)
    return (*center.tolist(), *(high - low).tolist(), yaw)


def _labels(semantic: np.ndarray, instance: np.ndarray, objects: list[Object]) -> np.ndarray:
    """SemanticKITTI labels: moving classes for moving objects, the instance in the high 16 bits."""
    whole = semantic.astype(np.uint32)
    for thing in objects:
        if thing.moving:
            whole[instance == thing.id] = KINDS[thing.kind].moving
    return np.asarray(whole | (instance.astype(np.uint32) << 16))
