"""Metric `box_recall`."""

from __future__ import annotations

import pytest
import torch

from lidarfw.components.metrics.box_recall import KINDS, BoxRecall, f1_score
from lidarfw.errors import ConfigError
from lidarfw.types import Boxes, Points, Spec, Targets

pytestmark = pytest.mark.filterwarnings("ignore:The ``compute`` method of metric BoxRecall was called before")
SPEC = Spec(Boxes, classes=("Car", "Pedestrian"))


def boxes_of(x: list[float], score: list[float] | None = None, label: list[int] | None = None) -> Boxes:
    """Boxes 4 x 2 x 1.5 m along the x axis: shifted by d they have IoU (4 - d) / (4 + d)."""
    tensor = torch.tensor([[v, 0, 0, 4, 2, 1.5, 0] for v in x]).view(-1, 7)
    labels = torch.tensor(label or [0] * len(x), dtype=torch.long)
    return Boxes.from_tensor(tensor, labels, None if score is None else torch.tensor(score))


def figures(*frames: tuple[Boxes, Targets], **options: object) -> dict[str, float]:
    metric = BoxRecall(SPEC, **options)
    for boxes, targets in frames:
        metric.update(boxes, targets)
    return metric.compute()


def test_golden() -> None:
    """Of three cars two are found, one of them a metre off (IoU 0.6); one detection is wrong, one too weak."""
    truth = boxes_of([5, 12, 20])
    found = figures((boxes_of([5, 13, 26, 20], [0.9, 0.8, 0.7, 0.2]), Targets(truth)))
    assert found["car_objects"] == 3
    assert found["car_bev_recall"] == pytest.approx(2 / 3)
    assert found["car_bev_precision"] == pytest.approx(2 / 3)
    assert found["mean_3d_recall"] == found["mean_3d_f1"] == pytest.approx(2 / 3)
    strict = figures((boxes_of([5, 13], [0.9, 0.8]), Targets(truth)), iou={"Car": 0.7})
    assert (strict["car_bev_recall"], strict["car_bev_precision"]) == (pytest.approx(1 / 3), 0.5)
    assert strict["car_bev_f1"] == pytest.approx(0.4)


def test_an_object_that_the_sensor_did_not_see_is_not_asked_for() -> None:
    metric = BoxRecall(SPEC, Spec(Points), min_points=1)
    points = Points.from_scan(torch.tensor([[5.0, 0, 0]]), torch.zeros(1, 0))
    metric.update(boxes_of([5.0], [0.9]), Targets(boxes_of([5, 20])), points)
    assert (metric.compute()["car_objects"], metric.compute()["car_bev_recall"]) == (1, 1)


def test_f1_golden() -> None:
    """Table IX of the MSRM paper: precision 82.40, recall 84.70."""
    assert f1_score(82.40, 84.70) == pytest.approx(83.534, abs=1e-3)
    assert f1_score(0.0, 0.0) == 0


def test_far_and_hidden_objects_are_ignored() -> None:
    truth = boxes_of([5, 12, 20, 40])
    truth = truth.replace(occlusion=torch.tensor([0, 1, 0, 0]), truncation=torch.tensor([0, 0, 0.8, 0]))
    every = boxes_of([5, 12, 20, 40, 60], [0.9, 0.8, 0.7, 0.6, 0.5])
    found = figures((every, Targets(truth)))
    assert (found["car_objects"], found["car_bev_recall"], found["car_bev_precision"]) == (1, 1, 1)
    found = figures((every, Targets(truth)), max_occlusion=1, max_truncation=1.0, max_range=50.0)
    assert (found["car_objects"], found["car_bev_recall"], found["car_bev_precision"]) == (4, 1, 1)
    found = figures((every, Targets(truth)), max_range=70.0)
    assert found["car_bev_precision"] == pytest.approx(2 / 3)


def test_an_object_at_the_border_is_found_by_a_detection_beyond_it() -> None:
    found = figures((boxes_of([30.1], [0.9]), Targets(boxes_of([29.9]))))
    assert (found["car_bev_recall"], found["car_bev_precision"]) == (1, 1)


def test_ignored_objects_of_the_data_stay_ignored() -> None:
    found = figures((boxes_of([5, 12], [0.9, 0.8]), Targets(boxes_of([5]), boxes_of([12]))))
    assert found["car_bev_precision"] == 1


@pytest.mark.parametrize("boxes", [Boxes.empty(), boxes_of([0.0], [0.9])])
def test_nothing_to_find_is_finite(boxes: Boxes) -> None:
    zero = {f"mean_{measure}_{kind}": 0.0 for measure in ("3d", "bev") for kind in KINDS}
    assert figures() == zero
    assert figures((boxes, Targets(Boxes.empty()))) == zero


def test_unknown_class_is_named() -> None:
    with pytest.raises(ConfigError, match=r"iou names the class 'Van'"):
        BoxRecall(SPEC, iou={"Van": 0.5})
