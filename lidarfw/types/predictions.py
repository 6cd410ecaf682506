"""What heads predict and what datasets label: the seven prediction types."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from lidarfw._lazy import LazyModule
from lidarfw.types.record import Record, Rows

if TYPE_CHECKING:
    import torch
    from torch import Tensor
else:
    torch = LazyModule("torch")


@dataclass
class Boxes(Rows):
    """Oriented 3D boxes: proposals, detections or ground truth.

    `center` is the geometric centre; `size` is length (along the heading), width, height; `yaw` is
    counter-clockwise from x. Metres and radians, sensor frame.
    """

    center: Tensor  # (M, 3)
    size: Tensor  # (M, 3) l, w, h
    yaw: Tensor  # (M,)
    label: Tensor  # (M,) int64, index into the classes of the DataSpec
    score: Tensor  # (M,) 0..1; 1 for ground truth
    batch: Tensor  # (M,) int64
    batch_size: int = 1
    velocity: Tensor | None = None  # (M, 2) m/s along x, y
    moving: Tensor | None = None  # (M,) int8: 1 moving, 0 static, -1 unknown
    embedding: Tensor | None = None  # (M, E)
    stage: Tensor | None = None  # (M,) int64, cascade stage that gave the box
    box2d: Tensor | None = None  # (M, 4) pixels left, top, right, bottom
    occlusion: Tensor | None = None  # (M,) int64, 0 visible, 1 partly, 2 largely, 3 unknown
    truncation: Tensor | None = None  # (M,) 0..1 share outside the picture
    alpha: Tensor | None = None  # (M,) observation angle in the picture, radians: heading less bearing
    row: Tensor | None = None  # (M,) int64, place of the object in its label file
    attribute: Tensor | None = None  # (M,) int64, what the object does, by the dataset's numbers; -1 not known

    @property
    def tensor(self) -> Tensor:
        """(M, 7) x, y, z, l, w, h, yaw."""
        return torch.cat([self.center, self.size, self.yaw[:, None]], 1)

    @classmethod
    def from_tensor(
        cls, boxes: Tensor, label: Tensor, score: Tensor | None = None, batch: Tensor | None = None, batch_size: int = 1
    ) -> Boxes:
        """Boxes from (M, 7) x, y, z, l, w, h, yaw; score defaults to 1, batch to 0."""
        score = boxes.new_ones(len(boxes)) if score is None else score
        batch = torch.zeros_like(label) if batch is None else batch
        return cls(boxes[:, :3], boxes[:, 3:6], boxes[:, 6], label, score, batch, batch_size)

    @classmethod
    def empty(cls, batch_size: int = 1, device: torch.device | str = "cpu") -> Boxes:
        """No boxes."""
        index = torch.zeros(0, dtype=torch.long, device=device)
        return cls.from_tensor(torch.zeros(0, 7, device=device), index, batch=index, batch_size=batch_size)


@dataclass
class PointLabels(Rows):
    """A class for every point of the scan, as probabilities or as known labels."""

    probability: Tensor  # (N, K) 0..1 over the classes; one-hot for ground truth, all zero = unlabelled
    batch: Tensor  # (N,) int64
    batch_size: int = 1
    instance: Tensor | None = None  # (N,) int64, 0 = none

    @property
    def label(self) -> Tensor:
        """(N,) most probable class, -1 where unlabelled."""
        best, label = self.probability.max(1) if self.probability.shape[1] else (self.batch, self.batch)
        return torch.where(best > 0, label, -1)


@dataclass
class SceneCoords(Rows):
    """Pairs of a point in the sensor frame and its place in the map."""

    source: Tensor  # (N, 3) metres, sensor frame
    world: Tensor  # (N, 3) metres, map frame
    weight: Tensor  # (N,)
    batch: Tensor  # (N,) int64
    batch_size: int = 1


@dataclass
class Poses(Record):
    """Poses of the sensor in the map: x_map = matrix @ x_sensor."""

    matrix: Tensor  # (B, 4, 4)
    ok: Tensor  # (B,) bool, False where no pose was found
    confidence: Tensor  # (B,) 0..1, e.g. the inlier ratio of a fit

    @property
    def batch_size(self) -> int:
        return int(self.matrix.shape[0])


@dataclass
class Descriptors(Record):
    """One global vector per frame, for retrieval."""

    vector: Tensor  # (B, D), L2-normalised
    modality: tuple[str, ...] = ()  # "lidar" or "camera" for each frame

    @property
    def batch_size(self) -> int:
        return int(self.vector.shape[0])


@dataclass
class Tracks(Record):
    """Boxes with identities."""

    boxes: Boxes
    id: Tensor  # (M,) int64, the same number for the same object in every frame of a sequence
    moving: Tensor | None = None  # (M,) log-odds that the object moves


@dataclass
class Matches(Record):
    """Nearest map entries of every query, best first."""

    index: Tensor  # (Q, k) int64 rows of the map, -1 where the map has fewer than k
    distance: Tensor  # (Q, k) L2, inf where index is -1
