"""Places by either of two sensors, and ready-made bird's-eye views of a drive."""

from __future__ import annotations

import dataclasses
import functools
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from lidarfw import registry
from lidarfw._lazy import LazyModule
from lidarfw.errors import ConfigError, DataError
from lidarfw.interfaces import Dataset
from lidarfw.types import BEV, DataSpec, Frame, FrameMeta, Grid, Poses, Spec, Targets

if TYPE_CHECKING:
    import torch
else:
    torch = LazyModule("torch")

MODALITIES = ("camera", "lidar")


class EitherSensor(Dataset):
    """Every frame of another dataset twice: once for its cameras and once for its LiDAR, as `meta.modality` says.

    The inputs are all there; a transform such as `panorama` takes those of the sensor. Pairs of frames drawn by
    `loader.pairs` are then of the cameras in a quarter of the cases, of the LiDAR in another and of both in half of
    them (paper 4.1).
    """

    example: ClassVar[dict[str, Any]] = {"of": "synthetic", "options": {"frames": 2, "image": True}}

    def __init__(self, *, of: str, options: dict[str, Any] | None = None, split: str = "train") -> None:
        """Options: of, name of the dataset; options, those of that dataset; split, one of its splits."""
        if ":" in of:  # what a checkpoint names must not be imported from anywhere
            raise ConfigError(f"dataset.either_sensor.of takes the name of an installed dataset, found {of!r}")
        self.split = split
        try:
            self.frames: Dataset = registry.load("dataset", of)(**(options or {}), split=split)
        except TypeError as error:
            raise ConfigError(f"dataset.either_sensor.options do not fit {of!r}: {error}") from error
        self.spec: DataSpec = self.frames.spec

    def prepare(self, workers: int = 0) -> None:
        """Let the dataset make ready."""
        self.frames.prepare(workers)

    def __len__(self) -> int:
        return 2 * len(self.frames)

    def __getitem__(self, index: int) -> Frame:
        number, sensor = divmod(range(len(self))[index], 2)
        frame = self.frames[number]
        return dataclasses.replace(frame, meta=_by_sensor(frame.meta, sensor))

    def meta(self, index: int) -> FrameMeta:
        """Of the frame, with the sensor."""
        number, sensor = divmod(range(len(self))[index], 2)
        return _by_sensor(self.frames.meta(number), sensor)

    def sequences(self) -> list[Sequence[int]]:
        """Those of the dataset, each frame by both sensors."""
        return [[2 * number + sensor for number in run for sensor in (0, 1)] for run in self.frames.sequences()]

    def positions(self) -> np.ndarray | None:
        """Where each frame was taken."""
        places = self.frames.positions()
        return None if places is None else places.repeat(2, axis=0)


def _by_sensor(meta: FrameMeta, sensor: int) -> FrameMeta:
    return dataclasses.replace(meta, id=f"{meta.id}_{MODALITIES[sensor]}", modality=MODALITIES[sensor])


