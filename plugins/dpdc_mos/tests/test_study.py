"""Figures of moving points, the study of the filter and its baselines."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from lidarfw.assembly import build, plan
from lidarfw.checkpoint import describe
from lidarfw.components.datasets.semantic_kitti import SemanticKittiDataset
from lidarfw.components.metrics.point_iou import MosIoU
from lidarfw.config import compose
from lidarfw.errors import DataError
from lidarfw.ops import range_project
from lidarfw.types import (
    DataSpec,
    FrameMeta,
    FrameResult,
    PointLabels,
    Points,
    Poses,
    RangeImage,
    RangeView,
    Spec,
    Targets,
)

from lidarfw_dpdc_mos.metrics import MosDetail
from lidarfw_dpdc_mos.study import Seen, figures, fit_prior, main, markdown, matched_threshold, predictions, study
from lidarfw_dpdc_mos.transforms import RangeProjection

LABELS = Spec(PointLabels, classes=("static", "moving"))
VIEW = RangeView(16, 128, math.radians(10), math.radians(-10))


SMALL = [
    "experiment=mos_finetune", "~dataset.town_mos", "dataset.semantic_kitti.root=nowhere",
    "dataset.semantic_kitti.task=moving", "dataset.semantic_kitti.sweeps=5", "dataset.semantic_kitti.pose=true",
    "backbone.dpdc.stem=8", "backbone.dpdc.widths=[16,16,16]",
    "transform.range_projection.height=16", "transform.range_projection.width=128",
]  # fmt: skip


def one_hot(label: list[int], instance: list[int] | None = None) -> PointLabels:
    probability = (torch.tensor(label)[:, None] == torch.arange(2)).float()
    number = None if instance is None else torch.tensor(instance)
    return PointLabels(probability.view(-1, 2), torch.zeros(len(label), dtype=torch.long), 1, number)


def test_iou_is_of_all_points_of_all_frames() -> None:
    """TP 30, FP 10, FN 20 give 0.5; two frames (10, 0, 0) and (0, 10, 10) give 1/3, not the mean of the frames."""
    for parts, expected in (([(30, 10, 20)], 0.5), ([(10, 0, 0), (0, 10, 10)], 1 / 3)):
        metric = MosIoU(LABELS)
        for right, wrong, missed in parts:
            truth = [1] * right + [0] * wrong + [1] * missed
            found = [1] * right + [1] * wrong + [0] * missed
            metric.update(one_hot(found), Targets(points=one_hot(truth)))
        assert metric.compute()["iou"] == pytest.approx(expected)


def test_parts_of_the_figure() -> None:
    metric = MosDetail(LABELS, Spec(Points, 1), DataSpec())
    xyz = torch.tensor([[10.0, 0, 0], [0, 10, 0], [-40, 0, 0], [0, -50, 0], [20, 20, 0], [0, 29, 0]])
    points = Points.from_scan(xyz, torch.zeros(6, 1))
    truth = one_hot([1, 1, 1, 1, -1, 0], [1, 1, 2, 2, 0, 0])
    metric.update(one_hot([1, 0, 0, 0, 1, 1]), points, Targets(points=truth))
    found = metric.compute()
    assert found["iou"] == pytest.approx(1 / 5)
    assert found["near_iou"] == pytest.approx(1 / 3)
    assert found["far_iou"] == 0
    assert found["object_recall"] == 0.5  # half of object 1 is found, nothing of object 2
    metric.reset()
    metric.update(one_hot([]), points[:0], Targets(points=one_hot([])))
    assert set(metric.compute().values()) == {0.0}


def test_the_edge_counts_by_itself() -> None:
    """A block of pixels found one column too far: wrong at its edges, right within."""
    rows, columns = torch.meshgrid(torch.arange(16), torch.arange(128), indexing="ij")
    xyz = VIEW.direction(rows.flatten().float(), columns.flatten().float()) * 10
    points = Points.from_scan(xyz, torch.zeros(len(xyz), 1))
    data = DataSpec({"range": Spec(RangeImage, 2, 1, VIEW)})
    inside = ((columns >= 40) & (columns < 60)).flatten()
    shifted = ((columns >= 41) & (columns < 61)).flatten()
    metric = MosDetail(LABELS, Spec(Points, 1), data)
    metric.update(one_hot(shifted.long().tolist()), points, Targets(points=one_hot(inside.long().tolist())))
    found = metric.compute()
    assert found["iou"] == pytest.approx(19 / 21)
    # columns 38..41 and 58..61 lie within two of the edge: true 40, 41, 58, 59, found 41, 58, 59, 60
    assert found["boundary_iou"] == pytest.approx(3 / 5)


def frames(count: int = 6, noise: float = 1.0) -> list[Seen]:
    """A wall, and a block that moves sideways; the network is right on average, with noise of each frame its own."""
    generator = torch.Generator().manual_seed(0)
    found = []
    rows, columns = torch.meshgrid(torch.arange(16), torch.arange(128), indexing="ij")
    direction = VIEW.direction(rows.flatten().float(), columns.flatten().float())
    for index in range(count):
        moves = ((columns >= 20 + index) & (columns < 30 + index) & (rows > 5)).flatten()
        xyz = direction * torch.where(moves, 8.0, 20.0)[:, None]
        points = Points.from_scan(xyz, torch.zeros(len(xyz), 1))
        logit = torch.where(moves, 1.2, -3.0) + noise * torch.randn(len(xyz), generator=generator)
        moving = torch.sigmoid(logit)
        labels = PointLabels(torch.stack([1 - moving, moving], 1), points.batch)
        pose = Poses(torch.eye(4)[None], torch.ones(1, dtype=torch.bool), torch.ones(1))
        image = range_project(points, VIEW)
        residual = image.features[:, :1] * 0 + (image.features[:, :1] < 10) * 0.2
        image = image.replace(features=torch.cat([image.features, residual], 1))
        result = FrameResult(FrameMeta(str(index), "s", index, 0.1 * index), {"head.seg": labels})
        result.inputs.update({"points": points, "range": image, "pose": pose})
        found.append(Seen(result, points, labels, moves.long(), pose))
    return found


def test_thresholds_that_match_a_prior() -> None:
    for window, expected in ((1, 0.5), (2, 0.366), (5, 0.293), (10, 0.271)):
        assert matched_threshold(0.25, window) == pytest.approx(expected, abs=1e-3)
    assert matched_threshold(0.5, 7) == 0.5


def test_the_study_of_a_made_up_network() -> None:
    """Noise that is new in every frame: the filter takes out much of it, and of the flicker."""
    seen = frames(noise=1.8)
    table = study(seen, fit_prior(seen))
    alone, filtered = table["no filter"], table["window 2, prior 0.5"]
    assert filtered["iou"] > alone["iou"] + 0.05
    assert filtered["flicker"] < alone["flicker"]
    matched = table["no filter, threshold 0.366"]
    assert matched["recall"] > alone["recall"]
    right = [frame.truth == 1 for frame in seen]
    seen[0].counts = False  # a frame that was all wrong
    assert figures(seen, [~right[0], *right[1:]])["iou"] == 1
    seen[0].counts = True
    assert math.isnan(figures(seen[:1], [torch.zeros(2048, dtype=torch.bool)])["flicker"])
    assert "| no filter |" in markdown(table)


def test_a_prior_that_depends_on_the_point() -> None:
    """Points that move lie at 8 m, the others at 20 m: the fitted log-odds fall with the range."""
    a, b, c = fit_prior(frames(2))
    near, far = (a + b * math.log(r) for r in (8, 20))
    assert near > 0 > far
    assert b < 0
    assert math.isfinite(c)


def test_transforms_know_the_dataset_before_frames_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    monkeypatch.setattr(RangeProjection, "prepare", lambda *_: calls.append("prepare"))
    monkeypatch.setattr(RangeProjection, "attach", lambda *_: calls.append("attach"))
    config = compose(SMALL)
    wired = plan(config)
    weights = {f"model.{name}": value for name, value in build(wired).state_dict().items()}
    torch.save({"lidarfw": describe(wired), "state_dict": weights}, tmp_path / "mos.ckpt")
    monkeypatch.setattr(SemanticKittiDataset, "prepare", lambda *_: calls.append("dataset"))
    with pytest.raises(DataError):
        next(predictions(tmp_path / "mos.ckpt", []))
    assert calls == ["dataset", "prepare", "attach"]


def test_the_command_says_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path / "no.ckpt")]) == 2
    assert "no.ckpt" in capsys.readouterr().err
