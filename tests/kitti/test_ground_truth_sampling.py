"""The database of objects and pasting from it."""

from __future__ import annotations

import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch

from lidarfw import cli
from lidarfw.components.datasets.kitti import KittiDataset
from lidarfw.components.transforms import object_database
from lidarfw.components.transforms.ground_truth_sampling import GroundTruthSampling
from lidarfw.components.transforms.object_database import ObjectDatabase
from lidarfw.errors import ConfigError, DataError
from lidarfw.ops import iou_bev, points_in_boxes_mask
from lidarfw.types import Boxes, Frame, FrameMeta, PointLabels, Points, Targets

COUNTS = {"Car": 3, "Pedestrian": 2, "Cyclist": 2}


@pytest.fixture
def dataset(kitti_root):
    return KittiDataset(root=str(kitti_root), split="train")


@pytest.fixture
def folder(dataset, tmp_path):
    return object_database.build(dataset, tmp_path / "database")


def sampling(folder, dataset, **options):
    transform = GroundTruthSampling(database=str(folder), **{"counts": COUNTS, "min_points": 1} | options)
    assert transform.spec(dataset.spec) == dataset.spec
    transform.attach(dataset)
    return transform


def empty_frame(points=0):
    """A frame without objects, `points` of ground far away."""
    xyz = torch.cat([torch.rand(points, 2) * 10 + 50, torch.full((points, 1), -1.66)], 1)
    return Frame(
        {"points": Points.from_scan(xyz, torch.zeros(points, 1))},
        Targets(boxes=Boxes.empty(), ignored=Boxes.empty()),
        FrameMeta("000000"),
    )


def test_database_holds_the_objects_and_their_points(dataset, folder):
    database = ObjectDatabase.load(folder)
    frames = [dataset[i] for i in range(2)]
    truth = Boxes.cat([f.targets.boxes for f in frames])
    assert torch.equal(database.boxes.tensor, truth.tensor)
    assert torch.equal(database.boxes.label, truth.label)
    assert torch.equal(database.boxes.occlusion, truth.occlusion)
    for row, (frame, place) in enumerate((f, i) for f in frames for i in range(3)):
        points = frame.inputs["points"]
        inside = points_in_boxes_mask(points.xyz, frame.targets.boxes.tensor)[:, place]
        cut, owner = database.points_of(np.array([row]))
        assert torch.equal(cut.xyz, points.xyz[inside])
        assert torch.equal(cut.features, points.features[inside])
        assert owner.tolist() == [0] * len(cut)
        assert len(cut) >= 20


def test_two_processes_write_the_same_database(dataset, folder, tmp_path):
    other = object_database.build(dataset, tmp_path / "other", workers=2)
    for name in ("objects.npz", "points.npy"):
        assert (folder / name).read_bytes() == (other / name).read_bytes()
    assert sorted(path.name for path in folder.iterdir()) == ["objects.npz", "points.npy"]


def test_an_interrupted_build_goes_on_where_it_stopped(dataset, folder, tmp_path, monkeypatch):
    broken = tmp_path / "broken"
    cut, seen = object_database._cut, []

    def stops(dataset, index, parts):
        seen.append(index)
        if index == 1 and seen.count(1) == 1:
            raise KeyboardInterrupt
        cut(dataset, index, parts)

    monkeypatch.setattr(object_database, "_cut", stops)
    with pytest.raises(KeyboardInterrupt):
        object_database.build(dataset, broken)
    with pytest.raises(DataError, match="lidarfw prepare"):
        ObjectDatabase.load(broken)
    part = next(broken.glob("parts-*")) / "1.npz"
    part.write_bytes(b"half a file")  # as a crash of the machine might leave it
    object_database.build(dataset, broken)
    assert seen == [0, 1, 1]
    assert (broken / "points.npy").read_bytes() == (folder / "points.npy").read_bytes()
    object_database.build(dataset, broken)
    assert seen == [0, 1, 1]  # nothing is done twice


def test_other_options_build_anew(dataset, folder, kitti_root):
    object_database.build(KittiDataset(root=str(kitti_root), split="train", classes=("Car",)), folder)
    assert ObjectDatabase.load(folder).classes == ("Car",)


class FromOneOn(KittiDataset):
    """Keeps its option under no name of its own."""

    def __init__(self, *, root: str, split: str = "train", begin: int = 0, workers: int = 0) -> None:
        super().__init__(root=root, split=split)
        self._order = [begin, 1 - begin]

    def __getitem__(self, index):
        return super().__getitem__(self._order[index])


