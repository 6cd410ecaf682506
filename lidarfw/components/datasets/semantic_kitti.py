"""SemanticKITTI: semantic and moving-object segmentation of the KITTI odometry drives, in its official layout.

Source: Behley et al., "SemanticKITTI: a dataset for semantic scene understanding of LiDAR sequences", ICCV 2019;
moving classes: Chen et al., "Moving object segmentation in 3D LiDAR data", RA-L 2021.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt

from lidarfw import kitti
from lidarfw._lazy import LazyModule
from lidarfw.components.datasets.drives import (
    Array,
    Drive,
    DriveDataset,
    inverse,
    pose_of,
    read_ids,
    read_poses,
    read_table,
    rigid,
    rows_of,
    scans_in,
)
from lidarfw.components.datasets.kitti import picture_size
from lidarfw.errors import ConfigError, DataError
from lidarfw.types import Camera, DataSpec, Frame, FrameMeta, PointLabels, Points, Poses, Spec, Targets

if TYPE_CHECKING:
    import torch
else:
    torch = LazyModule("torch")

CLASSES = (
    "car", "bicycle", "motorcycle", "truck", "other-vehicle", "person", "bicyclist", "motorcyclist", "road", "parking",
    "sidewalk", "other-ground", "building", "fence", "vegetation", "trunk", "terrain", "pole", "traffic-sign",
)  # fmt: skip
MOVING = ("static", "moving")
_UNLABELLED = (0, 1)  # unlabelled, outlier
_NO_CLASS = (9, 52, 99, 251)  # static, other-structure, other-object, moving: of no semantic class
_IDS = {
    10: "car", 11: "bicycle", 13: "other-vehicle", 15: "motorcycle", 16: "other-vehicle", 18: "truck",
    20: "other-vehicle", 30: "person", 31: "bicyclist", 32: "motorcyclist", 40: "road", 44: "parking", 48: "sidewalk",
    49: "other-ground", 50: "building", 51: "fence", 60: "road", 70: "vegetation", 71: "trunk", 72: "terrain",
    80: "pole", 81: "traffic-sign", 252: "car", 253: "bicyclist", 254: "person", 255: "motorcyclist",
    256: "other-vehicle", 257: "other-vehicle", 258: "truck", 259: "other-vehicle",
}  # fmt: skip
_FIRST_MOVING = 251
_STATIC_ID = 9
_LANE = (60,)  # lane markings count as road, whose own id is 40
TASKS = {"semantics": CLASSES, "moving": MOVING}
_PERIOD = 0.1  # seconds between scans without times.txt
_UNKNOWN = -2  # in the tables below: an id that the dataset does not have


def _table(task: str) -> npt.NDArray[np.int64]:
    """Class of every label id of 16 bits: an index, -1 unlabelled, -2 unknown."""
    table = np.full(2**16, _UNKNOWN)
    table[list(_UNLABELLED)] = -1
    for number in (*_NO_CLASS, *_IDS):
        if task == "moving":
            table[number] = int(number >= _FIRST_MOVING)
        else:
            table[number] = CLASSES.index(_IDS[number]) if number in _IDS else -1
    return table


def _numbers(*numbers: int) -> tuple[str, ...]:
    return tuple(f"{number:02d}" for number in numbers)


def read_sequence(folder: Path) -> Drive:
    """Scans, times and LiDAR poses of one sequence, from its folder; DataError where a file is missing or broken."""
    scans = scans_in(folder / "velodyne")
    numbers = [int(scan.stem) for scan in scans]
    times = _times(folder / "times.txt", numbers)
    cameras = rows_of(read_poses(folder / "poses.txt"), numbers, folder / "poses.txt")
    extrinsics = _extrinsics(folder / "calib.txt")
    return Drive(folder.name, scans, times, inverse(extrinsics) @ cameras @ extrinsics)


def label_ids(classes: Sequence[str]) -> npt.NDArray[np.uint32]:
    """The id (K + 1,) that a label file has for each class, and at the end the one of points without a class.

    As the evaluation of the benchmarks reads them: 9 and 251 for static and moving, where no class means static; the
    ids of SemanticKITTI for its classes, where it is 0. ConfigError for classes that it does not have.
    """
    if set(classes) == set(MOVING):
        return np.array([_STATIC_ID if name == "static" else _FIRST_MOVING for name in classes] + [_STATIC_ID], "<u4")
    known = {
        name: max(i for i, n in _IDS.items() if n == name and i not in _LANE and i < _FIRST_MOVING) for name in CLASSES
    }
    unknown = [name for name in classes if name not in known]
    if unknown:
        raise ConfigError(
            f"SemanticKITTI has no class '{unknown[0]}'.\n  its classes: {', '.join(CLASSES)}; or {', '.join(MOVING)}"
        )
    return np.array([known[name] for name in classes] + [0], "<u4")


class SemanticKittiDataset(DriveDataset):
    """SemanticKITTI: ROOT/sequences/00 ... 21 with velodyne, labels, poses.txt, calib.txt and times.txt.

    Points have one feature, remission 0..1. Targets are point labels (but for `test`) with their instances, and
    LiDAR poses in the frame of the sequence's first scan. Of several scans all points are labelled.
    """

    splits: ClassVar = {
        "train": _numbers(*range(8), 9, 10),
        "val": _numbers(8),
        "test": _numbers(*range(11, 22)),
        "road_train": _numbers(*range(30, 35), 40),
        "road_val": _numbers(*range(35, 40), 41),
    }

    def __init__(
        self, *, root: str = "", split: str = "train", task: str = "semantics", sweeps: int = 1, pose: bool = False
    ) -> None:
        """Options.

        root: folder that holds sequences/, or dataset/sequences/. split: train, val, test, road_train, road_val
        (KITTI-Road), all, or sequences such as 00; joined by +. task: semantics (19 classes) or moving (static,
        moving). sweeps: scans per frame, the past ones moved into the current frame. pose: also give the LiDAR's
        pose, as the input `pose`.
        """
        if task not in TASKS:
            raise ConfigError(f"dataset 'semantic_kitti' has no task '{task}'. Tasks: {', '.join(TASKS)}")
        if sweeps < 1:
            raise ConfigError(f"dataset.semantic_kitti.sweeps must be at least 1, got {sweeps}")
        self.root, self.split, self.task, self.sweeps, self.pose = root, split, task, sweeps, pose
        self.labelled = not set(self.named) & set(self.splits["test"])
        inputs = {"points": Spec(Points, channels=1)} | ({"pose": Spec(Poses)} if pose else {})
        targets = frozenset({PointLabels, Poses} if self.labelled else {Poses})
        self.spec = DataSpec(inputs, targets, TASKS[task], sweeps)

    @property
    def folder(self) -> Path:
        """ROOT/sequences or ROOT/dataset/sequences."""
        if not self.root:
            raise DataError(
                "dataset.semantic_kitti.root is not set.\n"
                "  fix: dataset.semantic_kitti.root=/path/to/semantic_kitti (it holds sequences/)"
            )
        places = [Path(self.root) / "sequences", Path(self.root) / "dataset" / "sequences"]
        found = [place for place in places if place.is_dir()]
        if not found:
            raise DataError(
                f"{places[0]}: no such folder.\n  fix: dataset.semantic_kitti.root must hold sequences/00 ..."
            )
        return found[0]

    def present(self) -> list[str]:
        """Sequences with scans; the unlabelled ones are no part of `all`."""
        names = sorted(path.name for path in self.folder.iterdir() if (path / "velodyne").is_dir())
        return [name for name in names if name not in self.splits["test"]]

    def open(self, sequence: str) -> Drive:
        """Scans, times and LiDAR poses of a sequence."""
        return read_sequence(self.folder / sequence)

    def prepare(self, workers: int = 0) -> None:
        """Check that every scan of the split has its labels."""
        for drive in self.drives if self.labelled else []:
            there = {path.stem for path in (self.folder / drive.name / "labels").glob("*.label")}
            missing = [scan.stem for scan in drive.scans if scan.stem not in there]
            if missing:
                raise DataError(
                    f"{self.folder / drive.name / 'labels'}: {len(missing)} of {len(drive.scans)} label files are "
                    f"missing, the first is {missing[0]}.label.\n  fix: download the labels, or correct the split"
                )

    def meta(self, index: int) -> FrameMeta:
        """Id, time and files of a frame, without its camera."""
        meta = super().meta(index)
        picture = self.folder / meta.sequence / "image_2" / f"{Path(meta.path).stem}.png"
        meta.images = {kitti.IMAGE: str(picture)} if picture.is_file() else {}
        return meta

    def _cameras(self, meta: FrameMeta) -> dict[str, Camera]:
        """The left colour camera as `image`, and camera 0 as `rectified`, where the picture is there."""
        if not meta.images:
            return {}
        lens, extrinsics = _calibration(self.folder / meta.sequence / "calib.txt", "P2", "Tr")
        rig = kitti.Calibration(lens[:3], np.eye(3), extrinsics[:3])
        return rig.cameras(*picture_size(meta.images[kitti.IMAGE]))

    def __getitem__(self, index: int) -> Frame:
        meta, (drive, place) = self.meta(index), self.find(index)
        meta.cameras = self._cameras(meta)
        scans, pose = self.scans(drive, place), pose_of(drive, place)
        points = self.merged(scans, drive, place)
        inputs: dict[str, Points | Poses | None] = {"points": points} | ({"pose": pose} if self.pose else {})
        labels = self._labels(drive, place, scans) if self.labelled else None
        return Frame(inputs, Targets(points=labels, poses=pose), meta)

    def _labels(self, drive: Drive, place: int, scans: list[Points]) -> PointLabels:
        """Class and instance of every point of the frame's scans."""
        paths = [self._label_path(drive.scans[past]) for past in self.recent(place)]
        found = [_read_labels(path, len(scan), self.task) for path, scan in zip(paths, scans, strict=True)]
        label, instance = (torch.from_numpy(np.concatenate(parts)) for parts in zip(*found, strict=True))
        probability = (label[:, None] == torch.arange(len(self.spec.classes))).float()
        return PointLabels(probability, torch.zeros(len(label), dtype=torch.long), 1, instance)

    @staticmethod
    def _label_path(scan: Path) -> Path:
        return scan.parent.parent / "labels" / f"{scan.stem}.label"


