"""tools/mos_transfer.py: figures of sequences that were held out in turn."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
import torch
from lidarfw.errors import LidarfwError
from lidarfw.ops import range_project
from lidarfw.types import FrameMeta, FrameResult, PointLabels, Points, Poses, RangeView

from lidarfw_dpdc_mos.study import Figures, Seen

tool = pytest.importorskip("mos_transfer", reason="the tools are in the repository only")


def seen(moving: list[int], probability: list[float], counts: bool, place: int) -> Seen:
    """A frame of points in a row ahead, a metre apart sideways."""
    xyz = torch.stack([torch.full((len(moving),), 10.0), torch.arange(float(len(moving))), torch.zeros(len(moving))], 1)
    points = Points.from_scan(xyz, torch.zeros(len(moving), 1))
    p = torch.tensor(probability)
    labels = PointLabels(torch.stack([1 - p, p], 1), points.batch)
    result = FrameResult(FrameMeta(str(place), "00", place, 0.1 * place), {"head.seg": labels})
    pose = Poses(torch.eye(4)[None], torch.ones(1, dtype=torch.bool), torch.ones(1))
    result.inputs.update({"points": points, "pose": pose, "range": range_project(points, RangeView(8, 128, 0.3, -0.3))})
    return Seen(result, points, labels, torch.tensor(moving), pose, counts)


def test_only_frames_with_enough_past_count() -> None:
    frames = [seen([1, 0], [0.1, 0.9], False, 0), seen([1, 0, 1], [0.9, 0.1, 0.2], True, 1)]
    flags = tool.judge(frames)
    assert set(flags) == {"", " + filter"}
    assert tool.count(frames, flags[""]).to_plain()["iou"] == 0.5


def test_points_of_all_sequences_are_counted_together() -> None:
    table = {"network": {"00": Figures(right=10), "04": Figures(wrong=10, missed=10)}}
    assert tool.pooled(table["network"].values()).to_plain()["iou"] == pytest.approx(1 / 3)
    header, _, row = tool.markdown(table).splitlines()
    assert header == "| | 00 | 04 | all | precision | recall |"
    assert row == "| network | 100.0 | 0.0 | 33.3 | 50.0 | 50.0 |"


def test_the_picture_tells_right_wrong_and_missed() -> None:
    frame = seen([1, 1, 0, 0, -1], [1, 0, 1, 0, 1], True, 0)
    shown = tool.picture(frame, frame.labels.probability[:, 1] > 0.5)
    colours = {tuple(c) for c in shown.reshape(-1, 3).tolist()}
    assert sum(len(set(c)) > 1 for c in colours) == 3  # blue, orange and green; static and unknown are grey
    assert len(shown) == 8 * 4


def test_the_sequence_held_out_is_not_trained_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[list[str]] = []
    monkeypatch.setattr(subprocess, "run", lambda command, check: calls.append(command))
    checkpoint = tool.finetune("ROOT", Path("town.ckpt"), "04", ["00", "04", "10"], tmp_path / "04", ["optimizer.lr=1"])
    assert checkpoint == tmp_path / "04" / "checkpoints" / "last.ckpt"
    assert {"splits.train=00+10", "splits.test=04", "init={from: town.ckpt}", "optimizer.lr=1"} <= set(calls[0])
    checkpoint.parent.mkdir(parents=True)
    checkpoint.touch()
    tool.finetune("ROOT", Path("town.ckpt"), "04", ["00", "04", "10"], tmp_path / "04", [])
    assert len(calls) == 1


def test_one_sequence_is_not_enough(tmp_path: Path) -> None:
    (tmp_path / "sequences" / "00").mkdir(parents=True)
    with pytest.raises(LidarfwError, match="two are needed"):
        tool.sequences_in(str(tmp_path))
