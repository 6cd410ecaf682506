"""A tiny KITTI in the official layout, written by the tests."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

CALIBRATION = """P0: 720 0 610 0 0 720 170 0 0 0 1 0
P1: 720 0 610 -380 0 720 170 0 0 0 1 0
P2: 720 0 610 45 0 720 170 -0.3 0 0 1 0.005
P3: 720 0 610 -330 0 720 170 2.3 0 0 1 0.003
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 -0.02 0 0 -1 -0.06 1 0 0 -0.33
Tr_imu_to_velo: 1 0 0 -0.8 0 1 0 0.3 0 0 1 -0.8

"""
LABELS = """Car 0.00 0 -1.57 300.00 160.00 400.00 220.00 1.50 1.60 4.00 -5.00 1.60 20.00 0.00
Van 0.00 1 1.57 700.00 150.00 800.00 230.00 2.20 1.90 5.00 5.00 1.60 25.00 1.57
Pedestrian 0.10 2 0.20 500.00 150.00 540.00 250.00 1.80 0.60 0.80 -2.00 1.60 12.00 0.30
Person_sitting 0.00 0 0.00 100.00 150.00 140.00 220.00 1.30 0.60 0.80 -9.00 1.60 15.00 0.00
Cyclist 0.00 0 1.00 650.00 150.00 700.00 250.00 1.70 0.60 1.80 1.00 1.60 14.00 1.20
Truck 0.00 0 0.00 10.00 150.00 90.00 220.00 3.30 2.60 9.00 -15.00 1.60 30.00 0.00
DontCare -1 -1 -10 900.00 160.00 950.00 190.00 -1 -1 -1 -1000 -1000 -1000 -10
"""
PLANE = "# Matrix\nWIDTH 4\nHEIGHT 1\n0.0 -1.0 0.0 1.6\n"
OBJECTS = {  # centre and size x, y, z, l, w, h (yaw -pi/2, so l runs along y) of the car etc. in the LiDAR frame
    "car": (20.33, 4.98, -0.91),
    "pedestrian": (12.33, 1.98, -0.76),
    "cyclist": (14.33, -1.02, -0.81),
}


def scan(rng, points=400):
    """Ground all around, and 30 points about the centre of each object."""
    ground = np.column_stack([rng.uniform(-30, 60, points), rng.uniform(-30, 30, points), np.full(points, -1.66)])
    objects = [np.array(place) + rng.uniform(-0.2, 0.2, (30, 3)) for place in OBJECTS.values()]
    xyz = np.concatenate([ground, *objects])
    return np.column_stack([xyz, rng.uniform(0, 1, len(xyz))]).astype("<f4")


def write(root: Path) -> None:
    """The files of both parts."""
    rng = np.random.default_rng(0)
    picture = np.full((375, 1242, 3), (200, 120, 40), dtype=np.uint8)
    picture[::5] = rng.integers(0, 255, (75, 1242, 3))
    for part, names in (("training", ("000000", "000001", "000002")), ("testing", ("000000",))):
        for folder in ("velodyne", "calib", "image_2", "label_2", "planes"):
            (root / part / folder).mkdir(parents=True)
        for name in names:
            scan(rng).tofile(root / part / "velodyne" / f"{name}.bin")
            (root / part / "calib" / f"{name}.txt").write_text(CALIBRATION)
            Image.fromarray(picture).save(root / part / "image_2" / f"{name}.png", compress_level=1)
            if part == "training":
                (root / part / "label_2" / f"{name}.txt").write_text(LABELS)
                (root / part / "planes" / f"{name}.txt").write_text(PLANE)
    (root / "ImageSets").mkdir()
    (root / "ImageSets" / "train.txt").write_text("000000\n000001\n")
    (root / "ImageSets" / "val.txt").write_text("000002\n")


@pytest.fixture(scope="session")
def kitti_template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("kitti_template")
    write(root)
    return root


@pytest.fixture
def kitti_root(kitti_template: Path, tmp_path: Path) -> Path:
    """ROOT with frames 000000 .. 000002 in training and 000000 in testing; train is the first two, val the last."""
    return Path(shutil.copytree(kitti_template, tmp_path / "kitti"))
