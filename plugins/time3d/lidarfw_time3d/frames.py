"""Boxes as arrays in the tracking frame: the map where poses are given, else the frame of the sensor."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from lidarfw.types import Boxes, FrameMeta, Poses

Array = npt.NDArray[np.float64]


def array(tensor: Any) -> Array:
    """A tensor as a float64 array on the CPU."""
    values: Array = tensor.detach().cpu().double().numpy()
    return values


def rows_of(boxes: Boxes) -> Array:
    """(M, 7) x, y, z, yaw, l, w, h of boxes in the sensor frame."""
    return np.concatenate([array(boxes.center), array(boxes.yaw)[:, None], array(boxes.size)], 1)


def to_map(rows: Array, pose: Array) -> Array:
    """Boxes (M, 7) x, y, z, yaw, l, w, h moved from the sensor into the tracking frame, `pose` (4, 4).

    The heading turns with the sensor about the vertical; its pitch and roll are not put into a yaw.
    """
    moved = rows.copy()
    moved[:, :3] = rows[:, :3] @ pose[:3, :3].T + pose[:3, 3]
    moved[:, 3] = rows[:, 3] + heading_of(pose)
    return moved


def to_sensor(rows: Array, pose: Array) -> Array:
    """Inverse of `to_map`."""
    moved = rows.copy()
    moved[:, :3] = (rows[:, :3] - pose[:3, 3]) @ pose[:3, :3]
    moved[:, 3] = rows[:, 3] - heading_of(pose)
    return moved


def velocity_of(boxes: Boxes, pose: Array) -> Array | None:
    """(M, 3) m/s of boxes in the tracking frame; None where the detector gives no velocity, 0 where it is NaN."""
    if boxes.velocity is None:
        return None
    flat = np.nan_to_num(array(boxes.velocity))
    turned: Array = flat @ pose[:3, :2].T
    return turned


def heading_of(pose: Array) -> float:
    """Yaw of the sensor in the tracking frame."""
    return math.atan2(pose[1, 0], pose[0, 0])


def pose_of(pose: Poses | None, last: Array) -> Array:
    """The pose of a frame (4, 4); the last one where it has none."""
    return array(pose.matrix[0]) if pose is not None and bool(pose.ok[0]) else last


def seconds_since(time: float | None, meta: FrameMeta, frame_time: float) -> float:
    """Seconds from the last frame to this one; `frame_time` at the first, and where time does not grow."""
    passed = 0.0 if time is None else meta.time - time
    return passed if passed > 0 else frame_time


def boxes_of(rows: Array, label: npt.NDArray[np.int64], score: Array, like: Boxes, velocity: Array) -> Boxes:
    """Boxes from (M, 7) x, y, z, yaw, l, w, h and velocity (M, 2) in the sensor frame, in the types of `like`."""
    tensor = torch.from_numpy(rows[:, [0, 1, 2, 4, 5, 6, 3]]).to(like.center)
    made = Boxes.from_tensor(tensor, torch.from_numpy(label).to(like.label), torch.from_numpy(score).to(like.score))
    return made.replace(velocity=torch.from_numpy(velocity).to(like.center))
