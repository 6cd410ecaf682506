"""KITTI-360 on files of the official layout: cameras, poses, pictures, splits, broken files, a real drive."""

from __future__ import annotations

import math
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch
from PIL import Image as Picture

from lidarfw.components.datasets.kitti_360 import Kitti360Dataset
from lidarfw.errors import ConfigError, DataError
from lidarfw.io import read_image
from lidarfw.testing.checks import run_checks
from lidarfw.types import DataSpec, Poses

DRIVE = "2013_05_28_drive_0003_sync"
TO_VEHICLE = {  # axes of each camera (x right, y down, z ahead) in the vehicle (x ahead, y right, z down)
    "image_00": "0 0 1 1.5 1 0 0 0 0 1 0 -1",
    "image_01": "0 0 1 1.5 1 0 0 0.6 0 1 0 -1",
    "image_02": "1 0 0 0.7 0 0 -1 -0.2 0 1 0 -1",
    "image_03": "-1 0 0 0.7 0 0 1 0.7 0 1 0 -1",
}
TO_LIDAR = "0 0 1 0.8 -1 0 0 0 0 -1 0 0"  # camera 0 -> LiDAR (x ahead, y left, z up)
FISHEYE = """%YAML:1.0
model_type: MEI
camera_name: {name}
image_width: 140
image_height: 140
mirror_parameters:
   xi: 2.0
distortion_parameters:
   k1: 0.0
   k2: 0.0
   p1: 0.0
   p2: 0.0
projection_parameters:
   gamma1: 130.0
   gamma2: 130.0
   u0: 70.0
   v0: 70.0
"""
PERSPECTIVE = """S_rect_0{n}: 141.0 38.0
R_rect_0{n}: 1 0 0 0 1 0 0 0 1
P_rect_0{n}: 55 0 70 0 0 55 20 0 0 0 1 0
"""
POSED = (0, 1, 3)  # scan 2 has no pose


def write_calibration(folder):
    folder.mkdir()
    (folder / "calib_cam_to_pose.txt").write_text("".join(f"{k}: {v} \n" for k, v in TO_VEHICLE.items()))
    (folder / "calib_cam_to_velo.txt").write_text(TO_LIDAR)
    (folder / "perspective.txt").write_text("calib_time: x\n" + PERSPECTIVE.format(n=0) + PERSPECTIVE.format(n=1))
    for name in ("image_02", "image_03"):
        (folder / f"{name}.yaml").write_text(FISHEYE.format(name=name))


def pose(number):
    """The vehicle drives along the world's y, 2 m a scan: its x is the world's y, its z points down."""
    return f"0 1 0 100 1 0 0 {200 + 2 * number} 0 0 -1 50"


def write_drive(root, name=DRIVE):
    scans = root / "data_3d_raw" / name / "velodyne_points/data"
    scans.mkdir(parents=True)
    (root / "data_poses" / name).mkdir(parents=True)
    (root / "data_poses" / name / "poses.txt").write_text("".join(f"{n} {pose(n)}\n" for n in POSED))
    (scans.parent / "timestamps.txt").write_text("".join(f"2013-05-28 08:46:0{n}.904509120\n" for n in range(4)))
    for number in range(4):
        rng = np.random.default_rng(number)
        table = np.column_stack([rng.uniform(-20, 20, (50, 3)), rng.uniform(0, 1, 50)]).astype("<f4")
        table[0] = 30 - 2 * number, 5, 1, 0.5  # stands still
        table.tofile(scans / f"{number:010d}.bin")
        for camera, kind, size in (("image_00", "data_rect", (141, 38)), ("image_02", "data_rgb", (140, 140))):
            folder = root / "data_2d_raw" / name / camera / kind
            folder.mkdir(parents=True, exist_ok=True)
            Picture.new("RGB", size, (255, 51, 0)).save(folder / f"{number:010d}.png")


