"""Pictures brought to size, boxes made of labels, and figures of tracks."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
import torch
from lidarfw.errors import ConfigError
from lidarfw.testing.examples import street
from lidarfw.testing.synthetic import SyntheticDataset
from lidarfw.types import Boxes, DataSpec, Frame, FrameMeta, Poses, Spec, Targets, Tracks

from lidarfw_time3d.monocular import Lens, overlap_2d, rectangles
from lidarfw_time3d.pictures import RandomPicture, ResizePicture
from lidarfw_time3d.simulated import LOOK, SimulatedDetector
from lidarfw_time3d.track_links import TrackLinks


def _framed() -> Frame:
    """A synthetic frame with rectangles on its labels, and a picture that is white inside them."""
    frame = street(1)[0]
    image = frame.inputs["image"]
    lens = Lens.of(image.cameras, "cpu")[torch.zeros(len(frame.targets.boxes), dtype=torch.long)]
    box2d = rectangles(frame.targets.boxes.tensor, lens).float()
    for left, top, right, bottom in box2d.round().int().tolist():
        image.features[:, :, top:bottom, left:right] = 1
    boxes = frame.targets.boxes.replace(box2d=box2d)
    return frame.replace(targets=frame.targets.replace(boxes=boxes, tracks=Tracks(boxes, frame.targets.tracks.id)))


@pytest.mark.parametrize(
    "change", [ResizePicture(width=208, height=96), RandomPicture(scale=0.2, shift=0.1)], ids=["resize", "random"]
)
def test_picture_camera_and_rectangles_change_together(change: ResizePicture | RandomPicture) -> None:
    frame = _framed()
    moved = change(frame, np.random.default_rng(3))
    image, boxes = moved.inputs["image"], moved.targets.boxes
    assert image.features.shape[2:] == (image.cameras[0].height, image.cameras[0].width)
    assert torch.equal(boxes.tensor, frame.targets.boxes.tensor)
    assert torch.equal(boxes.box2d, moved.targets.tracks.boxes.box2d)
    lens = Lens.of(image.cameras, "cpu")[torch.zeros(len(boxes), dtype=torch.long)]
    there = rectangles(boxes.tensor, lens).float()
    size = torch.tensor([image.cameras[0].width - 1, image.cameras[0].height - 1] * 2)
    inside = ((boxes.box2d > 0) & (boxes.box2d < size)).all(1)
    assert inside.any()
    assert overlap_2d(there[inside], boxes.box2d[inside]).diag().min() > 0.95
    for left, top, right, bottom in boxes.box2d[inside].tolist():
        middle = image.features[0, :, round((top + bottom) / 2), round((left + right) / 2)]
        assert middle.min() > 0.9


def test_pictures_are_asked_for() -> None:
    with pytest.raises(ConfigError, match="option image"):
        ResizePicture().spec(DataSpec())
    with pytest.raises(ConfigError, match="above 0"):
        ResizePicture(width=0)
    with pytest.raises(ConfigError, match="scale and shift"):
        RandomPicture(scale=0.7)


def _seen(noise: str, frames: int = 40) -> tuple[torch.Tensor, torch.Tensor, list[Frame]]:
    """Distance from an object and error of every box that is near to one."""
    detector, far, error, found = SimulatedDetector(noise=noise), [], [], []
    for number, frame in enumerate(SyntheticDataset(frames=frames, sequence_length=frames, points=2048, pose=True)):
        frame = detector(frame, np.random.default_rng(number))
        found.append(frame)
        apart = torch.cdist(frame.inputs["boxes"].center[:, :2], frame.targets.tracks.boxes.center[:, :2])
        near = apart.min(1)
        good = near.values < 5
        far.append(frame.targets.tracks.boxes.center[near.indices[good], :2].norm(dim=1))
        error.append(near.values[good])
    return torch.cat(far), torch.cat(error), found


def test_errors_of_the_simulated_detector() -> None:
    _, lidar, found = _seen("lidar")
    assert 0.08 < float(lidar.median()) < 0.2  # 0.1 m along x and y
    boxes = found[0].inputs["boxes"]
    assert boxes.embedding.shape == (len(boxes), LOOK)
    assert set(found[0].inputs) == {"pose", "boxes"}
    distance, mono, _ = _seen("mono")
    assert mono[distance > 25].median() > 2 * mono[distance < 12].median()
    objects = sum(len(frame.targets.tracks.id) for frame in found)
    seen = sum(len(frame.inputs["boxes"]) for frame in found)
    assert 0.8 < seen / objects < 1.1  # a tenth is missed, and there are false ones


def test_the_simulated_detector_repeats_itself_and_tells_frames_apart() -> None:
    frames, detector = street(2), SimulatedDetector()
    one, again, other = (detector(frame, np.random.default_rng(5)) for frame in (frames[0], frames[0], frames[1]))
    assert torch.equal(one.inputs["boxes"].tensor, again.inputs["boxes"].tensor)
    first = one.inputs["boxes"].center[0] - frames[0].targets.tracks.boxes.center[0]
    second = other.inputs["boxes"].center[0] - frames[1].targets.tracks.boxes.center[0]
    assert not torch.allclose(first, second, atol=1e-4)
    with pytest.raises(ConfigError, match="tracks"):
        detector.spec(DataSpec())


def test_appearance_tells_most_objects_apart() -> None:
    looks: dict[int, list[torch.Tensor]] = {}
    for frame in _seen("lidar", 6)[2]:
        boxes, known = frame.inputs["boxes"], frame.targets.tracks
        near = torch.cdist(boxes.center[:, :2], known.boxes.center[:, :2]).min(1)
        for row in (near.values < 1).nonzero()[:, 0].tolist():
            looks.setdefault(int(known.id[near.indices[row]]), []).append(boxes.embedding[row])
    same = [torch.cosine_similarity(a[0], a[1], dim=0) for a in looks.values() if len(a) > 1]
    first = [a[0] for a in looks.values()]
    other = [torch.cosine_similarity(a, b, dim=0) for a, b in itertools.pairwise(first)]
    assert torch.stack(same).median() > 0.6
    assert torch.stack(other).abs().median() < 0.3


SPEC = Spec(Tracks, classes=("Car",))


def _sequence(ids: list[list[int]], noise: float = 0.0) -> TrackLinks:
    """Two cars that drive 1 m a frame, tracked under `ids`, every second frame `noise` too far."""
    metric = TrackLinks(SPEC)
    for t, own in enumerate(ids):
        table = torch.tensor([[10.0 + t, 0, 0, 4, 2, 1.5, 0], [20 + t, 6, 0, 4, 2, 1.5, 0]])
        truth = Boxes.from_tensor(table, torch.zeros(2, dtype=torch.long))
        found = truth.replace(center=truth.center + torch.tensor([noise * (t % 2), 0, 0])[None])
        found = found.replace(velocity=torch.tensor([[10.0, 0]] * 2))
        meta = FrameMeta(str(t), "s", t, t / 10)
        known = Targets(tracks=Tracks(truth, torch.tensor([5, 6])))
        rows = torch.tensor([k for k, i in enumerate(own) if i >= 0], dtype=torch.long)
        metric.update(Tracks(found[rows], torch.tensor(own)[rows]), known, [meta])
    return metric


def test_links_switches_and_gaps() -> None:
    figures = _sequence([[1, 2]] * 4).compute()
    assert (figures["accuracy"], figures["switches"], figures["linkable"]) == (1, 0, 6)
    assert figures["jitter"] == pytest.approx(0, abs=1e-6)
    assert figures["velocity_error"] == pytest.approx(0, abs=1e-4)
    swapped = _sequence([[1, 2], [1, 2], [2, 1], [2, 1]]).compute()
    assert (swapped["accuracy"], swapped["switches"]) == (pytest.approx(4 / 6), 2)
    gap = _sequence([[1, 2], [1, -1], [1, 3]]).compute()
    assert (gap["linkable"], gap["switches"]) == (3, 1)
    assert _sequence([]).compute()["accuracy"] == 0


def test_jitter_is_the_second_difference_of_the_error() -> None:
    figures = _sequence([[1, 2]] * 6, noise=0.3).compute()
    assert figures["jitter"] == pytest.approx(0.6, abs=1e-5)
    assert figures["center_error"] == pytest.approx(0.15, abs=1e-5)


def test_links_are_measured_in_the_map() -> None:
    """A sensor that turns does not jitter a box that is right."""
    metric = TrackLinks(SPEC)
    for t in range(4):
        angle = 0.3 * t
        pose = torch.eye(4)
        pose[:2, :2] = torch.tensor([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        place = pose[:2, :2].T @ torch.tensor([20.0, 0])
        box = Boxes.from_tensor(torch.tensor([[*place.tolist(), 0, 4, 2, 1.5, -angle]]), torch.tensor([0]))
        known = Targets(
            tracks=Tracks(box, torch.tensor([1])), poses=Poses(pose[None], torch.tensor([True]), torch.ones(1))
        )
        off = box.replace(center=box.center + (pose[:3, :3].T @ torch.tensor([0.4, 0, 0]))[None])
        metric.update(
            Tracks(off, torch.tensor([1])), known, [dataclasses.replace(FrameMeta("0", "s"), index=t, time=t / 10)]
        )
    figures = metric.compute()
    assert figures["jitter"] == pytest.approx(0, abs=1e-5)
    assert figures["center_error"] == pytest.approx(0.4, abs=1e-5)
