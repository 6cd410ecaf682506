"""The simulated street: physically consistent, deterministic, cheap."""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np
import pytest
import torch

from lidarfw.errors import ConfigError
from lidarfw.testing import scene
from lidarfw.testing.synthetic import CAMERA, SyntheticDataset, frames
from lidarfw.types import Boxes, Frame, collate


def in_box(xyz: torch.Tensor, box: torch.Tensor, margin: float = 0.1) -> torch.Tensor:
    """(N,) bool, points within a (7,) box grown by `margin`."""
    offset = xyz - box[:3]
    cos, sin = box[6].cos(), box[6].sin()
    local = torch.stack(
        [cos * offset[:, 0] + sin * offset[:, 1], cos * offset[:, 1] - sin * offset[:, 0], offset[:, 2]], 1
    )
    return (local.abs() < box[3:6] / 2 + margin).all(1)


@pytest.fixture(scope="module")
def street() -> list[Frame]:
    return frames(6, points=8192, image=True, pose=True)


def test_importing_the_dataset_does_not_import_torch() -> None:
    code = "import sys; from lidarfw.testing.synthetic import SyntheticDataset as D; D().spec"
    code += "; print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"


def test_a_frame_depends_on_seed_split_and_index_alone() -> None:
    def points(index: int = 3, **options: object) -> torch.Tensor:
        return SyntheticDataset(**options)[index].inputs["points"].xyz  # type: ignore[arg-type]

    again = SyntheticDataset()
    again[7]
    assert torch.equal(points(), again[3].inputs["points"].xyz)
    for other in (points(4), points(seed=2), points(split="val"), points(index=11)):
        assert other.shape != points().shape or not torch.equal(other, points())


def test_a_frame_is_cheap() -> None:
    dataset = SyntheticDataset()
    dataset[0]
    started = time.process_time()
    for index in range(20):
        dataset[index]
    assert (time.process_time() - started) / 20 < 0.03  # seconds; 0.003 on an idle core


def test_every_labelled_point_lies_in_the_box_of_its_object(street: list[Frame]) -> None:
    for frame in street:
        points, labels, tracks = frame.inputs["points"], frame.targets.points, frame.targets.tracks
        for box, label, track in zip(tracks.boxes.tensor, tracks.boxes.label, tracks.id, strict=True):
            own = labels.instance == track + 1
            assert own.sum() >= 10
            assert in_box(points.xyz[own], box).all()
            assert (labels.label[own] == label).all()
        assert len(points) == len(labels)
        assert points.features.shape == (len(points), 1)
        assert 0 <= points.features.min() <= points.features.max() <= 1


def test_nothing_is_seen_through_a_wall() -> None:
    wall = np.array([[10, 0, 0, 0.4, 30, 4, 0.0]])
    hits = scene.cast(
        np.array([0.0, 0.2]), np.zeros((2, 1)), np.vstack([wall, wall + np.eye(7)[:1] * 5]), [scene.CLUTTER] * 2
    )
    np.testing.assert_allclose(hits.distance[:, 0], [9.8, 9.8 / np.cos(0.2)])
    assert (hits.object == 0).all()


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, 0.7])
def test_rays_meet_a_turned_box_where_geometry_says(yaw: float) -> None:
    box = np.array([[20, 3, 0, 4, 2, 2, yaw]])
    aim = np.arctan2(3, 20)
    hits = scene.cast(np.array([aim]), np.zeros((1, 1)), box, [scene.CLUTTER])
    angle = aim - yaw
    to_side = min(2 / abs(np.cos(angle)), 1 / abs(np.sin(angle)))
    assert hits.distance[0, 0] == pytest.approx(np.hypot(20, 3) - to_side)


def test_objects_keep_identity_size_and_velocity_in_the_world(street: list[Frame]) -> None:
    places: dict[int, list[tuple[float, np.ndarray, np.ndarray, np.ndarray]]] = {}
    for frame in street:
        pose = frame.targets.poses.matrix[0]
        boxes: Boxes = frame.targets.tracks.boxes
        world = boxes.center @ pose[:3, :3].T + pose[:3, 3]
        velocity = boxes.velocity @ pose[:2, :2].T
        for row, track in enumerate(frame.targets.tracks.id.tolist()):
            entry = (frame.meta.time, world[row].numpy(), velocity[row].numpy(), boxes.size[row].numpy())
            places.setdefault(track, []).append(entry)
    long = [track for track in places.values() if len(track) > 2]
    assert long
    for first, *others in long:
        for moment, center, velocity, size in others:
            np.testing.assert_allclose(size, first[3], atol=1e-5)
            np.testing.assert_allclose(center[:2], first[1][:2] + velocity * (moment - first[0]), atol=1e-3)


def test_picture_and_pixel_boxes_agree(street: list[Frame]) -> None:
    box = max(street[0].targets.boxes.box2d, key=lambda b: float((b[2] - b[0]) * (b[3] - b[1])))
    picture = street[0].inputs["image"].features[0]
    assert picture.shape == (3, CAMERA.height, CAMERA.width)
    column, row = int(box[[0, 2]].mean()), int(box[[1, 3]].mean())
    assert picture[:, row, column].std() > 0.05  # road users are coloured, the street is grey


def test_past_sweeps_line_up_in_the_current_frame() -> None:
    frame = frames(4, sweeps=4, points=8192)[3]
    points = frame.inputs["points"]
    assert sorted({round(t, 2) for t in points.time.tolist()}) == [-0.3, -0.2, -0.1, 0.0]
    assert len(points) == len(frame.targets.points)
    still = frame.targets.boxes.moving == 0
    for box in frame.targets.boxes.tensor[still]:
        past = points.xyz[in_box(points.xyz, box) & (points.time < -0.25)]
        assert len(past) >= 1


def test_sequences_and_meta_agree_with_the_frames() -> None:
    dataset = SyntheticDataset(frames=10, sequence_length=4, points=64)
    assert [list(s) for s in dataset.sequences()] == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]
    assert dataset[5].meta == dataset.meta(5)
    assert (dataset.meta(5).sequence, dataset.meta(5).index) == ("train_0001", 1)
    assert dataset.meta(9).id != dataset.meta(8).id
    with pytest.raises(IndexError):
        dataset[10]
    assert len(collate([dataset[0], dataset[9]])) == 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"split": "trian"}, "no split 'trian'. Splits: train, val, test"),
        ({"classes": ("Tram",)}, "no class 'Tram'. Classes: Car, Pedestrian, Cyclist"),
        ({"classes": ()}, "at least one class"),
        ({"points": 3}, "dataset.synthetic.points must be at least 32, got 3"),
    ],
)
def test_wrong_options_are_named(options: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        SyntheticDataset(**options)  # type: ignore[arg-type]


def test_no_class_is_rare() -> None:
    dataset = SyntheticDataset(frames=64)
    counts = sum(torch.bincount(dataset[i].targets.boxes.label, minlength=3) for i in range(0, 64, 4))
    assert (counts >= 20).all()