@pytest.fixture
def root(tmp_path):
    """Two drives, 0003 and 0005."""
    write_calibration(tmp_path / "calibration")
    for name in (DRIVE, "2013_05_28_drive_0005_sync"):
        write_drive(tmp_path, name)
    return tmp_path


def dataset(root, split="03", **options):
    return Kitti360Dataset(root=str(root), split=split, **options)


def test_frames_are_the_scans_that_have_a_pose(root):
    data = dataset(root)
    assert [data.meta(i).id for i in range(len(data))] == [f"{DRIVE}/{n:010d}" for n in POSED]
    assert data.meta(2).time - data.meta(0).time == pytest.approx(3)
    raw = np.fromfile(root / "data_3d_raw" / DRIVE / "velodyne_points/data/0000000003.bin", "<f4").reshape(-1, 4)
    assert torch.equal(data[2].inputs["points"].xyz, torch.tensor(raw[:, :3]))
    assert len(dataset(root, poses=False)) == 4


def test_pose_is_that_of_the_lidar(root):
    """The LiDAR is 0.8 m behind camera 0, which is 1.5 m ahead of and 1 m above the inertial unit."""
    matrix = dataset(root, pose=True)[1].inputs["pose"].matrix[0]
    expected = [[0, -1, 0, 100], [1, 0, 0, 202 + 0.7], [0, 0, 1, 51], [0, 0, 0, 1]]
    assert np.allclose(matrix, expected, atol=1e-4)


def test_past_scans_stand_in_the_current_frame(root):
    points = dataset(root, sweeps=3)[2].inputs["points"]
    still = points.xyz[points.features[:, 0] == 0.5]
    assert len(still) == 3
    assert (still - still[0]).abs().max() < 1e-4
    assert points.time.unique().tolist() == pytest.approx([-3, -2, 0])


def test_cameras_look_where_they_are_mounted(root):
    """By hand: the camera's place in the LiDAR's frame, and the unit sphere seen from xi behind its centre."""
    cameras = dataset(root).meta(0).cameras
    assert {name: c.model for name, c in cameras.items()} == {
        "image_00": "pinhole", "image_01": "pinhole", "image_02": "mei", "image_03": "mei",
    }  # fmt: skip
    ahead = torch.tensor([[10.8, -2.0, 1.0]])  # 10 m before camera 0, 2 m to its right, 1 m up
    uv, depth, _ = cameras["image_00"].project(ahead)
    assert uv[0].tolist() == pytest.approx([70 + 55 * 0.2, 20 - 55 * 0.1])
    assert depth[0] == pytest.approx(10)
    assert cameras["image_01"].project(ahead)[0][0].tolist() == pytest.approx([70 + 55 * 0.14, 20 - 55 * 0.1])
    left = torch.tensor([[0.0, 5.2, 0.0]])  # 5 m before the left fisheye, straight ahead of it
    uv, depth, seen = cameras["image_02"].project(left)
    assert (uv[0].tolist(), depth[0].item(), seen[0].item()) == (
        pytest.approx([70, 70], abs=1e-3),
        pytest.approx(5),
        True,
    )
    uv, _, seen = cameras["image_02"].project(torch.tensor([[5.0, 5.2, 0.0]]))  # 45 degrees to its right
    sphere = math.sqrt(0.5)
    assert uv[0].tolist() == pytest.approx([70 + 130 * sphere / (sphere + 2), 70], abs=1e-3)
    right = torch.tensor([[0.0, -5.7, 0.0]])
    assert cameras["image_03"].project(right)[0][0].tolist() == pytest.approx([70, 70], abs=1e-3)
    assert not cameras["image_02"].project(torch.tensor([[0.0, -9.0, 0.0]]))[2].any()


