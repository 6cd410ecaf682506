"""Labels and probabilities from pixels back to points."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from lidarfw.errors import ConfigError, DataError
from lidarfw.types import Frame, FrameMeta, PointLabels, Points, RangeImage, RangeView, Spec, Targets

from lidarfw_dpdc_mos.postprocessors import KnnLabels
from lidarfw_dpdc_mos.transforms import RangeProjection

LABELS = Spec(PointLabels, classes=("static", "moving"))
VIEW = RangeView(8, 16, math.radians(3), math.radians(-25))


def knn(**options: object) -> KnnLabels:
    return KnnLabels(LABELS, Spec(RangeImage, 2, 1, VIEW), Spec(Points, 1), **options)  # type: ignore[arg-type]


def scene(columns: list[tuple[int, float, float]]) -> tuple[PointLabels, RangeImage, Points]:
    """Points (column, range, probability of moving) on row 4 of the view."""
    rows = torch.full((len(columns),), 4.0)
    direction = VIEW.direction(rows, torch.tensor([float(c) for c, _, _ in columns]))
    xyz = direction * torch.tensor([r for _, r, _ in columns])[:, None]
    points = Points.from_scan(xyz, torch.zeros(len(columns), 1))
    frame = Frame({"points": points}, Targets(), FrameMeta("f"))
    project = RangeProjection(height=8, width=16)
    image = project(frame, np.random.default_rng(0)).inputs["range"]
    moving = torch.tensor([p for _, _, p in columns])
    seen = torch.stack([1 - moving, moving], 1)
    return PointLabels(seen, points.batch), image, points


def test_a_hidden_point_takes_what_lies_at_its_distance() -> None:
    """A wall at 10 m behind a moving object at 4 m: the point of the wall in the object's pixel is of the wall."""
    columns = [(3, 10.0, 0.1), (4, 10.1, 0.1), (5, 4.0, 0.9), (6, 10.2, 0.2), (7, 10.1, 0.2), (5, 10.1, 0.9)]
    labels, image, points = scene(columns)
    soft = knn(neighbors=4)(labels, image, points).probability[:, 1]
    # the reference lets the pixel itself count always, so one of the votes on the hidden point is the object's
    assert float(soft[5]) < 0.5
    assert float(soft[0]) < 0.3
    hard = knn(neighbors=5, soft=False)(labels, image, points)
    assert hard.label.tolist() == [0, 0, 1, 0, 0, 0]
    assert set(hard.probability.flatten().tolist()) == {0.0, 1.0}


def test_probabilities_are_means_of_the_accepted() -> None:
    labels, image, points = scene([(4, 10.0, 0.2), (5, 10.0, 0.6), (6, 30.0, 0.9)])
    soft = knn()(labels, image, points)
    assert soft.probability[:, 1].tolist() == pytest.approx([0.4, 0.4, 0.9])
    assert soft.probability.sum(1).tolist() == pytest.approx([1, 1, 1])


def test_the_window_goes_round() -> None:
    labels, image, points = scene([(0, 10.0, 0.2), (15, 10.0, 0.6)])
    assert knn()(labels, image, points).probability[:, 1].tolist() == pytest.approx([0.4, 0.4])


def test_points_outside_the_view_and_empty_scans() -> None:
    labels, image, points = scene([(4, 10.0, 0.2)])
    outside = image.replace(pixel=torch.tensor([-1]))
    assert knn()(labels, outside, points).probability.tolist() == labels.probability.tolist()
    nothing = knn()(labels[:0], image.replace(pixel=image.pixel[:0]), points[:0])
    assert nothing.probability.shape == (0, 2)


def test_errors() -> None:
    labels, image, points = scene([(4, 10.0, 0.2)])
    with pytest.raises(DataError, match="the scan has 0"):
        knn()(labels, image, points[:0])
    with pytest.raises(ConfigError, match="window must be odd"):
        knn(window=4)
