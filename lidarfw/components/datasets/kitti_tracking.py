"""The KITTI tracking benchmark in its official layout: boxes with identities over whole drives.

Source: Geiger et al., "Are we ready for autonomous driving? The KITTI vision benchmark suite", CVPR 2012. The usual
division of its training sequences: Weng et al., "3D multi-object tracking", IROS 2020 (AB3DMOT).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lidarfw import kitti
from lidarfw._lazy import LazyModule
from lidarfw.components.datasets.drives import (
    Array,
    Drive,
    DriveDataset,
    inverse,
    pose_of,
    read_table,
    rigid,
    scans_in,
)
from lidarfw.components.datasets.kitti import CAMERA, PICTURE, padded_picture, picture_size
from lidarfw.errors import ConfigError, DataError
from lidarfw.types import Boxes, Camera, DataSpec, Frame, FrameMeta, Image, Points, Poses, Spec, Targets, Tracks

if TYPE_CHECKING:
    import torch
else:
    torch = LazyModule("torch")

_PERIOD = 0.1  # seconds between scans
_VAL = (1, 6, 8, 10, 12, 13, 14, 15, 16, 18, 19)


def _names(*numbers: int) -> tuple[str, ...]:
    return tuple(f"{number:04d}" for number in numbers)


@dataclass(frozen=True, eq=False)
class _Recording:
    """What one file holds for a whole sequence."""

    calibration: kitti.Calibration
    labels: dict[int, list[kitti.TrackLabel]]  # by frame


class KittiTrackingDataset(DriveDataset):
    """KITTI tracking: ROOT/training and ROOT/testing with velodyne/0000, calib, label_02, image_02/0000, oxts.

    Frames are the scans that are there; some are missing in the download. Points have one feature, remission 0..1.
    Targets are boxes, tracks (the same boxes with their ids) and, with `poses`, the LiDAR's poses. Neutral objects
    are those of the dataset `kitti`.
    """

    splits: ClassVar = {
        "train": _names(*(n for n in range(21) if n not in _VAL)),
        "val": _names(*_VAL),
        "trainval": _names(*range(21)),
        "test": _names(*range(29)),
    }
    camera: Camera = CAMERA  # of the padded pictures, for the spec

    def __init__(
        self,
        *,
        root: str = "",
        split: str = "train",
        classes: tuple[str, ...] = ("Car", "Pedestrian", "Cyclist"),
        camera_view: bool = True,
        poses: str = "oxts",
        sweeps: int = 1,
        pose: bool = False,
        image: bool = False,
    ) -> None:
        """Options.

        root: folder that holds training/. split: train, val, trainval, test, all, or sequences such as 0000, joined
        by +. classes: types to learn. camera_view: keep only points in the picture, since only what it shows is
        labelled. poses: folder of the poses in training/, `oxts` or one with lines of camera poses; none where empty.
        sweeps: scans per frame, the past ones moved into the current frame. pose: also give the LiDAR's pose, as the
        input `pose`. image: also give the left colour picture, as the input `image`.
        """
        if sweeps < 1:
            raise ConfigError(f"dataset.kitti_tracking.sweeps must be at least 1, got {sweeps}")
        if not poses and (pose or sweeps > 1):
            raise ConfigError("dataset.kitti_tracking: pose=true and sweeps > 1 need poses.\n  fix: poses=oxts")
        self.root, self.split, self.classes, self.camera_view = root, split, tuple(classes), camera_view
        self.poses, self.sweeps, self.pose, self.image = poses, sweeps, pose, image
        inputs = {"points": Spec(Points, channels=1)} | ({"pose": Spec(Poses)} if pose else {})
        inputs |= {"image": Spec(Image, channels=3, geometry=self.camera)} if image else {}
        labels = frozenset() if split == "test" else frozenset({Boxes, Tracks})
        self.spec = DataSpec(inputs, labels | frozenset({Poses} if poses else ()), self.classes, sweeps)
        self._recordings: dict[str, _Recording] = {}

    @property
    def folder(self) -> Path:
        """ROOT/training, or ROOT/testing for the split `test`."""
        if not self.root:
            raise DataError(
                "dataset.kitti_tracking.root is not set.\n"
                "  fix: dataset.kitti_tracking.root=/path/to/kitti_tracking (it holds training/)"
            )
        folder = Path(self.root) / ("testing" if self.split == "test" else "training")
        if not folder.is_dir():
            raise DataError(
                f"{folder}: no such folder.\n  fix: dataset.kitti_tracking.root must hold training/velodyne"
            )
        return folder

    def present(self) -> list[str]:
        return sorted(path.name for path in (self.folder / "velodyne").glob("*") if path.is_dir())

    def open(self, sequence: str) -> Drive:
        """Scans, times (ten a second, by the frame number) and LiDAR poses of a sequence."""
        scans = scans_in(self.folder / "velodyne" / sequence)
        numbers = [int(scan.stem) for scan in scans]
        poses = self._lidar_poses(sequence, numbers) if self.poses else None
        return Drive(sequence, scans, _PERIOD * np.array(numbers), poses)

    def prepare(self, workers: int = 0) -> None:
        """List the split and read its labels and calibrations."""
        for drive in self.drives:
            self._recording(drive.name)

    def meta(self, index: int) -> FrameMeta:
        """Id, time and files of a frame, without its cameras."""
        meta = super().meta(index)
        found = (self.folder / "image_02" / f"{meta.id}{suffix}" for suffix in (".png", ".jpg"))
        picture = next((path for path in found if path.is_file()), None)
        meta.images = {} if picture is None else {kitti.IMAGE: str(picture)}
        return meta

    def __getitem__(self, index: int) -> Frame:
        drive, place = self.find(index)
        recording, meta = self._recording(drive.name), self.meta(index)
        size = picture_size(meta.images[kitti.IMAGE]) if meta.images else PICTURE
        meta.cameras = recording.calibration.cameras(*size)
        points, pose = self.points(drive, place), pose_of(drive, place)
        if self.camera_view:
            points = points[meta.cameras[kitti.IMAGE].project(points.xyz)[2]]
        inputs: dict[str, Points | Poses | Image | None] = {"points": points} | ({"pose": pose} if self.pose else {})
        if self.image:
            inputs["image"] = self._image(meta)
        targets = Targets() if self.split == "test" else self._objects(recording, int(drive.scans[place].stem))
        return Frame(inputs, targets.replace(poses=pose), meta)

    def _image(self, meta: FrameMeta) -> Image:
        if not meta.images:
            raise DataError(
                f"{self.folder / 'image_02' / meta.id}.png: no such picture.\n  fix: download it, or image=false"
            )
        return padded_picture(
            meta.images[kitti.IMAGE], meta.cameras[kitti.IMAGE], (self.camera.width, self.camera.height)
        )

    def _objects(self, recording: _Recording, frame: int) -> Targets:
        lines = recording.labels.get(frame, [])
        boxes, ignored = kitti.boxes_from_labels([o.label for o in lines], recording.calibration, self.classes)
        track = torch.tensor([o.id for o in lines], dtype=torch.long)
        return Targets(boxes=boxes, ignored=ignored, tracks=Tracks(boxes, track[boxes.row]))

    def _recording(self, sequence: str) -> _Recording:
        if sequence not in self._recordings:
            calibration = kitti.read_calibration(self.folder / "calib" / f"{sequence}.txt")
            lines = [] if self.split == "test" else self._lines(sequence)
            self._recordings[sequence] = _Recording(calibration, _by_frame(lines))
        return self._recordings[sequence]

    def _lines(self, sequence: str) -> list[kitti.TrackLabel]:
        path = self.folder / "label_02" / f"{sequence}.txt"
        types = [*kitti.TRACKING_TYPES, *(c for c in self.classes if c not in kitti.TRACKING_TYPES)]
        lines = [kitti.as_object(line) for line in kitti.read_tracks(path, types)]
        seen = set()
        for line in lines:
            if line.id >= 0 and (line.frame, line.id) in seen:
                raise DataError(f"{path}: track {line.id} is twice in frame {line.frame}")
            seen.add((line.frame, line.id))
        return lines

    def _lidar_poses(self, sequence: str, numbers: Sequence[int]) -> Array:
        """(N, 4, 4) LiDAR -> map of the frames."""
        calibration, path = self._recording(sequence).calibration, self.folder / self.poses / sequence
        table = _pose_table(path)
        missing = [number for number in numbers if number not in table]
        if missing:
            raise DataError(f"{path}: has no pose of frame {missing[0]:06d}, which has a scan")
        first = next(iter(table.values()))
        rows = np.stack([table[number] for number in numbers]) if numbers else np.zeros((0, len(first)))
        if len(first) == 12:
            extrinsics = calibration.to_rectified
            return inverse(extrinsics) @ rigid(rows, path) @ extrinsics
        if calibration.imu_to_velo is None:
            raise DataError(f"{self.folder / 'calib' / sequence}.txt: no key Tr_imu_velo, which OXTS poses need")
        origin = kitti.poses_from_oxts(np.stack([first, *rows]))[1:]
        return origin @ inverse(_square(calibration.imu_to_velo))


def _by_frame(lines: Sequence[kitti.TrackLabel]) -> dict[int, list[kitti.TrackLabel]]:
    frames: dict[int, list[kitti.TrackLabel]] = {}
    for line in lines:
        frames.setdefault(line.frame, []).append(line)
    return frames


def _square(matrix: Array) -> Array:
    return np.concatenate([matrix, [[0.0, 0.0, 0.0, 1.0]]])


def _pose_table(path: Path) -> dict[int, Array]:
    """Rows of 12 (camera pose) or 30 numbers (OXTS) by frame: lines of PATH.txt, or one file per frame in PATH/."""
    whole = path.with_suffix(".txt")
    if whole.is_file():
        return dict(enumerate(_rows(whole)))
    if not path.is_dir():
        raise DataError(f"{whole}: no such file.\n  fix: download it, or dataset.kitti_tracking.poses= (none)")
    return {int(file.stem): _rows(file)[0] for file in scans_in(path, ".txt")}


def _rows(path: Path) -> Array:
    columns = len(kitti.read_text(path).partition("\n")[0].split())
    if columns not in (12, 30):
        raise DataError(f"{path}, line 1: expected 12 numbers (a camera pose) or 30 (OXTS), found {columns}")
    return read_table(path, columns)
