"""KITTI's object and tracking benchmarks.

Source: Geiger et al., "Are we ready for autonomous driving? The KITTI vision benchmark suite", CVPR 2012, with the
readmes of the object and tracking development kits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from lidarfw import kitti
from lidarfw.components.datasets.kitti_tracking import KittiTrackingDataset
from lidarfw.files import write_text
from lidarfw.types import Camera

from lidarfw_town.bodies import KINDS
from lidarfw_town.camera import LIDAR_TO_CAMERA, kitti_camera, kitti_projection
from lidarfw_town.drive import Drive, Object, TownFrame
from lidarfw_town.layouts.base import FEWEST, Layout, Place, numbers, square, write_array, write_picture
from lidarfw_town.mesh import Array
from lidarfw_town.render import photograph

_ORIGIN = (49.0, 8.4)  # latitude and longitude of the town's origin, degrees
_EARTH = 6378137.0  # metres


class KittiLayout(Layout):
    """KITTI object detection: ROOT/training with velodyne, calib, label_2, image_2, and ROOT/ImageSets.

    Frames are a second apart and every 50 of them come from another town. Scans are not compensated, as KITTI's.
    """

    stride = 10
    length = 50
    compensated = False

    def write(self, frame: TownFrame, drive: Drive, place: Place) -> dict[str, Any]:
        name, folder = self._name(place), self.root / "training"
        camera = camera_of(self.width)
        write_array(folder / "velodyne" / f"{name}.bin", frame.points)
        write_text(folder / "calib" / f"{name}.txt", calibration_text(camera, tracking=False))
        labels = labels_of(frame.objects, camera)
        kitti.write_results(folder / "label_2" / f"{name}.txt", labels)
        if self.width:
            write_picture(folder / "image_2" / f"{name}.png", photograph(drive, frame, camera).image)
        return {"name": name}

    def _name(self, place: Place) -> str:
        # splits in one folder: validation frames count from 500000
        return f"{place.number + (0 if self.split == 'train' else 500000):06d}"

    def finish(self, parts: Sequence[Sequence[dict[str, Any]]]) -> None:
        names = [part["name"] for drive in parts for part in drive]
        write_text(self.root / "ImageSets" / f"{self.split}.txt", "".join(f"{name}\n" for name in names))


class KittiTrackingLayout(Layout):
    """KITTI tracking: ROOT/training with velodyne/SEQ, image_02/SEQ, label_02/SEQ.txt, calib/SEQ.txt, oxts/SEQ.txt.

    Scans are not compensated, as KITTI's.
    """

    drives: ClassVar = {split: KittiTrackingDataset.splits[split] for split in ("train", "val")}
    compensated = False

    def write(self, frame: TownFrame, drive: Drive, place: Place) -> dict[str, Any]:
        folder, sequence, name = self.root / "training", self.name(place.drive), f"{place.index:06d}"
        camera = camera_of(self.width)
        write_array(folder / "velodyne" / sequence / f"{name}.bin", frame.points)
        if self.width:
            write_picture(folder / "image_02" / sequence / f"{name}.png", photograph(drive, frame, camera).image)
        write_text(folder / "calib" / f"{sequence}.txt", calibration_text(camera, tracking=True))
        numbered = zip(_numbers(frame.objects, camera), labels_of(frame.objects, camera))
        lines = [f"{place.index} {number} {_tracking_line(label)}" for number, label in numbered]
        speed = float(drive.traffic.ego[frame.number, 3])
        return {"labels": lines, "oxts": oxts_line(frame.pose, speed)}

    def finish(self, parts: Sequence[Sequence[dict[str, Any]]]) -> None:
        for number, drive in enumerate(parts):
            file, folder = f"{self.name(number)}.txt", self.root / "training"
            lines = [line for part in drive for line in part["labels"]]
            write_text(folder / "label_02" / file, "".join(f"{line}\n" for line in lines))
            write_text(folder / "oxts" / file, "".join(part["oxts"] + "\n" for part in drive))


def camera_of(width: int) -> Camera:
    """The colour camera whose pictures are so wide; 0: as wide as KITTI's."""
    return kitti_camera(width) if width else kitti_camera()


def calibration_text(camera: Camera, *, tracking: bool) -> str:
    """A calibration file of the object or the tracking benchmark; all four cameras are camera 2."""
    rows = [f"P{n}: {numbers(kitti_projection(camera))}" for n in range(4)]
    inertial = np.eye(4)[:3]  # the inertial unit stands where the LiDAR does
    names = ("R_rect", "Tr_velo_cam", "Tr_imu_velo") if tracking else ("R0_rect:", "Tr_velo_to_cam:", "Tr_imu_to_velo:")
    rows += [f"{name} {numbers(matrix)}" for name, matrix in zip(names, (np.eye(3), LIDAR_TO_CAMERA, inertial))]
    return "\n".join([*rows, ""])


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


def _cameras(camera: Camera, pad: int = 0) -> dict[str, Camera]:
    """The cameras of lidarfw's KITTI code, the picture `pad` times as large on every side."""
    width, height = camera.width, camera.height
    image = camera.cropped(-pad * width, -pad * height, width * (2 * pad + 1), height * (2 * pad + 1))
    rectified = tuple(map(tuple, square(LIDAR_TO_CAMERA).tolist()))
    return {kitti.IMAGE: image, kitti.RECTIFIED: replace(image, from_sensor=rectified)}


def _level(objects: Sequence[Object]) -> Array:
    """Boxes (M, 7) in the levelled camera frame: here the LiDAR's axes about the place of camera 0."""
    table = np.array([thing.box for thing in objects], np.float64).reshape(-1, 7)
    table[:, :3] -= -np.array([LIDAR_TO_CAMERA[2, 3], -LIDAR_TO_CAMERA[0, 3], -LIDAR_TO_CAMERA[1, 3]])
    return table


def _in_view(objects: Sequence[Object], camera: Camera) -> list[tuple[Object, Array, float]]:
    """Objects in the picture, each with its 2D box (4,) and the share of it outside the picture."""
    level = _level(objects)
    boxes = kitti.project_level_boxes(level, _cameras(camera))
    whole = kitti.project_level_boxes(level, _cameras(camera, pad=4))
    area, full = ((b[:, 2] - b[:, 0]) * (b[:, 3] - b[:, 1]) for b in (boxes, whole))
    cut = np.clip(1 - area / np.maximum(full, 1e-6), 0, 1)
    seen = zip(objects, boxes, cut.tolist(), area.tolist())
    return [(thing, box, share) for thing, box, share, size in seen if size > 0 and thing.points > 0 and share < 0.97]


def _numbers(objects: Sequence[Object], camera: Camera) -> list[int]:
    """Track ids in the order of `labels_of`; DontCare has -1."""
    return [-1 if thing.points < FEWEST else thing.id for thing, _, _ in _in_view(objects, camera)]


def labels_of(objects: Sequence[Object], camera: Camera) -> list[kitti.Label]:
    """KITTI labels of the objects in the picture; those with hardly a point are DontCare."""
    return [_label(*seen) for seen in _in_view(objects, camera)]


def _label(thing: Object, box2d: Array, truncation: float) -> kitti.Label:
    left, top, right, bottom = box2d.tolist()
    rectangle = (left, top, right, bottom)
    if thing.points < FEWEST:
        return kitti.Label("DontCare", -1, -1, -10, rectangle, (-1, -1, -1), (-1000, -1000, -1000), -10)
    _, _, _, length, width, height, yaw = thing.box
    x, y, z, _ = (square(LIDAR_TO_CAMERA) @ (*thing.box[:3], 1.0)).tolist()
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