def _times(path: Path, numbers: list[int]) -> Array:
    """Seconds (N,) of the scans; ten a second where there is no times.txt, as in KITTI-Road."""
    if not path.is_file():
        return np.array([_PERIOD * number for number in numbers])
    seconds: Array = rows_of(read_table(path, 1), numbers, path)[:, 0]
    return seconds


def _calibration(path: Path, *keys: str) -> list[Array]:
    """(4, 4) matrices of a calibration file: Tr is LiDAR -> camera 0, P2 camera 0 -> the left colour picture."""
    rows = dict(row.split(":", 1) for row in kitti.read_text(path).splitlines() if ":" in row)
    matrices = []
    for key in keys:
        if key not in rows:
            raise DataError(
                f"{path}: no key {key}; it has {', '.join(rows) or 'none'}.\n"
                f"  fix: take calib.txt of the SemanticKITTI download, those of KITTI odometry's pictures lack Tr"
            )
        try:
            values = np.array(rows[key].split(), dtype=np.float64).reshape(3, 4)
        except ValueError:
            raise DataError(f"{path}: {key}: expected 12 numbers, found {rows[key].strip()[:80]!r}") from None
        matrices.append(np.concatenate([values, [[0.0, 0.0, 0.0, 1.0]]]))
    return matrices


def _extrinsics(path: Path) -> Array:
    """(4, 4) LiDAR -> camera 0."""
    (matrix,) = _calibration(path, "Tr")
    return np.asarray(rigid(matrix[:3].reshape(1, 12), path)[0])


def _read_labels(path: Path, count: int, task: str) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Class (N,), -1 unlabelled, and instance (N,), 0 none, from uint32: class below, instance above 16 bits."""
    raw = read_ids(path, count)
    label = _table(task)[raw & 0xFFFF]
    if (label == _UNKNOWN).any():
        unknown = np.unique(raw[label == _UNKNOWN] & 0xFFFF)
        raise DataError(f"{path}: SemanticKITTI has no label {', '.join(map(str, unknown[:5]))}; is it a label file?")
    return label, (raw >> 16).astype(np.int64)