class BEVPlaceDataset(Dataset):
    """Bird's-eye density images of drives, as published for BEVPlace: ROOT/NAME.npz with `bev` and `pose`.

    `bev` is (N, H, W) uint8 in cells of `cell` metres with the LiDAR in the middle, `pose` (N, 3, 4) LiDAR to map.
    One frame holds one `bev` of values 0..1. Frames are `period` seconds apart. Rows and columns are taken as stored:
    which way is ahead does not matter to a descriptor that is blind to the heading.

    A split is names of drives joined by `+`; NAME:x<100 keeps the frames with x below 100 m, and likewise > and y, so
    that a region of a drive can be held out. Train on several drives only if they share a map: losses look at
    positions alone.
    """

    example: ClassVar[dict[str, Any]] = {"split": "00"}

    def __init__(
        self, *, root: str = "", split: str = "00", size: int = 151, cell: float = 0.4, period: float = 0.1
    ) -> None:
        """Options: root, folder of the files; split: see above; size, pixels; cell, metres; period, seconds."""
        self.root, self.split, self.period = root, split, period
        half = size * cell / 2
        self.grid = Grid((-half, -half, -100.0), (half, half, 100.0), (cell, cell, 200.0))
        self.spec = DataSpec({"bev": Spec(BEV, 1, 1, self.grid)}, frozenset({Poses}))

    @functools.cached_property
    def _drives(self) -> dict[str, tuple[Any, Any, Any]]:
        """By part of the split: pictures, poses (N, 4, 4), numbers in the drive."""
        return {part: self._read(part) for part in self.split.split("+")}

    def _read(self, part: str) -> tuple[Any, Any, Any]:
        name, _, region = part.partition(":")
        if not self.root:
            raise DataError("dataset.bev_place.root is not set.\n  fix: dataset.bev_place.root=/path/to/images")
        path = Path(self.root) / f"{name}.npz"
        try:
            with np.load(path, allow_pickle=False) as file:
                pictures, poses = file["bev"], file["pose"]
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise DataError(f"{path}: expected an .npz file with bev and pose: {error}") from error
        side = self.grid.shape()[1]
        if pictures.shape[1:] != (side, side) or poses.shape != (len(pictures), 3, 4):
            raise DataError(
                f"{path}: expected bev (N, {side}, {side}) and pose (N, 3, 4), found {pictures.shape}, {poses.shape}"
            )
        kept = _inside(region, poses[:, :2, 3], part)
        bottom = np.broadcast_to(np.array([[[0.0, 0, 0, 1]]]), (len(poses), 1, 4))
        return pictures[kept], np.concatenate([poses, bottom], 1)[kept], np.flatnonzero(kept)

    @functools.cached_property
    def _starts(self) -> list[int]:
        return [0, *np.cumsum([len(numbers) for _, _, numbers in self._drives.values()]).tolist()]

    def __len__(self) -> int:
        return self._starts[-1]

    def _find(self, index: int) -> tuple[str, int]:
        index = range(len(self))[index]
        drive = int(np.searchsorted(self._starts, index, side="right")) - 1
        return list(self._drives)[drive], index - self._starts[drive]

    def meta(self, index: int) -> FrameMeta:
        """Drive, number and time of a frame."""
        part, place = self._find(index)
        number = int(self._drives[part][2][place])
        name = part.partition(":")[0]
        return FrameMeta(f"{name}_{number:06d}", name, number, number * self.period, modality="lidar")

    def __getitem__(self, index: int) -> Frame:
        part, place = self._find(index)
        pictures, poses, _ = self._drives[part]
        features = torch.from_numpy(pictures[place][None, None].astype(np.float32) / 255)
        pose = Poses(torch.from_numpy(poses[place][None].astype(np.float32)), torch.tensor([True]), torch.ones(1))
        return Frame({"bev": BEV(features, self.grid)}, Targets(poses=pose), self.meta(index))

    def sequences(self) -> list[Sequence[int]]:
        """The frames of each part."""
        return [range(start, end) for start, end in zip(self._starts[:-1], self._starts[1:], strict=True)]

    def positions(self) -> np.ndarray:
        """Where each frame was taken."""
        return np.concatenate([poses[:, :3, 3] for _, poses, _ in self._drives.values()])


def _inside(region: str, places: np.ndarray, part: str) -> np.ndarray:
    """Which places (N, 2) lie in a region such as x<100, or anywhere for none."""
    if not region:
        return np.ones(len(places), dtype=bool)
    axis, sign, limit = region[:1], region[1:2], region[2:]
    try:
        value = float(limit)
        column = {"x": 0, "y": 1}[axis]
        return {"<": places[:, column] < value, ">": places[:, column] >= value}[sign]
    except (KeyError, ValueError):
        raise ConfigError(f"split {part!r}: a region is written x<100, x>100, y<100 or y>100") from None