def test_an_option_that_the_dataset_does_not_show_builds_anew(kitti_root, tmp_path, monkeypatch):
    cut, seen = object_database._cut, []

    def counted(dataset, index, parts):
        seen.append(index)
        cut(dataset, index, parts)

    monkeypatch.setattr(object_database, "_cut", counted)
    for options, frames in (({}, 2), ({"begin": 1}, 4), ({"begin": 1, "workers": 3}, 4), ({"begin": 0}, 6)):
        object_database.build(FromOneOn(root=str(kitti_root), **options), tmp_path / "database")
        assert len(seen) == frames


def test_a_broken_frame_is_named(dataset, tmp_path, kitti_root):
    (kitti_root / "training/velodyne/000001.bin").write_bytes(b"123")
    for workers in (1, 2):
        with pytest.raises(DataError, match=r"000001\.bin"):
            object_database.build(dataset, tmp_path / "new", workers)


def test_pasting_fills_the_scene_up(dataset, folder):
    transform = sampling(folder, dataset)
    frame = empty_frame(100)
    filled = transform(frame, np.random.default_rng(0))
    boxes, points = filled.targets.boxes, filled.inputs["points"]
    # both frames hold the same three objects in the same places, so one of each fits
    assert sorted(boxes.label.tolist()) == [0, 1, 2]
    inside = points_in_boxes_mask(points.xyz, boxes.tensor)
    assert len(points) == 100 + int(inside.sum())
    assert inside.sum(0).min() >= 20
    assert torch.equal(points.xyz[:100], frame.inputs["points"].xyz)
    assert (boxes.score == 1).all()
    assert len(frame.targets.boxes) == 0
    assert transform.train_only


def test_nothing_collides_and_counts_hold(dataset, folder):
    """Objects that stand there already count, and nothing is put where they or neutral objects are."""
    transform = sampling(folder, dataset)
    frame = dataset[0]
    for seed in range(5):
        filled = transform(frame, np.random.default_rng(seed))
        assert torch.equal(filled.targets.boxes.tensor, frame.targets.boxes.tensor)  # every place is taken
    moved = frame.replace(targets=frame.targets.replace(boxes=frame.targets.boxes[1:]))
    filled = transform(moved, np.random.default_rng(0))
    assert filled.targets.boxes.label.tolist() == [1, 2, 0]
    neutral = moved.replace(targets=moved.targets.replace(ignored=frame.targets.boxes[:1]))
    assert transform(neutral, np.random.default_rng(0)).targets.boxes.label.tolist() == [1, 2]
    enough = sampling(folder, dataset, counts={"Car": 0, "Pedestrian": 1, "Cyclist": 1})
    assert enough(moved, np.random.default_rng(0)).targets.boxes.label.tolist() == [1, 2]


def test_pasted_boxes_do_not_overlap_each_other(dataset, tmp_path, kitti_root):
    path = kitti_root / "training/label_2/000001.txt"  # the second frame's objects 1 m to the side, cars overlap
    path.write_text(path.read_text().replace("-5.00 1.60", "-4.00 1.60").replace("1.00 1.60 14.00", "-1.50 1.60 14.00"))
    transform = sampling(object_database.build(dataset, tmp_path / "new"), dataset, min_points=0)
    kinds = set()
    for seed in range(20):
        boxes = transform(empty_frame(), np.random.default_rng(seed)).targets.boxes
        overlap = iou_bev(boxes.tensor, boxes.tensor) - torch.eye(len(boxes))
        assert overlap.max() < 1e-5
        kinds.add(tuple(boxes.label.tolist()))
        assert boxes.label.tolist().count(0) == 1
        assert boxes.label.tolist().count(2) == 2
    assert (
        len({float(transform(empty_frame(), np.random.default_rng(s)).targets.boxes.center[0, 1]) for s in range(9)})
        == 2
    )


def test_scene_points_inside_a_pasted_box_go(dataset, folder):
    transform = sampling(folder, dataset)
    center = ObjectDatabase.load(folder).boxes.center[:1]
    frame = empty_frame(10)
    frame.inputs["points"] = Points.cat([frame.inputs["points"], Points.from_scan(center, torch.full((1, 1), 0.77))])
    labels = torch.eye(11)
    frame.targets.points = PointLabels(labels, torch.zeros(11, dtype=torch.long))
    filled = transform(frame, np.random.default_rng(0))
    points = filled.inputs["points"]
    assert not (points.features == 0.77).any()
    assert len(filled.targets.points) == len(points)
    assert filled.targets.points.label.tolist() == [*range(10), *[-1] * (len(points) - 10)]


