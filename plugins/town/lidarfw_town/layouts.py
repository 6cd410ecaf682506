"""The official layouts of public datasets, written from drives through the town.

Sources: Geiger et al., "Are we ready for autonomous driving? The KITTI vision benchmark suite", CVPR 2012, with the
readmes of the object and tracking development kits; Behley et al., "SemanticKITTI", ICCV 2019.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lidarfw import kitti
from lidarfw.files import atomic_path, write_text
from lidarfw.types import Camera

from lidarfw_town.bodies import KINDS
from lidarfw_town.camera import LIDAR_TO_CAMERA, Pinhole, light_of, render
from lidarfw_town.drive import Drive, Object, TownFrame
from lidarfw_town.mesh import Array

_FEWEST = 3  # points below which an object of the camera's view is DontCare
_ORIGIN = (49.0, 8.4)  # latitude and longitude of the town's origin, degrees
_EARTH = 6378137.0  # metres


@dataclass(frozen=True)
class Place:
    """Where a frame belongs: number of the drive and of the frame within it, and its number in the whole set."""

    drive: int
    index: int
    number: int


class Layout:
    """How frames become files. `write` may run in any order and process; `finish` once, when all frames stand.

    `stride` is the number of 0.1 s steps from one frame to the next, `length` the most frames of one drive,
    `compensated` whether ego motion is taken out of the scans.
    """

    stride = 1
    length = 1000
    compensated = False

    def __init__(self, root: Path, camera: Pinhole | None, names: str = "train") -> None:
        self.root, self.camera, self.names = root, camera, names

    def write(self, frame: TownFrame, drive: Drive, place: Place) -> dict[str, Any]:
        """Write the files of a frame; what `finish` will need of it, as plain values."""
        raise NotImplementedError

    def finish(self, parts: Sequence[Sequence[dict[str, Any]]]) -> None:
        """Write the files of whole drives, from what `write` gave for their frames, drive by drive."""

    def _picture(self, path: Path, frame: TownFrame, drive: Drive) -> None:
        if self.camera is None:
            return
        from PIL import Image

        rng = np.random.default_rng((drive.seed, 7, drive.traversal, frame.number))
        light = light_of(drive.seed, drive.traversal)
        picture = render(self.camera, [drive.still, frame.movers], frame.pose, light, rng)
        with atomic_path(path) as temporary:
            Image.fromarray(picture).save(temporary, compress_level=3)


class KittiLayout(Layout):
    """KITTI object detection: ROOT/training with velodyne, calib, label_2, image_2, and ROOT/ImageSets.

    Frames are a second apart and every 50 of them come from another town. Scans are not compensated, as KITTI's.
    """

    stride = 10
    length = 50

    def write(self, frame: TownFrame, drive: Drive, place: Place) -> dict[str, Any]:
        name, folder = self._name(place), self.root / "training"
        camera = self.camera or _plain_camera()
        write_bin(folder / "velodyne" / f"{name}.bin", frame.points)
        write_text(folder / "calib" / f"{name}.txt", calibration_text(camera, tracking=False))
        labels = labels_of(frame.objects, camera)
        kitti.write_results(folder / "label_2" / f"{name}.txt", labels)
        self._picture(folder / "image_2" / f"{name}.png", frame, drive)
        return {"name": name}

    def _name(self, place: Place) -> str:
        # splits in one folder: validation frames count from 500000
        return f"{place.number + (0 if self.names == 'train' else 500000):06d}"

    def finish(self, parts: Sequence[Sequence[dict[str, Any]]]) -> None:
        names = [part["name"] for drive in parts for part in drive]
        write_text(self.root / "ImageSets" / f"{self.names}.txt", "".join(f"{name}\n" for name in names))


class KittiTrackingLayout(Layout):
    """KITTI tracking: ROOT/training with velodyne/SEQ, image_02/SEQ, label_02/SEQ.txt, calib/SEQ.txt, oxts/SEQ.txt."""

    def write(self, frame: TownFrame, drive: Drive, place: Place) -> dict[str, Any]:
        folder, sequence, name = self.root / "training", f"{place.drive:04d}", f"{place.index:06d}"
        camera = self.camera or _plain_camera()
        write_bin(folder / "velodyne" / sequence / f"{name}.bin", frame.points)
        self._picture(folder / "image_02" / sequence / f"{name}.png", frame, drive)
        write_text(folder / "calib" / f"{sequence}.txt", calibration_text(camera, tracking=True))
        numbered = zip(_numbers(frame.objects, camera), labels_of(frame.objects, camera))
        lines = [f"{place.index} {number} {_tracking_line(label)}" for number, label in numbered]
        speed = float(drive.traffic.ego[frame.number, 3])
        return {"labels": lines, "oxts": oxts_line(frame.pose, speed)}

    def finish(self, parts: Sequence[Sequence[dict[str, Any]]]) -> None:
        for number, drive in enumerate(parts):
            lines = [line for part in drive for line in part["labels"]]
            write_text(self.root / "training" / "label_02" / f"{number:04d}.txt", "".join(f"{e}\n" for e in lines))
            poses = "".join(part["oxts"] + "\n" for part in drive)
            write_text(self.root / "training" / "oxts" / f"{number:04d}.txt", poses)


class SemanticKittiLayout(Layout):
    """SemanticKITTI: ROOT/dataset/sequences/SEQ with velodyne, labels, image_2, poses.txt, calib.txt, times.txt.

    Scans are compensated for ego motion, as those of KITTI odometry are.
    """

    compensated = True

    def write(self, frame: TownFrame, drive: Drive, place: Place) -> dict[str, Any]:
        folder, name = self._folder(place.drive), f"{place.index:06d}"
        write_bin(folder / "velodyne" / f"{name}.bin", frame.points)
        with atomic_path(folder / "labels" / f"{name}.label") as temporary:
            frame.label.astype("<u4").tofile(temporary)
        self._picture(folder / "image_2" / f"{name}.png", frame, drive)
        return {"pose": frame.pose.tolist(), "time": frame.time}

    def _folder(self, drive: int) -> Path:
        return self.root / "dataset" / "sequences" / f"{drive:02d}"

    def finish(self, parts: Sequence[Sequence[dict[str, Any]]]) -> None:
        for number, drive in enumerate(parts):
            folder = self._folder(number)
            poses = np.array([part["pose"] for part in drive])
            write_text(folder / "poses.txt", "".join(_row(pose[:3]) + "\n" for pose in camera_poses(poses)))
            times = [part["time"] - drive[0]["time"] for part in drive]
            write_text(folder / "times.txt", "".join(f"{time:.6e}\n" for time in times))
            camera = self.camera or _plain_camera()
            rows = [f"P{n}: {_row(camera.projection)}" for n in range(4)]
            write_text(folder / "calib.txt", "\n".join([*rows, f"Tr: {_row(LIDAR_TO_CAMERA)}", ""]))


LAYOUTS: dict[str, type[Layout]] = {
    "kitti": KittiLayout,
    "semantic_kitti": SemanticKittiLayout,
    "kitti_tracking": KittiTrackingLayout,
}


def write_bin(path: Path, points: Array | np.ndarray) -> None:
    """Points (N, 4) as KITTI's little-endian float32."""
    with atomic_path(path) as temporary:
        np.asarray(points, "<f4").tofile(temporary)


