"""NCLT: 27 sessions on one campus over 15 months, with Velodyne scans and ground-truth poses.

Source: Carlevaris-Bianco et al., "University of Michigan North Campus long-term vision and lidar dataset", IJRR 2016.
"""

from __future__ import annotations

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
    pose_of,
    scans_in,
)
from lidarfw.errors import ConfigError, DataError
from lidarfw.types import DataSpec, Frame, Points, Poses, Spec, Targets

if TYPE_CHECKING:
    import torch
else:
    torch = LazyModule("torch")

_POINT = np.dtype([("place", "<u2", (3,)), ("intensity", "u1"), ("laser", "u1")])
_STEP, _OFFSET = 0.005, -100.0  # metres of a unit, and of 0
_FULL = 255  # intensity that becomes 1
_TURN = np.diag([1.0, -1, -1, 1])  # x ahead, y right, z down (north, east, down) -> x ahead, y left, z up


class NcltDataset(DriveDataset):
    """NCLT: ROOT/2012-01-08/velodyne_sync and ROOT/ground_truth/groundtruth_2012-01-08.csv.

    Frames are the scans within the ground truth. Points are given in the frame of the vehicle's body, as the files
    have them, turned to x ahead, y left, z up; they have one feature, the intensity 0..1. The target is the body's
    pose; the map is north, west, up with one origin for all sessions.
    """

    splits: ClassVar = {
        "train": ("2012-01-08",),
        "val": ("2012-02-05", "2012-06-15", "2013-02-23", "2013-04-05"),
        "test": ("2012-02-05", "2012-06-15", "2013-02-23", "2013-04-05"),
    }

    def __init__(self, *, root: str = "", split: str = "train", sweeps: int = 1, pose: bool = False) -> None:
        """Options.

        root: folder that holds the sessions and ground_truth/. split: train, val, test, all, or sessions such as
        2012-01-08, joined by +. sweeps: scans per frame, the past ones moved into the current frame. pose: also give
        the pose, as the input `pose`.
        """
        if sweeps < 1:
            raise ConfigError(f"dataset.nclt.sweeps must be at least 1, got {sweeps}")
        self.root, self.split, self.sweeps, self.pose = root, split, sweeps, pose
        inputs = {"points": Spec(Points, channels=1)} | ({"pose": Spec(Poses)} if pose else {})
        self.spec = DataSpec(inputs, frozenset({Poses}), (), sweeps)

    @property
    def folder(self) -> Path:
        """ROOT."""
        if not self.root:
            raise DataError("dataset.nclt.root is not set.\n  fix: dataset.nclt.root=/path/to/nclt")
        if not Path(self.root).is_dir():
            raise DataError(f"{self.root}: no such folder.\n  fix: dataset.nclt.root=/path/to/nclt")
        return Path(self.root)

    def present(self) -> list[str]:
        return sorted(path.name for path in self.folder.iterdir() if (path / "velodyne_sync").is_dir())

    def open(self, sequence: str) -> Drive:
        """Scans that have a pose, their times and poses."""
        scans = scans_in(self.folder / sequence / "velodyne_sync")
        stamps = np.array([int(scan.stem) for scan in scans], dtype=np.float64)
        times, bodies = _read_ground_truth(self.folder / "ground_truth" / f"groundtruth_{sequence}.csv")
        inside = np.flatnonzero((stamps >= times[0]) & (stamps <= times[-1]))
        poses = _TURN @ interpolated(times, bodies, stamps[inside]) @ _TURN
        return Drive(sequence, [scans[place] for place in inside], stamps[inside] / 1e6, poses)

    def scan(self, drive: Drive, place: int) -> Points:
        """One scan in our convention: uint16 x, y, z, uint8 intensity, uint8 laser."""
        path = drive.scans[place]
        try:
            data = path.read_bytes()
        except OSError as error:
            raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
        if not data or len(data) % _POINT.itemsize:
            raise DataError(f"{path}: expected 8 bytes a point, one point or more, found {len(data)} bytes")
        table = np.frombuffer(data, _POINT)
        xyz = (table["place"] * _STEP + _OFFSET) @ _TURN[:3, :3]
        intensity = table["intensity"].astype(np.float32)[:, None] / _FULL
        return Points.from_scan(torch.tensor(xyz, dtype=torch.float32), torch.tensor(intensity))

    def __getitem__(self, index: int) -> Frame:
        drive, place = self.find(index)
        points, pose = self.points(drive, place), pose_of(drive, place)
        inputs: dict[str, Points | Poses | None] = {"points": points} | ({"pose": pose} if self.pose else {})
        return Frame(inputs, Targets(poses=pose), self.meta(index))


def _read_ground_truth(path: Path) -> tuple[Array, Array]:
    """Times (M,) in microseconds and poses (M, 4, 4) body -> north, east, down; rows that are not finite are left out.

    Every file starts with such rows, before the first fix.
    """
    rows = [line.split(",") for line in kitti.read_text(path).splitlines() if line.strip()]
    wrong = next((number for number, row in enumerate(rows) if len(row) != 7), None)
    if wrong is not None:
        found = ",".join(rows[wrong])[:80]
        raise DataError(f"{path}, line {wrong + 1}: expected utime,x,y,z,roll,pitch,yaw, found {found!r}")
    try:
        table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    except ValueError as error:
        raise DataError(f"{path}: expected 7 numbers per line: {error}") from error
    table = table[np.isfinite(table).all(axis=1)]
    if len(table) < 2:
        raise DataError(f"{path}: expected two poses or more, found {len(table)}")
    if (np.diff(table[:, 0]) < 0).any():
        raise DataError(f"{path}: the time goes back after {table[int((np.diff(table[:, 0]) < 0).argmax()), 0]:.0f}")
    times, first = np.unique(table[:, 0], return_index=True)
    return times, from_angles(table[first, 1:])