def test_pictures(root):
    data = dataset(root, images=("image_00", "image_02"), image_scale=0.5)
    frame = data[0]
    assert data.spec.inputs["image_02"].geometry.model == "mei"
    fisheye = frame.inputs["image_02"]
    assert fisheye.features.shape == (1, 3, 70, 70)
    assert fisheye.features[0, :, 3, 3].tolist() == pytest.approx([1, 0.2, 0])
    assert fisheye.cameras[0] == frame.meta.cameras["image_02"].scaled(0.5)
    assert set(frame.meta.images) == {"image_00", "image_02"}


def test_splits(root):
    assert [d.name for d in dataset(root, "all").drives] == [DRIVE, "2013_05_28_drive_0005_sync"]
    assert [d.name for d in dataset(root, "5+" + DRIVE).drives] == ["2013_05_28_drive_0005_sync", DRIVE]
    assert dataset(root, "val").named == [DRIVE]
    assert len(dataset(root, "train").named) == 9
    with pytest.raises(DataError, match=r"drive_0007_sync/velodyne_points/data: no such folder"):
        len(dataset(root, "7"))


def test_spec_needs_no_disk():
    data = dataset("/nowhere", "train", images=("image_02", "image_03"), sweeps=2, pose=True)
    assert data.spec.targets == frozenset({Poses})
    assert set(data.spec.inputs) == {"points", "pose", "image_02", "image_03"}
    assert DataSpec.from_plain(data.spec.to_plain()) == data.spec


def test_import_and_spec_do_not_import_torch():
    code = (
        "import sys; from lidarfw.components.datasets.kitti_360 import Kitti360Dataset as D; "
        "D(root='x', images=('image_02',)).spec; sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    "options", [{"images": ("image_02",), "sweeps": 2, "pose": True}, {"poses": False, "images": ("image_00",)}]
)
def test_keeps_the_rules_of_a_dataset(root, options, monkeypatch):
    monkeypatch.setattr(Kitti360Dataset, "example", {"root": str(root), "split": "all", **options}, False)
    results = run_checks(Kitti360Dataset)
    assert [r for r in results if r.status == "failed"] == []
    assert {"frames_match_the_spec", "frames_can_be_read_anywhere"} <= {
        r.check for r in results if r.status == "passed"
    }


@pytest.mark.parametrize(
    ("path", "content", "message"),
    [
        ("calibration/calib_cam_to_pose.txt", "image_01: 1\n", r"calib_cam_to_pose.txt: expected 3 x 4 numbers"),
        ("calibration/calib_cam_to_pose.txt", "", r"calib_cam_to_pose.txt: no key image_00"),
        ("calibration/calib_cam_to_velo.txt", "1 2", r"calib_cam_to_velo.txt: expected 3 x 4 numbers"),
        (
            "calibration/calib_cam_to_velo.txt",
            "2 0 0 0 0 1 0 0 0 0 1 0",
            r"calib_cam_to_velo.txt, line 1: expected a rot",
        ),
        ("calibration/image_02.yaml", "%YAML:1.0\nmirror_parameters: 3\n", r"image_02.yaml: is no MEI calibration"),
        ("calibration/image_02.yaml", "%YAML:1.0\n{", r"image_02.yaml: is no MEI calibration"),
        ("calibration/perspective.txt", "P_rect_00: 1\n", r"perspective.txt: expected P_rect_00"),
        (f"data_poses/{DRIVE}/poses.txt", "0 1 2\n", r"poses.txt, line 1: expected 13 numbers, found 3"),
        (f"data_poses/{DRIVE}/poses.txt", "9 " + pose(0), r"the split '03' of .* has no frames"),
        (f"data_3d_raw/{DRIVE}/velodyne_points/timestamps.txt", "x\n", r"timestamps.txt: has 1 lines"),
        (f"data_3d_raw/{DRIVE}/velodyne_points/timestamps.txt", "x\n" * 4, r"timestamps.txt: expected a date"),
        (f"data_2d_raw/{DRIVE}/image_02/data_rgb/0000000000.png", "x", r"0000000000.png: cannot be decoded"),
    ],
)
def test_broken_files_are_named(root, path, content, message):
    (root / path).write_text(content)
    with pytest.raises(DataError, match=message):
        dataset(root, images=("image_02",))[0]


