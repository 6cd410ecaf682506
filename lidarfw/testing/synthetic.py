"""Frames of a small simulated street: the dataset of the tests, of the conformance kit, and of a first try."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lidarfw._lazy import LazyModule
from lidarfw.errors import ConfigError
from lidarfw.interfaces.data import Dataset
from lidarfw.testing import scene
from lidarfw.types import (
    Boxes,
    Camera,
    DataSpec,
    Frame,
    FrameMeta,
    Image,
    PointLabels,
    Points,
    Poses,
    Spec,
    Targets,
    Tracks,
)

if TYPE_CHECKING:
    import torch
else:
    torch = LazyModule("torch")

SPLITS = ("train", "val", "test")
_ROWS = 32  # beams of the scanner
_FIELD = np.pi / 4  # radians to either side of straight ahead
_FEWEST = 10  # returns that make an object worth learning
_CAMERA_HEIGHT = 0.1  # metres above the scanner
CAMERA = Camera(
    "pinhole",
    416,
    128,
    (208.0, 208.0, 208.0, 48.0),
    (),
    ((0.0, -1.0, 0.0, 0.0), (0.0, 0.0, -1.0, _CAMERA_HEIGHT), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
)
_CAMERAS = {"image": CAMERA, "rectified": CAMERA}  # as KITTI has them: the picture, and the frame of its labels


class SyntheticDataset(Dataset):
    """Scans of streets with cars, pedestrians and cyclists, ray-cast in numpy; needs no files.

    Objects keep their size, track id and velocity through a sequence; the sensor moves too. The range is that of
    KITTI's camera view: x 0..70 m, y -40..40 m, ground at z = -1.73 m. A frame depends on (seed, split, index) alone.
    Objects with fewer than ten returns are ignored targets. Velocity is over ground, along the sensor's axes.

    frames: number of frames. sequence_length: frames per sequence, 0.1 s apart. points: rays per scan, of which
    about three quarters return. sweeps: scans per frame, the past ones moved into the current sensor frame.
    image: also give a camera picture. pose: also give the sensor's pose as an input.
    """

    def __init__(
        self,
        *,
        split: str = "train",
        frames: int = 64,
        sequence_length: int = 8,
        classes: tuple[str, ...] = ("Car", "Pedestrian", "Cyclist"),
        points: int = 8192,
        sweeps: int = 1,
        image: bool = False,
        pose: bool = False,
        seed: int = 1,
    ) -> None:
        _check_options(split, frames, sequence_length, classes, points, sweeps)
        self.split, self.frames, self.sequence_length = split, frames, sequence_length
        self.classes, self.points, self.sweeps = tuple(classes), points, sweeps
        self.image, self.pose, self.seed = image, pose, seed
        inputs = {"points": Spec(Points, channels=1)}
        inputs |= {"image": Spec(Image, channels=3, geometry=CAMERA)} if image else {}
        inputs |= {"pose": Spec(Poses)} if pose else {}
        self.spec = DataSpec(inputs, frozenset({Boxes, PointLabels, Poses, Tracks}), self.classes, sweeps)

    def __len__(self) -> int:
        return self.frames

    def meta(self, index: int) -> FrameMeta:
        number, step = divmod(range(self.frames)[index], self.sequence_length)
        name = f"{self.split}_{number:04d}"
        return FrameMeta(f"{name}_{step:03d}", name, step, step * scene.PERIOD, dict(_CAMERAS))

    def sequences(self) -> list[Sequence[int]]:
        starts = range(0, self.frames, self.sequence_length)
        return [range(start, min(start + self.sequence_length, self.frames)) for start in starts]

    def __getitem__(self, index: int) -> Frame:
        number, step = divmod(range(self.frames)[index], self.sequence_length)
        shapes = [scene.SHAPES[name] for name in self.classes]
        world = scene.draw_scene(shapes, self.sequence_length, self._rng(number))
        scans = [self._scan(world, number, past) for past in range(step, max(-1, step - self.sweeps), -1)]
        points = Points.cat([_moved(scan, world, step - k, step) for k, (scan, _) in enumerate(scans)])
        inputs: dict[str, Any] = {"points": points if self.sweeps > 1 else points.replace(time=None)}
        poses = Poses(_tensor(world.pose(step)[None]), torch.ones(1, dtype=torch.bool), torch.ones(1))
        inputs |= {"image": _picture(world, step)} if self.image else {}
        inputs |= {"pose": poses} if self.pose else {}
        targets = _targets(world, step, hits=scans[0][1])  # judged by the current scan alone
        targets.points = _point_labels(world, np.concatenate([hits for _, hits in scans]), len(self.classes))
        targets.poses = poses
        return Frame(inputs, targets, self.meta(index))

    def _scan(self, world: scene.Scene, number: int, step: int) -> tuple[Points, scene.Array]:
        """One scan in its own sensor frame, and the object of each point (-1 ground)."""
        rng = self._rng(number, step + 1)
        columns = max(1, self.points // _ROWS)
        azimuth = ((np.arange(columns) + 0.5) / columns * 2 - 1) * _FIELD
        elevation = np.radians(np.linspace(3, -5, _ROWS // 2).tolist() + np.linspace(-6, -25, _ROWS // 2).tolist())
        slope = np.broadcast_to(np.tan(elevation), (columns, _ROWS))
        hits = scene.cast(azimuth, slope, world.boxes(step), world.kinds)
        returned = np.isfinite(hits.distance) & (rng.random(slope.shape) > 0.05)
        flat = hits.distance + rng.normal(0, 0.02, slope.shape)
        rays = np.stack(np.broadcast_arrays(np.cos(azimuth)[:, None], np.sin(azimuth)[:, None], slope), -1)
        xyz = rays[returned] * flat[returned][:, None]
        bright = (scene.remission(hits, world.kinds) + rng.normal(0, 0.03, slope.shape)).clip(0, 1)
        points = Points.from_scan(_tensor(xyz), _tensor(bright[returned][:, None]), torch.zeros(len(xyz)))
        return points, hits.object[returned]

    def _rng(self, *numbers: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, zlib.crc32(self.split.encode()), *numbers])


def _check_options(
    split: str, frames: int, sequence_length: int, classes: Sequence[str], points: int, sweeps: int
) -> None:
    if split not in SPLITS:
        raise ConfigError(f"dataset 'synthetic' has no split '{split}'. Splits: {', '.join(SPLITS)}")
    unknown = [name for name in classes if name not in scene.SHAPES]
    if unknown or not classes:
        what = f"no class '{unknown[0]}'" if unknown else "to have at least one class"
        raise ConfigError(f"dataset 'synthetic' has {what}. Classes: {', '.join(scene.SHAPES)}")
    least = {"frames": (frames, 0), "sequence_length": (sequence_length, 1), "points": (points, _ROWS)}
    for option, (value, lowest) in (least | {"sweeps": (sweeps, 1)}).items():
        if value < lowest:
            raise ConfigError(f"dataset.synthetic.{option} must be at least {lowest}, got {value}")


def _tensor(values: scene.Array) -> torch.Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float32)


def _moved(points: Points, world: scene.Scene, taken: int, now: int) -> Points:
    """The scan of step `taken` in the sensor frame of step `now`."""
    if taken == now:
        return points
    change = _tensor(np.linalg.inv(world.pose(now)) @ world.pose(taken))
    past = torch.full((len(points),), (taken - now) * scene.PERIOD)
    return points.replace(xyz=points.xyz @ change[:3, :3].T + change[:3, 3], time=past)


def _picture(world: scene.Scene, step: int) -> Image:
    """What the camera sees, by the same ray caster: all pixels of a column share their azimuth."""
    fx, fy, cx, cy = CAMERA.intrinsics
    across = (np.arange(CAMERA.width) - cx) / fx
    down = (np.arange(CAMERA.height) - cy) / fy
    slope = -down[None] / np.hypot(1, across)[:, None]
    hits = scene.cast(-np.arctan(across), slope, world.boxes(step), world.kinds, _CAMERA_HEIGHT)
    return Image(_tensor(scene.colours(hits, world.kinds).transpose(2, 1, 0)[None]), (CAMERA,))


def _targets(world: scene.Scene, step: int, hits: scene.Array) -> Targets:
    """Boxes to find, boxes to ignore (too few returns), and tracks; `hits` is the object of each point."""
    count = np.bincount(hits[hits >= 0], minlength=len(world.label))
    users = world.label >= 0
    found = users & (count >= _FEWEST)
    boxes = _boxes(world, step, found)
    return Targets(
        boxes=boxes,
        ignored=_boxes(world, step, users & (count > 0) & ~found),
        tracks=Tracks(boxes, torch.from_numpy(np.flatnonzero(found))),
    )


def _boxes(world: scene.Scene, step: int, chosen: scene.Array) -> Boxes:
    tensor = _tensor(world.boxes(step)[chosen])
    boxes = Boxes.from_tensor(tensor, torch.from_numpy(world.label[chosen]))
    velocity = _tensor(world.seen_velocity(step)[chosen])
    box2d, truncation = _box2d(tensor)
    return boxes.replace(
        velocity=velocity,
        moving=(velocity.norm(dim=1) > 0).to(torch.int8),
        box2d=box2d,
        truncation=truncation,
        occlusion=torch.zeros(len(boxes), dtype=torch.long),
    )


def _box2d(boxes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Upright pixel boxes (M, 4) clipped to the picture, and the share (M,) of each that lies outside."""
    from lidarfw.ops import box_corners

    ahead, left, up = box_corners(boxes).unbind(2)
    fx, fy, cx, cy = CAMERA.intrinsics
    column = cx - fx * left / ahead.clamp(min=0.1)
    row = cy - fy * (up - _CAMERA_HEIGHT) / ahead.clamp(min=0.1)
    low, high = torch.stack([column, row], 2).aminmax(dim=1)
    edge = low.new_tensor([CAMERA.width, CAMERA.height]) - 0.5
    inside = torch.cat([torch.minimum(part.clamp(min=-0.5), edge) for part in (low, high)], 1)
    seen = (inside[:, 2:] - inside[:, :2]).prod(1)
    return inside, 1 - seen / (high - low).prod(1)


def _point_labels(world: scene.Scene, hits: scene.Array, classes: int) -> PointLabels:
    """Class and object of each point; ground and clutter are unlabelled."""
    label = np.where(hits >= 0, world.label[hits], -1)
    probability = torch.from_numpy(label[:, None] == np.arange(classes)).float()
    instance = torch.from_numpy(np.where(label >= 0, hits + 1, 0))
    return PointLabels(probability, torch.zeros(len(hits), dtype=torch.long), 1, instance)


def frames(count: int = 1, **options: Any) -> list[Frame]:
    """The first frames of a synthetic sequence of that length, small enough for unit tests."""
    return list(sequence(count, **options))


def sequence(length: int = 4, **options: Any) -> Iterator[Frame]:
    """One synthetic sequence in order of time."""
    dataset = SyntheticDataset(**{"frames": length, "sequence_length": max(1, length), "points": 2048} | options)
    return (dataset[index] for index in range(len(dataset)))
