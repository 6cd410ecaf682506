"""KITTI tracking on files of the official layout: identities, poses, splits, broken files, real drives."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image

from lidarfw import kitti
from lidarfw.components.datasets.kitti_tracking import KittiTrackingDataset
from lidarfw.errors import ConfigError, DataError
from lidarfw.ops import points_in_boxes_mask
from lidarfw.testing.checks import run_checks
from lidarfw.types import Boxes, DataSpec, Poses, Tracks

CALIBRATION = """P0: 720 0 610 0 0 720 170 0 0 0 1 0
P1: 720 0 610 -380 0 720 170 0 0 0 1 0
P2: 720 0 610 45 0 720 170 -0.3 0 0 1 0.005
P3: 720 0 610 -330 0 720 170 2.3 0 0 1 0.003
R_rect 1 0 0 0 1 0 0 0 1
Tr_velo_cam 0 -1 0 -0.02 0 0 -1 -0.06 1 0 0 -0.33
Tr_imu_velo 1 0 0 -0.8 0 1 0 0.3 0 0 1 -0.8
"""
CAR = "Car 0 0 -1.57 300 160 400 220 1.5 1.6 4.0 {x} 1.6 {z} 0.0"
WALKER = "Pedestrian 2 1 0.2 500 150 540 250 1.8 0.6 0.8 -2.0 1.6 12.0 0.3"
SITTING = "Person 0 0 0 100 150 140 220 1.3 0.6 0.8 -9.0 1.6 15.0 0.0"
DONT_CARE = "DontCare -1 -1 -10 900 160 950 190 -1000 -1000 -1000 -10 -1 -1 -1"
FRAMES = (0, 1, 2, 5)  # scans 3 and 4 are missing, as in the download
SPEED = 1.2  # metres a frame, to the east
EARTH = 6378137.0


def oxts(frame):
    """A drive to the east along a circle of latitude, heading east."""
    east = SPEED * frame / (EARTH * math.cos(math.radians(49)))
    return " ".join(map(str, [49.0, 8.4 + math.degrees(east), 110.0, 0, 0, 0, *[0] * 24]))


def write_sequence(part, name):
    for folder in ("calib", "label_02", "oxts", f"velodyne/{name}", f"image_02/{name}"):
        (part / folder).mkdir(parents=True, exist_ok=True)
    (part / "calib" / f"{name}.txt").write_text(CALIBRATION)
    (part / "oxts" / f"{name}.txt").write_text("".join(oxts(frame) + "\n" for frame in range(6)))
    rows = []
    for frame in range(6):  # the car stands still: it comes nearer
        rows += [f"{frame} 7 {CAR.format(x=-5.0, z=20 - SPEED * frame)}", f"{frame} -1 {DONT_CARE}"]
        rows += [f"{frame} 3 {WALKER}", f"{frame} 4 {SITTING}"] if frame == 2 else []
    (part / "label_02" / f"{name}.txt").write_text("\n".join(rows) + "\n")
    for frame in FRAMES:
        rng = np.random.default_rng(frame)
        car = np.array([20.33 - SPEED * frame, 4.98, -0.91]) + rng.uniform(-0.2, 0.2, (30, 3))
        xyz = np.concatenate([car, rng.uniform((-30, -30, -2), (60, 30, 1), (200, 3))])
        scan = np.column_stack([xyz, rng.uniform(0, 1, len(xyz))]).astype("<f4")
        scan.tofile(part / "velodyne" / name / f"{frame:06d}.bin")
        Image.new("RGB", (1242, 375)).save(part / "image_02" / name / f"{frame:06d}.png")


@pytest.fixture
def root(tmp_path):
    """Sequences 0000 and 0001 of training, 0000 of testing."""
    for part, name in (("training", "0000"), ("training", "0001"), ("testing", "0000")):
        write_sequence(tmp_path / part, name)
    return tmp_path


def dataset(root, split="0000", **options):
    return KittiTrackingDataset(root=str(root), split=split, **options)


def test_boxes_and_their_identities(root):
    frame = dataset(root, camera_view=False)[2]
    raw = np.fromfile(root / "training/velodyne/0000/000002.bin", "<f4").reshape(-1, 4)
    assert torch.equal(frame.inputs["points"].xyz, torch.tensor(raw[:, :3]))
    boxes, tracks = frame.targets.boxes, frame.targets.tracks
    assert boxes.label.tolist() == [0, 1]
    assert tracks.id.tolist() == [7, 3]
    assert tracks.boxes is boxes
    assert boxes.center[0].tolist() == pytest.approx([20.33 - 2 * SPEED, 4.98, -1.66 + 0.75], abs=1e-5)
    assert boxes.yaw.tolist() == pytest.approx([-math.pi / 2, -math.pi / 2 - 0.3], abs=1e-6)
    assert boxes.truncation.tolist() == [0, 1]  # levels 0 and 2
    assert frame.targets.ignored.label.tolist() == [-1, 1]  # DontCare, and a sitting person for Pedestrian


def test_frames_are_the_scans_that_are_there(root):
    data = dataset(root)
    assert [data.meta(i).id for i in range(len(data))] == [f"0000/{frame:06d}" for frame in FRAMES]
    assert data.meta(3).time == pytest.approx(0.5)
    assert data.meta(3).images == {"image": str(root / "training/image_02/0000/000005.png")}
    assert data[3].targets.boxes.center[0, 0] == pytest.approx(20.33 - 5 * SPEED, abs=1e-4)


def test_pictures_are_padded_to_one_size(root):
    Image.new("RGB", (1242, 375), (255, 0, 51)).save(root / "training/image_02/0000/000001.png")
    data = dataset(root, image=True)
    image = data[1].inputs["image"]
    assert image.features.shape == (1, 3, 384, 1248)
    assert image.features[0, :, 100, 100].tolist() == pytest.approx([1, 0, 0.2])
    assert image.features[0, :, 380:].abs().max() == image.features[0, :, :, 1244:].abs().max() == 0
    camera = image.cameras[0]
    assert (camera.width, camera.height) == (1248, 384)
    assert camera.intrinsics == data[1].meta.cameras["image"].intrinsics
    assert data.spec.inputs["image"].channels == 3
    (root / "training/image_02/0000/000001.png").unlink()
    with pytest.raises(DataError, match=r"0000/000001.png: no such picture"):
        data[1]


def test_points_of_the_car_are_in_its_box(root):
    for frame in (dataset(root)[i] for i in range(4)):
        points = frame.inputs["points"].xyz
        assert points_in_boxes_mask(points, frame.targets.boxes.tensor)[:, 0].sum() >= 30
        assert frame.meta.cameras["image"].project(points)[2].all()


def test_oxts_poses_are_those_of_the_lidar(root):
    """The inertial unit drives east; the LiDAR is 0.8 m ahead, 0.3 m to its right and 0.8 m above."""
    matrix = np.stack([dataset(root)[i].targets.poses.matrix[0] for i in range(4)])
    assert np.allclose(matrix[:, :3, :3], np.eye(3), atol=1e-6)
    expected = np.array([0.8, -0.3, 0.8]) + SPEED * np.array(FRAMES)[:, None] * [1, 0, 0]
    assert np.allclose(matrix[:, :3, 3], expected, atol=1e-3)


def test_oxts_angles():
    """Roll about the nose, pitch nose down, yaw from east to north."""
    rows = np.zeros((1, 30))
    rows[0, :6] = 49, 8.4, 110, 0.1, 0.2, 0.3
    ahead, left, up = kitti.poses_from_oxts(rows)[0, :3, :3].T
    assert math.atan2(ahead[1], ahead[0]) == pytest.approx(0.3)
    assert ahead[2] == pytest.approx(-math.sin(0.2))
    assert math.atan2(left[2], up[2]) == pytest.approx(0.1)


def test_camera_poses(root):
    """Lines of camera poses, as of odometry: the camera's z is the LiDAR's x."""
    (root / "training/slam").mkdir()
    lines = "".join(f"1 0 0 0 0 1 0 0 0 0 1 {SPEED * frame}\n" for frame in range(6))
    (root / "training/slam/0000.txt").write_text(lines)
    frame = dataset(root, poses="slam", pose=True)[2]
    expected = np.eye(4)
    expected[0, 3] = 2 * SPEED
    assert np.allclose(frame.inputs["pose"].matrix[0], expected, atol=1e-5)


def test_past_scans_stand_in_the_current_frame(root):
    frame = dataset(root, sweeps=4, camera_view=False)[3]
    points = frame.inputs["points"]
    assert points.time.unique().tolist() == pytest.approx([-0.5, -0.4, -0.3, 0])
    inside = points_in_boxes_mask(points.xyz, frame.targets.boxes.tensor)[:, 0]
    assert [int(inside[points.time == time].sum()) >= 30 for time in points.time.unique()] == [True] * 4


def test_one_file_per_frame(root):
    folder = root / "training/oxts/0000"
    folder.mkdir()
    for frame in range(6):
        (folder / f"{frame:06d}.txt").write_text(oxts(frame) + "\n")
    whole = dataset(root)[3].targets.poses.matrix
    (root / "training/oxts/0000.txt").unlink()
    assert torch.equal(dataset(root)[3].targets.poses.matrix, whole)


def test_splits(root):
    data = dataset(root, "all")
    assert [d.name for d in data.drives] == ["0000", "0001"]
    assert set(dataset(root, "train").named).isdisjoint(dataset(root, "val").named)
    assert (len(dataset(root, "train").named), len(dataset(root, "val").named)) == (10, 11)
    assert sorted(dataset(root, "train+val").named) == sorted(dataset(root, "trainval").named)
    with pytest.raises(DataError, match=r"training/velodyne/0002: no such folder"):
        len(dataset(root, "train"))


def test_test_split_has_no_labels(root, monkeypatch):
    monkeypatch.setattr(KittiTrackingDataset, "splits", {"test": ("0000",)})
    data = dataset(root, "test")
    assert data.spec.targets == frozenset({Poses})
    assert data[0].targets.boxes is None
    assert "testing" in data[0].meta.path


def test_spec_needs_no_disk():
    data = dataset("/nowhere", "train", poses="", classes=("Car",))
    assert data.spec.targets == frozenset({Boxes, Tracks})
    assert DataSpec.from_plain(data.spec.to_plain()) == data.spec


def test_import_and_spec_do_not_import_torch():
    code = (
        "import sys; from lidarfw.components.datasets.kitti_tracking import KittiTrackingDataset as D; "
        "D(root='x').spec; sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("options", [{"sweeps": 3, "pose": True}, {"poses": ""}, {"image": True}])
def test_keeps_the_rules_of_a_dataset(root, options, monkeypatch):
    monkeypatch.setattr(KittiTrackingDataset, "example", {"root": str(root), "split": "all", **options}, False)
    results = run_checks(KittiTrackingDataset)
    assert [r for r in results if r.status == "failed"] == []
    assert {"frames_match_the_spec", "frames_can_be_read_anywhere"} <= {
        r.check for r in results if r.status == "passed"
    }


@pytest.mark.parametrize(
    ("path", "content", "message"),
    [
        ("label_02/0000.txt", f"0 7 {CAR.format(x=1, z=9)}\n" * 2, r"0000.txt: track 7 is twice in frame 0"),
        ("label_02/0000.txt", "0 7 Car 0 0\n", r"0000.txt, line 1: expected 17 columns"),
        ("label_02/0000.txt", f"0 7 Tank{CAR.format(x=1, z=9)[3:]}\n", r"0000.txt, line 1: type: expected one of"),
        ("calib/0000.txt", "P2: 720 0 610 45 0 720 170 -0.3 0 0 1 0.005\n", r"0000.txt: no key R0_rect"),
        ("oxts/0000.txt", "1 2 3\n", r"0000.txt, line 1: expected 12 numbers .* or 30 \(OXTS\), found 3"),
        ("oxts/0000.txt", oxts(0) + "\n", r"oxts/0000: has no pose of frame 000001"),
        ("velodyne/0000/000000.bin", "short", r"000000.bin: 5 bytes is not a multiple of 16"),
        ("image_02/0000/000000.png", "no picture", r"000000.png: is not a readable picture"),
    ],
)
def test_broken_files_are_named(root, path, content, message):
    (root / "training" / path).write_text(content)
    with pytest.raises(DataError, match=message):
        dataset(root)[0]


def test_missing_poses_are_named(root):
    with pytest.raises(DataError, match=r"training/gps/0000.txt: no such file"):
        len(dataset(root, poses="gps"))


def test_wrong_options():
    with pytest.raises(ConfigError, match="need poses"):
        dataset("x", poses="", sweeps=2)
    with pytest.raises(ConfigError, match="sweeps must be at least 1"):
        dataset("x", sweeps=0)
    with pytest.raises(DataError, match="root is not set"):
        len(dataset(""))


# real drives


def test_real_objects_hold_points(real_data):
    data = dataset(real_data("kitti_tracking"), "all", poses="oxts_frames", classes=("Car", "Van", "Cyclist"))
    seen, counts = {}, []
    for i in range(len(data)):
        frame = data[i]
        boxes = frame.targets.boxes
        inside = points_in_boxes_mask(frame.inputs["points"].xyz, boxes.tensor).sum(0)
        counts += inside[(boxes.center.norm(dim=1) < 25) & (boxes.occlusion == 0)].tolist()
        for identity, label in zip(frame.targets.tracks.id.tolist(), boxes.label.tolist()):
            seen.setdefault(identity, set()).add(label)
    assert len(data) == 22
    assert len(counts) > 40
    assert min(counts) >= 10
    assert all(len(labels) == 1 for labels in seen.values())


def test_real_poses_agree(real_data):
    """The inertial unit and stereo odometry describe the same path: 5 m in 16 scans, apart by no more than 0.6 m."""
    root = real_data("kitti_tracking")
    paths = []
    for name in ("oxts_frames", "pose_orbslam3"):
        poses = dataset(root, poses=name).drives[0].poses[:17]
        paths.append((np.linalg.inv(poses[0]) @ poses)[:, :3, 3])
    assert 4.5 < paths[0][-1, 0] < 5.6
    assert np.linalg.norm(paths[0] - paths[1], axis=1).max() < 0.6
