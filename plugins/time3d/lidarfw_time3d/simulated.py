"""A detector made of labels and noise: boxes as a camera or a LiDAR might give them, to train and compare trackers."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from lidarfw._lazy import LazyModule
from lidarfw.errors import ConfigError
from lidarfw.interfaces.data import Transform
from lidarfw.types import Boxes, Camera, DataSpec, Frame, FrameMeta, Spec, Tracks

if TYPE_CHECKING:
    import torch
else:
    torch = LazyModule("torch")

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Noise:
    """Errors of centres: metres for any object, and shares of its distance across and along the line of sight."""

    flat: float
    across: float
    along: float


NOISES = {"lidar": Noise(0.1, 0, 0), "mono": Noise(0, 0.02, 0.05)}
LOOK = 64  # width of the appearance vectors
_SIZE, _YAW = 0.05, 0.052  # relative, and radians (3 degrees)
_MISSED, _OCCLUDED = 0.1, 0.3  # share of misses, and what full occlusion adds
_FALSE = 0.5  # false boxes a frame
_ALIKE, _BLUR = 0.1, 0.5  # share of objects that look like others; noise of appearance against its length
_FAR = 60.0  # metres: false boxes are up to so far


class SimulatedDetector(Transform):
    """Replaces all inputs but `pose` by `boxes`: what a detector might have found of the labelled tracks.

    `noise` is `lidar` (0.1 m) or `mono` (5 % of the distance along the line of sight, 2 % across). Sizes err by 5 %,
    headings by 3 degrees; one object in ten is missed, up to four in ten where it is occluded, and there is a false
    box in every second frame. Scores fall with the error. Boxes have an appearance (`embedding`, 64 numbers: that of
    the object, blurred; one object in ten looks like another) and a rectangle (`box2d`) where the frame has a camera
    `image`. What is drawn depends on the random numbers of the clip and on the frame.
    """

    def __init__(self, *, noise: str = "lidar") -> None:
        if noise not in NOISES:
            raise ConfigError(f"simulated_detector.noise: expected one of {', '.join(NOISES)}, found {noise!r}")
        self.noise = NOISES[noise]

    def spec(self, data: DataSpec) -> DataSpec:
        """Boxes in place of sensor data."""
        if Tracks not in data.targets:
            raise ConfigError(
                "transform simulated_detector needs a dataset with tracks.\n  fix: dataset=kitti_tracking"
            )
        kept = {name: spec for name, spec in data.inputs.items() if name == "pose"}
        return replace(data, inputs={**kept, "boxes": Spec(Boxes, LOOK, classes=data.classes)})

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame with the boxes found."""
        if frame.targets.tracks is None:
            raise ConfigError(f"frame {frame.meta.id} has no tracks: simulated_detector makes its boxes of labels")
        # the numbers of a clip are the same for all of its frames: each frame has its own errors
        own = np.random.default_rng((int(rng.integers(2**32)), zlib.crc32(frame.meta.id.encode())))
        found = Boxes.cat([self._seen(frame.targets.tracks, frame.meta, own), self._false(frame.targets.tracks, own)])
        if "image" in frame.meta.cameras:
            found = found.replace(box2d=_rectangles(found, frame.meta.cameras["image"]))
        kept = {name: value for name, value in frame.inputs.items() if name == "pose"}
        return frame.replace(inputs={**kept, "boxes": found})

    def _seen(self, tracks: Tracks, meta: FrameMeta, rng: np.random.Generator) -> Boxes:
        hidden = np.zeros(len(tracks.id))
        if tracks.boxes.occlusion is not None:
            hidden = np.clip(tracks.boxes.occlusion.double().numpy(), 0, 2) / 2
        kept = np.flatnonzero(rng.random(len(hidden)) >= _MISSED + _OCCLUDED * hidden)
        truth, ids = tracks.boxes[torch.from_numpy(kept)], tracks.id[torch.from_numpy(kept)]
        table = truth.tensor.double().numpy()
        error = self._errors(table[:, :2], rng)
        table[:, :2] += error
        table[:, 3:6] *= 1 + _SIZE * rng.normal(size=(len(kept), 3))
        table[:, 6] += _YAW * rng.normal(size=len(kept))
        size = np.linalg.norm(error, axis=1) / self._typical(table[:, :2])
        score = 1 / (1 + np.exp(0.8 * size - 2.5 + 0.7 * rng.normal(size=len(kept))))
        look = np.stack([_appearance(meta.sequence, int(i), rng) for i in ids] or [np.zeros(LOOK)])[: len(kept)]
        return _boxes(table, truth.label.numpy(), score, look)

    def _errors(self, place: Array, rng: np.random.Generator) -> Array:
        """Errors (N, 2) of centres at (N, 2)."""
        ahead = place / np.maximum(np.linalg.norm(place, axis=1, keepdims=True), 1e-6)
        aside = np.stack([-ahead[:, 1], ahead[:, 0]], 1)
        along, across = rng.normal(size=(2, len(place), 1)) * np.linalg.norm(place, axis=1)[None, :, None]
        error: Array = self.noise.flat * rng.normal(size=place.shape)
        error += self.noise.along * along * ahead + self.noise.across * across * aside
        return error

    def _typical(self, place: Array) -> Array:
        """Length (N,) that errors at (N, 2) usually have."""
        far = np.linalg.norm(place, axis=1)
        typical: Array = np.sqrt(2 * self.noise.flat**2 + far**2 * (self.noise.along**2 + self.noise.across**2))
        at_least: Array = np.maximum(typical, 1e-6)
        return at_least

    def _false(self, tracks: Tracks, rng: np.random.Generator) -> Boxes:
        count, known = int(rng.poisson(_FALSE)), tracks.boxes
        table = np.zeros((count, 7))
        table[:, 0], table[:, 1] = rng.uniform(5, _FAR, count), rng.uniform(-0.5, 0.5, count)
        table[:, 1] *= table[:, 0]
        table[:, 2], table[:, 3:6], table[:, 6] = -1, (3.9, 1.6, 1.5), rng.uniform(-np.pi, np.pi, count)
        label = np.zeros(count, dtype=np.int64)
        if len(known):
            picked = rng.integers(len(known), size=count)
            table[:, 2:6], label = known.tensor.double().numpy()[picked, 2:6], known.label.numpy()[picked]
        look = rng.normal(size=(count, LOOK))
        return _boxes(table, label, rng.beta(2, 4, count), look / np.sqrt(LOOK))


def _appearance(sequence: str, identity: int, rng: np.random.Generator) -> Array:
    """(64,) of an object, blurred; one in ten has that of one of ten doubles."""
    own = zlib.crc32(f"{sequence} {identity}".encode())
    drawn = np.random.default_rng(own)
    face = drawn if drawn.random() >= _ALIKE else np.random.default_rng(drawn.integers(10))
    vector = face.normal(size=LOOK)
    blurred: Array = vector / np.linalg.norm(vector) + _BLUR * rng.normal(size=LOOK) / np.sqrt(LOOK)
    return blurred


def _boxes(table: Array, label: npt.NDArray[np.int64], score: Array, look: Array) -> Boxes:
    boxes = Boxes.from_tensor(
        torch.from_numpy(table).float(), torch.from_numpy(label), torch.from_numpy(np.asarray(score)).float()
    )
    return boxes.replace(embedding=torch.from_numpy(look).float().reshape(len(table), LOOK))


def _rectangles(boxes: Boxes, camera: Camera) -> torch.Tensor:
    from lidarfw_time3d.monocular import Lens, rectangles

    lens = Lens.of((camera,), "cpu")[torch.zeros(len(boxes), dtype=torch.long)]
    return rectangles(boxes.tensor, lens).float()
