"""Metrics `mean_iou` and `mos_iou`."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lidarfw.components.metrics.point_iou import MeanIoU, MosIoU, confusion
from lidarfw.errors import ConfigError, DataError
from lidarfw.types import PointLabels, Spec, Targets

pytestmark = pytest.mark.filterwarnings("ignore:The ``compute`` method of metric")
CLASSES = ("Car", "Traffic sign", "Road")
SPEC = Spec(PointLabels, classes=CLASSES)


def labels_of(label: list[int], classes: int = 3) -> PointLabels:
    """-1 = unlabelled."""
    index = torch.tensor(label, dtype=torch.long)
    table = torch.eye(classes + 1)[:, :classes]
    return PointLabels(table[index], torch.zeros_like(index))


def figures(metric: MeanIoU | MosIoU, *frames: tuple[list[int], list[int]], classes: int = 3) -> dict[str, float]:
    for predicted, truth in frames:
        metric.update(labels_of(predicted, classes), Targets(points=labels_of(truth, classes)))
    return metric.compute()


def test_golden() -> None:
    """Car: 2 right of 3 labelled and 3 predicted: 2 / 4. Sign: 1 / 2. Road: missed, 0 / 1."""
    found = figures(MeanIoU(SPEC), ([0, 0, 1, 0, 1, -1], [0, 0, 0, 1, 1, 2]))
    assert found == pytest.approx(
        {"car_iou": 2 / 4, "traffic_sign_iou": 1 / 3, "road_iou": 0, "mean_iou": (1 / 2 + 1 / 3) / 3, "accuracy": 3 / 6}
    )


def test_all_frames_count_together() -> None:
    """1 of 1 and 1 of 3 points are 2 / 4, not the mean of the frames' figures."""
    found = figures(MeanIoU(SPEC), ([0], [0]), ([0, 1, 1], [0, 0, 0]))
    assert found["car_iou"] == 2 / 4
    assert found["accuracy"] == 2 / 4


def test_points_without_label_do_not_count() -> None:
    found = figures(MeanIoU(SPEC), ([0, 1, 2, 0], [0, -1, -1, -1]))
    assert found == {"car_iou": 1, "mean_iou": 1, "accuracy": 1}


def test_nothing_is_finite() -> None:
    zero = {"mean_iou": 0, "accuracy": 0}
    assert figures(MeanIoU(SPEC)) == zero
    assert figures(MeanIoU(SPEC), ([], [])) == zero
    assert figures(MeanIoU(SPEC), ([0, 1], [-1, -1])) == zero
    metric = MeanIoU(SPEC)
    metric.update(labels_of([0]), Targets())
    assert metric.compute() == zero
    binary = Spec(PointLabels, classes=("static", "moving"))
    assert figures(MosIoU(binary)) == {"iou": 0, "precision": 0, "recall": 0}
    assert figures(MosIoU(binary), ([0, 0], [0, 0]), classes=2) == {"iou": 0, "precision": 0, "recall": 0}


def test_moving_golden() -> None:
    """3 moving points, 2 found, 2 false ones, of which one is not labelled: 2 / (3 + 3 - 2)."""
    spec = Spec(PointLabels, classes=("static", "moving"))
    found = figures(MosIoU(spec), ([1, 1, 0, 1, 1, 0], [1, 1, 1, 0, -1, 0]), classes=2)
    assert found == pytest.approx({"iou": 2 / 4, "precision": 2 / 3, "recall": 2 / 3})
    # a class of another name, at another place
    found = figures(MosIoU(SPEC, moving="Car"), ([0, 0, 1], [0, 1, 0]))
    assert found["iou"] == pytest.approx(1 / 3)


def test_user_errors() -> None:
    with pytest.raises(ConfigError, match="moving names the class 'moving'"):
        MosIoU(SPEC)
    with pytest.raises(DataError, match="2 points are predicted, 3 labelled"):
        figures(MeanIoU(SPEC), ([0, 0], [0, 0, 0]))


@pytest.mark.parametrize("seed", range(3))
def test_equals_plain_loops(seed: int) -> None:
    random = np.random.RandomState(seed)
    frames = [(random.randint(-1, 3, 50).tolist(), random.randint(-1, 3, 50).tolist()) for _ in range(4)]
    pairs = [(p, t) for predicted, truth in frames for p, t in zip(predicted, truth, strict=True) if t >= 0]
    found = figures(MeanIoU(SPEC), *frames)
    for label, name in enumerate(("car", "traffic_sign", "road")):
        both = sum(p == t == label for p, t in pairs)
        either = sum(label in (p, t) for p, t in pairs)
        assert found[f"{name}_iou"] == pytest.approx(both / either)
    moving = figures(MosIoU(SPEC, moving="Road"), *frames)
    assert moving["iou"] == pytest.approx(found["road_iou"])
    counts = confusion(torch.tensor([t for _, t in pairs]), torch.tensor([p for p, _ in pairs]), 3)
    assert counts.sum() == len(pairs)


def test_reset() -> None:
    metric = MeanIoU(SPEC)
    first = figures(metric, ([0, 1, 1], [0, 0, 1]))
    metric.reset()
    assert metric.compute() == {"mean_iou": 0, "accuracy": 0}
    assert figures(metric, ([0, 1, 1], [0, 0, 1])) == first
