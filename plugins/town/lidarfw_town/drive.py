"""A drive through a town: what the sensors of the ego vehicle measure at every moment, and the truth about it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lidarfw_town.bodies import KINDS
from lidarfw_town.light import WEATHER
from lidarfw_town.mesh import Array, Mesh, join
from lidarfw_town.sensors import Floats, Hits, Lidar, Scene, first_hits, receive
from lidarfw_town.traffic import Mover, Parked, Traffic
from lidarfw_town.world import World

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


@dataclass(frozen=True, eq=False)
class TownFrame:
    """A scan with its truth. Points (N, 4) x, y, z, remission; `label` (N,) SemanticKITTI's uint32, class and instance.

    `pose` (4, 4) maps the frame of the points to the world; `movers` are the moving objects as the scan saw them.
    """

    number: int
    time: float
    points: Floats
    label: np.ndarray
    objects: list[Object]
    pose: Array
    movers: Scene
    grid: Floats  # (beams, columns) ranges in metres, 0 where nothing came back


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
        return Scene(join([self.world.mesh, *self._parked.values()]))

    @cached_property
    def _parked(self) -> dict[int, Mesh]:
        return {
            p.id: self._placed(p, p.pose, Mover(p.id, p.kind, p.seed, np.zeros((2, 4))).body(0))
            for p in self.traffic.parked
        }

    def _placed(self, thing: Mover | Parked, state: Array, body: Mesh) -> Mesh:
        height = self.traffic.height(thing.kind, state)
        return body.placed(float(state[0]), float(state[1]), height, float(state[2])).with_instance(thing.id)

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
        bodies = self._bodies(step, pose)
        movers = Scene(join([body for thing, body, _ in bodies if isinstance(thing, Mover)]))
        origins, directions = self._rays(step)
        hits = first_hits([self.still, movers], origins, directions)
        scan = receive(self.lidar, hits, directions, rng, WEATHER[self.weather])
        back = scan.range.ravel() > 0.5
        local = self._directions.reshape(-1, 3)[back] * scan.range.ravel()[back, None]
        if self.compensated:
            world = origins[back] + directions[back] * scan.range.ravel()[back, None]
            local = (world - pose[:3, 3]) @ pose[:3, :3]
        points = np.concatenate([local, scan.remission.ravel()[back, None]], 1).astype(np.float32)
        instance = scan.instance.ravel()[back]
        objects = self._objects(bodies, step, pose, hits, instance, origins, directions)
        label = _labels(scan.semantic.ravel()[back], instance, objects)
        return TownFrame(step, step * self.lidar.turn, points, label, objects, pose, movers, scan.range)

    def _rays(self, step: int) -> tuple[Floats, Floats]:
        """Origins and directions (beams * columns, 3) in the world; every column from where the vehicle then is."""
        poses = self.poses(step + self._shares.astype(float))
        directions = np.einsum("cij,bcj->bci", poses[:, :3, :3], self._directions, optimize=False)
        origins = np.broadcast_to(poses[None, :, :3, 3], directions.shape)
        return (
            np.ascontiguousarray(origins, np.float32).reshape(-1, 3),
            np.ascontiguousarray(directions, np.float32).reshape(-1, 3),
        )

    def _bodies(self, step: int, pose: Array) -> list[tuple[Mover | Parked, Mesh, float]]:
        """Everything movable near by, where it is when the beams pass it, and that moment."""
        bodies: list[tuple[Mover | Parked, Mesh, float]] = []
        things: list[Mover | Parked] = [*self.traffic.movers, *self.traffic.parked]
        for thing in things:
            state = thing.at(step) if isinstance(thing, Mover) else thing.pose
            if np.hypot(*(state[:2] - pose[:2, 3])) > SEEN_FROM:
                continue
            moment = step + self._passed(state, pose)
            if isinstance(thing, Parked):
                bodies.append((thing, self._parked[thing.id], moment))
            else:
                bodies.append((thing, self._placed(thing, thing.at(moment), thing.body(moment)), moment))
        return bodies

    def _passed(self, state: Array, pose: Array) -> float:
        """When in a turn, -0.5..0.5, the beams pass a place."""
        local = pose[:2, :2].T @ (state[:2] - pose[:2, 3])
        return float(-np.arctan2(local[1], local[0]) / (2 * np.pi))

    def _objects(
        self, bodies: list[tuple[Mover | Parked, Mesh, float]], step: int, pose: Array, hits: Hits,
        instance: np.ndarray, origins: Floats, directions: Floats,
    ) -> list[Object]:  # fmt: skip
        """The truth about all objects that some beam would reach if nothing stood before them."""
        numbers, reached = np.unique(hits.instance, return_counts=True)
        beams = dict(zip(numbers.tolist(), reached.tolist()))
        numbers, left = np.unique(instance, return_counts=True)
        points = dict(zip(numbers.tolist(), left.tolist()))
        moments = np.array([moment for _, _, moment in bodies])
        frames = self.poses(moments) if not self.compensated else np.broadcast_to(pose, (len(moments), 4, 4))
        objects = []
        for (thing, body, moment), frame in zip(bodies, frames):
            if beams.get(thing.id, 0) == 0:
                continue
            state = thing.at(moment) if isinstance(thing, Mover) else np.append(thing.pose, 0.0)
            visible = beams[thing.id] / max(_beams_on(body, origins, directions), beams[thing.id])
            speed, axes = float(state[3]), frame[:3, :3].T @ (np.cos(state[2]), np.sin(state[2]), 0.0)
            velocity = (float(axes[0] * speed), float(axes[1] * speed))
            box = _box_of(body, frame, float(np.arctan2(axes[1], axes[0])))
            objects.append(
                Object(thing.id, thing.kind, box, velocity, speed > _MOVES, points.get(thing.id, 0), visible)
            )
        return objects


def _box_of(body: Mesh, frame: Array, yaw: float) -> tuple[float, ...]:
    """The upright box of a heading that holds a body exactly, in a frame."""
    local = (body.triangles.reshape(-1, 3).astype(np.float64) - frame[:3, 3]) @ frame[:3, :3]
    cosine, sine = np.cos(yaw), np.sin(yaw)
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    local = local @ turn
    low, high = local.min(0), local.max(0)
    center = turn @ ((low + high) / 2)
    return (*center.tolist(), *(high - low).tolist(), yaw)


def _beams_on(body: Mesh, origins: Floats, directions: Floats) -> int:
    """How many rays hit a body that stands alone."""
    low, high = body.triangles.min((0, 1)), body.triangles.max((0, 1))
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2 + 0.1
    towards = middle - origins[len(origins) // 2]
    distance = float(np.linalg.norm(towards))
    if distance < radius + 1.5:
        rows = np.arange(len(directions))
    else:
        angle = np.arcsin(min((radius + 1.5) / distance, 1.0))  # 1.5 m: the vehicle moves within a turn
        rows = np.flatnonzero(directions @ (towards / distance) > np.cos(angle))
    return int((Scene(body).cast(origins[rows], directions[rows])[1] >= 0).sum())


def _labels(semantic: np.ndarray, instance: np.ndarray, objects: list[Object]) -> np.ndarray:
    """SemanticKITTI labels: moving classes for moving objects, the instance in the high 16 bits."""
    whole = semantic.astype(np.uint32)
    for thing in objects:
        if thing.moving:
            whole[instance == thing.id] = KINDS[thing.kind].moving
    return np.asarray(whole | (instance.astype(np.uint32) << 16))
