"""Quality of matched boxes by hand."""

from __future__ import annotations

import math

import pytest
import torch
from lidarfw.types import Boxes, Spec, Targets

from lidarfw_msrm.metrics.box_quality import BoxQuality

SPEC = Spec(Boxes, classes=("Car", "Pedestrian"))


def cars(x: list[float], score: list[float] | None = None, occlusion: list[int] | None = None, yaw: float = 0) -> Boxes:
    table = torch.tensor([[place, 0, 0, 4, 2, 1.5, yaw] for place in x]).view(-1, 7)
    label = torch.zeros(len(x), dtype=torch.long)
    found = Boxes.from_tensor(table, label, None if score is None else torch.tensor(score))
    return found if occlusion is None else found.replace(occlusion=torch.tensor(occlusion))


def figures(boxes: Boxes, truth: Boxes, ignored: Boxes | None = None, **options: float) -> dict[str, float]:
    metric = BoxQuality(SPEC, **options)  # type: ignore[arg-type]
    metric.update(boxes, Targets(boxes=truth, ignored=ignored))
    return metric.compute()


def test_overlap_and_errors_of_pairs() -> None:
    """One metre off along 4 m: IoU 0.6; half a turn is no error."""
    found = figures(cars([11.0, 50.0], [0.9, 0.8], yaw=math.pi), cars([10.0, 30.0]))
    assert found["car_iou"] == pytest.approx(0.6, abs=1e-5)
    assert found["car_center"] == pytest.approx(1.0)
    assert found["car_yaw"] == pytest.approx(0.0, abs=1e-5)
    assert found["car_recall"] == found["mean_recall"] == 0.5


def test_average_precision_by_distance_and_visibility() -> None:
    truth = cars([10.0, 30.0, 50.0], occlusion=[0, 0, 2])
    found = figures(cars([10.0, 31.0, 50.0], [0.9, 0.8, 0.7]), truth)
    assert [found[f"car_ap_{name}"] for name in ("near", "middle", "far")] == [1, 0, 1]
    assert [found[f"car_objects_{name}"] for name in ("near", "middle", "far", "visible", "largely")] == [1, 1, 1, 2, 1]
    # the false one at 31 m stands before the hidden car, and is one of two to the visible ones
    assert (found["car_ap_visible"], found["car_ap_largely"]) == (0.5, 0.5)
    assert found["car_iou_middle"] == pytest.approx(0.6, abs=1e-5)
    assert "car_ap_partly" not in found


def test_ignored_objects_and_frames_without_labels_do_not_count() -> None:
    truth = cars([10.0])
    found = figures(cars([30.0, 10.0], [0.9, 0.8]), truth, cars([30.0]))
    assert found["car_ap_near"] == 1
    metric = BoxQuality(SPEC)
    metric.update(cars([1.0]), Targets())
    assert metric.compute() == {"mean_iou": 0, "mean_recall": 0}


def test_nothing_found() -> None:
    found = figures(cars([]), cars([10.0]))
    assert found["car_recall"] == found["car_ap_near"] == 0
    assert "car_iou" not in found
    assert figures(cars([10.0], [0.5]), cars([])) == {"mean_iou": 0, "mean_recall": 0}
