"""Splits for localization on data that is not driven twice on purpose (TACO, section 5.1)."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from lidarfw.components.datasets.drives import Drive, DriveDataset
from lidarfw.components.datasets.kitti_360 import Kitti360Dataset
from lidarfw.components.datasets.nuscenes import NuScenesDataset
from lidarfw.errors import ConfigError, DataError
from scipy.spatial import cKDTree

Places = npt.NDArray[np.int64]

_SPLITS = ("train", "val", "test")
_CLASSES = ("car", "truck", "bus", "trailer", "construction_vehicle", "pedestrian", "motorcycle", "bicycle",
            "traffic_cone", "barrier")  # fmt: skip


class ChosenFrames(DriveDataset):
    """Drives of which a split takes some frames only; `part` is the split, `split` of the base the drives."""

    part: str

    def chosen(self, drive: Drive) -> Places:
        """Places of the frames of a drive that the split takes, ascending."""
        raise NotImplementedError

    @functools.cached_property
    def _chosen(self) -> list[Places]:
        found = [self.chosen(drive) for drive in self.drives]
        if not any(map(len, found)):
            raise DataError(f"the split '{self.part}' of {self.root} has no frames: too few scans there")
        return found

    def find(self, index: int) -> tuple[Drive, int]:
        """The sequence of a frame, and its place there."""
        index = range(len(self))[index]
        for drive, places in zip(self.drives, self._chosen, strict=True):
            if index < len(places):
                return drive, int(places[index])
            index -= len(places)
        raise IndexError(index)

    def __len__(self) -> int:
        return sum(map(len, self._chosen))

    def sequences(self) -> list[Sequence[int]]:
        """The frames of each drive."""
        ends = np.cumsum([0, *map(len, self._chosen)]).tolist()
        return [range(start, end) for start, end in itertools.pairwise(ends) if end > start]

    def _take(self, part: str, name: str) -> str:
        if part not in _SPLITS:
            raise ConfigError(f"dataset '{name}' has no split '{part}'. Splits: {', '.join(_SPLITS)}")
        return part


class NuScenesRelocalization(ChosenFrames, NuScenesDataset):
    """nuScenes as pairs of visits (TACO, section 5.1): of every five key frames four are to learn, the fifth to find.

    Everything else is as in `nuscenes`. Splits are `train` and `val`, which is `test` too.
    """

    def __init__(
        self,
        *,
        root: str = "",
        split: str = "train",
        scenes: str = "all",
        version: str = "v1.0-trainval",
        classes: tuple[str, ...] = _CLASSES,
        window: int = 5,
    ) -> None:
        """Options.

        root, version, classes: as in `nuscenes`. split: train, val or test. scenes: what `nuscenes` calls split; a
        map is one town, so localization needs scenes of one. window: key frames of which the last is to find.
        """
        if window < 2:
            raise ConfigError(f"dataset.nuscenes_relocalization.window must be at least 2, got {window}")
        self.part, self.window = self._take(split, "nuscenes_relocalization"), window
        super().__init__(root=root, split=scenes, version=version, classes=classes, sweeps=1)

    def chosen(self, drive: Drive) -> Places:
        """All but the last frame of each window, or these."""
        last = np.arange(len(drive.scans)) % self.window == self.window - 1
        return np.flatnonzero(~last if self.part == "train" else last)


class Kitti360Relocalization(ChosenFrames, Kitti360Dataset):
    """KITTI-360 as two visits (TACO, section 5.1): the first frames of a drive are to learn, returns to find.

    A later frame is to find where it lies within `radius` metres of a frame to learn that is at least `apart` seconds
    older. Everything else is as in `kitti_360`. Splits are `train` and `val`, which is `test` too.
    """

    def __init__(
        self,
        *,
        root: str = "",
        split: str = "train",
        drive: str = "00",
        frames: int = 7000,
        radius: float = 5.0,
        apart: float = 30.0,
    ) -> None:
        """Options.

        root: as in `kitti_360`. split: train, val or test. drive: one of the dataset's, such as 00 or 09. frames: how
        many of its frames are to learn.
        """
        if frames < 1 or radius <= 0 or apart < 0:
            raise ConfigError(
                f"dataset.kitti_360_relocalization: need frames >= 1, radius > 0 and apart >= 0, "
                f"got {frames}, {radius}, {apart}"
            )
        self.part, self.first = self._take(split, "kitti_360_relocalization"), frames
        self.radius, self.apart = radius, apart
        super().__init__(root=root, split=drive)

    def chosen(self, drive: Drive) -> Places:
        """The first frames, or the later ones that return to them."""
        every: Places = np.arange(len(drive.scans))
        if self.part == "train" or drive.poses is None:
            return every[: self.first]
        learned, later = drive.poses[: self.first, :3, 3], drive.poses[self.first :, :3, 3]
        near = cKDTree(learned).query_ball_point(later, self.radius)
        older = [
            bool(len(places)) and drive.times[self.first + i] - drive.times[min(places)] >= self.apart
            for i, places in enumerate(near)
        ]
        found: Places = every[self.first :][np.array(older, dtype=bool)]
        return found
