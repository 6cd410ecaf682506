"""Metric task_features: what the contrastive losses change."""

from __future__ import annotations

import pytest
import torch
from lidarfw.assembly import build, plan
from lidarfw.config import compose
from lidarfw.errors import ConfigError
from lidarfw.testing.synthetic import SyntheticDataset
from lidarfw.types import BEV, Boxes, Grid, Points, Spec, Targets, collate, take

from lidarfw_taco.metrics.motion_ap import MotionAP
from lidarfw_taco.metrics.task_features import TaskFeatures, neighbors

GRID = Grid((0.0, 0.0, -2.0), (8.0, 8.0, 2.0), (1.0, 1.0, 1.0))
SPEC = Spec(BEV, 2, 1, GRID)


def bev(*samples: dict[tuple[int, int], list[float]]) -> BEV:
    features = torch.zeros(len(samples), 2, 8, 8)
    for number, cells in enumerate(samples):
        for (column, row), vector in cells.items():
            features[number, :, row, column] = torch.tensor(vector)
    return BEV(features, GRID)


def boxes(*rows: tuple[float, float, int, int]) -> Boxes:
    """At x, y, of class and motion state."""
    tensor = torch.tensor([[x, y, 0.0, 0.9, 0.9, 1.5, 0.0] for x, y, _, _ in rows]).view(-1, 7)
    made = Boxes.from_tensor(tensor, torch.tensor([label for *_, label, _ in rows], dtype=torch.long))
    return made.replace(moving=torch.tensor([state for *_, state in rows], dtype=torch.int8))


def figures(*frames: tuple[BEV, BEV, Boxes | None], top: int = 2) -> dict[str, float]:
    metric = TaskFeatures(SPEC, SPEC, top=top)
    for detection, localization, found in frames:
        metric.update(detection, localization, Targets(found))
    return metric.compute()


@pytest.mark.filterwarnings("ignore:The ``compute`` method")
def test_golden():
    detection = bev({(1, 1): [1, 0], (3, 3): [0, 1]})
    # the strongest two: a parked car's cell, and one elsewhere; outside of objects: (6, 6) and (7, 7)
    localization = bev({(3, 3): [9, 0], (6, 6): [3, 4], (7, 7): [1, 0]})
    found = figures((detection, localization, boxes((1.5, 1.5, 0, 1), (3.5, 3.5, 0, 0))))
    assert found["cross_task_cosine"] == pytest.approx((0.6 + 0.8 + 1 + 0) / 4)
    assert found["parked_cosine"] == pytest.approx((0.6 + 1) / 2)
    assert found["parked_share"] == pytest.approx(0.5)
    assert found["parked_area"] == pytest.approx(1 / 3)
    assert found["frames"] == 1
    without = figures((detection, localization, None), (detection, localization, boxes()))
    assert without.pop("parked_area") == 0
    assert set(without.values()) == {0}


def test_neighbors_count_only_where_there_is_a_choice():
    moving = [([1.0, 0.0], 0, 1), ([0.0, 1.0], 1, 1)]
    static = [([0.9, 0.1], 0, 0)]
    vectors, labels, states = (torch.tensor(column) for column in zip(*(*moving, *static), strict=True))
    batch = torch.zeros(3, dtype=torch.long)
    # the static car chooses between the moving car (nearest) and the moving pedestrian; the others have no choice
    assert [int(v) for v in neighbors(vectors, labels, states, batch)] == [1, 1]
    assert [int(v) for v in neighbors(vectors.flip(1), labels, states, batch)] == [1, 1]
    assert [int(v) for v in neighbors(vectors[[1, 0, 2]], labels, states, batch)] == [0, 1]
    assert [int(v) for v in neighbors(vectors, labels, torch.tensor([1, -1, 0]), batch)] == [0, 0]


def test_frames_and_batches_count_alike():
    generator = torch.Generator().manual_seed(0)
    maps = [BEV(torch.rand(3, 2, 8, 8, generator=generator), GRID) for _ in range(2)]
    rows = [boxes((1.5, 2.5, 0, 1), (3.5, 3.5, 1, 0), (5.5, 6.5, 0, 0)) for _ in range(3)]
    batched = figures((*maps, Boxes.cat(rows, as_batch=True)), top=8)
    alone = figures(*((take(maps[0], i), take(maps[1], i), rows[i]) for i in range(3)), top=8)
    assert batched == pytest.approx(alone)
    assert batched["frames"] == 3


