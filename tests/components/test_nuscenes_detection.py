"""Metric `nuscenes_detection`."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
import torch

from lidarfw.components.metrics.nuscenes_detection import (
    ERRORS,
    NuscenesDetection,
    average_precision,
    detection_score,
    mean_error,
)
from lidarfw.errors import ConfigError
from lidarfw.types import Boxes, Spec, Targets

pytestmark = pytest.mark.filterwarnings("ignore:The ``compute`` method of metric NuscenesDetection was called before")
CLASSES = ("car", "pedestrian", "barrier", "traffic_cone")
SPEC = Spec(Boxes, classes=CLASSES)
Pair = tuple[Boxes, Targets]


def boxes_of(rows: list[list[float]], score: list[float] | None = None, label: int = 0) -> Boxes:
    """Rows x, y, yaw, length, vx, vy, attribute; 2 m wide, 1.5 m high."""
    table = torch.tensor(rows, dtype=torch.float64).view(-1, 7)
    x, y, yaw, length, vx, vy, attribute = table.T
    tensor = torch.stack([x, y, 0 * x, length, 0 * x + 2, 0 * x + 1.5, yaw], 1)
    labels = torch.full((len(rows),), label)
    boxes = Boxes.from_tensor(tensor, labels, None if score is None else torch.tensor(score, dtype=torch.float64))
    return boxes.replace(velocity=torch.stack([vx, vy], 1), attribute=attribute.long())


def figures(*frames: Pair, **options: object) -> dict[str, float]:
    metric = NuscenesDetection(SPEC, **options)
    for boxes, targets in frames:
        metric.update(boxes, targets)
    return metric.compute()


def car(x: float, y: float = 0, yaw: float = 0, length: float = 4, vx: float = 0, vy: float = 0, does: int = 1) -> list:
    return [x, y, yaw, length, vx, vy, does]


def test_perfect() -> None:
    truth = boxes_of([car(5 * i, vx=i) for i in range(1, 9)])
    found = figures((truth, Targets(truth)))
    assert (found["nds"], found["map"]) == pytest.approx((1, 1))
    assert [found[f"m{name}"] for name in ERRORS] == pytest.approx([0] * 5)
    assert [found[f"car_ap_{distance}m"] for distance in ("0.5", "1", "2", "4")] == pytest.approx([1] * 4)


def test_errors_golden() -> None:
    """One car that is off by 0.6 m, a quarter radian, 5 to 4 m length, 1 m/s and in its attribute."""
    truth = boxes_of([car(10)])
    found = figures((boxes_of([car(10.6, yaw=0.25, length=5, vx=0.6, vy=0.8, does=2)], [0.9]), Targets(truth)))
    assert [found[f"car_ap_{distance}m"] for distance in ("0.5", "1", "2", "4")] == pytest.approx([0, 1, 1, 1])
    assert [found[f"car_{name}"] for name in ERRORS] == pytest.approx([0.6, 1 - 4 / 5, 0.25, 1, 1])
    assert found["nds"] == pytest.approx((5 * 0.75 + 0.4 + 0.8 + 0.75 + 0 + 0) / 10)


def test_average_precision_golden() -> None:
    """Precision 1 up to recall 0.5, then 0.5 up to recall 1: (39 * 0.9 + 1 * .9 + 50 * 0.4) / 90 / 0.9."""
    precision = np.where(np.arange(101) <= 50, 1.0, 0.5)
    assert average_precision(precision) == pytest.approx((40 * 0.9 + 50 * 0.4) / 90 / 0.9)
    assert average_precision(np.full(101, 0.55)) == pytest.approx(0.5)
    assert average_precision(np.full(101, 0.1)) == 0
    assert average_precision(np.full(101, 0.05)) == 0


def test_detection_score_golden() -> None:
    assert detection_score(0.662, [0.3, 0.25, 0.35, 0.25, 0.15]) == pytest.approx(0.701)
    assert detection_score(0.0, [2.0, 1.0, 1.0, 1.0, 1.0]) == 0


def test_mean_error_golden() -> None:
    """The mean so far is 0, then 1/2; where the score falls from 0.9 to 0.5 it goes from one to the other."""
    score, error = np.array([0.9, 0.5]), np.array([0.0, 1.0])
    confidence = np.where(np.arange(101) <= 60, 0.9, 0.5)
    assert mean_error(score, error, confidence) == pytest.approx(40 / 90 * 0.5)
    assert mean_error(score, np.array([np.nan, 1.0]), confidence) == pytest.approx(40 / 90)
    assert mean_error(score, error * np.nan, confidence) == 1
    assert mean_error(score, error, np.where(np.arange(101) <= 10, 0.9, 0)) == 1  # recall 0.11 is not reached


def test_the_nearest_free_object_by_falling_score() -> None:
    truth = boxes_of([car(10), car(11)])
    found = figures((boxes_of([car(10.6), car(10.9)], [0.9, 0.8]), Targets(truth)))
    # the first takes 11, the second only 10: 0.9 m away
    assert [found[f"car_ap_{distance}m"] for distance in ("0.5", "1")] == pytest.approx([0.5 * 0.888888, 1], abs=0.02)
    assert found["car_ate"] == pytest.approx((0.4 + 0.65) / 2, abs=0.1)


def test_a_limit_is_not_reached_by_the_distance_itself() -> None:
    assert figures((boxes_of([car(12)], [0.9]), Targets(boxes_of([car(10)]))))["car_ap_2m"] == 0


def test_range_of_the_class() -> None:
    truth = boxes_of([car(20), car(60)])
    assert figures((truth, Targets(truth)))["car_ap"] == pytest.approx(1)
    assert figures((truth[:1], Targets(truth)))["car_ap"] == pytest.approx(1)
    assert figures((truth[:1], Targets(truth)), max_range={"car": 70})["car_ap"] < 0.5
    people = truth.replace(label=torch.ones(2).long(), center=truth.center * 2)
    assert "pedestrian_ap" not in figures((people[1:], Targets(people[1:])))
    with pytest.raises(ConfigError, match="max_range names the class 'van'"):
        NuscenesDetection(SPEC, max_range={"van": 3})


def test_five_hundred_boxes_of_a_frame() -> None:
    truth = boxes_of([car(10)])
    crowd = boxes_of([car(30)] * 500 + [car(10)], [0.9] * 500 + [0.1])
    assert figures((crowd, Targets(truth)))["car_ate"] == 1
    assert figures((crowd[1:], Targets(truth)))["car_ap"] == 0  # precision 1 / 500
    two = Boxes.cat([crowd[1:], truth], as_batch=True)
    both = Boxes.cat([truth, truth], as_batch=True)
    assert figures((two, Targets(both)))["car_ap"] > 0.4


def test_classes_without_some_errors() -> None:
    barrier, cone = (boxes_of([car(10, yaw=3.0)], label=label) for label in (2, 3))
    turned = boxes_of([car(10, yaw=3.0 - math.pi + 0.1)], label=2)
    found = figures((Boxes.cat([turned, cone]), Targets(Boxes.cat([barrier, cone]))))
    assert found["barrier_aoe"] == pytest.approx(0.1)
    assert {"barrier_ave", "barrier_aae", "traffic_cone_aoe", "traffic_cone_ave"}.isdisjoint(found)
    assert (found["maoe"], found["mave"], found["maae"]) == (pytest.approx(0.1), 1, 1)


def test_unknown_velocity_and_attribute() -> None:
    truth = boxes_of([car(10, vx=0.5, does=-1), car(20, vx=math.nan, does=2)])
    found = figures((truth, Targets(truth)))
    assert (found["car_ave"], found["car_aae"]) == (0, 0)
    silent = truth.replace(velocity=None, attribute=None, score=torch.tensor([0.9, 0.8]))
    told = figures((silent, Targets(truth)))
    assert told["car_ave"] == pytest.approx(0.5)
    assert told["car_aae"] == pytest.approx(25.5 / 90)  # from 0 at recall 0.5 straight to 1
    unlabelled = figures((truth, Targets(silent)))
    assert (unlabelled["car_ave"], unlabelled["car_aae"], unlabelled["car_ase"]) == (1, 1, 0)


@pytest.mark.parametrize("boxes", [Boxes.empty(), boxes_of([car(3)])])
def test_nothing_to_find_is_finite(boxes: Boxes) -> None:
    zero = {"nds": 0, "map": 0, **{f"m{name}": 1 for name in ERRORS}}
    assert figures() == zero
    assert figures((boxes, Targets())) == zero
    assert figures((boxes, Targets(Boxes.empty()))) == zero
    lost = figures((Boxes.empty(), Targets(boxes_of([car(3)]))))
    assert (lost["nds"], lost["car_ap"], lost["car_ate"]) == (0, 0, 1)


def noisy_frames(seed: int, count: int = 12) -> list[Pair]:
    """Frames of all classes with doubled, moved, missing and made-up detections; scores are all different."""
    random = np.random.RandomState(seed)  # a stream that numpy promises never to change
    frames = []
    for _ in range(count):
        number = random.randint(4, 16)
        rows = random.uniform([-45, -45, -3, 1, -5, -5, 0], [45, 45, 3, 5, 5, 5, 3], (number, 7))
        rows[random.uniform(size=number) < 0.1, 4:6] = np.nan
        rows[:, 6] = np.where(random.uniform(size=number) < 0.2, -1, rows[:, 6].astype(int))
        noise = random.normal(0, [0.7, 0.7, 0.4, 0.2, 0.5, 0.5, 0], (2 * number, 7))
        moved = np.nan_to_num(np.tile(rows, (2, 1)) + noise)
        moved[:, 6] = np.where(random.uniform(size=2 * number) < 0.3, 1, np.maximum(moved[:, 6], 0))
        label, found = random.randint(0, 4, number), random.uniform(size=2 * number) < 0.6
        guess = np.where(random.uniform(size=2 * number) < 0.1, 0, np.tile(label, 2))[found]
        boxes = boxes_of(moved[found].tolist(), random.uniform(size=int(found.sum())).tolist())
        truth = boxes_of(rows.tolist()).replace(label=torch.from_numpy(label).long())
        frames.append((boxes.replace(label=torch.from_numpy(guess).long()), Targets(truth)))
    return frames


def looped_ap(frames: list[Pair], label: int, limit: float, reach: float) -> float:
    """Average precision by the words of the paper: sort all, match one by one, interpolate at 101 recalls."""
    detections, objects, taken = [], 0, set()
    for number, (boxes, targets) in enumerate(frames):
        for row in range(len(boxes)):
            if int(boxes.label[row]) == label and math.hypot(*boxes.center[row, :2].tolist()) < reach:
                detections.append((float(boxes.score[row]), number, boxes.center[row, :2].tolist()))
        places = targets.boxes.center[targets.boxes.label == label, :2].tolist()  # type: ignore[union-attr]
        objects += sum(math.hypot(*place) < reach for place in places)
    hits, points = 0, []
    for rank, (_, number, place) in enumerate(sorted(detections, reverse=True), 1):
        truth = frames[number][1].boxes
        best, nearest = limit, None
        for row in range(len(truth)):  # type: ignore[arg-type]
            other = truth.center[row, :2].tolist()  # type: ignore[union-attr]
            free = (number, row) not in taken and int(truth.label[row]) == label  # type: ignore[union-attr]
            if free and math.hypot(*other) < reach and math.dist(place, other) < best:
                best, nearest = math.dist(place, other), row
        hits += nearest is not None
        taken.add((number, nearest))
        points.append((hits / objects, hits / rank))
    total = 0.0
    for step in range(11, 101):
        total += max(0.0, at(points, step / 100) - 0.1)
    return total / 90 / 0.9


def at(points: list[tuple[float, float]], recall: float) -> float:
    """Precision at a recall, on the straight line between the points beside it; of equal recalls the last."""
    below = [point for point in points if point[0] <= recall]
    above = [point for point in points if point[0] > recall]
    if not above:
        return below[-1][1] if below[-1][0] == recall else 0.0
    if not below:
        return above[0][1]
    (left, start), (right, end) = below[-1], above[0]
    return start + (end - start) * (recall - left) / (right - left)


@pytest.mark.parametrize("seed", range(3))
def test_average_precision_equals_plain_loops(seed: int) -> None:
    frames = noisy_frames(seed)
    found = figures(*frames)
    for label, (name, reach) in enumerate(zip(CLASSES, (50, 40, 30, 30), strict=True)):
        for limit in (0.5, 1, 2, 4):
            expected = looped_ap(frames, label, limit, reach)
            assert found[f"{name}_ap_{limit:g}m"] == pytest.approx(expected, abs=1e-9), (name, limit)


@pytest.mark.parametrize(
    ("seed", "expected"),
    [
        (0, (0.473216592, 0.3625957481, 0.877356296, 0.0628197172, 0.3285528354, 0.6297663495, 0.1823176227)),
        (1, (0.4717950374, 0.3391633137, 0.8060836868, 0.0655418345, 0.3311961308, 0.5595170054, 0.2155275374)),
        (2, (0.4580917338, 0.3666904447, 0.8810655019, 0.0633971011, 0.295527138, 0.7834807964, 0.2290643477)),
    ],
)
def test_equals_the_devkit(seed: int, expected: tuple[float, ...]) -> None:
    """Golden figures of nuscenes-devkit 1.2.0 (accumulate, calc_ap, calc_tp) for the same frames and these classes."""
    found = figures(*noisy_frames(seed, 40))
    assert [found[name] for name in ("nds", "map", *(f"m{e}" for e in ERRORS))] == pytest.approx(expected, abs=1e-9)


def test_a_batch_counts_as_its_frames() -> None:
    frames = noisy_frames(3)
    boxes = Boxes.cat([boxes for boxes, _ in frames], as_batch=True)
    truth = Boxes.cat([targets.boxes for _, targets in frames], as_batch=True)  # type: ignore[misc]
    assert figures((boxes, Targets(truth))) == pytest.approx(figures(*frames))


def test_reset_and_pickle() -> None:
    frames, metric = noisy_frames(4), NuscenesDetection(SPEC)
    for _ in range(2):
        for boxes, targets in frames:
            metric.update(boxes, targets)
        assert pickle.loads(pickle.dumps(metric)).compute() == metric.compute() == figures(*frames)
        metric.reset()
    assert metric.compute()["nds"] == 0