def _plain_camera() -> Pinhole:
    from lidarfw_town.camera import kitti_camera

    return kitti_camera()


def _row(matrix: Array) -> str:
    return " ".join(f"{value:.12e}" for value in np.asarray(matrix).ravel())


def calibration_text(camera: Pinhole, *, tracking: bool) -> str:
    """A calibration file of the object or the tracking benchmark; all four cameras are camera 2."""
    rows = [f"P{n}: {_row(camera.projection)}" for n in range(4)]
    inertial = np.eye(4)[:3]  # the inertial unit stands where the LiDAR does
    names = ("R_rect", "Tr_velo_cam", "Tr_imu_velo") if tracking else ("R0_rect:", "Tr_velo_to_cam:", "Tr_imu_to_velo:")
    rows += [f"{name} {_row(matrix)}" for name, matrix in zip(names, (np.eye(3), LIDAR_TO_CAMERA, inertial))]
    return "\n".join([*rows, ""])


def camera_poses(poses: Array) -> Array:
    """Poses (F, 4, 4) of camera 0, in its own first frame, of those of the LiDAR in the world."""
    extrinsic = np.concatenate([LIDAR_TO_CAMERA, [[0, 0, 0, 1]]])
    relative = np.linalg.inv(poses[0]) @ poses
    return np.asarray(extrinsic @ relative @ np.linalg.inv(extrinsic))


