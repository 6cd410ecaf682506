"""One's own scans: a folder of files in any format that `lidarfw.io` reads, with optional poses and labels."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from lidarfw import kitti
from lidarfw._lazy import LazyModule
from lidarfw.components.datasets.drives import (
    Array,
    Drive,
    DriveDataset,
    pose_of,
    read_boxes,
    read_ids,
    read_poses,
    read_table,
)
from lidarfw.errors import ConfigError, DataError
from lidarfw.files import natural
from lidarfw.io import SCAN_READERS, read_points
from lidarfw.types import Boxes, DataSpec, Frame, PointLabels, Points, Poses, Spec, Targets, Tracks

if TYPE_CHECKING:
    import torch
else:
    torch = LazyModule("torch")

_PERIOD = 0.1  # seconds between scans without times.txt


class FolderDataset(DriveDataset):
    """Scans in ROOT, or in folders of ROOT, one for each sequence; in order of their names.

    A sequence is a folder of scans, or one with scans in points/. Beside them: poses.txt (LiDAR -> map, 12 numbers
    a scan), times.txt (seconds), boxes/NAME.txt (class x y z l w h yaw, and a track id), labels/NAME.label (uint32 a
    point: 0 unlabelled, k the k-th class; instance in the upper 16 bits). All in lidarfw's conventions. Where there is
    ignored/NAME.txt, with lines as in boxes, its boxes are neither right nor wrong for their class.
    """

    def __init__(
        self,
        *,
        root: str = "",
        split: str = "all",
        classes: tuple[str, ...] = (),
        boxes: bool = False,
        tracks: bool = False,
        labels: bool = False,
        poses: bool = False,
        sweeps: int = 1,
        pose: bool = False,
        features: int = 1,
        full_intensity: float = 1.0,
        columns: int | None = None,
    ) -> None:
        """Options.

        root: the folder. split: all, a sequence, or a file ROOT/SPLIT.txt that lists sequences; joined by +.
        classes: names, boxes of others are left out. boxes, tracks, labels, poses: which of these files there are.
        sweeps: scans per frame, the past ones moved into the current frame. pose: also give the pose as an input.
        features: values kept of a point after x, y, z, the intensity first. full_intensity: value that becomes 1.
        columns: float32 values of a point in .bin files, where not 4.
        """
        if sweeps < 1:
            raise ConfigError(f"dataset.folder.sweeps must be at least 1, got {sweeps}")
        if not poses and (pose or sweeps > 1):
            raise ConfigError("dataset.folder: pose=true and sweeps > 1 need poses.txt.\n  fix: poses=true")
        if (boxes or tracks or labels) and not classes:
            raise ConfigError("dataset.folder: labels need names.\n  fix: dataset.folder.classes=[car,pedestrian]")
        if full_intensity <= 0:
            raise ConfigError(f"dataset.folder.full_intensity must be positive, got {full_intensity}")
        self.root, self.split, self.classes = root, split, tuple(classes)
        self.boxes, self.tracks, self.labels, self.poses = boxes or tracks, tracks, labels, poses
        self.sweeps, self.pose, self.features = sweeps, pose, features
        self.full_intensity, self.columns = full_intensity, columns
        inputs = {"points": Spec(Points, channels=features)} | ({"pose": Spec(Poses)} if pose else {})
        given = {Boxes: self.boxes, Tracks: tracks, PointLabels: labels, Poses: poses}
        self.spec = DataSpec(inputs, frozenset(k for k, there in given.items() if there), self.classes, sweeps)

    @property
    def folder(self) -> Path:
        """ROOT."""
        if not self.root:
            raise DataError("dataset.folder.root is not set.\n  fix: dataset.folder.root=/path/to/scans")
        if not Path(self.root).is_dir():
            raise DataError(f"{self.root}: no such folder.\n  fix: dataset.folder.root=/path/to/scans")
        return Path(self.root)

    @property
    def named(self) -> list[str]:
        """The sequences of the split: those that a file of its name lists, else the one of its name."""
        names: list[str] = []
        for part in self.split.split("+"):
            listed = self.folder / f"{part}.txt"
            if part != "all":
                names += kitti.read_text(listed).split() if listed.is_file() else [part]
        return names

    def present(self) -> list[str]:
        """ROOT itself where it holds scans, else its folders that do."""
        places = [".", *sorted((p.name for p in self.folder.iterdir() if p.is_dir()), key=natural)]
        found = [name for name in places if _scans(self.folder / name)]
        return found[:1] if "." in found else found

    def open(self, sequence: str) -> Drive:
        """Scans, times and poses of a sequence."""
        folder = self.folder / sequence
        if not folder.is_dir():
            raise DataError(
                f"{folder}: no such sequence, nor a list {folder}.txt of sequences.\n"
                f"  fix: write one, or take every sequence: splits.train=all splits.val=all splits.test=all"
            )
        scans = _scans(folder)
        if not scans:
            raise DataError(f"{folder}: no scans: no files {', '.join(SCAN_READERS)} here or in points/")
        seconds = _times(folder / "times.txt", len(scans))
        matrices = None
        if self.poses:
            matrices = _one_each(read_poses(folder / "poses.txt"), len(scans), folder / "poses.txt")
        return Drive(folder.resolve().name if sequence == "." else sequence, scans, seconds, matrices)

    def scan(self, drive: Drive, place: int) -> Points:
        """One scan with the features asked for; the intensity is 0..1."""
        path = drive.scans[place]
        read = read_points(path, columns=self.columns)
        if read.features.shape[1] < self.features:
            there = ", ".join(read.names) or "none"
            raise DataError(f"{path}: expected {self.features} values after x, y, z, found {there}.\n  fix: features=")
        features = read.features[:, : self.features].copy()
        if self.features:
            features[:, 0] /= self.full_intensity
            low, high = float(features[:, 0].min()), float(features[:, 0].max())
            if low < 0 or high > 1:
                raise DataError(
                    f"{path}: intensity: expected 0..1, found {low:g}..{high:g}.\n"
                    f"  fix: dataset.folder.full_intensity=255"
                )
        return Points.from_scan(torch.tensor(read.xyz), torch.tensor(features))

    def __getitem__(self, index: int) -> Frame:
        drive, place = self.find(index)
        scans, pose = self.scans(drive, place), pose_of(drive, place)
        points = self.merged(scans, drive, place)
        targets = self._objects(drive.scans[place]) if self.boxes else Targets()
        if self.labels:
            targets.points = self._point_labels([drive.scans[past] for past in self.recent(place)], scans)
        inputs: dict[str, Points | Poses | None] = {"points": points} | ({"pose": pose} if self.pose else {})
        return Frame(inputs, targets.replace(poses=pose), self.meta(index))

    def _objects(self, scan: Path) -> Targets:
        """Boxes of the classes, and tracks where asked for."""
        boxes, track = read_boxes(self.beside(scan, "boxes"), self.classes, tracks=self.tracks)
        unclear = self.beside(scan, "ignored")
        ignored = read_boxes(unclear, self.classes)[0] if unclear.is_file() else Boxes.empty()
        return Targets(boxes=boxes, ignored=ignored, tracks=Tracks(boxes, track) if self.tracks else None)

    @staticmethod
    def beside(scan: Path, kind: str, suffix: str = ".txt") -> Path:
        """The file of a kind (boxes, ignored, labels) that belongs to a scan, whether it is there or not."""
        folder = scan.parent.parent if scan.parent.name == "points" else scan.parent
        return folder / kind / f"{scan.stem}{suffix}"

    def _point_labels(self, files: list[Path], scans: list[Points]) -> PointLabels:
        parts = [self._ids(self.beside(file, "labels", ".label"), len(scan)) for file, scan in zip(files, scans)]
        raw = np.concatenate(parts)
        label = torch.from_numpy((raw & 0xFFFF).astype(np.int64)) - 1
        probability = (label[:, None] == torch.arange(len(self.classes))).float()
        instance = torch.from_numpy((raw >> 16).astype(np.int64))
        return PointLabels(probability, torch.zeros(len(raw), dtype=torch.long), 1, instance)

    def _ids(self, path: Path, count: int) -> npt.NDArray[np.uint32]:
        raw = read_ids(path, count)
        if (raw & 0xFFFF).max(initial=0) > len(self.classes):
            raise DataError(f"{path}: expected labels 0 .. {len(self.classes)}, found {(raw & 0xFFFF).max()}")
        return raw


def _one_each(rows: Array, count: int, path: Path) -> Array:
    if len(rows) != count:
        raise DataError(f"{path}: expected {count} lines, one per scan, found {len(rows)}")
    return rows


def _times(path: Path, count: int) -> Array:
    """Seconds (N,) of the scans; ten a second where there is no times.txt."""
    if not path.is_file():
        return np.array([_PERIOD * number for number in range(count)])
    seconds = _one_each(read_table(path, 1), count, path)[:, 0]
    back = np.flatnonzero(np.diff(seconds) < 0)
    if len(back):
        raise DataError(f"{path}, line {back[0] + 2}: goes back in time; scans are taken in order of their names")
    return seconds


def _scans(folder: Path) -> list[Path]:
    """Scan files of a sequence; DataError where two have the same name but for the suffix."""
    place = folder / "points" if (folder / "points").is_dir() else folder
    files = [path for path in place.iterdir() if path.suffix.lower() in SCAN_READERS and path.is_file()]
    files.sort(key=lambda path: natural(path.stem))
    for first, second in itertools.pairwise(files):
        if first.stem == second.stem:
            raise DataError(f"{first} and {second.name}: a frame goes by its name, expected one file of each")
    return files
