"""Metric `box_ap`."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidarfw.components.metrics.box_ap import FALSE, IGNORED, TRUE, BoxAP, average_precision
from lidarfw.errors import ConfigError
from lidarfw.types import Boxes, Points, Spec, Targets

pytestmark = pytest.mark.filterwarnings("ignore:The ``compute`` method of metric BoxAP was called before")
SPEC = Spec(Boxes, classes=("Car", "Pedestrian", "Traffic Cone"))


def boxes_of(x: list[float], score: list[float] | None = None, label: list[int] | None = None) -> Boxes:
    """Boxes 4 x 2 x 1.5 m along the x axis: shifted by d they have IoU (4 - d) / (4 + d)."""
    tensor = torch.tensor([[v, 0, 0, 4, 2, 1.5, 0] for v in x]).view(-1, 7)
    labels = torch.tensor(label or [0] * len(x), dtype=torch.long)
    return Boxes.from_tensor(tensor, labels, None if score is None else torch.tensor(score))


def figures(*frames: tuple[Boxes, Targets], **options: object) -> dict[str, float]:
    metric = BoxAP(SPEC, **options)
    for boxes, targets in frames:
        metric.update(boxes, targets)
    return metric.compute()


def test_average_precision_golden() -> None:
    score = torch.tensor([0.9, 0.8, 0.7])
    assert average_precision(score, torch.tensor([TRUE, FALSE, TRUE]), 2) == pytest.approx(0.833333, abs=1e-6)
    assert average_precision(score, torch.tensor([TRUE, TRUE, FALSE]), 4) == 0.5
    assert average_precision(score, torch.tensor([TRUE, IGNORED, TRUE]), 2) == 1.0
    assert average_precision(score, torch.tensor([FALSE, FALSE, FALSE]), 2) == 0.0
    assert average_precision(score[:0], torch.tensor([]), 2) == 0.0
    # equal scores are one step: neither order of the two may win
    assert average_precision(torch.tensor([0.5, 0.5]), torch.tensor([TRUE, FALSE]), 1) == 0.5
    assert average_precision(torch.tensor([0.5, 0.5]), torch.tensor([FALSE, TRUE]), 1) == 0.5


def test_recall_steps_are_exact() -> None:
    """7 of 10 found: recalls up to 28/40 count, whatever 0.7 is in binary."""
    verdict = torch.full((7,), TRUE)
    assert average_precision(torch.linspace(1, 0.5, 7), verdict, 10) == 0.7


def test_perfect_detections() -> None:
    truth = boxes_of([0, 10, 20, 30], label=[0, 1, 0, 2])
    found = figures((truth, Targets(truth)))
    names = [f"{name}_{kind}_ap" for kind in ("3d", "bev") for name in ("car", "pedestrian", "traffic_cone", "mean")]
    assert found == pytest.approx(dict.fromkeys(names, 1.0))
    assert BoxAP.monitor in found


def test_thresholds_are_per_class() -> None:
    """A quarter of the length away: IoU 0.6, enough for a pedestrian and a cone, not for a car."""
    truth, moved = boxes_of([0, 10, 20], label=[0, 1, 2]), boxes_of([1, 11, 21], label=[0, 1, 2])
    found = figures((moved, Targets(truth)))
    names = ("car", "pedestrian", "traffic_cone", "mean")
    assert [found[f"{name}_3d_ap"] for name in names] == pytest.approx([0, 1, 1, 2 / 3])
    found = figures((moved, Targets(truth)), iou={"Car": 0.59}, default_iou=0.65)
    assert [found[f"{n}_3d_ap"] for n in ("car", "pedestrian", "traffic_cone")] == [1, 1, 0]
    with pytest.raises(ConfigError, match=r"iou names the class 'Van'"):
        BoxAP(SPEC, iou={"Van": 0.5})


def test_height_counts_in_3d_only() -> None:
    truth = boxes_of([0])
    lifted = truth.replace(center=truth.center + torch.tensor([0, 0, 1.0]))
    found = figures((lifted, Targets(truth)))
    assert (found["car_3d_ap"], found["car_bev_ap"]) == (0, 1)


def test_an_object_is_found_once_and_by_the_best_score() -> None:
    truth = boxes_of([0, 20])
    found = figures((boxes_of([0, 0.2, 20], [0.9, 0.8, 0.7]), Targets(truth)))
    assert found["car_3d_ap"] == pytest.approx(0.833333, abs=1e-6)
    # the better score takes the nearest object, the other one the next
    close = boxes_of([0, 0.4])
    assert figures((boxes_of([0.3, 0.1], [0.9, 0.8]), Targets(close)))["car_3d_ap"] == 1.0


def test_other_frames_and_classes_do_not_match() -> None:
    truth = boxes_of([0])
    other = boxes_of([0], label=[1])
    assert figures((other, Targets(truth)))["car_3d_ap"] == 0
    assert figures((truth, Targets(Boxes.empty())), (Boxes.empty(), Targets(truth)))["car_3d_ap"] == 0


def test_ignored_objects_are_neither_right_nor_wrong() -> None:
    truth, false = boxes_of([0, 20]), boxes_of([0, 40, 60, 20], [0.9, 0.8, 0.7, 0.6])
    assert figures((false, Targets(truth)))["car_3d_ap"] == pytest.approx(0.75)
    van, anything = boxes_of([40.0]), boxes_of([60.0], label=[-1])
    both = Boxes.cat([van, anything])
    assert figures((false, Targets(truth, both)))["car_3d_ap"] == 1.0
    assert figures((false, Targets(truth, van)))["car_3d_ap"] == pytest.approx(0.833333, abs=1e-6)
    of_other_class = replace(van, label=torch.tensor([1]))
    assert figures((false, Targets(truth, of_other_class)))["car_3d_ap"] == pytest.approx(0.75)


def test_objects_that_the_sensor_did_not_see_are_ignored() -> None:
    """The car at 20 m has two points, one of them on its surface; the third point lies in the other frame."""
    xyz = torch.tensor([[0.0, 0, 0], [20, 0, 0], [22, 1, 0.75], [20, 0, 0]])
    points = Points(xyz, torch.zeros(4, 0), torch.tensor([0, 0, 0, 1]), 2)
    truth, found = boxes_of([0, 20, 40]), boxes_of([0, 20, 40], [0.9, 0.8, 0.7])

    def ap(least: int, found: Boxes) -> tuple[float, int]:
        metric = BoxAP(SPEC, Spec(Points), min_points=least)
        metric.update(found, Targets(truth, boxes_of([60.0])), points)
        return metric.compute()["car_3d_ap"], int(metric.objects[0])

    assert ap(0, found[:2]) == (pytest.approx(26 / 40), 3)
    assert ap(1, found[:2]) == (1.0, 2)
    assert ap(2, found) == (1.0, 1)
    assert ap(2, Boxes.cat([found, boxes_of([60, 80], [1.0, 0.95])])) == (pytest.approx(0.5), 1)
    with pytest.raises(ConfigError, match="min_points counts points"):
        BoxAP(SPEC, min_points=1)


def test_an_object_to_find_comes_before_an_ignored_one() -> None:
    truth, ignored = boxes_of([0.5]), boxes_of([0.0])
    assert figures((boxes_of([0.0], [0.9]), Targets(truth, ignored)))["car_3d_ap"] == 1.0


def test_2d_only_regions_play_no_part() -> None:
    region = boxes_of([0.0], label=[-1])
    region.size[:] = 0
    assert figures((boxes_of([0], [0.5]), Targets(boxes_of([0]), region)))["car_3d_ap"] == 1.0


@pytest.mark.parametrize("boxes", [Boxes.empty(), boxes_of([0.0])])
def test_nothing_to_find_is_finite(boxes: Boxes) -> None:
    zero = {"mean_3d_ap": 0.0, "mean_bev_ap": 0.0}
    assert figures() == zero
    assert figures((boxes, Targets())) == zero
    assert figures((boxes, Targets(Boxes.empty()))) == zero
    assert figures((Boxes.empty(), Targets(boxes_of([0]))))["car_3d_ap"] == 0.0


def noisy_frames(seed: int = 0, number: int = 12) -> list[tuple[Boxes, Targets]]:
    random = torch.Generator().manual_seed(seed)
    frames = []
    for _ in range(number):
        count = int(torch.randint(0, 9, (), generator=random))
        tensor = torch.rand(count, 7, generator=random) * torch.tensor([20, 20, 1, 3, 2, 1, 6.28])
        tensor[:, 3:6] += 1
        label = torch.randint(0, 3, (count,), generator=random)
        ignored = torch.rand(count, generator=random) < 0.2
        guess = torch.cat([tensor + 0.1 * torch.randn(count, 7, generator=random)] * 2)
        guess = guess[torch.rand(2 * count, generator=random) < 0.7]
        guess[:, 3:6].clamp_(min=0.1)
        guesses = torch.randint(0, 3, (len(guess),), generator=random)
        score = (torch.rand(len(guess), generator=random) * 20).round() / 20
        truth = Boxes.from_tensor(tensor, label)
        frames.append((Boxes.from_tensor(guess, guesses, score), Targets(truth[~ignored], truth[ignored])))
    return frames


def test_a_batch_counts_as_its_frames() -> None:
    frames = noisy_frames()
    boxes = Boxes.cat([b for b, _ in frames], as_batch=True)
    truth = Boxes.cat([t.boxes for _, t in frames if t.boxes is not None], as_batch=True)
    ignored = Boxes.cat([t.ignored for _, t in frames if t.ignored is not None], as_batch=True)
    assert figures((boxes, Targets(truth, ignored))) == pytest.approx(figures(*frames))


def test_reset_and_pickle() -> None:
    frames, metric = noisy_frames(), BoxAP(SPEC)
    for _ in range(2):
        for boxes, targets in frames:
            metric.update(boxes, targets)
        assert pickle.loads(pickle.dumps(metric)).compute() == metric.compute()
        metric.reset()
    assert metric.compute()["mean_3d_ap"] == 0.0


def test_only_figures_are_kept() -> None:
    metric = BoxAP(SPEC)
    for boxes, targets in noisy_frames():
        metric.update(boxes, targets)
    rows = sum(len(part) for part in metric.detections)
    assert rows == sum(len(boxes) for boxes, _ in noisy_frames())
    assert all(part.shape[1] == 4 for part in metric.detections)


def noisy_cars(seed: int, number: int = 40) -> list[tuple[Boxes, Targets]]:
    """Frames with doubled, moved, missing and made-up detections; a fifth of the cars is ignored."""
    random = np.random.RandomState(seed)  # a stream that numpy promises never to change
    size, lower = np.array([40, 40, 1, 3, 1, 1, 6.28]), np.array([5, -20, -1.5, 2, 1, 1, -3.14])
    frames = []
    for _ in range(number):
        cars = random.uniform(size=(random.randint(12), 7)) * size + lower
        ignored = random.uniform(size=len(cars)) < 0.2
        moved = np.tile(cars, (2, 1)) + random.normal(size=(2 * len(cars), 7)) * [
            0.15,
            0.1,
            0.05,
            0.15,
            0.08,
            0.08,
            0.06,
        ]
        found = np.concatenate(
            [moved[random.uniform(size=len(moved)) < 0.6], random.uniform(size=(3, 7)) * size + lower]
        )
        score = random.randint(1, 50, len(found)) / 50  # with ties
        truth, boxes = (torch.tensor(b, dtype=torch.float32) for b in (cars, found))
        labels = [torch.zeros(len(b), dtype=torch.long) for b in (truth, boxes)]
        objects, mask = Boxes.from_tensor(truth, labels[0]), torch.tensor(ignored)
        detections = Boxes.from_tensor(boxes, labels[1], torch.tensor(score, dtype=torch.float32))
        frames.append((detections, Targets(objects[~mask], objects[mask])))
    return frames


@pytest.mark.parametrize(
    ("seed", "iou", "bev", "volume"),
    [
        (0, 0.5, 0.4568992080, 0.4568992080),
        (0, 0.7, 0.3343812063, 0.2575317572),
        (1, 0.5, 0.4570848569, 0.4570848569),
        (1, 0.7, 0.3818478286, 0.2855474547),
    ],
)
def test_equals_an_independent_implementation(seed: int, iou: float, bev: float, volume: float) -> None:
    """Golden figures of a separate numpy program that loops over the detections."""
    found = figures(*noisy_cars(seed), iou={"Car": iou})
    assert (found["car_bev_ap"], found["car_3d_ap"]) == pytest.approx((bev, volume), abs=1e-9)


def test_a_process_without_frames_takes_part_in_the_exchange() -> None:
    """Every process must gather as many tensors as the others, or they wait for each other for ever."""
    busy, idle = BoxAP(SPEC), BoxAP(SPEC)
    for boxes, targets in noisy_frames():
        busy.update(boxes, targets)
    states = [[torch.cat(metric.detections), metric.objects.clone()] for metric in (busy, idle)]
    for metric in (busy, idle):
        gathered: list[torch.Tensor] = []

        def gather(tensor: torch.Tensor, group: object, gathered: list[torch.Tensor] = gathered) -> list[torch.Tensor]:
            gathered.append(tensor)
            return [next(part for part in state if part.dtype == tensor.dtype) for state in states]

        metric.dist_sync_fn, metric.distributed_available_fn = gather, lambda: True
        assert metric.compute() == pytest.approx(figures(*noisy_frames()))
        assert len(gathered) == 2
