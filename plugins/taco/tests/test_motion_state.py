"""Transform motion_state: what moves, by velocity, by track and by matching."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from lidarfw.errors import ConfigError, DataError
from lidarfw.interfaces import Dataset
from lidarfw.types import Boxes, DataSpec, Frame, FrameMeta, Points, Poses, Spec, Targets, Tracks

from lidarfw_taco.transforms.motion_state import MotionState, speeds

RNG = np.random.default_rng(0)


class Drive(Dataset):
    """A car that drives at `ego` m/s past objects: start and velocity over ground, class, and frames they are seen."""

    def __init__(self, objects, *, ego=10.0, frames=12, period=0.1, ids=True, velocities=None, jitter=0.0, pose=True):
        self.objects, self.ego, self.frames, self.period = objects, ego, frames, period
        self.ids, self.velocities, self.jitter, self.pose = ids, velocities, jitter, pose
        self.split = "train"
        self.spec = DataSpec({"points": Spec(Points, 1)}, frozenset({Boxes, Poses}), ("Car", "Pedestrian"))
        self.reads = 0

    def __len__(self) -> int:
        return self.frames

    def meta(self, index: int) -> FrameMeta:
        return FrameMeta(f"{index:03d}", "drive", index, index * self.period)

    def __getitem__(self, index: int) -> Frame:
        self.reads += 1
        time, noise = index * self.period, np.random.default_rng(index)
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[0, 3] = self.ego * time
        rows, labels, numbers = [], [], []
        for number, (start, velocity, label, seen) in enumerate(self.objects):
            if index in seen:
                place = np.array(start) + np.array(velocity) * time - (self.ego * time, 0)
                rows.append([*(place + noise.normal(0, self.jitter, 2)), 0, 4, 2, 1.5, 0])
                labels.append(label)
                numbers.append(number)
        boxes = Boxes.from_tensor(torch.tensor(rows).view(-1, 7).float(), torch.tensor(labels, dtype=torch.long))
        if self.velocities is not None:
            boxes = boxes.replace(velocity=torch.tensor([self.velocities[n] for n in numbers]).view(-1, 2))
        tracks = Tracks(boxes, torch.tensor(numbers, dtype=torch.long)) if self.ids else None
        known = torch.tensor([self.pose])
        poses = Poses(matrix[None].float(), known, known.float())
        points = Points.from_scan(torch.zeros(1, 3), torch.zeros(1, 1))
        return Frame({"points": points}, Targets(boxes=boxes, tracks=tracks, poses=poses), self.meta(index))


EVER = range(100)
PARKED = ((20.0, 3.0), (0.0, 0.0), 0, EVER)
SLOW = ((30.0, -3.0), (0.4, 0.0), 0, EVER)
FAST = ((10.0, 0.0), (8.0, 0.0), 0, EVER)
WALKER = ((15.0, 5.0), (0.0, 1.2), 1, EVER)


def states(dataset: Dataset, **options) -> list[list[int]]:
    transform = MotionState(**options)
    transform.attach(dataset)
    return [transform(dataset[i], RNG).targets.boxes.moving.tolist() for i in range(len(dataset))]


def test_speed_is_distance_over_half_a_second():
    """G9: 0.30 m in 0.5 s moves, 0.25 m does not, one sighting tells nothing."""
    place = np.array([[0, 0], [0.15, 0], [0.30, 0], [5, 0], [5.125, 0], [5.25, 0], [9, 9]])
    time, track = np.array([0, 0.25, 0.5] * 2 + [0.25]), np.array([0] * 3 + [1] * 3 + [2])
    found = speeds(place, time, track, 0.25)
    assert found[[1, 4]] == pytest.approx([0.6, 0.5])
    assert np.isnan(found[6])
    assert found[0] == pytest.approx(0.6)  # where a track begins one side alone counts
    shuffled = RNG.permutation(7)
    assert speeds(place[shuffled], time[shuffled], track[shuffled], 0.25)[:6] == pytest.approx(
        found[shuffled][:6], nan_ok=True
    )
    assert len(speeds(np.zeros((0, 2)), np.zeros(0), np.zeros(0, dtype=int), 0.25)) == 0


@pytest.mark.parametrize("ids", [True, False])
@pytest.mark.parametrize("ego", [0.0, 10.0])
def test_parked_and_slow_objects_are_static_whatever_the_sensor_does(ids, ego):
    found = states(Drive([PARKED, SLOW, FAST, WALKER], ids=ids, ego=ego))
    assert found == [[0, 0, 1, 1]] * 12


@pytest.mark.parametrize("ids", [True, False])
def test_jitter_of_the_labels_does_not_make_parked_cars_move(ids):
    parked = [((5.0 * i, 3.0), (0.0, 0.0), 0, EVER) for i in range(8)]
    found = np.array(states(Drive([*parked, FAST], frames=60, period=0.05, jitter=0.05, ids=ids)))
    assert found[8:-8, :8].mean() < 0.03
    assert found[:, 8].all()
    consecutive = np.array(states(Drive(parked, frames=60, period=0.2, jitter=0.05, ids=ids), reach=0.01))
    assert consecutive.mean() < 0.1


def test_an_object_that_is_hardly_seen_is_unknown():
    once = ((40.0, 8.0), (9.0, 0.0), 0, range(5, 6))
    twice = ((50.0, 9.0), (9.0, 0.0), 0, range(5, 8))
    found = states(Drive([PARKED, once, twice]))
    assert [found[5], found[6], found[7]] == [[0, -1, 1], [0, 1], [0, 1]]


def test_frames_that_are_farther_apart_than_the_reach_use_the_next_ones():
    assert states(Drive([PARKED, FAST], period=0.8, frames=5, ids=False)) == [[0, 1]] * 5


def test_velocities_come_first_and_unknown_ones_fall_back():
    nan = float("nan")
    told = Drive([PARKED, FAST], velocities=[(3.0, 0.0), (0.5, 0.0)], pose=False)
    assert states(told) == [[1, 0]] * 12
    assert states(Drive([PARKED, FAST], velocities=[(3.0, 0.0), (nan, nan)])) == [[1, 1]] * 12
    with pytest.raises(DataError, match="frame 000 has boxes of unknown velocity and no pose"):
        states(Drive([PARKED], velocities=[(nan, nan)], pose=False))


def test_matching_keeps_classes_apart_and_crossing_objects_alone():
    """A walker close by a parked car is not taken for it, and a row of parked cars stays one."""
    near = ((20.5, 3.5), (0.0, 1.5), 1, EVER)
    assert states(Drive([PARKED, near], ids=False)) == [[0, 1]] * 12


def test_a_known_state_may_stay():
    class Labelled(Drive):
        def __getitem__(self, index):
            frame = super().__getitem__(index)
            boxes = frame.targets.boxes.replace(moving=torch.tensor([1, -1], dtype=torch.int8))
            return frame.replace(targets=frame.targets.replace(boxes=boxes))

    assert states(Labelled([PARKED, FAST]), overwrite=False)[0] == [1, 1]
    assert states(Labelled([PARKED, FAST]))[0] == [0, 1]


def test_frames_without_objects():
    late = ((20.0, 3.0), (0.0, 0.0), 0, range(4, 12))
    assert states(Drive([late], ids=False)) == [[]] * 4 + [[0]] * 8
    assert states(Drive([])) == [[]] * 12


def test_a_file_keeps_the_states(tmp_path):
    dataset, path = Drive([PARKED, FAST], ids=False), str(tmp_path / "motion")
    transform = MotionState(file=path)
    with pytest.raises(DataError, match="does not hold the motion states of this dataset"):
        transform.attach(dataset)
    transform.prepare(dataset)
    reads = dataset.reads
    transform.prepare(dataset)
    transform.attach(dataset)
    assert transform(dataset[3], RNG).targets.boxes.moving.tolist() == [0, 1]
    assert dataset.reads == reads + 1
    with pytest.raises(DataError, match="does not hold"):
        MotionState(file=path, speed=0.1).attach(dataset)


class Part(Drive):
    """Some frames of a drive, of which `split` says nothing."""

    def __init__(self, objects, part: str):
        super().__init__(objects, frames=8, ids=False)
        self.part, self.split = part, "all"

    def meta(self, index: int) -> FrameMeta:
        return FrameMeta(f"{self.part}/{index:03d}", "drive", index, index * self.period)


def test_parts_of_one_split_keep_their_states_apart(tmp_path):
    """As train and val of nuscenes_relocalization, which are frames of the same scenes."""
    train, val = Part([PARKED, FAST], "train"), Part([FAST, PARKED], "val")
    for part in (train, val):
        MotionState(file=str(tmp_path / "motion")).prepare(part)
    for part, expected in ((train, [0, 1]), (val, [1, 0])):
        assert states(part, file=str(tmp_path / "motion"))[3] == expected


def test_a_file_that_is_broken_or_of_others_is_made_anew(tmp_path):
    dataset, transform = Drive([PARKED, FAST], ids=False), MotionState(file=str(tmp_path / "motion"))
    transform.prepare(dataset)
    (file,) = tmp_path.glob("motion_train_*.npz")
    for content in (b"garbage" * 20, b"", file.read_bytes()[:200]):
        file.write_bytes(content)
        with pytest.raises(DataError, match="fix: lidarfw prepare"):
            transform.attach(dataset)
        transform.prepare(dataset)
        assert states(dataset, file=transform.file)[3] == [0, 1]
    np.savez(file, something=np.zeros(3))
    with pytest.raises(DataError, match="fix: lidarfw prepare"):
        transform.attach(dataset)
    transform.prepare(dataset)
    transform.attach(dataset)


def test_boxes_that_were_dropped_before_are_noticed():
    dataset = Drive([PARKED, FAST])
    transform = MotionState()
    transform.attach(dataset)
    frame = dataset[2]
    fewer = frame.replace(targets=frame.targets.replace(boxes=frame.targets.boxes[:1]))
    with pytest.raises(DataError, match=r"has 1 boxes, 2 were labelled(?s:.*)must come before transforms that drop"):
        transform(fewer, RNG)


def test_it_needs_boxes():
    with pytest.raises(ConfigError, match="needs a dataset with labelled boxes"):
        MotionState().spec(DataSpec({}, frozenset({Poses})))
    with pytest.raises(ConfigError, match="need speed >= 0 and reach > 0"):
        MotionState(reach=0)


def test_shuffled_states_are_a_control():
    dataset = Drive([PARKED, FAST, WALKER, SLOW])
    transform = MotionState(shuffle=True)
    transform.attach(dataset)
    found = [tuple(transform(dataset[3], np.random.default_rng(i)).targets.boxes.moving.tolist()) for i in range(20)]
    assert len(set(found)) > 3
    assert all(sum(states) == 2 for states in found)
