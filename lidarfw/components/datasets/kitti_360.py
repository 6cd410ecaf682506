"""KITTI-360 in its official layout: scans, poses, and both fisheye cameras.

Source: Liao et al., "KITTI-360: a novel dataset and benchmarks for urban scene understanding in 2D and 3D", PAMI 2022.
The fisheyes follow Mei and Rives, "Single view point omnidirectional camera calibration from planar grids", ICRA 2007.
"""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from lidarfw import kitti
from lidarfw.components.datasets.drives import (
    Array,
    Drive,
    DriveDataset,
    inverse,
    pose_of,
    read_table,
    rigid,
    scaled_image,
    scans_in,
)
from lidarfw.errors import ConfigError, DataError
from lidarfw.io import read_image
from lidarfw.types import Camera, DataSpec, Frame, FrameMeta, Image, Points, Poses, Spec, Targets

_PERIOD = 0.1  # seconds between scans without time stamps
_USUAL = {  # for the spec, which is asked before the calibration is there
    "image_00": Camera("pinhole", 1408, 376, (552.6, 552.6, 682.0, 238.8)),
    "image_01": Camera("pinhole", 1408, 376, (552.6, 552.6, 682.0, 238.8)),
    "image_02": Camera("mei", 1400, 1400, (1336.0, 1336.0, 717.0, 706.0), (2.21, 0.017, 1.65, 0.0, 0.0)),
    "image_03": Camera("mei", 1400, 1400, (1485.0, 1485.0, 699.0, 698.0), (2.55, 0.049, 4.51, 0.0, 0.0)),
}
_FOLDERS = {"image_00": "data_rect", "image_01": "data_rect", "image_02": "data_rgb", "image_03": "data_rgb"}


def _drives(*numbers: int) -> tuple[str, ...]:
    return tuple(f"2013_05_28_drive_{number:04d}_sync" for number in numbers)


