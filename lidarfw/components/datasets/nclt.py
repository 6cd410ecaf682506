"""NCLT: 27 sessions on one campus over 15 months: Velodyne scans, a Ladybug3's pictures all round, ground-truth poses.

Source: Carlevaris-Bianco et al., "University of Michigan North Campus long-term vision and lidar dataset", IJRR 2016.
"""

from __future__ import annotations

import functools
import re
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
    from_angles,
    interpolated,
    inverse,
    pose_of,
    scaled_image,
    scans_in,
)
from lidarfw.errors import ConfigError, DataError
from lidarfw.io import read_image
from lidarfw.types import Camera, DataSpec, Frame, FrameMeta, Image, Points, Poses, Spec, Targets

if TYPE_CHECKING:
    import torch
else:
    torch = LazyModule("torch")

_POINT = np.dtype([("place", "<u2", (3,)), ("intensity", "u1"), ("laser", "u1")])
_STEP, _OFFSET = 0.005, -100.0  # metres of a unit, and of 0
_FULL = 255  # intensity that becomes 1
_TURN = np.diag([1.0, -1, -1, 1])  # x ahead, y right, z down (north, east, down) -> x ahead, y left, z up
LIDAR = np.array([0.002, 0.004, 0.957])  # in the body, x ahead, y left, z up, metres
RIG = (0.035, 0.002, -1.23, -179.93, -0.23, 0.50)  # the Ladybug3 in the body: x, y, z in metres, angles in degrees
CAMERAS = tuple(f"Cam{number}" for number in range(6))  # Cam0 looks up, Cam5 ahead
_LENS = Camera("pinhole", 1616, 1232, (400.0, 400.0, 808.0, 616.0))  # about what each is when it is undistorted
_APART = 100_000  # microseconds between a scan and its picture: cameras take five a second


class NcltDataset(DriveDataset):
    """NCLT: ROOT/SESSION/{velodyne_sync,lb3}, ROOT/ground_truth, and for pictures ROOT/{cam_params,U2D_ALL_1616X1232}.

    Frames are the scans within the ground truth; with `images`, those that have a picture of each within 0.1 s. The
    sensor frame is the LiDAR's place with the axes of the body, x ahead, y left, z up. Points have one feature, the
    intensity 0..1. The target is the pose; the map is north, west, up with one origin for all sessions. Pictures of
    `Cam1` to `Cam5` look all round and lie on their side, Cam0 looks up; they are undistorted, black where nothing was
    recorded, and where the sensor was when the picture was taken is not told apart from where it was in the scan.
    """

    splits: ClassVar = {
        "train": ("2012-01-08",),
        "val": ("2012-02-05", "2012-06-15", "2013-02-23", "2013-04-05"),
        "test": ("2012-02-05", "2012-06-15", "2013-02-23", "2013-04-05"),
    }

    def __init__(
        self,
        *,
        root: str = "",
        split: str = "train",
        images: tuple[str, ...] = (),
        image_scale: float = 1.0,
        sweeps: int = 1,
        pose: bool = False,
    ) -> None:
        """Options.

        root: folder that holds the sessions and ground_truth/. split: train, val, test, all, or sessions such as
        2012-01-08, joined by +. images: cameras to give as inputs of their names. image_scale: their size, 1 as
        recorded. sweeps: scans per frame, the past ones moved into the current frame. pose: also give the pose, as the
        input `pose`.
        """
        unknown = [name for name in images if name not in CAMERAS]
        if unknown:
            raise ConfigError(f"dataset 'nclt' has no camera '{unknown[0]}'. Cameras: {', '.join(CAMERAS)}")
        if sweeps < 1:
            raise ConfigError(f"dataset.nclt.sweeps must be at least 1, got {sweeps}")
        if not 0 < image_scale <= 1:
            raise ConfigError(f"dataset.nclt.image_scale must be over 0 and at most 1, got {image_scale}")
        self.root, self.split, self.images, self.image_scale = root, split, tuple(images), image_scale
        self.sweeps, self.pose = sweeps, pose
        self._pictures: dict[str, dict[str, list[Path]]] = {}  # of each session and camera, one for each frame
        inputs = {"points": Spec(Points, channels=1)} | ({"pose": Spec(Poses)} if pose else {})
        inputs |= {name: Spec(Image, channels=3, geometry=_LENS.scaled(image_scale)) for name in self.images}
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
        """Scans that have a pose and all pictures that are inputs, their times and poses."""
        scans = scans_in(self.folder / sequence / "velodyne_sync")
        stamps = np.array([int(scan.stem) for scan in scans], dtype=np.int64)
        times, bodies = _read_ground_truth(self.folder / "ground_truth" / f"groundtruth_{sequence}.csv")
        kept = (stamps >= times[0]) & (stamps <= times[-1])
        found = {name: _nearest(self.folder / sequence / "lb3" / name, stamps) for name in self.images}
        for _, apart in found.values():
            kept &= apart <= _APART
        inside = np.flatnonzero(kept)
        self._pictures[sequence] = {name: [paths[place] for place in inside] for name, (paths, _) in found.items()}
        poses = _TURN @ interpolated(times, bodies, stamps[inside].astype(np.float64)) @ _TURN
        poses[:, :3, 3] += poses[:, :3, :3] @ LIDAR
        return Drive(sequence, [scans[place] for place in inside], stamps[inside] / 1e6, poses)

    def prepare(self, workers: int = 0) -> None:
        """List the split and read what the pictures need, so that missing files show before training."""
        super().prepare(workers)
        _ = self._cameras, self._straight

    def meta(self, index: int) -> FrameMeta:
        """Id, time, files and cameras of a frame."""
        meta, (drive, place) = super().meta(index), self.find(index)
        meta.images = {name: str(paths[place]) for name, paths in self._pictures[drive.name].items()}
        meta.cameras = dict(self._cameras)
        return meta

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
        xyz = (table["place"] * _STEP + _OFFSET) @ _TURN[:3, :3] - LIDAR
        intensity = table["intensity"].astype(np.float32)[:, None] / _FULL
        return Points.from_scan(torch.tensor(xyz, dtype=torch.float32), torch.tensor(intensity))

    def __getitem__(self, index: int) -> Frame:
        drive, place = self.find(index)
        points, pose = self.points(drive, place), pose_of(drive, place)
        inputs: dict[str, Points | Poses | Image | None] = {"points": points} | ({"pose": pose} if self.pose else {})
        inputs |= {name: self._image(name, paths[place]) for name, paths in self._pictures[drive.name].items()}
        return Frame(inputs, Targets(poses=pose), self.meta(index))

    def _image(self, name: str, path: Path) -> Image:
        """A picture, undistorted."""
        import cv2

        picture, straight = read_image(path), self._straight[name]
        if picture.shape[:2] == straight.shape[1:]:  # else `scaled_image` says so
            picture = cv2.remap(picture, straight[0], straight[1], cv2.INTER_LINEAR)
        return scaled_image(picture, self._cameras[name], self.image_scale, path)

    @functools.cached_property
    def _straight(self) -> dict[str, npt.NDArray[np.float32]]:
        """By camera (2, H, W): for each pixel of the undistorted picture its x and y in the recorded one."""
        return {name: _read_straight(self._distortion(name)) for name in self.images}

    @functools.cached_property
    def _cameras(self) -> dict[str, Camera]:
        """The cameras of undistorted pictures."""
        return {name: self._camera(name) for name in self.images}

    def _camera(self, name: str) -> Camera:
        folder, number = self.folder / "cam_params", name[-1]
        matrix = _read_numbers(folder / f"K_cam{number}.csv", 9)
        place = _read_numbers(folder / f"x_lb3_c{number}.csv", 6)
        rig, camera = from_angles(np.array([[*row[:3], *np.radians(row[3:])] for row in (RIG, place)]))
        body = _TURN @ np.block([[np.eye(3), LIDAR[:, None]], [np.zeros(3), 1]])
        rows = tuple(tuple(map(float, row)) for row in inverse(rig @ camera) @ body)
        lens = (float(matrix[0]), float(matrix[4]), float(matrix[2]), float(matrix[5]))
        return Camera("pinhole", *_read_size(self._distortion(name)), lens, from_sensor=rows)

    def _distortion(self, name: str) -> Path:
        return self.folder / "U2D_ALL_1616X1232" / f"U2D_{name}_1616X1232.txt"


