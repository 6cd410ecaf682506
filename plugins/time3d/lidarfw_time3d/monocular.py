"""Boxes in pictures and back: nine keypoints of a box, and its place from them by least squares (KM3D, section 3.3).

Everything is said in the sensor frame, in which boxes stand upright; the camera may look anywhere, and be tilted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from lidarfw.errors import DataError
from lidarfw.ops import box_corners
from lidarfw.types import Camera
from torch import Tensor

NEAR = 0.5  # metres before the camera at which boxes are cut off
_EDGES = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
_DAMPING, _ROUNDS = 1e-6, 3


@dataclass
class Lens:
    """The pinhole cameras of N objects (or of N samples), as tensors in double precision."""

    focal: Tensor  # (N, 2) pixels
    centre: Tensor  # (N, 2) pixels
    turn: Tensor  # (N, 3, 3) sensor -> camera
    shift: Tensor  # (N, 3) metres
    size: Tensor  # (N, 2) pixels, width and height

    @classmethod
    def of(cls, cameras: tuple[Camera, ...], device: torch.device | str) -> Lens:
        """DataError where a camera is no pinhole without distortion."""
        for camera in cameras:
            if camera.model != "pinhole" or any(camera.distortion):
                raise DataError(
                    f"km3d solves for pinhole cameras without distortion, found {camera.model} {camera.distortion}.\n"
                    "  fix: rectified pictures, as KITTI's and nuScenes' are"
                )
        lens = torch.tensor([camera.intrinsics for camera in cameras], dtype=torch.float64).reshape(-1, 4)
        known = [camera.from_sensor or torch.eye(4).tolist() for camera in cameras]
        matrix = torch.tensor(known, dtype=torch.float64).reshape(-1, 4, 4)
        size = torch.tensor([(c.width, c.height) for c in cameras], dtype=torch.float64).reshape(-1, 2)
        parts = (lens[:, :2], lens[:, 2:], matrix[:, :3, :3], matrix[:, :3, 3], size)
        return cls(*(part.to(device) for part in parts))

    def __getitem__(self, rows: Tensor) -> Lens:
        return Lens(self.focal[rows], self.centre[rows], self.turn[rows], self.shift[rows], self.size[rows])

    def to_camera(self, xyz: Tensor) -> Tensor:
        """Points (N, P, 3) in the camera frame."""
        return torch.einsum("nij,npj->npi", self.turn, xyz.double()) + self.shift[:, None]

    def pixels(self, xyz: Tensor) -> Tensor:
        """Pixels (N, P, 2) of points (N, P, 3) in the camera frame, whose depth is taken as at least NEAR."""
        plane = xyz[..., :2] / xyz[..., 2:].clamp(min=NEAR)
        return plane * self.focal[:, None] + self.centre[:, None]

    def normalised(self, pixels: Tensor) -> Tensor:
        """(N, P, 2) on the plane of focal length 1."""
        return (pixels.double() - self.centre[:, None]) / self.focal[:, None]

    def bearing(self, pixel: Tensor) -> Tensor:
        """Angle (N,) about the vertical of the sensor, counter-clockwise from x, of rays through pixels (N, 2)."""
        plane = self.normalised(pixel[:, None])[:, 0]
        ray = torch.cat([plane, torch.ones_like(plane[:, :1])], 1)
        x, y, _ = torch.linalg.solve(self.turn, ray).unbind(1)
        return torch.atan2(y, x)


def keypoints(boxes: Tensor) -> Tensor:
    """(N, 9, 3) corners of boxes (N, 7) in the order of `box_corners`, and the centre."""
    return torch.cat([box_corners(boxes), boxes[:, None, :3]], 1)


def rectangles(boxes: Tensor, lens: Lens) -> Tensor:
    """(N, 4) left, top, right, bottom of what of boxes (N, 7) is in the picture; zero width where nothing is."""
    corners = lens.to_camera(box_corners(boxes))
    start, end = corners[:, [a for a, _ in _EDGES]], corners[:, [b for _, b in _EDGES]]
    rise = end[..., 2] - start[..., 2]
    crosses = (start[..., 2] < NEAR) != (end[..., 2] < NEAR)
    share = (NEAR - start[..., 2]) / torch.where(crosses, rise, 1)
    points = torch.cat([corners, start + share[..., None] * (end - start)], 1)
    counts = torch.cat([corners[..., 2] >= NEAR, crosses], 1)[..., None]
    pixels, border = lens.pixels(points), (lens.size - 1)[:, None]
    low = torch.where(counts, pixels, torch.inf).amin(1, keepdim=True).clamp(min=0).minimum(border)
    high = torch.where(counts, pixels, -torch.inf).amax(1, keepdim=True).clamp(min=0).minimum(border)
    return torch.cat([low, high.maximum(low)], 2)[:, 0]


def observation(yaw: Tensor, bearing: Tensor) -> Tensor:
    """KITTI's observation angle (N,) of headings seen in directions `bearing`; its own inverse in `yaw`."""
    return wrapped(bearing - yaw - math.pi / 2)


def wrapped(angle: Tensor) -> Tensor:
    """Angles in [-pi, pi)."""
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def solve(pixels: Tensor, size: Tensor, yaw: Tensor, lens: Lens) -> Tensor:
    """Centre (N, 3) in the sensor frame, of boxes of `size` (N, 3) l, w, h and `yaw` (N,) with keypoints (N, 9, 2).

    Keypoint k at T + d_k has the ray (u_k, v_k, 1): two linear equations in T each (KM3D, equation 5, here for any
    camera). They are solved by normal equations, damped so that keypoints that fell together give a finite place;
    the damping is undone by repeating it on what is left over.
    """
    local = torch.cat([torch.zeros_like(size), size, yaw[:, None]], 1).double()
    plane = lens.normalised(pixels)
    # a row of the camera's turn less the pixel times its last row: what T must have none of
    rows = (lens.turn[:, None, :2] - plane[..., None] * lens.turn[:, None, 2:]).flatten(1, 2)  # (N, 18, 3)
    known = (lens.shift[:, None, :2] - plane * lens.shift[:, None, 2:]).flatten(1)
    offset = keypoints(local).repeat_interleave(2, 1)
    right = -(known + (rows * offset).sum(2))
    square = rows.transpose(1, 2) @ rows
    goal = (rows * right[..., None]).sum(1)
    damped = square + _DAMPING * torch.eye(3, dtype=square.dtype, device=square.device)
    place = torch.zeros_like(goal)
    for _ in range(_ROUNDS):
        left = goal - (square @ place[..., None])[..., 0]
        place = place + torch.linalg.solve(damped, left)
    return place


def overlap_2d(a: Tensor, b: Tensor) -> Tensor:
    """IoU (N, M) of rectangles (N, 4) and (M, 4) left, top, right, bottom; 0 where both are empty."""
    low, high = torch.maximum(a[:, None, :2], b[None, :, :2]), torch.minimum(a[:, None, 2:], b[None, :, 2:])
    common = (high - low).clamp(min=0).prod(2)
    areas = [(r[:, 2:] - r[:, :2]).clamp(min=0).prod(1) for r in (a, b)]
    return common / (areas[0][:, None] + areas[1] - common).clamp(min=1e-9)
