"""Oxford Radar RobotCar: repeated traversals with Velodyne scans and inertial poses, and boxes beside them.

Source: Barnes et al., "The Oxford Radar RobotCar dataset: a radar extension to the Oxford RobotCar dataset", ICRA 2020.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lidarfw import kitti
from lidarfw._lazy import LazyModule
from lidarfw.components.datasets.drives import (
    Array,
    Drive,
    DriveDataset,
    from_angles,
    interpolated,
    inverse,
    pose_of,
    read_boxes,
    read_table,
    scans_in,
)
from lidarfw.errors import ConfigError, DataError
from lidarfw.types import Boxes, DataSpec, Frame, Points, Poses, Spec, Targets, Tracks

if TYPE_CHECKING:
    import torch
else:
    torch = LazyModule("torch")

LIDARS = ("velodyne_left", "velodyne_right")
_SUFFIX = "-radar-oxford-10k"
_FROM_VELODYNE = np.diag([-1.0, 1, -1, 1])  # their frame is x back, y left, z down
_UP = np.diag([1.0, -1, -1, 1])  # north, east, down -> north, west, up
_ORIGIN = (5_735_000.0, 620_000.0)  # northing, easting of the map's origin, metres: float32 has no UTM
_FULL = 255  # intensity that becomes 1
_INS = ("timestamp", "northing", "easting", "down", "roll", "pitch", "yaw")


class OxfordDataset(DriveDataset):
    """Oxford Radar RobotCar: ROOT/2019-01-11-14-02-26-radar-oxford-10k with velodyne_left, gps; ROOT/extrinsics.

    Frames are the scans between the first and the last inertial pose. Points have one feature, the intensity 0..1.
    Targets are the LiDAR's pose (north, west, up; one origin for all traversals) and, with `boxes`, the objects of
    TRAVERSAL/boxes/TIMESTAMP.txt, lines of class x y z l w h yaw in lidarfw's conventions; a track id may follow, and
    where all objects of a frame have one, its tracks are targets too.
    """

    splits: ClassVar = {
        "train": ("2019-01-11-14-02-26", "2019-01-14-12-05-52", "2019-01-14-14-48-55", "2019-01-18-15-20-12"),
        "val": ("2019-01-15-13-06-37", "2019-01-17-13-26-39", "2019-01-17-14-03-00", "2019-01-18-14-14-42"),
        "test": ("2019-01-15-13-06-37", "2019-01-17-13-26-39", "2019-01-17-14-03-00", "2019-01-18-14-14-42"),
    }

    def __init__(
        self,
        *,
        root: str = "",
        split: str = "train",
        lidar: str = "velodyne_left",
        boxes: bool = False,
        classes: tuple[str, ...] = ("Vehicle", "Pedestrian", "Cyclist"),
        sweeps: int = 1,
        pose: bool = False,
    ) -> None:
        """Options.

        root: folder that holds the traversals and extrinsics/. split: train, val, test, all, or traversals such as
        2019-01-11-14-02-26, joined by +. lidar: velodyne_left or velodyne_right. boxes: there are labelled objects.
        classes: to learn, boxes of others are left out. sweeps: scans per frame, the past ones moved into the current
        frame. pose: also give the LiDAR's pose, as the input `pose`.
        """
        if lidar not in LIDARS:
            raise ConfigError(f"dataset 'oxford' has no lidar '{lidar}'. LiDARs: {', '.join(LIDARS)}")
        if sweeps < 1:
            raise ConfigError(f"dataset.oxford.sweeps must be at least 1, got {sweeps}")
        self.root, self.split, self.lidar, self.boxes = root, split, lidar, boxes
        self.classes, self.sweeps, self.pose = tuple(classes), sweeps, pose
        inputs = {"points": Spec(Points, channels=1)} | ({"pose": Spec(Poses)} if pose else {})
        targets = frozenset({Boxes, Poses} if boxes else {Poses})
        self.spec = DataSpec(inputs, targets, self.classes if boxes else (), sweeps)

    @property
    def folder(self) -> Path:
        """ROOT."""
        if not self.root:
            raise DataError("dataset.oxford.root is not set.\n  fix: dataset.oxford.root=/path/to/traversals")
        if not Path(self.root).is_dir():
            raise DataError(f"{self.root}: no such folder.\n  fix: dataset.oxford.root=/path/to/traversals")
        return Path(self.root)

    def present(self) -> list[str]:
        places = sorted(path for path in self.folder.iterdir() if (path / self.lidar).is_dir())
        return [place.name.removesuffix(_SUFFIX) for place in places]

    def open(self, sequence: str) -> Drive:
        """Scans that have a pose, their times and LiDAR poses."""
        folder = self._traversal(sequence)
        scans = scans_in(folder / self.lidar)
        stamps = np.array([int(scan.stem) for scan in scans], dtype=np.float64)
        times, inertial = _read_ins(folder / "gps" / "ins.csv")
        inside = np.flatnonzero((stamps >= times[0]) & (stamps <= times[-1]))
        poses = _UP @ interpolated(times, inertial, stamps[inside]) @ self._lidar_to_inertial()
        return Drive(sequence, [scans[place] for place in inside], stamps[inside] / 1e6, poses)

    def scan(self, drive: Drive, place: int) -> Points:
        """One scan in our convention: float32 x, y, z, intensity, all x first."""
        path = drive.scans[place]
        values = np.fromfile(path, "<f4")
        if not len(values) or path.stat().st_size % 16:
            raise DataError(
                f"{path}: expected 4 rows of float32 (x, y, z, intensity), found {path.stat().st_size} bytes"
            )
        table = values.reshape(4, -1)
        if not np.isfinite(table).all() or table[3].min() < 0 or table[3].max() > _FULL:
            raise DataError(
                f"{path}: expected finite points with intensity 0..{_FULL}; is it a row per value, x first?"
            )
        xyz = table[:3].T @ _FROM_VELODYNE[:3, :3].T.astype(np.float32)
        return Points.from_scan(torch.tensor(xyz), torch.tensor(table[3:].T / _FULL))

    def __getitem__(self, index: int) -> Frame:
        drive, place = self.find(index)
        points, pose = self.points(drive, place), pose_of(drive, place)
        inputs: dict[str, Points | Poses | None] = {"points": points} | ({"pose": pose} if self.pose else {})
        targets = Targets(poses=pose)
        if self.boxes:
            labels = self._traversal(drive.name) / "boxes" / f"{drive.scans[place].stem}.txt"
            targets.boxes, tracks = read_boxes(labels, self.classes)
            targets.tracks = Tracks(targets.boxes, tracks) if bool((tracks >= 0).all()) else None
        return Frame(inputs, targets, self.meta(index))

    def _traversal(self, name: str) -> Path:
        places = [self.folder / f"{name}{_SUFFIX}", self.folder / name]
        found = next((place for place in places if place.is_dir()), None)
        if found is None:
            raise DataError(f"{places[0]}: no such folder.\n  fix: unpack the traversal, or correct root and split")
        return found

    def _lidar_to_inertial(self) -> Array:
        """(4, 4) LiDAR in our convention -> inertial unit, by the extrinsics of the development kit."""
        vehicle = {}
        for name in (self.lidar, "ins"):
            path = self.folder / "extrinsics" / f"{name}.txt"
            if not path.is_file():
                raise DataError(
                    f"{path}: no such file.\n  fix: copy the folder extrinsics of robotcar-dataset-sdk to root"
                )
            rows = read_table(path, 6)
            if len(rows) != 1:
                raise DataError(f"{path}: expected one line x y z roll pitch yaw, found {len(rows)}")
            vehicle[name] = from_angles(rows)[0]
        matrix: Array = inverse(vehicle["ins"]) @ vehicle[self.lidar] @ _FROM_VELODYNE
        return matrix


def _read_ins(path: Path) -> tuple[Array, Array]:
    """Times (M,) in microseconds and poses (M, 4, 4) inertial unit -> north, east, down from the map's origin."""
    rows = list(csv.DictReader(io.StringIO(kitti.read_text(path))))
    missing = [key for key in _INS if not rows or key not in rows[0]]
    if missing:
        raise DataError(
            f"{path}: has no rows with the column {missing[0]}; it has {', '.join(rows[0] if rows else ())}"
        )
    try:
        table = np.array([[row[key] for key in _INS] for row in rows], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"{path}: expected numbers in {', '.join(_INS)}: {error}") from error
    rises = np.concatenate([[True], np.diff(table[:, 0]) > 0])
    wrong = ~(np.isfinite(table).all(axis=1) & rises)
    if wrong.any():
        raise DataError(f"{path}, line {wrong.argmax() + 2}: expected finite numbers and a rising timestamp")
    table[:, 1:3] -= _ORIGIN
    return table[:, 0], from_angles(table[:, 1:])
