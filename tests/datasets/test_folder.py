"""A folder of one's own scans: formats, sequences, poses, labels, broken files."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch

from lidarfw.components.datasets.folder import FolderDataset
from lidarfw.errors import ConfigError, DataError
from lidarfw.testing.checks import run_checks
from lidarfw.types import Boxes, DataSpec, PointLabels, Poses, Tracks

CLASSES = ("car", "tree")
POSES = "1 0 0 0 0 1 0 0 0 0 1 0\n0 -1 0 5 1 0 0 0 0 0 1 0\n"  # the second 5 m ahead, turned to the left


def cloud(points, columns=4, seed=0):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-20, 20, (points, 3)), rng.uniform(0, 1, (points, columns - 3))]).astype("<f4")


def write_sequence(folder, count=2):
    for name in ("points", "boxes", "labels"):
        (folder / name).mkdir(parents=True)
    for number in range(count):
        cloud(10, seed=number).tofile(folder / "points" / f"scan_{number + 9}.bin")
        rows = "car 1 2 0.5 4 1.8 1.5 0.3 12\ntruck 9 9 1 9 3 3 0 13\n"
        (folder / "boxes" / f"scan_{number + 9}.txt").write_text(rows)
        (np.arange(10) % 3 + (5 << 16)).astype("<u4").tofile(folder / "labels" / f"scan_{number + 9}.label")
    (folder / "poses.txt").write_text(POSES)
    (folder / "times.txt").write_text("100\n100.5\n")


@pytest.fixture
def root(tmp_path):
    """Two sequences with everything, and a list of the second."""
    for name in ("a", "b"):
        write_sequence(tmp_path / name)
    (tmp_path / "val.txt").write_text("b\n")
    return tmp_path


def dataset(root, **options):
    return FolderDataset(root=str(root), **options)


def test_a_folder_of_scans_of_any_format(tmp_path):
    folder = tmp_path / "yard"
    folder.mkdir()
    table = cloud(5)
    np.save(folder / "scan_10.npy", table)
    table.tofile(folder / "scan_2.bin")
    np.savez(folder / "scan_1.npz", points=table)
    header = "ply\nformat ascii 1.0\nelement vertex 5\n" + "".join(
        f"property float {n}\n" for n in ("x", "y", "z", "intensity")
    )
    (folder / "scan_11.ply").write_text(
        header + "end_header\n" + "".join(" ".join(map(str, r)) + "\n" for r in table.tolist())
    )
    data = dataset(folder)
    assert [data.meta(i).id for i in range(4)] == ["yard/scan_1", "yard/scan_2", "yard/scan_10", "yard/scan_11"]
    assert [data.meta(i).time for i in range(4)] == pytest.approx([0, 0.1, 0.2, 0.3])
    for index in range(4):
        assert torch.allclose(data[index].inputs["points"].xyz, torch.tensor(table[:, :3]))
        assert torch.allclose(data[index].inputs["points"].features, torch.tensor(table[:, 3:]))
    assert data.spec.targets == frozenset()


def test_sequences_and_splits(root):
    data = dataset(root)
    assert [d.name for d in data.drives] == ["a", "b"]
    assert [data.meta(i).id for i in range(4)] == ["a/scan_9", "a/scan_10", "b/scan_9", "b/scan_10"]
    assert [d.name for d in dataset(root, split="val").drives] == ["b"]
    assert [d.name for d in dataset(root, split="val+a").drives] == ["b", "a"]
    with pytest.raises(DataError, match=r"train: no such sequence, nor a list .*train.txt"):
        len(dataset(root, split="train"))


def test_labels(root):
    frame = dataset(root, classes=CLASSES, tracks=True, labels=True)[0]
    assert frame.targets.boxes.tensor.tolist() == [pytest.approx([1, 2, 0.5, 4, 1.8, 1.5, 0.3])]
    assert frame.targets.boxes.label.tolist() == [0]  # a truck is none of the classes
    assert frame.targets.tracks.id.tolist() == [12]
    assert frame.targets.points.label.tolist() == [-1, 0, 1] * 3 + [-1]
    assert set(frame.targets.points.instance.tolist()) == {5}


def test_past_scans_stand_in_the_current_frame(root):
    frame = dataset(root, poses=True, sweeps=2, pose=True, labels=True, classes=CLASSES)[1]
    now, past = cloud(10, seed=1), cloud(10, seed=0)
    points = frame.inputs["points"]
    expected = np.column_stack([past[:, 1], 5 - past[:, 0], past[:, 2]])  # its x is the map's y, its y the map's -x
    assert np.allclose(points.xyz, np.concatenate([now[:, :3], expected]), atol=1e-5)
    assert points.time.tolist() == [0] * 10 + [-0.5] * 10
    assert len(frame.targets.points) == 20
    assert frame.inputs["pose"].matrix[0, :3, 3].tolist() == [5, 0, 0]


def test_features_and_intensities(tmp_path):
    table = cloud(6, columns=5)
    table[:, 3] *= 255
    table.tofile(tmp_path / "s.bin")
    features = dataset(tmp_path, columns=5, features=2, full_intensity=255)[0].inputs["points"].features
    assert torch.allclose(features, torch.tensor(table[:, 3:] / [255, 1]).float())
    assert dataset(tmp_path, columns=5, features=0)[0].inputs["points"].features.shape == (6, 0)
    with pytest.raises(DataError, match=r"s.bin: intensity: expected 0..1.*\n.*full_intensity=255"):
        dataset(tmp_path, columns=5)[0]
    with pytest.raises(DataError, match=r"s.bin: expected 3 values after x, y, z, found intensity, ring"):
        dataset(tmp_path, columns=5, features=3, full_intensity=255)[0]


def test_spec_needs_no_disk():
    data = dataset("/nowhere", classes=CLASSES, tracks=True, labels=True, poses=True, sweeps=4, features=2)
    assert data.spec.targets == frozenset({Boxes, Tracks, PointLabels, Poses})
    assert (data.spec.sweeps, data.spec.inputs["points"].channels) == (4, 2)
    assert DataSpec.from_plain(data.spec.to_plain()) == data.spec


def test_import_and_spec_do_not_import_torch():
    code = (
        "import sys; from lidarfw.components.datasets.folder import FolderDataset as D; "
        "D(root='x').spec; sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    "options",
    [{}, {"classes": CLASSES, "tracks": True, "labels": True, "poses": True, "sweeps": 2, "pose": True}],
)
def test_keeps_the_rules_of_a_dataset(root, options, monkeypatch):
    monkeypatch.setattr(FolderDataset, "example", {"root": str(root), **options}, False)
    results = run_checks(FolderDataset)
    assert [r for r in results if r.status == "failed"] == []
    assert {"frames_match_the_spec", "frames_can_be_read_anywhere"} <= {
        r.check for r in results if r.status == "passed"
    }


@pytest.mark.parametrize(
    ("path", "content", "message"),
    [
        ("boxes/scan_9.txt", "car 1 2 3\n", r"boxes/scan_9.txt, line 1: expected 9 columns .* found 4"),
        ("boxes/scan_9.txt", "car 1 2 0 4 2 x 0 1\n", r"scan_9.txt, line 1: expected numbers after the class"),
        ("boxes/scan_9.txt", "\ncar 1 2 0 4 0 1 0 1\n", r"scan_9.txt, line 2: expected finite numbers and positive"),
        ("boxes/scan_9.txt", "car 1e300 2 0 4 1 1 0 1\n", r"scan_9.txt, line 1: expected finite numbers"),
        ("boxes/scan_9.txt", "car 1 2 0 4 1 1 0 7.2\n", r"scan_9.txt, line 1: expected a whole number .* found 7.2"),
        ("boxes/scan_9.txt", "car 1 2 0 4 1 1 0 1e300\n", r"scan_9.txt, line 1: expected a whole number .* 1e300"),
        ("boxes/scan_9.txt", "\ncar 1 2 0 4 1 1 0 7\ncar 9 2 0 4 1 1 0 7\n", r"line 3: .* once, 7 is in line 2 too"),
        ("labels/scan_9.label", b"\0" * 8, r"scan_9.label: expected 40 bytes"),
        ("labels/scan_9.label", b"\3\0\0\0" * 10, r"scan_9.label: expected labels 0 .. 2, found 3"),
        ("poses.txt", POSES * 2, r"poses.txt: expected 2 lines, one per scan, found 4"),
        ("times.txt", "1\n", r"times.txt: expected 2 lines"),
        ("times.txt", "2\n1\n", r"times.txt, line 2: goes back in time"),
        ("points/scan_9.bin", b"\0" * 17, r"scan_9.bin: 17 bytes is not a multiple of 16"),
        ("points/scan_9.npy", b"", r"scan_9.* and scan_9.*: a frame goes by its name"),
    ],
)
def test_broken_files_are_named(root, path, content, message):
    (root / "a" / path).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(DataError, match=message):
        dataset(root, classes=CLASSES, tracks=True, labels=True, poses=True)[0]


def test_nothing_there(tmp_path):
    with pytest.raises(DataError, match="has no frames: no scans there"):
        len(dataset(tmp_path))
    with pytest.raises(DataError, match="no such folder"):
        len(dataset(tmp_path / "nowhere"))
    with pytest.raises(DataError, match="root is not set"):
        len(dataset(""))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"boxes": True}, "labels need names"),
        ({"sweeps": 2}, "need poses.txt"),
        ({"sweeps": 0}, "sweeps must be at least 1"),
        ({"full_intensity": 0}, "must be positive"),
    ],
)
def test_wrong_options(options, message):
    with pytest.raises(ConfigError, match=message):
        dataset("x", **options)


def test_real_scans(real_data):
    """A drive of SemanticKITTI is a folder of scans with its poses given in the LiDAR's frame."""
    data = dataset(real_data("semantic_kitti/dataset/sequences/00/velodyne"))
    assert len(data) == 10
    assert len(data[3].inputs["points"]) > 100_000
