"""The poses of a run on the map, and the frames of a split as `lidarfw predict` takes them."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from lidarfw import draw
from lidarfw.assembly import build, plan
from lidarfw.checkpoint import describe
from lidarfw.cli import main
from lidarfw.config import compose
from lidarfw.errors import DataError
from lidarfw.predict import Trajectory, read_poses
from lidarfw.testing.synthetic import frames
from lidarfw.types import FrameMeta, FrameResult, Poses, Targets


def circle(count: int = 40) -> Tensor:
    """Poses along a circle of 50 m."""
    angle = torch.arange(count) / count * 2 * math.pi
    matrix = torch.eye(4).repeat(count, 1, 1)
    matrix[:, 0, 3], matrix[:, 1, 3] = 50 * angle.cos(), 50 * angle.sin()
    return matrix


def poses_of(matrix: Tensor, ok: bool = True) -> Poses:
    return Poses(matrix[None], torch.tensor([ok]), torch.ones(1))


def run(known: bool = True) -> Trajectory:
    """Estimates that are off by 0.1, 0.2 ... metres along z; the last was not found."""
    path = Trajectory()
    truth = circle()
    for number, matrix in enumerate(truth):
        estimate = matrix.clone()
        estimate[2, 3] += 0.1 * (number + 1)
        targets = Targets(poses=poses_of(matrix)) if known else None
        found = {"postprocessor.pose": poses_of(estimate, number < len(truth) - 1)}
        path.add(FrameResult(FrameMeta(str(number)), found, None, targets, {}))
    return path


def test_errors_count_what_was_not_found_as_infinite() -> None:
    errors = run().errors()
    assert errors is not None
    torch.testing.assert_close(errors[:-1, 0], 0.1 * torch.arange(1, 40, dtype=torch.float64), atol=1e-5, rtol=0)
    assert errors[-1].isinf().all()
    assert run().summary() == "39 of 40 poses found, median error 2.00 m, 0.00 degrees"


def test_without_truth_there_are_no_errors() -> None:
    path = run(known=False)
    assert path.errors() is None
    assert path.summary() == "39 of 40 poses found"
    assert path.picture().ndim == 3


def test_results_without_a_pose_are_passed_over() -> None:
    path = Trajectory()
    path.add(FrameResult(FrameMeta("0")))
    assert len(path) == 0
    assert path.errors() is None


def test_bad_poses_are_told_from_good_ones_in_the_picture() -> None:
    truth = circle()
    found = Poses(truth.clone(), torch.ones(40, dtype=torch.bool), torch.ones(40))
    found.matrix[3, 0, 3] += 20
    good = draw.trajectory(found.replace(matrix=truth), truth)
    bad = draw.trajectory(found, truth, torch.rand(500, 3) * 100 - 50, "with a map")
    orange = torch.tensor([0xD5, 0x5E, 0x00])

    def lines(picture: draw.Picture) -> int:
        return int(((torch.from_numpy(picture.copy()).int() - orange).abs().sum(2) < 60).sum())

    assert lines(good) == 0
    assert lines(bad) > 50


def test_a_run_without_any_pose_still_draws() -> None:
    found = Poses(circle(3), torch.zeros(3, dtype=torch.bool), torch.zeros(3))
    assert draw.trajectory(found, circle(3)).shape[2] == 3


def test_scans_stand_in_for_the_map() -> None:
    path, frame = Trajectory(), frames(1)[0]
    path.add(FrameResult(frame.meta, {"p": poses_of(circle()[0])}, None, None, dict(frame.inputs)))
    assert path.picture().size > 0


def test_pose_files(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("1 0 0 4 0 1 0 5 0 0 1 6\n" * 2)
    torch.testing.assert_close(read_poses(path, 2)[1, :3, 3], torch.tensor([4.0, 5.0, 6.0], dtype=torch.float64))
    with pytest.raises(DataError, match="2 poses for 3 scans"):
        read_poses(path, 3)


def test_predict_a_split(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    torch.manual_seed(0)
    small = ["head=center_small", "dataset.synthetic.frames=2", "dataset.synthetic.points=1024"]
    wired = plan(compose([*small, "backbone.pillars.cell=[1.28,1.28]"]))
    weights = {f"model.{name}": value for name, value in build(wired).state_dict().items()}
    torch.save({"lidarfw": describe(wired), "state_dict": weights}, tmp_path / "m.ckpt")
    common = ["predict", str(tmp_path / "m.ckpt"), "-o", str(tmp_path / "out")]
    assert main([*common, "--split", "val", "--no-pictures"]) == 0
    assert len(list((tmp_path / "out").glob("*.json"))) == 2
    assert main(common) != 0
    assert "scans or --split" in capsys.readouterr().err
