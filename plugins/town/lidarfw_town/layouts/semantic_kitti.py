"""SemanticKITTI: Behley et al., "SemanticKITTI", ICCV 2019."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from lidarfw.components.datasets.semantic_kitti import SemanticKittiDataset
from lidarfw.files import write_text

from lidarfw_town.camera import LIDAR_TO_CAMERA, kitti_projection
from lidarfw_town.drive import Drive, TownFrame
from lidarfw_town.layouts.base import Layout, Place, numbers, square, write_array, write_picture
from lidarfw_town.layouts.kitti import camera_of
from lidarfw_town.mesh import Array
from lidarfw_town.render import photograph


class SemanticKittiLayout(Layout):
    """SemanticKITTI: ROOT/dataset/sequences/SEQ with velodyne, labels, image_2, poses.txt, calib.txt, times.txt.

    Scans are compensated for ego motion, as those of KITTI odometry are.
    """

    drives: ClassVar = {split: SemanticKittiDataset.splits[split] for split in ("train", "val")}

    def write(self, frame: TownFrame, drive: Drive, place: Place) -> dict[str, Any]:
        folder, name = self._folder(place.drive), f"{place.index:06d}"
        write_array(folder / "velodyne" / f"{name}.bin", frame.points)
        write_array(folder / "labels" / f"{name}.label", frame.label, "<u4")
        if self.width:
            write_picture(folder / "image_2" / f"{name}.png", photograph(drive, frame, camera_of(self.width)).image)
        return {"pose": frame.pose.tolist(), "time": frame.time}

    def _folder(self, drive: int) -> Path:
        return self.root / "dataset" / "sequences" / self.name(drive)

    def finish(self, parts: Sequence[Sequence[dict[str, Any]]]) -> None:
        for number, drive in enumerate(parts):
            folder = self._folder(number)
            poses = np.array([part["pose"] for part in drive])
            write_text(folder / "poses.txt", "".join(numbers(pose[:3]) + "\n" for pose in camera_poses(poses)))
            times = [part["time"] - drive[0]["time"] for part in drive]
            write_text(folder / "times.txt", "".join(f"{time:.6e}\n" for time in times))
            projection = numbers(kitti_projection(camera_of(self.width)))
            rows = [f"P{n}: {projection}" for n in range(4)]
            write_text(folder / "calib.txt", "\n".join([*rows, f"Tr: {numbers(LIDAR_TO_CAMERA)}", ""]))


def camera_poses(poses: Array) -> Array:
    """Poses (F, 4, 4) of camera 0, in its own first frame, of those of the LiDAR in the world."""
    extrinsic = square(LIDAR_TO_CAMERA)
    relative = np.linalg.inv(poses[0]) @ poses
    return np.asarray(extrinsic @ relative @ np.linalg.inv(extrinsic))