def test_a_metric_may_ask_for_the_taps_of_heads():
    """In an evaluation each frame carries the taps that its metrics ask for, and no others."""
    overrides = [
        "dataset.synthetic.frames=4", "dataset.synthetic.pose=true", "backbone=pillars_small", "neck=bev_fpn_small",
        "head=[center,scene_coord_bev]", "head.center.channels=16", "head.scene_coord_bev.tap_channels=16",
        "head.scene_coord_bev.hidden=16", "metric=[box_ap,task_features]",
    ]  # fmt: skip
    model = build(plan(compose(overrides))).eval()
    dataset = SyntheticDataset(frames=3, sequence_length=3, pose=True, points=2048)
    with torch.no_grad():
        results = model.predict(collate([dataset[index] for index in range(3)]))
    assert set(results[0].taps) == {"head.center", "head.scene_coord_bev"}
    assert results[2].taps["head.center"].features.shape[0] == 1
    model.update_metrics(results)
    found = model.compute_metrics()
    assert found["task_features/frames"] > 0
    assert 0 < found["task_features/cross_task_cosine"] <= 1
    plain = build(plan(compose([*overrides[:-1], "metric=box_ap"]))).eval()
    with torch.no_grad():
        assert plain.predict(collate([dataset[0]]))[0].taps == {}


@pytest.mark.parametrize(
    ("loss", "figure", "falls"),
    [("itcl", "cross_task_cosine", True), ("idcl", "neighbor_accuracy", False), ("ilcl", "parked_cosine", True)],
)
def test_each_loss_moves_its_figure(loss, figure, falls):
    """A few steps on the same frames, from the same weights, with a loss alone: its figure goes where it should."""
    torch.manual_seed(0)
    overrides = [
        "dataset.synthetic.frames=6", "dataset.synthetic.pose=true", "backbone=pillars_small", "neck=bev_fpn_small",
        "head=[center,scene_coord_bev]", "head.center.channels=16", "head.scene_coord_bev.tap_channels=16",
        "head.scene_coord_bev.hidden=16", "metric=[task_features,box_ap]", "metric.task_features.top=32",
        f"loss=[{loss}]", "backbone.pillars.cell=[0.8,0.8]",
    ]  # fmt: skip
    model = build(plan(compose(overrides)))
    dataset = SyntheticDataset(frames=6, sequence_length=6, pose=True, points=2048)
    batch = collate([dataset[0], dataset[3]])
    before, optimizer = _figure(model, batch, figure), torch.optim.Adam(model.parameters(), lr=1e-2)
    for _ in range(8):
        optimizer.zero_grad()
        torch.stack(list(model.train().losses(model(batch), batch)[loss].values())).sum().backward()
        optimizer.step()
    after = _figure(model, batch, figure)
    assert after < 0.7 * before if falls else after > before


def _figure(model, batch, figure: str) -> float:
    model.reset_metrics()
    with torch.no_grad():
        model.eval().update_metrics(model.predict(batch))
    return model.compute_metrics()[f"task_features/{figure}"]


# average precision by motion state


def test_precision_of_moving_and_of_static_objects() -> None:
    """Of two parked cars one is found, of two moving ones both; a false detection counts for either."""
    truth = boxes((1, 1, 0, 0), (1, 5, 0, 0), (5, 1, 0, 1), (5, 5, 0, 1), (7, 7, 0, -1))
    found = boxes((1, 1, 0, 0), (5, 1, 0, 0), (5, 5, 0, 0), (3, 3, 0, 0), (7, 7, 0, 0)).replace(moving=None)
    found = found.replace(score=torch.tensor([0.9, 0.8, 0.7, 0.6, 0.95]))
    metric = MotionAP(Spec(Boxes, classes=("Car", "Pedestrian")), iou={"Car": 0.5})
    metric.update(found, Targets(truth))
    figures = metric.compute()
    assert figures["moving_car_3d_ap"] == pytest.approx(1.0)
    assert figures["static_car_3d_ap"] == pytest.approx(0.5)
    assert "moving_pedestrian_3d_ap" not in figures  # there is none
    ignored = Targets(truth, ignored=boxes((3, 3, -1, 0)))
    metric.reset()
    metric.update(found, ignored)
    assert metric.compute()["static_car_3d_ap"] == pytest.approx(0.5)


def test_precision_by_motion_leaves_out_what_the_sensor_did_not_see() -> None:
    """Only one of two parked cars has a point, and it is found."""
    truth = boxes((1, 1, 0, 0), (1, 5, 0, 0))
    metric = MotionAP(Spec(Boxes, classes=("Car",)), Spec(Points), min_points=1)
    points = Points.from_scan(truth.center[:1], torch.zeros(1, 0))
    metric.update(truth[:1].replace(score=torch.tensor([0.9])), Targets(truth), points)
    assert metric.compute()["static_car_3d_ap"] == 1.0


def test_precision_by_motion_needs_motion() -> None:
    metric = MotionAP(Spec(Boxes, classes=("Car",)))
    metric.update(Boxes.empty(), Targets(Boxes.empty()))
    assert metric.compute()["mean_3d_ap"] == 0
    with pytest.raises(ConfigError, match="what moves"):
        metric.update(Boxes.empty(), Targets(boxes((1, 1, 0, 0)).replace(moving=None)))
    with pytest.raises(ConfigError, match="Truck"):
        MotionAP(Spec(Boxes, classes=("Car",)), iou={"Truck": 0.5})