def test_missing_pictures_show_before_training(root):
    with pytest.raises(DataError, match=r"image_03/data_rgb: 3 of 3 pictures are missing, the first is 0000000000.png"):
        dataset(root, images=("image_03",)).prepare()
    (root / "calibration/image_03.yaml").unlink()
    with pytest.raises(DataError, match=r"calibration: has no calibration of image_03"):
        dataset(root, images=("image_03",)).prepare()


def test_picture_of_another_size(root):
    path = root / "data_2d_raw" / DRIVE / "image_02/data_rgb/0000000000.png"
    Picture.new("RGB", (70, 70)).save(path)
    with pytest.raises(DataError, match=r"0000000000.png: expected 140 x 140 pixels .* found 70 x 70"):
        dataset(root, images=("image_02",))[0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"images": ("image_04",)}, "no camera 'image_04'"),
        ({"image_scale": 2.0}, "image_scale must be over 0"),
        ({"poses": False, "sweeps": 2}, "need poses"),
        ({"sweeps": 0}, "sweeps must be at least 1"),
    ],
)
def test_wrong_options(options, message):
    with pytest.raises(ConfigError, match=message):
        dataset("x", **options)


def test_nothing_there(tmp_path):
    with pytest.raises(DataError, match="root is not set"):
        len(dataset(""))
    with pytest.raises(DataError, match="data_3d_raw: no such folder"):
        len(dataset(tmp_path))


# a real drive


def _edge_strength(frame, shift):
    """Mean picture gradient at the projections of points that stand out from their neighbour, moved by `shift` px."""
    grey = cv2.cvtColor(read_image(frame.meta.images["image_00"]), cv2.COLOR_RGB2GRAY).astype(np.float32)
    slope = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    slope = cv2.GaussianBlur(slope, (0, 0), 1.5)
    xyz = frame.inputs["points"].xyz
    uv, depth, seen = frame.meta.cameras["image_00"].project(xyz)
    apart = xyz.norm(dim=1)
    stands_out = torch.cat([torch.zeros(1, dtype=torch.bool), apart[:-1] - apart[1:] > 1.5])
    pixel = uv[seen & stands_out & (depth < 30)].round().long()
    column = (pixel[:, 0] + shift).clamp(0, slope.shape[1] - 1)
    return float(slope[pixel[:, 1].clamp(0, slope.shape[0] - 1), column].mean())


def test_real_scans_lie_on_the_real_pictures(real_data):
    data = dataset(real_data("kitti_360"), "all", poses=False, images=("image_00",))
    data.prepare()
    frames = [data[i] for i in range(len(data))]
    assert len(frames) == 7
    strength = {shift: sum(_edge_strength(frame, shift) for frame in frames) for shift in (-20, -10, 0, 10, 20)}
    assert max(strength, key=strength.get) == 0
    assert strength[0] > 1.15 * max(strength[-20], strength[20])


def test_real_fisheyes_see_their_sides(real_data):
    frame = dataset(real_data("kitti_360"), "all", poses=False)[0]
    xyz = frame.inputs["points"].xyz
    for name, side in (("image_02", 1), ("image_03", -1)):
        camera = frame.meta.cameras[name]
        uv, depth, seen = camera.project(xyz)
        assert (seen & (side * xyz[:, 1] > 3)).sum() > 0.95 * (side * xyz[:, 1] > 3).sum()
        assert (seen & (side * xyz[:, 1] < -3)).sum() < 0.05 * (side * xyz[:, 1] < -3).sum()
        origin, direction = camera.sensor_rays(uv[seen].double())
        apart = (origin + direction * depth[seen, None] - xyz[seen]).norm(dim=1)
        assert apart.isnan().float().mean() < 1e-3  # rounding at the rim of the lens
        assert apart.nan_to_num().max() < 0.01
