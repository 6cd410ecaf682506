"""Five real fisheye pictures with a scan each: the points on a chessboard fall on the chessboard of the picture."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from lidarfw.types import Camera

DATA = Path(os.environ.get("LIDARFW_REAL_DATA", "")) / "fisheye_lidar_pair"
BESIDE = Path(__file__).resolve().parents[4] / "shared" / "data" / "fisheye_lidar_pair"
CORNERS = (7, 5)  # inner corners; the board reaches 1.5 squares beyond them
MARGIN = 1.5


@pytest.fixture(scope="module")
def folder() -> Path:
    for place in (DATA, BESIDE):
        if (place / "calib.json").is_file():
            return place
    pytest.skip("no real fisheye pictures here: set LIDARFW_REAL_DATA to a folder with fisheye_lidar_pair")


def camera(folder: Path) -> Camera:
    said = json.loads((folder / "calib.json").read_text())
    (fx, _, cx), (_, fy, cy), _ = said["K"]
    rig = tuple(tuple(row) for row in said["T_cam_lidar"])
    return Camera("fisheye", said["width"], said["height"], (fx, fy, cx, cy), tuple(said["D"]), rig)


def board_coordinates(camera: Camera, corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 2) places of points in squares from the first inner corner, by rays: the lens bends straight lines."""
    rays = camera.rays(torch.from_numpy(corners).double()).numpy()
    grid = np.stack(np.meshgrid(*(np.arange(n, dtype=float) for n in CORNERS)), -1).reshape(-1, 2)
    plane, _ = cv2.findHomography(rays[:, :2] / rays[:, 2:], grid)
    seen = camera.rays(camera.project(torch.from_numpy(points).double())[0]).numpy()
    found: np.ndarray = cv2.perspectiveTransform((seen[:, :2] / seen[:, 2:])[None], plane)[0]
    return found


@pytest.mark.parametrize("number", range(1, 6))
def test_points_on_the_board_fall_on_the_board_of_the_picture(folder: Path, number: int) -> None:
    picture, scan = cv2.imread(str(folder / f"pose{number}.jpg")), np.load(folder / f"pose{number}.npz")
    found, corners = cv2.findChessboardCorners(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), CORNERS)
    assert found
    lens = camera(folder)
    place = board_coordinates(lens, corners.reshape(-1, 2), scan["board"][:, :3])
    last = np.array(CORNERS) - 1
    outside = np.maximum(-MARGIN - place, place - last - MARGIN).max(1)
    assert (outside < 0).mean() > 0.96
    assert outside.max() < 0.35  # of a square of 0.1 m: the extrinsics are a mean of several estimates
    uv, _, valid = lens.project(torch.from_numpy(scan["board"][:, :3]).double())
    assert valid.all()
    # the check can fail: without the coefficients of the lens many points fall beside the board
    straight = Camera("pinhole", lens.width, lens.height, lens.intrinsics, (), lens.from_sensor)
    wrong = straight.project(torch.from_numpy(scan["board"][:, :3]).double())[0]
    assert (wrong - uv).norm(dim=1).max() > 20
