"""KITTI-360: Liao et al., "KITTI-360: a novel dataset and benchmarks for urban scene understanding", PAMI 2022."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from typing import Any, ClassVar

import numpy as np
from lidarfw.components.datasets.drives import inverse
from lidarfw.components.datasets.kitti_360 import Kitti360Dataset
from lidarfw.files import write_text
from lidarfw.types import Camera

from lidarfw_town.camera import fisheye_cameras, perspective_cameras, rays_of
from lidarfw_town.drive import Drive, TownFrame
from lidarfw_town.layouts.base import Layout, Place, numbers, write_array, write_picture
from lidarfw_town.mesh import Array
from lidarfw_town.render import Rendering, photograph

_FULL = 1400  # pixels of a fisheye picture of the real rig; its perspective pictures are 1408 wide
_BEGIN = datetime(2013, 5, 28, 8, 46)
# the LiDAR in the vehicle, whose frame is x ahead, y right, z down
LIDAR_TO_VEHICLE = np.array([[1.0, 0, 0, 0.775], [0, -1, 0, 0.3], [0, 0, -1, -0.83], [0, 0, 0, 1]])
_OWN, _SKY = 1, 23
_LABELS = {  # SemanticKITTI's classes -> KITTI-360's, which are those of Cityscapes
    10: 26, 11: 33, 13: 28, 15: 32, 18: 27, 30: 24, 31: 25, 32: 25, 40: 7, 44: 9, 48: 8, 49: 6, 50: 11, 51: 13, 52: 12,
    60: 7, 70: 21, 71: 21, 72: 22, 80: 17, 81: 20,
}  # fmt: skip
_YAML = """%YAML:1.0
---
model_type: MEI
camera_name: {name}
image_width: {camera.width}
image_height: {camera.height}
mirror_parameters:
   xi: {distortion[0]:.16e}
distortion_parameters:
   k1: {distortion[1]:.16e}
   k2: {distortion[2]:.16e}
   p1: {distortion[3]:.16e}
   p2: {distortion[4]:.16e}
projection_parameters:
   gamma1: {lens[0]:.16e}
   gamma2: {lens[1]:.16e}
   u0: {lens[2]:.16e}
   v0: {lens[3]:.16e}
