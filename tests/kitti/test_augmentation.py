"""Augmentations move points, labels, poses and calibration together."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from lidarfw.components.datasets.kitti import KittiDataset
from lidarfw.components.transforms.augmentation import RandomFlip, RandomRotation, RandomScaling, move_frame
from lidarfw.components.transforms.crop import Crop
from lidarfw.errors import ConfigError
from lidarfw.ops import box_corners, points_in_boxes_mask
from lidarfw.types import (
    BEV,
    Boxes,
    Frame,
    FrameMeta,
    Grid,
    Image,
    PointLabels,
    Points,
    Poses,
    Targets,
    Tracks,
)


def rotation(angle):
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]])


MATRICES = {
    "mirrored about x": np.diag([1.0, -1, 1]),
    "mirrored about y": np.diag([-1.0, 1, 1]),
    "turned": rotation(0.6),
    "scaled": np.eye(3) * 1.05,
    "all": np.diag([1.0, -1, 1]) @ rotation(-2.5) @ np.eye(3) * 0.95,
}


@pytest.fixture
def frame(kitti_root):
    """A KITTI frame with picture, and made-up velocities, poses, tracks and point labels."""
    frame = KittiDataset(root=str(kitti_root), split="train", image=True)[0]
    boxes, count = frame.targets.boxes, len(frame.inputs["points"])
    boxes.velocity = torch.tensor([[3.0, 1.0], [0.5, -0.5], [0.0, 2.0]])
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3] = torch.tensor([[0.0, -1, 0, 100], [1, 0, 0, 50], [0, 0, 1, 2]])
    frame.inputs["pose"] = Poses(pose[None].float(), torch.ones(1, dtype=torch.bool), torch.ones(1))
    frame.targets = frame.targets.replace(
        poses=Poses(pose[None], torch.ones(1, dtype=torch.bool), torch.ones(1)),
        tracks=Tracks(boxes, torch.arange(3)),
        points=PointLabels(torch.ones(count, 1), torch.zeros(count, dtype=torch.long)),
    )
    return frame


@pytest.mark.parametrize("name", MATRICES)
def test_boxes_move_with_their_points(frame, name):
    moved = move_frame(frame, MATRICES[name])
    before = points_in_boxes_mask(frame.inputs["points"].xyz, frame.targets.boxes.tensor)
    after = points_in_boxes_mask(moved.inputs["points"].xyz, moved.targets.boxes.tensor)
    assert torch.equal(before, after)
    assert before.sum(0).min() >= 20
    old, new = box_corners(frame.targets.boxes.tensor), box_corners(moved.targets.boxes.tensor)
    expected = old @ torch.tensor(MATRICES[name].T, dtype=torch.float32)
    distance = torch.cdist(expected, new).min(2).values  # a mirror changes the order of the corners
    assert distance.max() < 1e-4
    heading = new[:, 0] + new[:, 3] - new[:, 1] - new[:, 2]  # front less back
    expected_heading = expected[:, 0] + expected[:, 3] - expected[:, 1] - expected[:, 2]
    assert torch.allclose(heading, expected_heading, atol=1e-4)
    assert (moved.targets.boxes.yaw.abs() <= math.pi + 1e-6).all()
    assert torch.equal(moved.targets.tracks.boxes.center, moved.targets.boxes.center)
    assert torch.equal(moved.targets.boxes.occlusion, frame.targets.boxes.occlusion)


@pytest.mark.parametrize("name", MATRICES)
def test_points_keep_their_pixels_and_their_place_in_the_map(frame, name):
    moved = move_frame(frame, MATRICES[name])
    for old, new in [
        (frame.meta.cameras["image"], moved.meta.cameras["image"]),
        (frame.meta.cameras["rectified"], moved.meta.cameras["rectified"]),
        (frame.inputs["image"].cameras[0], moved.inputs["image"].cameras[0]),
    ]:
        uv, _, valid = old.project(frame.inputs["points"].xyz.double())
        moved_uv, _, moved_valid = new.project(moved.inputs["points"].xyz.double())
        assert torch.allclose(uv, moved_uv, atol=0.01)
        assert torch.equal(valid, moved_valid)
        assert valid.sum() > 80
    assert torch.equal(moved.inputs["image"].features, frame.inputs["image"].features)
    for old, new in [
        (frame.inputs["pose"], moved.inputs["pose"]),
        (frame.targets.poses, moved.targets.poses),
    ]:
        assert torch.allclose(_in_map(frame, old), _in_map(moved, new), atol=1e-3)


def _in_map(frame, poses):
    xyz = frame.inputs["points"].xyz.double()
    return xyz @ poses.matrix[0, :3, :3].double().T + poses.matrix[0, :3, 3].double()


@pytest.mark.parametrize("name", MATRICES)
def test_velocity_is_that_of_the_moved_centre(frame, name):
    moved = move_frame(frame, MATRICES[name])
    boxes = frame.targets.boxes
    later = boxes.center.clone()
    later[:, :2] += boxes.velocity
    moved_later = later @ torch.tensor(MATRICES[name].T, dtype=torch.float32)
    expected = (moved_later - moved.targets.boxes.center)[:, :2]
    assert torch.allclose(moved.targets.boxes.velocity, expected, atol=1e-4)


def test_the_frame_given_stays_as_it_was(frame):
    xyz, center = frame.inputs["points"].xyz.clone(), frame.targets.boxes.center.clone()
    move_frame(frame, MATRICES["all"])
    assert torch.equal(frame.inputs["points"].xyz, xyz)
    assert torch.equal(frame.targets.boxes.center, center)


def test_neutral_objects_and_picture_boxes(frame):
    moved = move_frame(frame, MATRICES["scaled"])
    assert torch.allclose(moved.targets.ignored.size[0], frame.targets.ignored.size[0] * 1.05)
    assert moved.targets.ignored.size[2].tolist() == [0, 0, 0]
    assert torch.equal(moved.targets.ignored.box2d, frame.targets.ignored.box2d)


def test_flip_takes_its_axes_with_its_probability(frame):
    flip = RandomFlip(axes=("x", "y"), probability=0.5)
    first = frame.inputs["points"].xyz[0]
    signs = []
    for seed in range(200):
        moved = flip(frame, np.random.default_rng(seed)).inputs["points"].xyz[0]
        signs.append(tuple((moved / first).round().int().tolist()))
    counts = {s: signs.count(s) for s in set(signs)}
    assert set(counts) == {(1, 1, 1), (1, -1, 1), (-1, 1, 1), (-1, -1, 1)}
    assert min(counts.values()) > 25
    assert RandomFlip(probability=0.0)(frame, np.random.default_rng(0)) is frame
    flipped = RandomFlip(probability=1.0)(frame, np.random.default_rng(0)).inputs["points"].xyz[0]
    assert torch.equal(flipped, first * torch.tensor([1.0, -1, 1]))


def test_rotation_and_scaling_stay_in_their_ranges(frame):
    first = frame.inputs["points"].xyz[0].double()
    angles, factors = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        turned = RandomRotation(angle=0.3)(frame, rng).inputs["points"].xyz[0].double()
        cross, dot = first[0] * turned[1] - first[1] * turned[0], first[:2] @ turned[:2]
        angles.append(math.atan2(cross, dot))
        scaled = RandomScaling(low=0.9, high=1.2)(frame, rng).inputs["points"].xyz[0].double()
        factors.append(float(scaled.norm() / first.norm()))
    assert -0.3 <= min(angles) < -0.2
    assert 0.2 < max(angles) <= 0.3
    assert 0.9 - 1e-6 <= min(factors) < 0.95
    assert 1.15 < max(factors) <= 1.2 + 1e-6


def test_the_same_generator_gives_the_same_frame(frame):
    for transform in (RandomFlip(), RandomRotation(), RandomScaling()):
        a, b = (transform(frame, np.random.default_rng(5)).inputs["points"].xyz for _ in range(2))
        assert torch.equal(a, b)
        assert transform.train_only


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: RandomFlip(axes=("z",)), "axes"),
        (lambda: RandomFlip(probability=1.5), "probability"),
        (lambda: RandomRotation(angle=45.0), "radians"),
        (lambda: RandomScaling(low=1.1, high=0.9), "low"),
        (lambda: Crop(lower=(0, 0, 0), upper=(1, 0, 1)), "lower < upper"),
    ],
)
def test_wrong_options_are_refused(make, word):
    with pytest.raises(ConfigError, match=word):
        make()


def test_views_made_before_are_refused(frame):
    grid = Grid((0, 0, 0), (1, 1, 1), (1, 1, 1))
    frame.inputs["map"] = BEV(torch.zeros(1, 1, 1, 1), grid)
    with pytest.raises(ConfigError, match="before the transform that makes it"):
        move_frame(frame, np.eye(3))


def test_empty_frames_move_too():
    points = Points.from_scan(torch.zeros(0, 3), torch.zeros(0, 1))
    frame = Frame({"points": points}, Targets(boxes=Boxes.empty()), FrameMeta("0"))
    moved = RandomRotation()(frame, np.random.default_rng(0))
    assert len(moved.inputs["points"]) == len(moved.targets.boxes) == 0


# crop


def small_frame():
    xyz = torch.tensor([[0.0, 0, 0], [10, 0, 0], [9.99, -5, 0], [5, 0, 1.0], [5, 0, -1]])
    boxes = Boxes.from_tensor(torch.tensor([[9.9, 0, 0, 4, 2, 1, 0], [10.1, 0, 0, 4, 2, 1, 0]]), torch.tensor([0, 0]))
    ignored = Boxes.from_tensor(torch.tensor([[20.0, 0, 0, 4, 2, 1, 0], [0] * 7]), torch.tensor([0, -1]))
    targets = Targets(
        boxes=boxes,
        ignored=ignored,
        points=PointLabels(torch.eye(5), torch.zeros(5, dtype=torch.long)),
        tracks=Tracks(boxes, torch.tensor([7, 8])),
    )
    inputs = {"points": Points.from_scan(xyz, torch.arange(5.0)[:, None]), "image": Image(torch.zeros(1, 3, 1, 1), ())}
    return Frame(inputs, targets, FrameMeta("0"))


def test_crop():
    crop = Crop(lower=(0, -5, -1), upper=(10, 5, 1))
    cropped = crop(small_frame(), np.random.default_rng(0))
    assert cropped.inputs["points"].features[:, 0].tolist() == [0, 2, 4]  # the lower edge is inside, the upper is not
    assert cropped.targets.points.label.tolist() == [0, 2, 4]
    assert cropped.targets.boxes.center[:, 0].tolist() == pytest.approx([9.9])
    assert cropped.targets.ignored.label.tolist() == [-1]
    assert cropped.targets.tracks.id.tolist() == [7]
    assert crop.train_only


def test_crop_of_points_alone_serves_evaluation_too():
    crop = Crop(lower=(0, -5, -1), upper=(10, 5, 1), boxes=False)
    cropped = crop(small_frame(), np.random.default_rng(0))
    assert len(cropped.inputs["points"]) == 3
    assert len(cropped.targets.boxes) == len(cropped.targets.ignored) == 2
    assert not crop.train_only