class Kitti360Dataset(DriveDataset):
    """KITTI-360: ROOT/calibration, data_3d_raw/DRIVE/velodyne_points, data_poses/DRIVE, data_2d_raw/DRIVE/image_02 ...

    Frames are the scans that have a pose. Points have one feature, remission 0..1. The target is the LiDAR's pose in
    the world of the dataset. Cameras: `image_00` and `image_01`, the rectified perspective pair ahead; `image_02` to
    the left and `image_03` to the right, fisheyes of 180 degrees.
    """

    splits: ClassVar = {
        "train": _drives(0, 2, 4, 5, 6, 7, 8, 9, 10),
        "val": _drives(3),
        "test": _drives(3, 18),
    }

    def __init__(
        self,
        *,
        root: str = "",
        split: str = "train",
        images: tuple[str, ...] = (),
        image_scale: float = 1.0,
        poses: bool = True,
        sweeps: int = 1,
        pose: bool = False,
    ) -> None:
        """Options.

        root: folder that holds calibration/ and data_3d_raw/. split: train, val, test, all, or drives such as 03,
        joined by +. images: cameras to give as inputs of their names. image_scale: their size, 1 as recorded. poses:
        read them, and leave out scans that have none. sweeps: scans per frame, the past ones moved into the current
        frame. pose: also give the LiDAR's pose, as the input `pose`.
        """
        unknown = [name for name in images if name not in _USUAL]
        if unknown:
            raise ConfigError(f"dataset 'kitti_360' has no camera '{unknown[0]}'. Cameras: {', '.join(_USUAL)}")
        if sweeps < 1:
            raise ConfigError(f"dataset.kitti_360.sweeps must be at least 1, got {sweeps}")
        if not 0 < image_scale <= 1:
            raise ConfigError(f"dataset.kitti_360.image_scale must be over 0 and at most 1, got {image_scale}")
        if not poses and (pose or sweeps > 1):
            raise ConfigError("dataset.kitti_360: pose=true and sweeps > 1 need poses.\n  fix: poses=true")
        self.root, self.split, self.images, self.image_scale = root, split, tuple(images), image_scale
        self.poses, self.sweeps, self.pose = poses, sweeps, pose
        inputs = {"points": Spec(Points, channels=1)} | ({"pose": Spec(Poses)} if pose else {})
        inputs |= {n: Spec(Image, channels=3, geometry=_USUAL[n].scaled(image_scale)) for n in self.images}
        self.spec = DataSpec(inputs, frozenset({Poses} if poses else ()), (), sweeps)

    @property
    def folder(self) -> Path:
        """ROOT."""
        if not self.root:
            raise DataError("dataset.kitti_360.root is not set.\n  fix: dataset.kitti_360.root=/path/to/KITTI-360")
        if not (Path(self.root) / "data_3d_raw").is_dir():
            raise DataError(
                f"{Path(self.root) / 'data_3d_raw'}: no such folder.\n"
                f"  fix: dataset.kitti_360.root must hold calibration, data_3d_raw, data_poses"
            )
        return Path(self.root)

    @property
    def named(self) -> list[str]:
        """The drives of the split; 3 or 03 stands for 2013_05_28_drive_0003_sync."""
        return [_drives(int(name))[0] if name.isdigit() else name for name in super().named]

    def present(self) -> list[str]:
        places = (self.folder / "data_3d_raw").iterdir()
        return sorted(place.name for place in places if (place / "velodyne_points" / "data").is_dir())

    def open(self, sequence: str) -> Drive:
        """Scans that have a pose, their times and LiDAR poses."""
        folder = self.folder / "data_3d_raw" / sequence / "velodyne_points"
        scans = scans_in(folder / "data")
        times = _times(folder / "timestamps.txt", [int(scan.stem) for scan in scans])
        if not self.poses:
            return Drive(sequence, scans, times)
        vehicle = _read_numbered(self.folder / "data_poses" / sequence / "poses.txt")
        chosen = [place for place, scan in enumerate(scans) if int(scan.stem) in vehicle]
        matrices = [vehicle[int(scans[place].stem)] @ self.calibration.lidar_to_vehicle for place in chosen]
        return Drive(sequence, [scans[i] for i in chosen], times[chosen], np.array(matrices).reshape(-1, 4, 4))

    @functools.cached_property
    def calibration(self) -> Calibration:
        """Where the sensors are, and the lenses."""
        return read_calibration(self.folder / "calibration")

    def prepare(self, workers: int = 0) -> None:
        """Read the calibration and list the split; every picture that is an input must be there."""
        cameras = self.calibration.cameras
        for name in self.images:
            self._camera_of(name, cameras)
        for folder, drive in ((self._pictures(d.name, n), d) for d in self.drives for n in self.images):
            there = {path.stem for path in folder.glob("*.png")}
            missing = [scan.stem for scan in drive.scans if scan.stem not in there]
            if missing:
                raise DataError(
                    f"{folder}: {len(missing)} of {len(drive.scans)} pictures are missing, the first is "
                    f"{missing[0]}.png.\n  fix: download them, or leave the camera out of images"
                )

    def meta(self, index: int) -> FrameMeta:
        """Id, time, files and cameras of a frame."""
        meta, (drive, place) = super().meta(index), self.find(index)
        files = {n: self._pictures(drive.name, n) / f"{drive.scans[place].stem}.png" for n in _USUAL}
        meta.images = {name: str(path) for name, path in files.items() if path.is_file()}
        meta.cameras = dict(self.calibration.cameras)
        return meta

    def __getitem__(self, index: int) -> Frame:
        drive, place = self.find(index)
        pose, meta = pose_of(drive, place), self.meta(index)
        inputs: dict[str, Any] = {"points": self.points(drive, place)} | ({"pose": pose} if self.pose else {})
        for name in self.images:
            path = self._pictures(drive.name, name) / f"{drive.scans[place].stem}.png"
            camera = self._camera_of(name, meta.cameras)
            inputs[name] = scaled_image(read_image(path), camera, self.image_scale, path)
        return Frame(inputs, Targets(poses=pose), meta)

    def _pictures(self, drive: str, name: str) -> Path:
        return self.folder / "data_2d_raw" / drive / name / _FOLDERS[name]

    def _camera_of(self, name: str, cameras: dict[str, Camera]) -> Camera:
        if name not in cameras:
            raise DataError(f"{self.folder / 'calibration'}: has no calibration of {name}, an input of the dataset")
        return cameras[name]


@dataclasses.dataclass(frozen=True, eq=False)
class Calibration:
    """The rig: one for all drives."""

    lidar_to_vehicle: Array  # (4, 4) to the inertial unit, whose poses are given
    cameras: dict[str, Camera]  # those whose lens is calibrated, seen from the LiDAR


