"""What the datasets of recorded drives share: splits by sequence, poses, and past scans in the current frame."""

from __future__ import annotations

import functools
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt

from lidarfw import kitti
from lidarfw._lazy import LazyModule
from lidarfw.errors import ConfigError, DataError
from lidarfw.interfaces.data import Dataset
from lidarfw.io import read_points
from lidarfw.types import Boxes, Camera, FrameMeta, Image, Points, Poses

if TYPE_CHECKING:
    import torch
    from torch import Tensor
else:
    torch = LazyModule("torch")

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Drive:
    """One sequence, a row per frame in order of time."""

    name: str
    scans: Sequence[Path]
    times: Array  # (N,) seconds
    poses: Array | None = None  # (N, 4, 4) LiDAR -> map; None where the dataset was not asked for poses


class DriveDataset(Dataset):
    """Frames of several sequences.

    A split is a name of `splits`, the name of a sequence, `all` for every sequence that is there, or several of
    these joined by `+`. Subclasses say which sequences there are (`present`) and read the lists of one (`open`);
    nothing is read before the first frame is asked for.
    """

    splits: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    root: str
    sweeps: int

    @abstractmethod
    def open(self, sequence: str) -> Drive:
        """The frames of a sequence; DataError where its files are missing or broken."""

    @abstractmethod
    def present(self) -> list[str]:
        """Names of all sequences whose scans are there."""

    @property
    def named(self) -> list[str]:
        """The sequences that the split names; none for `all`, which depends on the disk."""
        parts = self.split.split("+")
        return list(dict.fromkeys(s for part in parts if part != "all" for s in self.splits.get(part, (part,))))

    @functools.cached_property
    def drives(self) -> list[Drive]:
        """The sequences of the split, those without a frame left out."""
        whole = self.present() if "all" in self.split.split("+") else []
        drives = [self.open(name) for name in dict.fromkeys([*self.named, *whole])]
        if not any(len(drive.scans) for drive in drives):
            raise DataError(f"the split '{self.split}' of {self.root or 'no root'} has no frames: no scans there")
        return [drive for drive in drives if len(drive.scans)]

    @functools.cached_property
    def _starts(self) -> npt.NDArray[np.int64]:
        return np.cumsum([0, *(len(drive.scans) for drive in self.drives)])

    def find(self, index: int) -> tuple[Drive, int]:
        """The sequence of a frame, and its place there."""
        index = range(len(self))[index]
        number = int(np.searchsorted(self._starts, index, side="right")) - 1
        return self.drives[number], index - int(self._starts[number])

    def prepare(self, workers: int = 0) -> None:
        """List the split, so that missing files show before training and not within."""
        len(self)

    def __len__(self) -> int:
        return int(self._starts[-1])

    def meta(self, index: int) -> FrameMeta:
        """Id, time and file of a frame, without its cameras."""
        drive, place = self.find(index)
        path = drive.scans[place]
        name = f"{drive.name}/{path.stem}"
        return FrameMeta(name, drive.name, place, float(drive.times[place]), path=str(path))

    def sequences(self) -> list[Sequence[int]]:
        """The frames of each drive."""
        return [range(start, end) for start, end in zip(self._starts[:-1].tolist(), self._starts[1:].tolist())]

    def positions(self) -> Array | None:
        """Where each frame was taken, (N, 3) metres in the map; None where a drive has no poses."""
        poses = [drive.poses for drive in self.drives if drive.poses is not None]
        return np.concatenate(poses)[:, :3, 3] if len(poses) == len(self.drives) else None

    def recent(self, place: int) -> list[int]:
        """Places of the scans of a frame: its own first, then the past ones; fewer at the start of a sequence."""
        return list(range(place, max(-1, place - self.sweeps), -1))

    def points(self, drive: Drive, place: int) -> Points:
        """The scan of a frame and, for `sweeps` > 1, the past ones moved into its frame, with times."""
        return self.merged(self.scans(drive, place), drive, place)

    def scans(self, drive: Drive, place: int) -> list[Points]:
        """The scans of a frame, each in its own frame."""
        return [self.scan(drive, past) for past in self.recent(place)]

    def merged(self, scans: Sequence[Points], drive: Drive, place: int) -> Points:
        """The scans of a frame as one, in the frame of the first."""
        return scans[0] if self.sweeps == 1 else merge_scans(scans, drive, self.recent(place))

    def scan(self, drive: Drive, place: int) -> Points:
        """One scan in its own frame: x, y, z and remission 0..1."""
        return read_scan(drive.scans[place])


def merge_scans(scans: Sequence[Points], drive: Drive, places: Sequence[int]) -> Points:
    """The scans at these places of a drive as one, in the frame of the first, with times relative to it.

    Raises ConfigError for a drive without poses.
    """
    return Points.cat([_moved(scan, drive, past, places[0]) for scan, past in zip(scans, places, strict=True)])