def _nearest(folder: Path, stamps: npt.NDArray[np.int64]) -> tuple[list[Path], npt.NDArray[np.int64]]:
    """The picture of a folder nearest to each time (N,), and how far off it is (N,), microseconds."""
    pictures = scans_in(folder, ".tiff")
    if not pictures:
        raise DataError(f"{folder}: no .tiff pictures.\n  fix: unpack them, or leave the camera out of images")
    taken = np.array([int(picture.stem) for picture in pictures], dtype=np.int64)
    after = np.searchsorted(taken, stamps).clip(max=len(taken) - 1)
    before = (after - 1).clip(min=0)
    places = np.where(np.abs(taken[before] - stamps) <= np.abs(taken[after] - stamps), before, after)
    return [pictures[place] for place in places], np.abs(taken[places] - stamps)


def _read_size(path: Path) -> tuple[int, int]:
    """Width and height of the pictures, from the first line: width/cols = 1616 , height/rows = 1232."""
    try:
        with path.open(encoding="utf-8") as file:
            line = file.readline(200)
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read: {error}\n  fix: unpack U2D_ALL_1616X1232.tar.gz there") from error
    found = re.findall(r"\d+", line)
    if len(found) != 2 or "0" in found:
        raise DataError(f"{path}, line 1: expected width/cols = 1616 , height/rows = 1232, found {line.strip()[:80]!r}")
    return int(found[0]), int(found[1])


def _read_straight(path: Path) -> npt.NDArray[np.float32]:
    """(2, H, W) x, y in the recorded picture, from lines of row, column, and y, x of what is seen there."""
    width, height = _read_size(path)
    try:
        table = np.loadtxt(path, skiprows=1, ndmin=2, dtype=np.float32)
    except ValueError as error:
        raise DataError(f"{path}: expected 4 numbers per line: {error}") from error
    if table.shape != (width * height, 4):
        raise DataError(f"{path}: expected {width * height} lines of 4 numbers, found {table.shape}")
    straight = np.full((2, height, width), np.nan, np.float32)
    row, column = table[:, :2].astype(np.int64).T
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    straight[:, row[inside], column[inside]] = table[inside][:, [3, 2]].T
    if np.isnan(straight).any():
        place = np.argwhere(np.isnan(straight).any(0))[0].tolist()
        raise DataError(f"{path}: expected a line for every pixel, found none for row {place[0]}, column {place[1]}")
    return straight


def _read_numbers(path: Path, count: int) -> Array:
    """So many numbers with commas between them; DataError where there are others."""
    try:
        numbers = np.array([float(word) for word in re.split(r"[,\s]+", kitti.read_text(path).strip())])
    except ValueError as error:
        raise DataError(f"{path}: expected {count} numbers: {error}") from error
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise DataError(f"{path}: expected {count} finite numbers, found {len(numbers)}: {numbers.tolist()[:12]}")
    return numbers


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