def read_calibration(folder: Path) -> Calibration:
    """The files of KITTI-360's folder `calibration`; DataError names file and key."""
    path = folder / "calib_cam_to_pose.txt"
    cameras = {name: _transform(words, path) for name, words in _keyed(path).items()}
    if "image_00" not in cameras:
        raise DataError(f"{path}: no key image_00; it has {', '.join(cameras) or 'none'}")
    path = folder / "calib_cam_to_velo.txt"
    to_vehicle = cameras["image_00"] @ inverse(_transform(kitti.read_text(path).split(), path))
    found = {}
    for name in (n for n in _USUAL if n in cameras):
        lens = _fisheye(folder / f"{name}.yaml") if _USUAL[name].model == "mei" else _perspective(folder, name)
        if lens is not None:
            camera, rectify = lens
            matrix = rectify @ inverse(cameras[name]) @ to_vehicle
            rows = tuple(tuple(float(value) for value in row) for row in matrix)
            found[name] = dataclasses.replace(camera, from_sensor=rows)
    return Calibration(to_vehicle, found)


def _keyed(path: Path) -> dict[str, list[str]]:
    rows = (line.partition(":") for line in kitti.read_text(path).splitlines() if ":" in line)
    return {key.strip(): values.split() for key, _, values in rows}


def _transform(words: Sequence[str], path: Path) -> Array:
    try:
        values = np.array(words, dtype=np.float64).reshape(1, 12)
    except ValueError:
        raise DataError(f"{path}: expected 3 x 4 numbers, found {' '.join(words)[:80]!r}") from None
    matrix: Array = rigid(values, path)[0]
    return matrix


def _fisheye(path: Path) -> tuple[Camera, Array] | None:
    """The lens of a fisheye; None where its file is not there."""
    import yaml

    if not path.is_file():
        return None
    try:  # the first line is OpenCV's, which YAML does not know
        values = yaml.safe_load(kitti.read_text(path).removeprefix("%YAML:1.0"))
        lens, mirror = values["projection_parameters"], values["mirror_parameters"]
        intrinsics = tuple(float(lens[key]) for key in ("gamma1", "gamma2", "u0", "v0"))
        bend = tuple(float(values["distortion_parameters"][key]) for key in ("k1", "k2", "p1", "p2"))
        size = int(values["image_width"]), int(values["image_height"])
        return Camera("mei", *size, intrinsics, (float(mirror["xi"]), *bend)), np.eye(4)  # type: ignore[arg-type]
    except (yaml.YAMLError, TypeError, KeyError, ValueError) as error:
        raise DataError(f"{path}: is no MEI calibration: {type(error).__name__}: {error}") from error


def _perspective(folder: Path, name: str) -> tuple[Camera, Array] | None:
    """The lens of a rectified picture, and the rotation that rectifies; None where its file is not there."""
    path, number = folder / "perspective.txt", name[-2:]
    if not path.is_file():
        return None
    table = _keyed(path)
    try:
        lens = np.array(table[f"P_rect_{number}"], dtype=np.float64).reshape(3, 4)
        turn = np.array(table[f"R_rect_{number}"], dtype=np.float64).reshape(3, 3)
        width, height = (round(float(word)) for word in table[f"S_rect_{number}"])
    except (KeyError, ValueError) as error:
        raise DataError(f"{path}: expected P_rect_{number}, R_rect_{number} and S_rect_{number}: {error}") from error
    rectify = np.eye(4)
    rectify[:3, :3] = turn
    intrinsics = (float(lens[0, 0]), float(lens[1, 1]), float(lens[0, 2]), float(lens[1, 2]))
    return Camera("pinhole", width, height, intrinsics), rectify


def _times(path: Path, numbers: Sequence[int]) -> Array:
    """Seconds of the scans; ten a second where there are no time stamps."""
    if not path.is_file():
        return np.array([_PERIOD * number for number in numbers])
    lines = kitti.read_text(path).strip().splitlines()
    if numbers and max(numbers) >= len(lines):
        raise DataError(f"{path}: has {len(lines)} lines, but there is a scan {max(numbers):010d}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # numpy only warns of a time zone
            stamps = np.array([lines[number].strip() for number in numbers], dtype="datetime64[ns]")
    except (ValueError, UserWarning) as error:
        raise DataError(f"{path}: expected a date and time per line: {error}") from error
    return stamps.astype(np.int64) / 1e9


def _read_numbered(path: Path) -> dict[int, Array]:
    """Poses (4, 4) by frame number, from lines of the number and 12 values."""
    table = read_table(path, 13)
    wrong = (table[:, 0] < 0) | (table[:, 0] >= 1e10) | (table[:, 0] % 1 != 0)
    if wrong.any():
        line = int(wrong.argmax())
        raise DataError(f"{path}, line {line + 1}: expected a frame number of ten digits first, found {table[line, 0]}")
    return dict(zip(table[:, 0].astype(int).tolist(), rigid(table[:, 1:], path), strict=True))
