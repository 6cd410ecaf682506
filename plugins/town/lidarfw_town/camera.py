"""The cameras of the vehicle: KITTI's pinhole, KITTI-360's rig with two fisheyes, NCLT's Ladybug3.

The cameras are lidarfw's `Camera`: `from_sensor` takes the frame of the LiDAR to that of the camera, so a camera says
by itself where it stands. A picture of a frame (see `render.py`):

    camera = fisheye_cameras(700)["image_02"]        # or kitti_camera(1242), perspective_cameras(1408)["image_00"]
    shot = photograph(drive, drive.frame(20), camera)
    shot.image      # (H, W, 3) uint8 RGB
    shot.depth      # (H, W) float32 metres as in Camera.project: z of a pinhole, the distance else; 0 where no surface
    shot.semantic   # (H, W) uint16 SemanticKITTI classes, movable objects by their standing class; 0 for the sky
    shot.instance   # (H, W) int32 track ids, 0 for all else

The lenses have the form and the size of KITTI-360's, with numbers of their own; the file formats are the layouts'
business: a MEI camera's `intrinsics` are gamma1, gamma2, u0, v0 and its `distortion` xi, k1, k2, p1, p2.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import numpy.typing as npt
from lidarfw.types import Camera

from lidarfw_town.mesh import Array
from lidarfw_town.sensors import Floats

LIDAR_TO_CAMERA = np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27]])  # to KITTI's camera 0
BASELINE = 0.06  # metres from camera 0 to camera 2, to the left
LENS_EDGE = math.radians(95)  # from the axis of a fisheye: beyond, its picture is black

_KITTI = Camera("pinhole", 1242, 375, (721.5377, 721.5377, 609.5593, 172.854))
_PERSPECTIVE = Camera("pinhole", 1408, 376, (552.0, 552.0, 682.0, 238.0))
_LEFT = Camera("mei", 1400, 1400, (1336.0, 1335.5, 716.0, 706.0), (2.21, 0.016, 1.66, 4e-4, 4e-4))
_RIGHT = Camera("mei", 1400, 1400, (1485.0, 1484.5, 699.0, 698.0), (2.55, 0.05, 4.5, 1.3e-3, -7e-4))
_LADYBUG = Camera("pinhole", 1616, 1232, (400.0, 400.0, 812.0, 618.0))


def kitti_camera(width: int = _KITTI.width) -> Camera:
    """KITTI's left colour camera, camera 2, its picture scaled to a width in pixels."""
    right, down, ahead = LIDAR_TO_CAMERA[:, :3]
    return _mounted(_scaled(_KITTI, width), right, down, ahead, (0.27, BASELINE, -0.08))


def kitti_projection(camera: Camera) -> Array:
    """(3, 4): rectified camera 0 -> pixels of camera 2, KITTI's P2."""
    fx, fy, cx, cy = camera.intrinsics
    return np.array([[fx, 0, cx, fx * BASELINE], [0, fy, cy, 0], [0, 0, 1, 0]])


def fisheye_cameras(width: int = _LEFT.width) -> dict[str, Camera]:
    """KITTI-360's fisheyes of over 180 degrees: image_02 looks to the left, image_03 to the right."""
    left = _mounted(_scaled(_LEFT, width), (1, 0, 0), (0, 0, -1), (0, 1, 0), (-0.05, 0.45, 0.23))
    right = _mounted(_scaled(_RIGHT, width), (-1, 0, 0), (0, 0, -1), (0, -1, 0), (-0.07, -0.45, 0.24))
    return {"image_02": left, "image_03": right}


def perspective_cameras(width: int = _PERSPECTIVE.width) -> dict[str, Camera]:
    """KITTI-360's rectified pair: image_00 looks ahead from the left, image_01 0.6 m to its right."""
    lens, tilt = _scaled(_PERSPECTIVE, width), math.radians(5)
    down, ahead = (-math.sin(tilt), 0, -math.cos(tilt)), (math.cos(tilt), 0, -math.sin(tilt))
    places = {"image_00": (0.80, 0.30, -0.18), "image_01": (0.80, -0.30, -0.18)}
    return {name: _mounted(lens, (0, -1, 0), down, ahead, place) for name, place in places.items()}


def ladybug_cameras(width: int = _LADYBUG.width) -> dict[str, Camera]:
    """NCLT's: Cam1 to Cam5 every 72 degrees to the left, Cam5 ahead, right of a picture is down; Cam0 looks up."""
    lens, middle = _scaled(_LADYBUG, width), np.array([0.033, -0.006, 0.273])
    cameras = {"Cam0": _mounted(lens, (-1, 0, 0), (0, -1, 0), (0, 0, 1), middle)}
    for number in range(1, 6):
        turn = math.radians(72 * number)
        ahead, left = np.array([math.cos(turn), math.sin(turn), 0]), (-math.sin(turn), math.cos(turn), 0)
        cameras[f"Cam{number}"] = _mounted(lens, (0, 0, -1), left, ahead, middle + 0.042 * ahead)
    return cameras


def _scaled(camera: Camera, width: int) -> Camera:
    return camera.scaled(width / camera.width)


def _mounted(
    camera: Camera, right: npt.ArrayLike, down: npt.ArrayLike, ahead: npt.ArrayLike, place: npt.ArrayLike
) -> Camera:
    """A camera at a place, its axes given in the frame of the LiDAR."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([right, down, ahead], 1), place
    return camera.transformed(pose)


@functools.lru_cache(maxsize=8)
def rays_of(camera: Camera) -> tuple[Array, Floats, Floats]:
    """What the pixels look along, row by row, in the frame of the LiDAR.

    The place of the camera (3,) in metres, unit directions (H * W, 3), 0 for pixels without a ray, and the depth (H *
    W,) of a surface a metre along the ray.
    """
    import torch

    rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    pixels = torch.stack([columns, rows], -1).reshape(-1, 2).double()
    place, directions = (value.numpy() for value in camera.sensor_rays(pixels))
    along = directions @ np.array(camera.from_sensor)[2, :3]
    seen = np.isfinite(along) & ((camera.model == "pinhole") | (along > math.cos(LENS_EDGE)))
    depth = along if camera.model == "pinhole" else np.ones_like(along)
    return (
        place,
        np.where(seen[:, None], directions, 0).astype(np.float32),
        np.where(seen, depth, 0).astype(np.float32),
    )