def oxts_line(pose: Array, speed: float) -> str:
    """The 30 values of KITTI's inertial unit: place, attitude and speed are filled, accuracies as usual, the rest 0.

    Places are those of KITTI's Mercator projection about the town's origin.
    """
    latitude, longitude = _ORIGIN
    scale = math.cos(math.radians(latitude))
    x = scale * _EARTH * math.radians(longitude) + pose[0, 3]
    y = scale * _EARTH * math.log(math.tan(math.radians(90 + latitude) / 2)) + pose[1, 3]
    longitude = math.degrees(x / (scale * _EARTH))
    latitude = 2 * math.degrees(math.atan(math.exp(y / (scale * _EARTH)))) - 90
    roll, pitch = math.atan2(pose[2, 1], pose[2, 2]), -math.asin(pose[2, 0])
    yaw = math.atan2(pose[1, 0], pose[0, 0])
    north, east = speed * math.sin(yaw), speed * math.cos(yaw)
    head = [latitude, longitude, pose[2, 3], roll, pitch, yaw, north, east, speed]
    return " ".join([*(f"{value:.14g}" for value in head), *["0"] * 14, "0.05", "0.01", "4", "11", "6", "6", "6"])


def _cameras(camera: Pinhole, pad: int = 0) -> dict[str, Camera]:
    """The cameras of lidarfw's KITTI code, the picture `pad` times as large on every side."""
    fx, fy, cx, cy = camera.lens
    lens = (fx, fy, cx + pad * camera.width, cy + pad * camera.height)
    size = (camera.width * (2 * pad + 1), camera.height * (2 * pad + 1))
    rectified = np.concatenate([LIDAR_TO_CAMERA, [[0, 0, 0, 1]]])
    shift = np.eye(4)
    shift[:3, 3] = np.linalg.solve(camera.projection[:, :3], camera.projection[:, 3])
    matrices = {kitti.IMAGE: shift @ rectified, kitti.RECTIFIED: rectified}
    return {n: Camera("pinhole", *size, lens, (), tuple(map(tuple, m.tolist()))) for n, m in matrices.items()}


def _level(objects: Sequence[Object]) -> Array:
    """Boxes (M, 7) in the levelled camera frame: here the LiDAR's axes about the place of camera 0."""
    table = np.array([thing.box for thing in objects], np.float64).reshape(-1, 7)
    table[:, :3] -= -np.array([LIDAR_TO_CAMERA[2, 3], -LIDAR_TO_CAMERA[0, 3], -LIDAR_TO_CAMERA[1, 3]])
    return table


def _in_view(objects: Sequence[Object], camera: Pinhole) -> list[tuple[Object, Array, float]]:
    """Objects in the picture, each with its 2D box (4,) and the share of it outside the picture."""
    level = _level(objects)
    boxes = kitti.project_level_boxes(level, _cameras(camera))
    whole = kitti.project_level_boxes(level, _cameras(camera, pad=4))
    area, full = ((b[:, 2] - b[:, 0]) * (b[:, 3] - b[:, 1]) for b in (boxes, whole))
    cut = np.clip(1 - area / np.maximum(full, 1e-6), 0, 1)
    seen = zip(objects, boxes, cut.tolist(), area.tolist())
    return [(thing, box, share) for thing, box, share, size in seen if size > 0 and thing.points > 0 and share < 0.97]


def _numbers(objects: Sequence[Object], camera: Pinhole) -> list[int]:
    """Track ids in the order of `labels_of`; DontCare has -1."""
    return [-1 if thing.points < _FEWEST else thing.id for thing, _, _ in _in_view(objects, camera)]


def labels_of(objects: Sequence[Object], camera: Pinhole) -> list[kitti.Label]:
    """KITTI labels of the objects in the picture; those with hardly a point are DontCare."""
    return [_label(*seen) for seen in _in_view(objects, camera)]


def _label(thing: Object, box2d: Array, truncation: float) -> kitti.Label:
    left, top, right, bottom = box2d.tolist()
    rectangle = (left, top, right, bottom)
    if thing.points < _FEWEST:
        return kitti.Label("DontCare", -1, -1, -10, rectangle, (-1, -1, -1), (-1000, -1000, -1000), -10)
    _, _, _, length, width, height, yaw = thing.box
    x, y, z, _ = (np.concatenate([LIDAR_TO_CAMERA, [[0, 0, 0, 1]]]) @ (*thing.box[:3], 1.0)).tolist()
    occlusion = 0 if thing.visible > 0.75 else 1 if thing.visible > 0.4 else 2
    turned = float(kitti.wrap_angle(np.array(-yaw - math.pi / 2)))
    alpha = float(kitti.observation_angles(_level([thing]))[0])
    name, size = KINDS[thing.kind].name, (height, width, length)
    return kitti.Label(name, round(truncation, 2), occlusion, alpha, rectangle, size, (x, y + height / 2, z), turned)


def _tracking_line(label: kitti.Label) -> str:
    """The tracking benchmark gives truncation as a level 0, 1, 2."""
    words = label.line().split()
    if label.type != "DontCare":
        words[1] = str(0 if label.truncation < 0.05 else 1 if label.truncation < 0.5 else 2)
    return " ".join(words)