def test_min_points(dataset, folder):
    transform = sampling(folder, dataset, min_points=1000)
    assert len(transform(empty_frame(), np.random.default_rng(0)).targets.boxes) == 0


def test_road_plane(dataset, folder, kitti_root):
    """The frame's ground is 1 m lower: objects go down with it, and their points with them."""
    for plane in (kitti_root / "training/planes").iterdir():
        plane.write_text("# Matrix\nWIDTH 4\nHEIGHT 1\n0.0 -1.0 0.0 2.6\n")
    low = sampling(folder, dataset, road_plane=True)(empty_frame(), np.random.default_rng(0))
    flat = sampling(folder, dataset)(empty_frame(), np.random.default_rng(0))
    assert torch.allclose(low.targets.boxes.center[:, 2], flat.targets.boxes.center[:, 2] - 1, atol=1e-4)
    assert torch.allclose(low.inputs["points"].xyz[:, 2], flat.inputs["points"].xyz[:, 2] - 1, atol=1e-4)
    assert torch.equal(low.inputs["points"].xyz[:, :2], flat.inputs["points"].xyz[:, :2])


def test_draws_depend_on_the_generator_alone(dataset, folder):
    transform = sampling(folder, dataset)
    a, b = (transform(empty_frame(), np.random.default_rng(4)).inputs["points"].xyz for _ in range(2))
    assert torch.equal(a, b)


def test_errors(dataset, folder, kitti_root, tmp_path):
    with pytest.raises(DataError, match="lidarfw prepare"):
        sampling(tmp_path / "none", dataset)
    with pytest.raises(DataError, match="split 'train'"):
        sampling(folder, KittiDataset(root=str(kitti_root), split="val"))
    with pytest.raises(ConfigError, match="Lorry"):
        sampling(folder, dataset, counts={"Lorry": 3})
    with pytest.raises(ConfigError, match="would not show"):
        sampling(folder, KittiDataset(root=str(kitti_root), split="train", image=True))
    with pytest.raises(ConfigError, match="database"):
        GroundTruthSampling().attach(dataset)
    with pytest.raises(ConfigError, match="attach"):
        GroundTruthSampling(database=str(folder))(empty_frame(), np.random.default_rng(0))
    with pytest.raises(ConfigError, match="0 or more"):
        GroundTruthSampling(counts={"Car": -1})
    (folder / "points.npy").write_bytes((folder / "points.npy").read_bytes()[:-50])
    with pytest.raises(DataError, match="broken"):
        sampling(folder, dataset)


def test_prepare_command(kitti_root, tmp_path, capsys):
    database = tmp_path / "database"
    overrides = ["dataset=kitti", f"dataset.kitti.root={kitti_root}", "transform=ground_truth_sampling"]
    overrides += [f"transform.ground_truth_sampling.database={database}"]
    assert cli.main(["prepare", *overrides, "--workers", "1"]) == 0
    assert "train: 2 frames" in capsys.readouterr().out
    assert ObjectDatabase.load(database).split == "train"
    shutil.rmtree(kitti_root / "training" / "velodyne")
    assert cli.main(["prepare", *overrides, "--workers", "1"]) == 2
    assert "velodyne" in capsys.readouterr().err


def test_killed_build_resumes(kitti_root, tmp_path):
    """SIGKILL at any moment leaves either no database or a whole one, and the next build completes it."""
    code = (
        "from lidarfw.components.datasets.kitti import KittiDataset as K\n"
        "from lidarfw.components.transforms import object_database as d\n"
        "import os, signal, numpy as np\n"
        f"real, left = np.savez, int(os.environ['SAVES'])\n"
        "def save(path, **arrays):\n"
        "    global left\n"
        "    real(path, **arrays)\n"
        "    left -= 1\n"
        "    if left == 0: os.kill(os.getpid(), signal.SIGKILL)\n"
        "d.np.savez = save\n"
        f"d.build(K(root={str(kitti_root)!r}, split='all'), {str(tmp_path / 'database')!r})\n"
    )
    for saves in (2, 3):
        done = subprocess.run([sys.executable, "-c", code], env={"SAVES": str(saves), "PATH": ""}, check=False)
        assert done.returncode == -9
        with pytest.raises(DataError):
            ObjectDatabase.load(tmp_path / "database")
    object_database.build(KittiDataset(root=str(kitti_root), split="all"), tmp_path / "database")
    assert len(ObjectDatabase.load(tmp_path / "database").boxes) == 9
