"""Greedy matching and the tracker `greedy`."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import Tensor

from lidarfw.components.matching import greedy_match
from lidarfw.components.trackers.greedy import GreedyTracker
from lidarfw.errors import ConfigError
from lidarfw.types import Boxes, FrameMeta, FrameResult, Poses, Spec

SPEC = Spec(Boxes, classes=("Car", "Pedestrian"))


def in_turn(preference: Tensor) -> list[int]:
    """What `greedy_match` promises, row by row."""
    taken: set[int] = set()
    chosen = []
    for row in preference.tolist():
        free = [(-value, column) for column, value in enumerate(row) if column not in taken and value > -math.inf]
        chosen.append(min(free)[1] if free else -1)
        taken.add(chosen[-1])
    return chosen


@pytest.mark.parametrize("seed", range(30))
def test_greedy_match_equals_choosing_in_turn(seed: int) -> None:
    random = torch.Generator().manual_seed(seed)
    rows, columns = (int(torch.randint(0, 12, (), generator=random)) for _ in range(2))
    preference = torch.randint(0, 6, (rows, columns), generator=random).float()  # with ties
    preference[torch.rand(rows, columns, generator=random) < 0.3] = -torch.inf
    before = preference.clone()
    assert greedy_match(preference).tolist() == in_turn(preference)
    assert preference.equal(before)


def frame_of(
    places: list[tuple[float, float]], number: int, labels: list[int] | None = None, **fields: Tensor
) -> Boxes:
    tensor = torch.zeros(len(places), 7)
    tensor[:, :2] = torch.tensor(places).view(-1, 2)
    tensor[:, 3:6] = 1
    boxes = Boxes.from_tensor(tensor, torch.tensor(labels or [0] * len(places), dtype=torch.long))
    return boxes.replace(**fields)


def track(
    tracker: GreedyTracker, frames: list[Boxes], times: list[float] | None = None, poses: list[Tensor] | None = None
) -> list[list[int]]:
    """Ids of the detections of each frame."""
    state, ids = tracker.start(), []
    for number, boxes in enumerate(frames):
        time = times[number] if times else number * 0.1
        pose = None if poses is None else Poses(poses[number][None], torch.ones(1, dtype=torch.bool), torch.ones(1))
        (result,) = tracker.step(state, FrameResult(FrameMeta(str(number), time=time)), boxes, pose)
        assert result.tracks is not None
        assert result.tracks.boxes is boxes
        ids.append(result.tracks.id.tolist())
    return ids


def test_still_objects_keep_their_ids() -> None:
    frames = [frame_of([(0, 0), (5, 0), (0, 5)], n) for n in range(6)]
    assert track(GreedyTracker(SPEC), frames) == [[1, 2, 3]] * 6
    turned = [boxes[torch.tensor([2, 0, 1])] if number % 2 else boxes for number, boxes in enumerate(frames)]
    assert track(GreedyTracker(SPEC), turned) == [[1, 2, 3], [3, 1, 2]] * 3


@pytest.mark.parametrize("with_velocity", [False, True])
def test_crossing_objects_keep_their_ids(with_velocity: bool) -> None:
    """Two objects pass each other 0.5 m apart; then each is nearer to the other's last place than to its own."""
    frames = []
    for n in range(22):
        x = -10.5 + n
        boxes = frame_of([(x, 0.25), (-x, -0.25)], n)
        velocity = torch.tensor([[10.0, 0.0], [-10.0, 0.0]])
        frames.append(boxes.replace(velocity=velocity) if with_velocity else boxes)
    assert track(GreedyTracker(SPEC), frames) == [[1, 2]] * 22
    apart = torch.cdist(frames[11].center, frames[10].center)
    assert apart.argmin(1).tolist() == [1, 0]


def test_classes_are_never_mixed() -> None:
    frames = [frame_of([(0, 0)], 0, [0]), frame_of([(0, 0)], 1, [1]), frame_of([(0, 0), (0.1, 0)], 2, [1, 0])]
    assert track(GreedyTracker(SPEC), frames) == [[1], [2], [2, 1]]


def test_gate_is_per_class() -> None:
    frames = [frame_of([(0, 0), (9, 0)], 0, [0, 1]), frame_of([(1.5, 0), (10.5, 0)], 1, [0, 1])]
    assert track(GreedyTracker(SPEC, max_distance={"Pedestrian": 1.0}), frames) == [[1, 2], [1, 3]]
    with pytest.raises(ConfigError, match="'Dog'"):
        GreedyTracker(SPEC, max_distance={"Dog": 1.0})


def test_higher_score_chooses_first() -> None:
    second = frame_of([(0.5, 0), (0.4, 0)], 1, score=torch.tensor([0.9, 0.2]))
    assert track(GreedyTracker(SPEC), [frame_of([(0, 0)], 0), second]) == [[1], [1, 2]]


@pytest.mark.parametrize(("gap", "same"), [(3, True), (4, False)])
def test_tracks_live_through_gaps_up_to_max_age(gap: int, same: bool) -> None:
    empty = [frame_of([], n) for n in range(gap)]
    ids = track(GreedyTracker(SPEC, max_age=3), [frame_of([(0, 0)], 0), *empty, frame_of([(0, 0)], 9)])
    assert ids == [[1], *[[]] * gap, [1 if same else 2]]


