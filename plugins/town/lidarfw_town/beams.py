"""Which beams meet which movable object: bodies are met in their own frame, by the few beams that can reach them."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lidarfw_town.mesh import Array, Mesh
from lidarfw_town.sensors import Floats, Hits, Lidar, Scene, unit

Rows = npt.NDArray[np.int64]

_MARGIN = 0.3  # metres around a body, for the way of the vehicle while the beams pass it
_BEHIND = 2.5  # radians off the heading from which on a body may be passed at both ends of a turn


@functools.lru_cache(maxsize=1024)
def _ready(mesh: Mesh) -> Scene:
    """A body made ready for rays once, wherever it stands afterwards."""
    return Scene(mesh)


@dataclass(frozen=True, eq=False)
class Body:
    """An object where it is when the beams pass it: its mesh in a frame of its own, and that frame's place and yaw."""

    id: int
    mesh: Mesh
    place: tuple[float, float, float]
    yaw: float

    @functools.cached_property
    def placed(self) -> Mesh:
        """The mesh in the world."""
        return self.mesh.placed(*self.place, self.yaw).with_instance(self.id)

    @functools.cached_property
    def turn(self) -> Array:
        """The rotation (3, 3) to the world."""
        cosine, sine = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])

    def meet(self, origins: Floats, directions: Floats) -> tuple[Floats, npt.NDArray[np.int32], Floats]:
        """`Scene.cast` for rays of the world; the normals are in the frame of the body."""
        turn = self.turn.astype(np.float32)
        near = (origins - np.array(self.place)).astype(np.float32)
        return _ready(self.mesh).cast(np.ascontiguousarray(near @ turn), np.ascontiguousarray(directions @ turn))

    def window(self, lidar: Lidar, pose: Array, travel: float) -> Rows:
        """Beams that may reach the body, as rows of beams * columns.

        `pose` (4, 4) is that of the LiDAR when it passes the body, `travel` the way of the vehicle in a turn, metres.
        """
        corners = self.mesh.corners @ self.turn.T + self.place
        local = (corners - pose[:3, 3]) @ pose[:3, :3]
        middle = float(np.arctan2(*local.mean(0)[1::-1]))
        margin = _MARGIN + (travel if abs(middle) > _BEHIND else 0.0)
        flat = np.hypot(local[:, 0], local[:, 1])
        nearest = _nearest(self.mesh.corners, self.turn.T @ (pose[:3, 3] - self.place)) - margin
        low, high = float(local[:, 2].min()) - margin, float(local[:, 2].max()) + margin
        if nearest < 0.5:
            return np.arange(len(lidar.elevations) * lidar.columns)
        far = float(flat.max()) + margin
        down = np.arctan2(low, nearest if low < 0 else far)
        up = np.arctan2(high, nearest if high > 0 else far)
        aside = np.angle(np.exp(1j * (np.arctan2(local[:, 1], local[:, 0]) - middle)))
        spread = np.arcsin(min(margin / nearest, 1.0))
        return _rows(lidar, middle + aside.min() - spread, middle + aside.max() + spread, down, up)


def _nearest(corners: Array, place: Array) -> float:
    """Metres on the level from a place to a box, both in the frame of the box."""
    outside = np.maximum(np.maximum(corners[0, :2] - place[:2], place[:2] - corners[7, :2]), 0)
    return float(np.hypot(*outside))


def _rows(lidar: Lidar, right: float, left: float, down: float, up: float) -> Rows:
    """Beams within azimuths and elevations, radians; columns run from the left to the right."""
    first, last = ((1 - angle / np.pi) * lidar.columns / 2 for angle in (left, right))
    columns = np.arange(int(np.floor(first)), int(np.ceil(last)) + 1) % lidar.columns
    elevations = np.radians(lidar.elevations)
    beams = np.flatnonzero((elevations >= down) & (elevations <= up))
    return (beams[:, None] * lidar.columns + columns[: lidar.columns]).ravel()


def merge(
    hits: Hits, body: Body, rows: Rows, distance: Floats, triangle: npt.NDArray[np.int32], normal: Floats
) -> None:
    """Put the hits on a body, at rows, before what stands behind it."""
    nearer = (triangle >= 0) & (distance < hits.distance[rows])
    rows, triangle = rows[nearer], triangle[nearer]
    hits.distance[rows] = distance[nearer]
    for name in ("semantic", "reflectance"):
        getattr(hits, name)[rows] = getattr(body.mesh, name)[triangle]
    hits.instance[rows] = body.id
    hits.normal[rows] = unit(normal[nearer]) @ body.turn.T