def _moved(scan: Points, drive: Drive, past: int, now: int) -> Points:
    if drive.poses is None:
        raise ConfigError(f"{drive.name}: past scans need the poses of the sequence.\n  fix: sweeps=1, or give poses")
    time = torch.full((len(scan),), float(drive.times[past] - drive.times[now]))
    if past == now:
        return scan.replace(time=time)
    change = torch.tensor(inverse(drive.poses[now]) @ drive.poses[past])
    xyz = scan.xyz.double() @ change[:3, :3].T + change[:3, 3]
    return scan.replace(xyz=xyz.float(), time=time)


def read_scan(path: Path, repair: bool = False) -> Points:
    """A scan of float32 x, y, z, remission; DataError where remission is not 0..1. `repair` as in `read_points`."""
    scan = read_points(path, columns=4, repair=repair)
    low, high = float(scan.features.min()), float(scan.features.max())
    if low < 0 or high > 1:
        raise DataError(f"{path}: remission: expected 0..1, found {low:g}..{high:g}. Is it a scan of 4 columns?")
    return Points.from_scan(torch.tensor(scan.xyz), torch.tensor(scan.features))


def scaled_image(picture: npt.NDArray[np.uint8], camera: Camera, scale: float, path: Path) -> Image:
    """A picture (H, W, 3) of a file as a batch of one, resized; DataError where the camera has another size."""
    import cv2

    if picture.shape[:2] != (camera.height, camera.width):
        found = f"{picture.shape[1]} x {picture.shape[0]}"
        raise DataError(f"{path}: expected {camera.width} x {camera.height} pixels (the calibration), found {found}")
    small = camera.scaled(scale)
    resized = cv2.resize(picture, (small.width, small.height), interpolation=cv2.INTER_AREA)
    return Image(torch.tensor(resized.transpose(2, 0, 1)[None]).float() / 255, (small,))


def pose_of(drive: Drive, place: int) -> Poses | None:
    """The pose of a frame as a batch of one; None where the drive has none."""
    if drive.poses is None:
        return None
    matrix = torch.tensor(drive.poses[place], dtype=torch.float32)[None]
    return Poses(matrix, torch.ones(1, dtype=torch.bool), torch.ones(1))


def inverse(matrix: Array) -> Array:
    """Inverse of rigid transforms (..., 4, 4)."""
    turn = np.swapaxes(matrix[..., :3, :3], -1, -2)
    result = np.array(matrix, dtype=np.float64)
    result[..., :3, :3] = turn
    result[..., :3, 3:] = -turn @ matrix[..., :3, 3:]
    return result


def read_table(path: Path, columns: int) -> Array:
    """Numbers (N, columns) written as text, a row per line; DataError names the line that is wrong."""
    rows = [line.split() for line in kitti.read_text(path).rstrip().splitlines()]
    for number, row in enumerate(rows, 1):
        if len(row) != columns:
            raise DataError(
                f"{path}, line {number}: expected {columns} numbers, found {len(row)}: {' '.join(row)[:80]}"
            )
    try:
        table = np.array(rows, dtype=np.float64).reshape(-1, columns)
    except ValueError as error:
        raise DataError(f"{path}: expected {columns} numbers per line: {error}") from error
    bad = ~np.isfinite(table).all(1)
    if bad.any():
        raise DataError(f"{path}, line {bad.argmax() + 1}: expected finite numbers, found {rows[bad.argmax()]}")
    return table


def read_poses(path: Path) -> Array:
    """Poses (N, 4, 4) from lines of 12 numbers, rows of 3 x 4; DataError where one is no rigid transform."""
    return rigid(read_table(path, 12), path)


