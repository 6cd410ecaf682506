"""SemanticKITTI on files of the official layout: classes, poses, past scans, splits, broken files, real scans."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial import cKDTree

from lidarfw.components.datasets.semantic_kitti import CLASSES, SemanticKittiDataset
from lidarfw.errors import ConfigError, DataError
from lidarfw.testing.checks import run_checks
from lidarfw.types import DataSpec, PointLabels, Poses

IDS = [0, 1, 10, 252, 40, 60, 99, 259, 81, 254]  # of the points of every tiny scan
SEMANTICS = [-1, -1, 0, 0, 8, 8, -1, 4, 18, 5]
MOVING = [-1, -1, 0, 1, 0, 0, 0, 1, 0, 1]
LAMP = np.array([20.0, 3.0, 1.0])  # a point that stands still, in the map
TR = "Tr: 0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.3"  # LiDAR -> camera


def lidar_pose(step):
    """Two metres ahead and 0.1 rad to the left with every scan."""
    turn = 0.1 * step
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    pose[:2, 3] = 2 * step, 0.1 * step**2
    return pose


def write_sequence(folder, scans=4, labels=True):
    extrinsics = np.eye(4)
    extrinsics[:3] = np.array(TR.split()[1:], float).reshape(3, 4)
    for name in ("velodyne", "labels"):
        (folder / name).mkdir(parents=True)
    (folder / "calib.txt").write_text("P0: 1 0 0 0 0 1 0 0 0 0 1 0\n" + TR + "\n")
    (folder / "times.txt").write_text("".join(f"{0.1 * step:e}\n" for step in range(scans)))
    lines = []
    for step in range(scans):
        pose = lidar_pose(step)
        camera = extrinsics @ pose @ np.linalg.inv(extrinsics)
        lines.append(" ".join(f"{value:.9g}" for value in camera[:3].ravel()))
        lamp = np.linalg.inv(pose) @ [*LAMP, 1]
        xyz = np.concatenate([lamp[None, :3], np.random.default_rng(step).uniform(-20, 20, (len(IDS) - 1, 3))])
        scan = np.column_stack([xyz, np.linspace(0, 1, len(IDS))]).astype("<f4")
        scan.tofile(folder / "velodyne" / f"{step:06d}.bin")
        if labels:
            (np.array(IDS) + (np.arange(len(IDS)) << 16)).astype("<u4").tofile(folder / "labels" / f"{step:06d}.label")
    (folder / "poses.txt").write_text("\n".join(lines) + "\n")


@pytest.fixture
def root(tmp_path):
    """Sequences 00 and 08 with labels, 11 without."""
    for name in ("00", "08", "11"):
        write_sequence(tmp_path / "sequences" / name, labels=name != "11")
    return tmp_path


def dataset(root, split="08", **options):
    return SemanticKittiDataset(root=str(root), split=split, **options)


def test_points_and_their_classes(root):
    frame = dataset(root, task="semantics")[1]
    raw = np.fromfile(root / "sequences/08/velodyne/000001.bin", "<f4").reshape(-1, 4)
    assert torch.equal(frame.inputs["points"].xyz, torch.tensor(raw[:, :3]))
    assert torch.equal(frame.inputs["points"].features, torch.tensor(raw[:, 3:]))
    assert frame.targets.points.label.tolist() == SEMANTICS
    assert frame.targets.points.instance.tolist() == list(range(10))
    assert (frame.meta.id, frame.meta.sequence, frame.meta.index) == ("08/000001", "08", 1)
    assert frame.meta.time == pytest.approx(0.1)


def test_moving_classes(root):
    data = dataset(root, task="moving")
    assert data.spec.classes == ("static", "moving")
    assert data[0].targets.points.label.tolist() == MOVING


def test_labels_of_kitti_road(root):
    """KITTI-Road has only 9 (static) and 251 (moving)."""
    np.array([9, 251] * 5, "<u4").tofile(root / "sequences/08/labels/000000.label")
    assert dataset(root, task="moving")[0].targets.points.label.tolist() == [0, 1] * 5
    assert dataset(root)[0].targets.points.label.tolist() == [-1] * 10


def test_poses_are_those_of_the_lidar(root):
    for step in range(4):
        poses = dataset(root)[step].targets.poses
        assert np.allclose(poses.matrix[0], lidar_pose(step), atol=1e-5)
    assert "pose" not in dataset(root)[0].inputs
    given = dataset(root, pose=True)[2].inputs["pose"]
    assert np.allclose(given.matrix[0], lidar_pose(2), atol=1e-5)


def test_past_scans_stand_in_the_current_frame(root):
    frame = dataset(root, sweeps=3)[3]
    points = frame.inputs["points"]
    assert points.time.view(3, -1)[:, 0].tolist() == pytest.approx([0, -0.1, -0.2])
    lamps = points.xyz[:: len(IDS)].numpy()  # the first point of every scan is the lamp
    assert np.allclose(lamps, lamps[0], atol=1e-4)
    assert frame.targets.points.label.tolist() == SEMANTICS * 3
    assert len(dataset(root, sweeps=3)[1].inputs["points"]) == 2 * len(IDS)  # the sequence starts


def test_ten_scans_a_second_without_times(root):
    (root / "sequences/08/times.txt").unlink()
    assert [dataset(root).meta(i).time for i in range(4)] == pytest.approx([0, 0.1, 0.2, 0.3])


def test_camera_where_the_picture_is_there(root):
    assert dataset(root)[0].meta.cameras == {}
    folder = root / "sequences/08"
    (folder / "image_2").mkdir()
    Image.new("RGB", (1226, 370)).save(folder / "image_2/000001.png")
    (folder / "calib.txt").write_text(f"P2: 700 0 600 70 0 700 180 0 0 0 1 0\n{TR}\n")
    meta = dataset(root)[1].meta
    assert meta.images == {"image": str(folder / "image_2/000001.png")}
    uv, depth, _ = meta.cameras["image"].project(torch.tensor([[10.3, 2.0, -0.7]]))
    # in camera 0: 1.9 m to the left, 0.5 m down, 10 m ahead; the picture's camera is 0.1 m to the left of it
    assert uv[0].tolist() == pytest.approx([600 - 700 * 0.18, 180 + 700 * 0.05], abs=1e-2)
    assert depth[0] == pytest.approx(10, abs=1e-4)


def test_splits(root):
    assert dataset(root, "all").named == []
    assert [d.name for d in dataset(root, "all").drives] == ["00", "08"]
    assert [d.name for d in dataset(root, "08+00").drives] == ["08", "00"]
    assert [list(s) for s in dataset(root, "all").sequences()] == [[0, 1, 2, 3], [4, 5, 6, 7]]
    assert dataset(root, "all").meta(5).id == "08/000001"
    assert dataset(root, "train").named == ["00", "01", "02", "03", "04", "05", "06", "07", "09", "10"]
    assert dataset(root, "val").named == ["08"]
    with pytest.raises(DataError, match=r"01/velodyne: no such folder"):
        len(dataset(root, "train"))


def test_unlabelled_sequences(root):
    data = dataset(root, "11")
    assert data.spec.targets == frozenset({Poses})
    assert data[0].targets.points is None
    data.prepare()


def test_spec_needs_no_disk():
    data = dataset("/nowhere", "train", task="moving", sweeps=5, pose=True)
    assert data.spec.targets == frozenset({PointLabels, Poses})
    assert (set(data.spec.inputs), data.spec.sweeps) == ({"points", "pose"}, 5)
    assert DataSpec.from_plain(data.spec.to_plain()) == data.spec


def test_import_and_spec_do_not_import_torch():
    code = (
        "import sys; from lidarfw.components.datasets.semantic_kitti import SemanticKittiDataset as D; "
        "D(root='x').spec; sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("task", ["semantics", "moving"])
def test_keeps_the_rules_of_a_dataset(root, task, monkeypatch):
    example = {"root": str(root), "split": "all", "task": task, "sweeps": 2, "pose": True}
    monkeypatch.setattr(SemanticKittiDataset, "example", example, False)
    results = run_checks(SemanticKittiDataset)
    assert [r for r in results if r.status == "failed"] == []
    assert {"frames_match_the_spec", "frames_can_be_read_anywhere"} <= {
        r.check for r in results if r.status == "passed"
    }


# what is wrong is said, with the file


def broken(root, path, content):
    file = root / "sequences/08" / path
    file.write_bytes(content if isinstance(content, bytes) else content.encode())


@pytest.mark.parametrize(
    ("path", "content", "message"),
    [
        ("labels/000000.label", b"\0" * 36, r"000000.label: expected 40 bytes .* 10 points\), found 36"),
        ("labels/000000.label", b"\7\0\0\0" * 10, r"000000.label: SemanticKITTI has no label 7"),
        ("velodyne/000000.bin", b"\0" * 30, r"000000.bin: 30 bytes is not a multiple of 16"),
        ("velodyne/000000.bin", np.full((10, 4), 7, "<f4").tobytes(), r"000000.bin: remission: expected 0..1"),
        ("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n", r"poses.txt: has 1 lines, but there is a scan 000003"),
        ("poses.txt", "1 0 0 0 0 1 0 0 0 0 1\n", r"poses.txt, line 1: expected 12 numbers, found 11"),
        ("poses.txt", "2 0 0 0 0 1 0 0 0 0 1 0\n" * 4, r"poses.txt, line 1: expected a rotation"),
        ("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 nan\n" * 4, r"poses.txt, line 1: expected finite numbers"),
        ("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 x\n" * 4, r"poses.txt: expected 12 numbers per line"),
        ("times.txt", "", r"times.txt: has 0 lines"),
        ("calib.txt", "P0: 1\n", r"calib.txt: no key Tr"),
        ("calib.txt", "Tr: 1 2\n", r"calib.txt: Tr: expected 12 numbers"),
    ],
)
def test_broken_files_are_named(root, path, content, message):
    broken(root, path, content)
    with pytest.raises(DataError, match=message):
        dataset(root)[0]


def test_missing_labels_show_before_training(root):
    (root / "sequences/08/labels/000002.label").unlink()
    with pytest.raises(DataError, match=r"08/labels: 1 of 4 label files are missing, the first is 000002.label"):
        dataset(root).prepare()
    with pytest.raises(DataError, match=r"000002.label: cannot be read"):
        dataset(root)[2]


def test_wrong_options():
    with pytest.raises(ConfigError, match="no task 'panoptic'"):
        dataset("x", task="panoptic")
    with pytest.raises(ConfigError, match="sweeps must be at least 1"):
        dataset("x", sweeps=0)
    with pytest.raises(DataError, match="root is not set"):
        len(dataset(""))
    with pytest.raises(DataError, match="must hold sequences"):
        len(dataset("/nowhere"))


# real scans


def test_real_scans_are_labelled(real_data):
    """Moving points a scan as published with the excerpt, and every task reads every scan."""
    root = real_data("semantic_kitti")
    bounds = {"00": (59, 88), "01": (239, 371), "04": (868, 2734), "05": (135, 200), "10": (68, 201)}
    for sequence, (least, most) in bounds.items():
        data = dataset(root, sequence, task="moving")
        counts = [int((data[i].targets.points.label == 1).sum()) for i in range(len(data))]
        assert (len(counts), min(counts), max(counts)) == (10, least, most)


def test_real_past_scans_fit(real_data):
    """Walls and poles of a scan 0.8 s ago lie on those of now, and do not without the poses."""
    root = real_data("semantic_kitti")
    upright = torch.tensor([CLASSES.index(c) for c in ("building", "fence", "trunk", "pole", "traffic-sign")])
    for sequence in ("00", "01", "04", "05", "10"):
        frame, first = dataset(root, sequence, sweeps=9)[8], dataset(root, sequence)[0]
        points = frame.inputs["points"]
        chosen = torch.isin(frame.targets.points.label, upright) & (points.xyz.norm(dim=1) < 25)
        now = cKDTree(points.xyz[chosen & (points.time == 0)])
        apart = now.query(points.xyz[chosen & (points.time < -0.75)])[0]
        still = torch.isin(first.targets.points.label, upright) & (first.inputs["points"].xyz.norm(dim=1) < 25)
        assert np.median(apart) < 0.08 < 3 * 0.08 < np.median(now.query(first.inputs["points"].xyz[still])[0])