def test_lost_objects_are_expected_where_they_went() -> None:
    frames = [frame_of([(n * 1.5, 0.0)], n) for n in range(8)]
    frames[4] = frames[5] = frame_of([], 4)
    assert track(GreedyTracker(SPEC), frames) == [[1]] * 4 + [[], []] + [[1]] * 2
    still = [frame_of([(0, 0)], 0)] * 4 + [frame_of([], 4)] * 2 + [frame_of([(9.0, 0)], 6)]
    assert track(GreedyTracker(SPEC), still)[-1] == [2]


def test_ids_are_never_given_twice() -> None:
    frames = [frame_of([(10.0 * n, 0)], n) for n in range(12)]
    assert [i for ids in track(GreedyTracker(SPEC, max_age=1), frames) for i in ids] == list(range(1, 13))


@pytest.mark.parametrize("times", [[0.0] * 6, [0.5, 0.4, 0.3, 0.2, 0.1, 0.0], [1.0, 1.0, 1.1, 1.1, 1.1, 1.2]])
def test_time_that_does_not_grow_counts_as_one_frame_time(times: list[float]) -> None:
    velocity = torch.tensor([[15.0, 0.0]])
    frames = [frame_of([(n * 1.5, 0.0)], n, velocity=velocity) for n in range(6)]
    assert track(GreedyTracker(SPEC, default_distance=0.5), frames, times) == [[1]] * 6


def test_uneven_times_are_respected() -> None:
    times = [0.0, 0.1, 0.2, 0.6, 0.7]
    frames = [frame_of([(15 * time, 0.0)], n) for n, time in enumerate(times)]
    ids = track(GreedyTracker(SPEC, default_distance=1.6), frames, times)
    assert ids == [[1]] * 5  # 6 m in 0.4 s after 1.5 m in 0.1 s is no jump


def test_unknown_velocity_counts_as_still() -> None:
    frames = [frame_of([(0, 0)], n, velocity=torch.full((1, 2), math.nan)) for n in range(3)]
    assert track(GreedyTracker(SPEC), frames) == [[1]] * 3


def turning_drive(number: int) -> Tensor:
    """Sensor that drives 2 m and turns 20 degrees per frame, far from the map's origin."""
    angle = math.radians(20) * number
    pose = torch.eye(4, dtype=torch.float64)
    pose[:2, :2] = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    pose[:3, 3] = torch.tensor([456789.0 + 2 * number, 5412345.0, 300.0])
    return pose


def test_poses_take_out_the_motion_of_the_sensor() -> None:
    world = torch.tensor([[15.0, 8.0, 0.0], [15.0, -8.0, 0.0], [25.0, 3.0, 0.0]], dtype=torch.float64)
    world = world + turning_drive(0)[:3, 3]
    poses = [turning_drive(n) for n in range(8)]
    frames = []
    for pose in poses:
        local = (world - pose[:3, 3]) @ pose[:3, :3]
        frames.append(frame_of([(float(x), float(y)) for x, y, _ in local], 0))
    assert track(GreedyTracker(SPEC), frames, poses=poses) == [[1, 2, 3]] * 8
    assert track(GreedyTracker(SPEC), frames) != [[1, 2, 3]] * 8


def test_detector_velocities_are_turned_into_the_map() -> None:
    pose = turning_drive(4)[None].repeat(2, 1, 1)
    frames = [frame_of([(0, 0)], n, velocity=torch.tensor([[30.0, 0.0]])) for n in (0, 1)]
    frames[1].center[0, 0] = 3.0
    assert track(GreedyTracker(SPEC, default_distance=0.01), frames, poses=list(pose)) == [[1], [1]]


def test_a_frame_without_pose_uses_the_last_one() -> None:
    tracker, state = GreedyTracker(SPEC), GreedyTracker(SPEC).start()
    ids = []
    for ok in (True, False, True):
        matrix = turning_drive(3)[None] if ok else torch.full((1, 4, 4), math.nan, dtype=torch.float64)
        pose = Poses(matrix, torch.tensor([ok]), torch.ones(1))
        ids += tracker.step(state, FrameResult(FrameMeta("a")), frame_of([(4, 4)], 0), pose)[0].tracks.id.tolist()
    assert ids == [1, 1, 1]


def test_interleaved_streams_equal_separate_runs_and_state_is_complete() -> None:
    random = torch.Generator().manual_seed(0)
    walks = [(torch.randn(30, 6, 2, generator=random) * 0.4).cumsum(0) + 4 * torch.arange(6)[:, None] for _ in range(2)]
    runs = [[frame_of([tuple(p) for p in places.tolist()], n) for n, places in enumerate(walk)] for walk in walks]
    tracker = GreedyTracker(SPEC, default_distance=1.0)
    separate = [track(tracker, run) for run in runs]
    states, mixed = [tracker.start(), tracker.start()], [[], []]
    for number in range(30):
        for stream in (0, 1):
            meta = FrameMeta(str(number), time=number * 0.1)
            (result,) = tracker.step(states[stream], FrameResult(meta), runs[stream][number])
            mixed[stream].append(result.tracks.id.tolist())
        states = copy.deepcopy(states)  # nothing is kept outside the state
        tracker = GreedyTracker(SPEC, default_distance=1.0)
    assert mixed == separate
    assert len({i for ids in separate[0] for i in ids}) > 6  # some tracks were lost and born on the way


def test_many_detections() -> None:
    random = torch.Generator().manual_seed(0)
    places = torch.rand(500, 2, generator=random) * 100
    frames = [frame_of([tuple(p) for p in places.tolist()], n) for n in range(3)]
    assert track(GreedyTracker(SPEC), frames) == [list(range(1, 501))] * 3