"""


class Kitti360Layout(Layout):
    """KITTI-360: ROOT/calibration, data_3d_raw, data_poses, data_2d_raw with two fisheyes and the perspective pair.

    Beside them the truth of the pictures: data_2d_semantics/train/DRIVE/CAMERA/semantic with the classes of KITTI-360,
    and data_2d_depth/DRIVE/CAMERA with 256 units a metre, 0 where nothing is: z of a perspective picture, the distance
    from a fisheye. Every drive goes round the same circuit of one town, every second one the other way. Scans are
    compensated for ego motion. `width` is that of the fisheyes; the others are as large in proportion.
    """

    drives: ClassVar = {"train": Kitti360Dataset.splits["train"], "test": Kitti360Dataset.splits["test"]}
    one_town = True

    def write(self, frame: TownFrame, drive: Drive, place: Place) -> dict[str, Any]:
        folder = self.root / "data_3d_raw" / self.name(place.drive) / "velodyne_points"
        write_array(folder / "data" / f"{place.index:010d}.bin", frame.points)
        for name, camera in rig(self.width).items() if self.width else ():
            self._pictures(name, camera, photograph(drive, frame, camera), place)
        return {"pose": (frame.pose @ inverse(LIDAR_TO_VEHICLE)).tolist(), "time": frame.time}

    def _pictures(self, name: str, camera: Camera, shot: Rendering, place: Place) -> None:
        drive, file = self.name(place.drive), f"{place.index:010d}.png"
        kind = "data_rgb" if camera.model == "mei" else "data_rect"
        write_picture(self.root / "data_2d_raw" / drive / name / kind / file, shot.image)
        depth = np.minimum(np.round(shot.depth * 256), 2**16 - 1).astype(np.uint16)
        write_picture(self.root / "data_2d_depth" / drive / name / file, depth)
        semantic = labels_of(shot, np.asarray(rays_of(camera)[1].any(1)).reshape(shot.depth.shape))
        write_picture(self.root / "data_2d_semantics" / "train" / drive / name / "semantic" / file, semantic)

    def finish(self, parts: Sequence[Sequence[dict[str, Any]]]) -> None:
        cameras = rig(self.width or _FULL)
        self._calibration(cameras)
        rectified = LIDAR_TO_VEHICLE @ inverse(np.array(cameras["image_00"].from_sensor))
        for number, drive in enumerate(parts):
            poses = np.array([part["pose"] for part in drive])
            folder = self.root / "data_poses" / self.name(number)
            write_text(folder / "poses.txt", _numbered(poses[:, :3]))
            write_text(folder / "cam0_to_world.txt", _numbered(poses @ rectified))
            times = (_BEGIN + timedelta(hours=number, seconds=part["time"]) for part in drive)
            folder = self.root / "data_3d_raw" / self.name(number) / "velodyne_points"
            write_text(folder / "timestamps.txt", "".join(f"{time:%Y-%m-%d %H:%M:%S.%f}000\n" for time in times))

    def _calibration(self, cameras: dict[str, Camera]) -> None:
        folder, from_lidar = self.root / "calibration", {n: np.array(c.from_sensor) for n, c in cameras.items()}
        places = {name: LIDAR_TO_VEHICLE @ inverse(matrix) for name, matrix in from_lidar.items()}
        lines = (f"{name}: {numbers(matrix[:3])}\n" for name, matrix in sorted(places.items()))
        write_text(folder / "calib_cam_to_pose.txt", "".join(lines))
        write_text(folder / "calib_cam_to_velo.txt", numbers(inverse(from_lidar["image_00"])[:3]) + "\n")
        pair = {name: camera for name, camera in cameras.items() if camera.model == "pinhole"}
        write_text(folder / "perspective.txt", "".join(map(_perspective, pair, pair.values())))
        for name in cameras.keys() - pair.keys():
            camera = cameras[name]
            text = _YAML.format(name=name, camera=camera, distortion=camera.distortion, lens=camera.intrinsics)
            write_text(folder / f"{name}.yaml", text)


def labels_of(shot: Rendering, imaged: np.ndarray) -> np.ndarray:
    """Classes (H, W) of a picture in KITTI-360's ids; `imaged` says which pixels the lens reaches."""
    table = np.zeros(2**16, np.uint8)
    table[list(_LABELS)] = list(_LABELS.values())
    nothing = np.where(shot.depth > 0, _OWN, np.where(imaged, _SKY, 0))
    return np.where(shot.semantic == 0, nothing, table[shot.semantic]).astype(np.uint8)


def rig(width: int) -> dict[str, Camera]:
    """The cameras by name, seen from the LiDAR; `width` in pixels is that of the fisheyes."""
    return perspective_cameras(round(1408 * width / _FULL)) | fisheye_cameras(width)


def _perspective(name: str, camera: Camera) -> str:
    """The rows of a camera in perspective.txt; both look the same way, so that nothing has to be rectified."""
    fx, fy, cx, cy = camera.intrinsics
    baseline = 0.6 * int(name[-1])  # metres to the right of image_00
    projection = np.array([[fx, 0, cx, -fx * baseline], [0, fy, cy, 0], [0, 0, 1, 0]])
    size = numbers([camera.width, camera.height])
    rows = {"S_rect": size, "R_rect": numbers(np.eye(3)), "P_rect": numbers(projection)}
    return "".join(f"{key}_{name[-2:]}: {value}\n" for key, value in rows.items())


def _numbered(matrices: Array) -> str:
    return "".join(f"{number} {numbers(matrix)}\n" for number, matrix in enumerate(matrices))