def rigid(rows: Array, path: Path) -> Array:
    """Rigid transforms (N, 4, 4) of rows (N, 12) read from a file; DataError names the line of one that is not."""
    matrices = np.tile(np.eye(4), (len(rows), 1, 1))
    matrices[:, :3] = rows.reshape(-1, 3, 4)
    turn = matrices[:, :3, :3]
    with np.errstate(invalid="ignore"):
        apart = np.abs(turn @ turn.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
        wrong = ~((apart < 1e-2) & (np.linalg.det(turn) > 0) & np.isfinite(rows).all(axis=1))  # NaN is wrong too
    if wrong.any():
        line = int(wrong.argmax())
        raise DataError(f"{path}, line {line + 1}: expected a rotation (orthonormal), found {rows[line].tolist()}")
    return matrices


def rows_of(table: Array, numbers: Sequence[int], path: Path) -> Array:
    """The rows of a file that belong to frames `numbers` (line = number + 1); DataError where it is too short."""
    if numbers and max(numbers) >= len(table):
        raise DataError(
            f"{path}: has {len(table)} lines, but there is a scan {max(numbers):06d}: "
            f"expected {max(numbers) + 1} lines or more"
        )
    return table[list(numbers)]


def read_ids(path: Path, count: int) -> npt.NDArray[np.uint32]:
    """A uint32 for each of `count` points; DataError where the file is missing or of another length."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}. Are the labels there?") from error
    if len(data) != 4 * count:
        raise DataError(f"{path}: expected {4 * count} bytes (uint32 for each of {count} points), found {len(data)}")
    return np.frombuffer(data, "<u4")


def read_boxes(path: Path, classes: Sequence[str], tracks: bool = False) -> tuple[Boxes, Tensor]:
    """Boxes of the classes and their track ids (M,), -1 where not given; boxes of other names are left out.

    A line is class x y z l w h yaw in lidarfw's conventions, and a whole number, the track id, which must be there
    with `tracks`; no two boxes have the same. DataError names the line that is wrong.
    """
    lines = [(i, line.split()) for i, line in enumerate(kitti.read_text(path).splitlines(), 1) if line.strip()]
    for number, words in lines:
        if len(words) != 9 and (tracks or len(words) != 8):
            expected = "9 columns (class x y z l w h yaw track)" if tracks else "8 columns (class x y z l w h yaw)"
            raise DataError(f"{path}, line {number}: expected {expected}, found {len(words)}: {' '.join(words)[:80]}")
    rows = [(number, words[0], _numbers(words[1:], f"{path}, line {number}")) for number, words in lines]
    rows = [row for row in rows if row[1] in classes]
    label = torch.tensor([classes.index(name) for _, name, _ in rows], dtype=torch.long)
    table = torch.tensor([values[:7] for *_, values in rows], dtype=torch.float32).view(-1, 7)
    ids = [int(values[7]) if len(values) > 7 else -1 for *_, values in rows]
    _check_once(ids, [number for number, *_ in rows], path)
    return Boxes.from_tensor(table, label), torch.tensor(ids, dtype=torch.long)


def _check_once(ids: Sequence[int], lines: Sequence[int], path: Path) -> None:
    """DataError where two lines of a file have the same track id."""
    first: dict[int, int] = {}
    for track, line in zip(ids, lines, strict=True):
        if track >= 0 and first.setdefault(track, line) != line:
            raise DataError(f"{path}, line {line}: expected each track id once, {track} is in line {first[track]} too")


def _numbers(words: list[str], where: str) -> list[float]:
    """A box and perhaps its track id, which a double holds exactly."""
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise DataError(f"{where}: expected numbers after the class: {error}") from None
    with np.errstate(over="ignore"):
        box = np.array(values[:7], np.float32)
    if not np.isfinite(box).all() or box[3:6].min() <= 0:
        raise DataError(f"{where}: expected finite numbers and positive l w h, found {' '.join(words)}")
    if not all(track.is_integer() and abs(track) < 2**53 for track in values[7:]):
        raise DataError(f"{where}: expected a whole number as the track id, found {words[7]}")
    return values


def scans_in(folder: Path, suffix: str = ".bin") -> list[Path]:
    """Files of a folder in order of their number; DataError where there is no such folder or a name is no number."""
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder.\n  fix: download or unpack the sequence, or correct root and split")
    files = sorted(folder.glob(f"*{suffix}"))
    for file in files:
        if not file.stem.isdigit():
            raise DataError(f"{file}: expected a number as the name, as in 000000{suffix}")
    return files


def interpolated(times: Array, poses: Array, wanted: Array) -> Array:
    """Poses (N, 4, 4) at the `wanted` times (N,), between poses (M, 4, 4) at rising `times` (M,).

    Positions are interpolated linearly, rotations along the shortest arc. Wanted times lie within `times`.
    """
    from scipy.spatial.transform import Rotation, Slerp  # slow to import

    matrices = np.tile(np.eye(4), (len(wanted), 1, 1))
    if len(wanted):
        matrices[:, :3, :3] = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(wanted).as_matrix()
        matrices[:, :3, 3] = np.stack([np.interp(wanted, times, poses[:, axis, 3]) for axis in range(3)], 1)
    return matrices


def from_angles(rows: Array) -> Array:
    """Transforms (N, 4, 4) of rows (N, 6) x, y, z, roll, pitch, yaw in radians: Rz(yaw) Ry(pitch) Rx(roll)."""
    from scipy.spatial.transform import Rotation  # slow to import

    matrices = np.tile(np.eye(4), (len(rows), 1, 1))
    if len(rows):
        matrices[:, :3, :3] = Rotation.from_euler("ZYX", rows[:, [5, 4, 3]]).as_matrix()
    matrices[:, :3, 3] = rows[:, :3]
    return matrices
